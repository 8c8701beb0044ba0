"""Tests of finding the subject of a scene: the object on the ground, without floaters."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from progdf.demo_scenes import DemoScene
from progdf.formats.ply import load_ply
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.scene.bounds import front_direction, is_surrounding
from progdf.scene.orbit_rig import detailed_side
from progdf.scene.subject import fit_eye, is_room, room_viewpoint, subject_rows
from progdf.scene.up_axis import AXES, axis_direction, guess_up
from tests.helpers.demo_scenes import bear, room
from tests.helpers.paths import SHARED_DATA
from tests.helpers.scenes import high_chair, random_gaussians, turned
from viewer.camera.view_camera import FILL, Vec3, first_camera, fit, to_camera

DATA = SHARED_DATA
UP = torch.tensor([0.0, 1.0, 0.0])
FIGURE = ("body", "head", "ears", "arms", "legs", "scarf", "plinth")


@pytest.fixture(scope="module")
def demo() -> DemoScene:
    return bear(6000)


def joined(*scenes: Gaussians) -> Gaussians:
    return Gaussians(**{name: torch.cat([getattr(scene, name) for scene in scenes]) for name in ATTRIBUTES})


def shell(like: Gaussians, count: int, nearest: float, farthest: float, size: float) -> Gaussians:
    """Return Gaussians all around, above the ground, between two distances."""
    shape = like.shN.shape[1]
    found = replace(random_gaussians(count, seed=3), shN=torch.zeros(count, shape, 3))
    away = torch.nn.functional.normalize(found.means, dim=1) * torch.tensor([1.0, 0.0, 1.0]) + UP
    far = torch.linspace(nearest, farthest, count)[:, None]
    return replace(
        found,
        means=torch.nn.functional.normalize(away * torch.rand(count, 1).add(0.2), dim=1) * far,
        log_scales=torch.full((count, 3), math.log(size)),
        logit_opacities=torch.full((count,), 2.0),
    )


def agreement(rows: Tensor, wanted: Tensor) -> float:
    """Return the intersection over union of two sets of rows."""
    both = len(np.intersect1d(rows.numpy(), wanted.numpy()))
    return both / (len(rows) + len(wanted) - both)


def spans(scene: Gaussians, rows: Tensor, width: int = 600, height: int = 400) -> tuple[float, float]:
    """Return the share of width and height that these rows span in the first picture of the scene."""
    camera = to_camera(first_camera(scene, aspect=width / height), width, height)
    seen = scene.means[rows] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    assert bool((seen[:, 2] > 0).all())
    x, y = (seen[:, :2] / seen[:, 2:] * camera.K[0, 0] + camera.K[:2, 2]).unbind(1)
    for along, side in ((x, width), (y, height)):
        assert float((along - 0.5 * side).abs().max()) <= 0.5 * side
    return float(x.max() - x.min()) / width, float(y.max() - y.min()) / height


def test_subject_is_the_bear_and_its_plinth_without_the_lawn(demo: DemoScene) -> None:
    rows = subject_rows(demo.gaussians, UP)
    assert agreement(rows, demo.members(*FIGURE)) > 0.9


def test_tilted_ground_is_a_ground(demo: DemoScene) -> None:
    angle = math.radians(15)
    turn = torch.tensor(
        [[1, 0, 0], [0, math.cos(angle), -math.sin(angle)], [0, math.sin(angle), math.cos(angle)]]
    )
    rows = subject_rows(replace(demo.gaussians, means=demo.gaussians.means @ turn.T), UP)
    assert agreement(rows, demo.members(*FIGURE)) > 0.9


def test_sky_and_floaters_are_not_the_subject(demo: DemoScene) -> None:
    scene = demo.gaussians
    around = joined(scene, shell(scene, 2500, 20.0, 60.0, 1.5), shell(scene, 100, 3.0, 8.0, 0.02))
    assert agreement(subject_rows(around, UP), demo.members(*FIGURE)) > 0.9
    assert not is_room(around, UP), "a sky is no ceiling"


@pytest.mark.parametrize("factor", [1e-3, 1e4])
def test_subject_does_not_depend_on_the_unit_of_length(demo: DemoScene, factor: float) -> None:
    scene = demo.gaussians
    scaled = replace(scene, means=factor * scene.means, log_scales=scene.log_scales + math.log(factor))
    assert agreement(subject_rows(scaled, UP), subject_rows(scene, UP)) > 0.999


def test_everything_is_the_subject_without_a_ground(demo: DemoScene) -> None:
    alone = demo.gaussians[demo.members(*FIGURE[:-1])]
    assert len(subject_rows(alone, UP)) > 0.99 * int((alone.opacities > 0.1).sum())


def test_bare_ground_is_the_subject(demo: DemoScene) -> None:
    lawn = demo.gaussians[demo.members("grass")]
    assert len(subject_rows(lawn, UP)) > 0.95 * int((lawn.opacities > 0.1).sum())


@pytest.mark.parametrize("count", [1, 2, 7, 63, 64, 65])
def test_few_gaussians_have_a_subject(count: int) -> None:
    rows = subject_rows(random_gaussians(count), UP)
    assert 1 <= len(rows) <= count


def test_subject_fills_two_thirds_of_the_first_picture(demo: DemoScene) -> None:
    width, height = spans(demo.gaussians, demo.members(*FIGURE))
    assert 0.6 < max(width, height) < 0.8


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the shared scenes")
@pytest.mark.parametrize("name", ["playbot_8k", "playbot_31k", "playbot_125k"])
def test_trained_robot_fills_the_first_picture_without_the_ground(name: str) -> None:
    scene = load_ply(DATA / f"{name}.ply")
    robot = torch.from_numpy(np.load(DATA / f"{name}_labels.npy")).bool().nonzero()[:, 0]
    rows = torch.zeros(len(scene), dtype=torch.bool)
    rows[subject_rows(scene, guess_up(scene))] = True
    taken = max(1, -(-len(scene) // 60_000))
    assert int(rows[robot].sum()) > 0.9 * len(robot) / taken
    rows[robot] = False
    assert int(rows.sum()) < 0.1 * len(robot) / taken
    assert 0.6 < max(spans(scene, robot)) < 0.8


def test_eye_is_as_close_as_possible() -> None:
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3) * torch.tensor([3.0, 1.0, 2.0])
    eye = fit_eye(corners, 0.0, torch.eye(3), (0.5, 0.5))
    torch.testing.assert_close(eye, torch.tensor([0.0, 0.0, 8.0], dtype=torch.float64))
    shown = corners.double() - eye
    assert float((shown[:, :2].abs().amax(dim=1) / -shown[:, 2]).max()) == pytest.approx(0.5)


def test_single_gaussian_fills_the_picture_by_its_size() -> None:
    scene = random_gaussians(1)
    camera = first_camera(scene, aspect=1.0)
    half = math.atan(2 * float(scene.scales.max()) / camera.distance)
    assert half == pytest.approx(math.atan(FILL * math.tan(math.radians(22.5))), rel=0.1)


def test_fit_keeps_the_direction_and_the_lens(demo: DemoScene) -> None:
    first = replace(first_camera(demo.gaussians), azimuth=80.0, elevation=-10.0, fov_y=30.0)
    scarf = fit(first, demo.gaussians[demo.members("scarf")], 1.5)
    assert (scarf.azimuth, scarf.elevation, scarf.fov_y, scarf.up) == (80.0, -10.0, 30.0, first.up)
    assert scarf.distance < first.distance


def test_room_opens_from_inside_without_obstacles() -> None:
    demo = room(4000)
    assert is_room(demo.gaussians, UP)
    eye, target = room_viewpoint(demo.gaussians, UP)
    assert float(eye[[0, 2]].abs().max()) < 1.9, "within its walls"
    assert 0.8 < float(eye[1]) < 2.2, "between its floor and its ceiling"
    assert float((target - eye).norm()) > 1.0
    nearest = float((demo.gaussians.means - eye).norm(dim=1).min())
    assert nearest > 0.3, "with nothing in one's face"
    assert first_camera(demo.gaussians).fov_y == 60.0


def test_bear_under_a_sky_is_no_room(demo: DemoScene) -> None:
    assert not is_room(demo.gaussians, UP)


def seen_in_first_picture(scene: Gaussians, size: float = 1.0, up: Vec3 | None = None) -> Tensor:
    """Return the positions of all Gaussians in the first picture's axes, in units of `size`. [N,3]"""
    camera = to_camera(first_camera(scene, up=up), 600, 400)
    return (scene.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) / size


