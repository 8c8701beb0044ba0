"""Selecting the subject of a view: its rim, supports, hovering parts, other views, and scenes without one."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from progdf.camera import Camera, intrinsics, look_at
from progdf.demo_scenes.bear import bear
from progdf.demo_scenes.room import room
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians, concatenate
from progdf.scene.neighbors import Neighborhood
from progdf.scene.regions import check_region, parse_region
from progdf.scene.subject import first_view, select_subject
from progdf.sh import rgb_to_sh0
from tests.helpers.scenes import random_gaussians

UP = torch.tensor([0.0, 1.0, 0.0])
SIZE = (160, 120)


def overlap(found: np.ndarray, truth: np.ndarray) -> float:
    return float((found & truth).sum() / (found | truth).sum())


def view_of(target: tuple[float, float, float], eye: tuple[float, float, float]) -> Camera:
    viewmat = look_at(torch.tensor(eye), torch.tensor(target), UP)
    return Camera(viewmat, intrinsics(math.radians(45.0), *SIZE), *SIZE)


@cache
def balls_on_a_floor() -> tuple[Gaussians, np.ndarray]:
    """Return a floor (0), a ball on the left (1), one on the right (2) and a small one above it (3)."""
    rng = np.random.default_rng(4)
    floor = np.stack([rng.uniform(-3, 3, 3000), np.zeros(3000), rng.uniform(-3, 3, 3000)], axis=1)
    parts = [(floor, (0.3, 0.5, 0.2))]
    for x, y, radius, count, color in (
        (-1.0, 0.5, 0.5, 900, (0.8, 0.2, 0.1)),
        (1.2, 0.5, 0.5, 900, (0.1, 0.2, 0.8)),
        (1.2, 1.45, 0.2, 200, (0.8, 0.8, 0.1)),
    ):
        directions = rng.normal(size=(count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        parts.append((radius * directions + np.array([x, y, 0.0]), color))
    means = torch.from_numpy(np.concatenate([points for points, _ in parts])).float()
    labels = np.repeat(np.arange(len(parts)), [len(points) for points, _ in parts])
    scene = random_gaussians(len(means), seed=5)
    colors = torch.tensor([color for _, color in parts])[torch.from_numpy(labels)]
    return (
        replace(
            scene,
            means=means,
            log_scales=torch.full_like(means, math.log(0.04)),
            logit_opacities=torch.full((len(means),), 4.0),
            sh0=rgb_to_sh0(colors),
            shN=scene.shN[:, :0],
        ),
        labels,
    )


@cache
def neighborhood() -> Neighborhood:
    return Neighborhood(balls_on_a_floor()[0])


@pytest.mark.parametrize(
    ("target", "labels"), [((-1.0, 0.5, 0.0), (1,)), ((1.2, 0.7, 0.0), (2, 3)), ((-0.7, 0.7, 0.0), (1,))]
)
def test_middle_of_the_view_chooses_the_object(
    target: tuple[float, float, float], labels: tuple[int, ...]
) -> None:
    scene, truth = balls_on_a_floor()
    camera = view_of(target, (target[0], 1.2, 4.0))
    found = select_subject(scene, neighborhood(), camera, UP)
    assert overlap(found, np.isin(truth, labels)) > 0.9


def test_subject_of_the_bear_leaves_its_plinth() -> None:
    demo = bear(6000)
    truth = ~torch.isin(demo.labels, torch.tensor([6, 7], dtype=demo.labels.dtype)).numpy()
    near = Neighborhood(demo.gaussians)
    found = select_subject(demo.gaussians, near, first_view(demo.gaussians, UP, SIZE), UP)
    assert overlap(found, truth) > 0.9


def test_object_without_surroundings_is_selected_whole() -> None:
    demo = bear(6000)
    alone = demo.gaussians[(demo.labels < 6).nonzero()[:, 0]]
    found = select_subject(alone, Neighborhood(alone), first_view(alone, UP, SIZE), UP)
    assert found.mean() > 0.99


def test_scene_of_one_gaussian_is_its_own_subject() -> None:
    alone = replace(random_gaussians(1, seed=1), means=torch.zeros(1, 3), logit_opacities=torch.tensor([4.0]))
    assert select_subject(alone, Neighborhood(alone), first_view(alone, UP, SIZE), UP).all()


def test_object_much_higher_than_wide_is_found_quickly() -> None:
    floor, labels = balls_on_a_floor()
    is_line = labels == 1
    means = floor.means.clone()
    means[is_line] = torch.tensor([0.0, 1.0, 0.0]) * torch.linspace(0.0, 1.0, int(is_line.sum()))[:, None]
    kept = torch.from_numpy(np.flatnonzero(labels < 2))
    scene = replace(floor, means=means)[kept]
    view = view_of((0.0, 0.5, 0.0), (0.0, 1.5, 4.0))
    found = select_subject(scene, Neighborhood(scene), view, UP)
    assert found[is_line[labels < 2]].mean() > 0.8


def test_room_and_empty_view_give_one_line() -> None:
    inside = room(3000).gaussians
    with pytest.raises(ProgdfError, match="a room has no single subject"):
        select_subject(inside, Neighborhood(inside), first_view(inside, UP, SIZE), UP)
    scene, _ = balls_on_a_floor()
    away = view_of((0.0, 1.0, 9.0), (0.0, 1.0, 5.0))
    with pytest.raises(ProgdfError, match="no subject in the middle"):
        select_subject(scene, neighborhood(), away, UP)


def test_region_language_knows_the_subject() -> None:
    scene, truth = balls_on_a_floor()
    check_region("subject")
    check_region("all-subject|grow")
    with pytest.raises(ProgdfError, match="missing"):
        check_region("subject:missing.json")
    chosen = parse_region("subject", scene).mask.numpy()
    assert overlap(chosen, truth > 0) > 0.4
    assert not chosen[truth == 0].mean() > 0.05


@pytest.mark.parametrize("spec", ["subject", "all", "sphere:0,0,0,1"])
def test_region_of_an_empty_scene_gives_one_line(spec: str) -> None:
    scene = balls_on_a_floor()[0][torch.zeros(0, dtype=torch.int64)]
    with pytest.raises(ProgdfError, match="because the scene has none"):
        parse_region(spec, scene)


def test_haze_around_an_object_without_a_ground_is_not_selected() -> None:
    scene, labels = balls_on_a_floor()
    ball = scene[torch.from_numpy(labels == 1)]
    around = 3.0 * torch.nn.functional.normalize(
        torch.randn(len(ball), 3, generator=torch.manual_seed(1)), dim=1
    )
    inside = ball.means.mean(dim=0) + 0.05 * around
    haze = replace(ball, means=around, logit_opacities=torch.full((len(ball),), -3.0))
    core = replace(haze, means=inside)
    whole = concatenate([ball, haze, core])
    selected = select_subject(whole, Neighborhood(whole), view_of((-1.0, 0.5, 0.0), (-1.0, 1.2, 4.0)), UP)
    assert selected[: len(ball)].all()
    assert not selected[len(ball) : 2 * len(ball)].any()
    assert selected[2 * len(ball) :].all()


@pytest.mark.parametrize(("x", "label"), [(-1.0, 1), (1.2, 2)])
def test_middle_of_the_view_chooses_between_objects_without_a_ground(x: float, label: int) -> None:
    scene, labels = balls_on_a_floor()
    rows = np.isin(labels, [1, 2])
    balls = scene[torch.from_numpy(rows)]
    selected = select_subject(balls, Neighborhood(balls), view_of((x, 0.5, 0.0), (x, 1.2, 4.0)), UP)
    np.testing.assert_array_equal(selected, labels[rows] == label)