@pytest.mark.parametrize("up", AXES)
def test_scene_opens_the_same_in_any_orientation(up: str) -> None:
    scene = high_chair()
    front = front_direction(axis_direction(up))
    side = torch.linalg.cross(axis_direction(up), front)
    lying = turned(scene, torch.stack([side, axis_direction(up), front], dim=1))
    torch.testing.assert_close(seen_in_first_picture(lying), seen_in_first_picture(scene), atol=0.02, rtol=0)


@pytest.mark.parametrize(("factor", "moved"), [(1e-3, 0.0), (1e3, 0.0), (1.0, 100.0)])
def test_scaled_or_moved_scene_opens_the_same(factor: float, moved: float) -> None:
    scene = high_chair()
    other = replace(scene, means=factor * scene.means + moved, log_scales=scene.log_scales + math.log(factor))
    expected = seen_in_first_picture(scene)
    torch.testing.assert_close(seen_in_first_picture(other, factor), expected, atol=0.01, rtol=0)


def test_strays_do_not_move_the_first_view() -> None:
    scene = high_chair()
    strays = shell(scene, 40, 8.0, 40.0, 0.5)
    strays = replace(strays, logit_opacities=torch.full((40,), -1.0), shN=scene.shN[:40])
    y_up = (0.0, 1.0, 0.0)
    seen = seen_in_first_picture(joined(scene, strays), up=y_up)[: len(scene)]
    torch.testing.assert_close(seen, seen_in_first_picture(scene, up=y_up), atol=0.05, rtol=0)


def guitar(count: int = 4000) -> Gaussians:
    """Return a body of most of the Gaussians, and a neck five times as long, y up."""
    draw = np.random.default_rng(2)
    means = draw.normal(0.0, 0.1, (count, 3))
    neck = np.arange(count) % 8 == 0
    means[neck] *= 0.1
    means[neck, 1] += draw.uniform(0.0, 1.0, int(neck.sum()))
    small = random_gaussians(count, seed=2, scale=0.01)
    return replace(small, means=torch.from_numpy(means).float(), logit_opacities=torch.full((count,), 2.0))


@pytest.mark.parametrize("make", [guitar, high_chair])
def test_core_is_in_the_first_picture_with_a_margin(make: Callable[[], Gaussians]) -> None:
    scene = make()
    camera = to_camera(first_camera(scene, up=(0.0, 1.0, 0.0)), 600, 400)
    seen = scene.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    across = (seen[:, :2] / seen[:, 2:] * camera.K.diagonal()[:2] / camera.K[:2, 2]).abs()
    assert float((across.amax(dim=1) < 0.9).float().mean()) > 0.999, "5 % of each side are free"


def test_head_is_no_room() -> None:
    scene = random_gaussians(6000, seed=1, scale=0.005)
    inside = torch.from_numpy(np.random.default_rng(1).uniform(-0.5, 0.5, (6000, 3))).float()
    head = replace(scene, means=inside * torch.tensor([0.28, 0.38, 0.15]))
    assert not is_room(head, UP)
    assert not is_surrounding(head, UP)


@pytest.mark.parametrize("open_side", [1.0, -1.0])
def test_alcove_opens_from_its_open_side(open_side: float) -> None:
    draw = np.random.default_rng(0)
    spots = torch.from_numpy(draw.uniform(-0.5, 0.5, (6000, 3))).float()
    side = torch.arange(6000) % 7
    for face, (axis, place) in enumerate([(0, -0.5), (0, 0.5), (1, -0.5), (2, -0.5 * open_side)]):
        spots[side == face, axis] = place
    shelves = side > 3  # along the back wall
    spots[shelves, 2] = (0.05 * (20 * spots[shelves, 1]).sin() - 0.3) * open_side
    scene = replace(random_gaussians(6000, scale=0.02), means=spots, logit_opacities=torch.full((6000,), 2.0))
    camera = first_camera(scene, up=(0.0, 1.0, 0.0))
    assert math.cos(math.radians(camera.azimuth)) * open_side > 0.3


@pytest.mark.parametrize(("painted", "azimuth"), [(1.0, 90.0), (-1.0, -90.0), (0.0, 20.0)])
def test_painted_side_of_a_plain_box_is_its_first_view(painted: float, azimuth: float) -> None:
    draw = np.random.default_rng(0)
    spots = torch.from_numpy(draw.uniform(-0.5, 0.5, (6000, 3))).float()
    faces = torch.arange(6000) % 6
    for face in range(6):
        spots[faces == face, face // 2] = (-0.5, 0.5)[face % 2]
    plain = random_gaussians(6000, scale=0.02)
    on_side = (spots[:, 0] == 0.5 * painted)[:, None]
    colors = torch.where(on_side, plain.sh0, torch.zeros(3))
    bands = torch.zeros_like(plain.shN)
    scene = replace(plain, means=spots, sh0=colors, shN=bands, logit_opacities=torch.full((6000,), 2.0))
    assert abs(20.0 + detailed_side(scene, UP, 20.0, 15.0) - azimuth) <= 45.0 * abs(painted)
