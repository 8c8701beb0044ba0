"""Tests of the demo scenes (exact size, seeded, labeled, opaque) and of edits with a known path."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from progdf import demo_scenes as scenes
from progdf.color.edits import typical_color
from progdf.demo_scenes import surface
from progdf.demo_scenes.assemble import assemble
from progdf.demo_scenes.bear import bear_parts, paint_bear
from progdf.errors import ProgdfError
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.rasterize import render
from progdf.sh import sh0_to_rgb
from trainer.evaluate.suite import analytic_edits


@pytest.fixture(scope="module")
def bear() -> scenes.DemoScene:
    return scenes.bear(6000)


def _same(a: Gaussians, b: Gaussians) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in ATTRIBUTES)


@pytest.mark.slow
@pytest.mark.parametrize("size", [scenes.MIN_BEAR_GAUSSIANS, 401, 5003])
def test_bear_has_the_requested_size_and_leaves_torch_unchanged(size: int) -> None:
    torch.manual_seed(5)
    before = torch.get_rng_state()
    threads = torch.get_num_threads()
    scene = scenes.bear(size)
    assert torch.equal(before, torch.get_rng_state())
    assert torch.get_num_threads() == threads
    assert len(scene.gaussians) == size
    assert scene.labels.shape == (size,)
    assert set(scene.labels.tolist()) == set(range(len(scene.label_names)))


@pytest.mark.slow
def test_bear_is_determined_by_its_seed(bear: scenes.DemoScene) -> None:
    assert _same(bear.gaussians, scenes.bear(6000).gaussians)
    assert not torch.equal(bear.gaussians.means, scenes.bear(6000, seed=1).gaussians.means)


@pytest.fixture(scope="module")
def room() -> scenes.DemoScene:
    return scenes.room(2503)


@pytest.mark.slow
def test_room_has_its_size_and_all_parts_and_is_seeded(room: scenes.DemoScene) -> None:
    scene = room
    assert len(scene.gaussians) == 2503
    assert set(scene.labels.tolist()) == set(range(len(scene.label_names)))
    assert _same(scene.gaussians, scenes.room(2503).gaussians)
    with pytest.raises(ProgdfError, match="too few for a room; use at least"):
        scenes.room(scenes.MIN_ROOM_GAUSSIANS - 1)


def test_room_cameras_are_inside_and_see_walls_everywhere() -> None:
    scene = scenes.room(6000)
    for camera in scene.cameras:
        x, y, z = camera.position.tolist()
        assert max(abs(x), abs(z)) < 1.9
        assert 0.9 < y < 2.0
    camera = scene.cameras[5].resize(96, 72)
    red, green = (
        render(scene.gaussians, camera, background=c).image for c in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    )
    # closed on all sides: nearly no background is visible
    assert float((red - green).abs().mean()) < 0.02


def test_part_inside_another_is_refused() -> None:
    outer = surface.Part("outer", "x", surface.ball(), torch.zeros(3), torch.eye(3))
    inner = surface.Part("inner", "x", surface.ball(), torch.zeros(3), 0.1 * torch.eye(3))
    with pytest.raises(ValueError, match="lies inside other parts; move it"):
        assemble([outer, inner], ("x",), paint_bear, 500, 0)


def test_too_few_gaussians_for_a_bear_are_refused() -> None:
    with pytest.raises(ProgdfError, match="too few for a bear; use at least"):
        scenes.bear(scenes.MIN_BEAR_GAUSSIANS - 1)


def test_every_value_of_the_bear_is_usable(bear: scenes.DemoScene) -> None:
    g = bear.gaussians
    assert all(getattr(g, name).isfinite().all() for name in ATTRIBUTES)
    assert g.sh_degree == 1
    assert torch.allclose(g.quats.norm(dim=1), torch.ones(len(g)), atol=1e-5)
    assert g.scales.min() > 1e-5
    assert g.scales.max() < 0.5
    assert g.opacities.min() > 0.4
    assert g.opacities.std() > 0.02


def test_some_colors_are_clamped_as_in_real_scenes(bear: scenes.DemoScene) -> None:
    rgb = sh0_to_rgb(bear.gaussians.sh0)
    assert (rgb < 0.03).any()
    assert (rgb > 0.97).any()


def test_labels_match_the_positions_of_parts(bear: scenes.DemoScene) -> None:
    order = ["ears", "head", "scarf", "body", "plinth", "grass"]
    heights = [float(bear.gaussians.means[bear.members(name), 1].mean()) for name in order]
    assert heights == sorted(heights, reverse=True)
    assert len(bear.members("arms", "legs")) == len(bear.members("arms")) + len(bear.members("legs"))
    with pytest.raises(ProgdfError, match="no part 'wings'; it has body, head"):
        bear.members("wings")


def test_no_gaussian_is_buried_in_another_part() -> None:
    scene = scenes.bear(3000)
    body = next(part for part in bear_parts() if part.name == "body")
    others = scene.gaussians.means[scene.labels != scene.label_names.index("body")]
    assert float(body.depth(others).max()) < 0.05


def test_bear_has_no_holes_from_its_cameras(bear: scenes.DemoScene) -> None:
    # only light from behind changes with the background
    red, green = (
        render(bear.gaussians, bear.cameras[0].resize(160, 160), background=color).image
        for color in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    )
    leak = (red - green).abs().amax(dim=2)
    rows, columns = torch.meshgrid(torch.arange(160), torch.arange(160), indexing="ij")
    inside = (columns > 66) & (columns < 94) & (rows > 35) & (rows < 100)
    assert float(leak[inside].mean()) < 0.01
    assert float(leak[inside].max()) < 0.15
    assert float(leak[:10].min()) > 0.95


def test_first_camera_sees_the_face(bear: scenes.DemoScene) -> None:
    front = bear.cameras[0]
    back = bear.cameras[16]
    assert float(front.position[2]) > 2
    assert abs(float(front.position[0])) < 1e-4
    assert float(back.position[2]) < -2
    image = render(bear.gaussians, front.resize(128, 128), background=bear.background).image
    assert torch.allclose(image[2, 2], torch.tensor(bear.background), atol=0.02)
    dark = (image.amax(dim=2) < 0.2).nonzero().float().mean(0)
    assert 25 < float(dark[0]) < 60  # eyes and nose, the darkest pixels, are in the upper half


@pytest.mark.parametrize(
    "shape",
    [surface.ball(), surface.ball(5.0), surface.ring(0.3), surface.lathe((0.5, 1.0, 0.3), (1.0, 0.2, -1.0))],
)
def test_samples_lie_on_the_surface_with_outward_normals(shape: surface.Shape) -> None:
    matrix = torch.tensor([[0.5, 0.1, 0.0], [0.0, 0.8, 0.0], [0.1, 0.0, 0.3]])
    part = surface.Part("x", "x", shape, torch.tensor([1.0, 2.0, 3.0]), matrix)
    at = surface.sample(part, 700)
    # the profile is a polyline of 512 pieces
    assert torch.allclose(shape.level(part.to_local(at.points)), torch.ones(700), atol=2e-3)
    assert (shape.level(part.to_local(at.points + 0.01 * at.normals)) > 1).all()


def test_samples_are_even_by_area() -> None:
    sphere = surface.Part("x", "x", surface.ball(), torch.zeros(3), 2.0 * torch.eye(3))
    at = surface.sample(sphere, 1000)
    assert torch.allclose((at.spacing**2).sum(), torch.tensor(16 * math.pi), rtol=1e-2)
    distance = torch.cdist(at.points, at.points).fill_diagonal_(9.0).amin(dim=1)
    assert float(distance.min()) > 0.6 * float(at.spacing.mean())


EDITS = ("gold", "blue scarf", "stripes", "big ears", "tilted ears", "long ears", "bent ears", "night")


@pytest.mark.parametrize("name", EDITS)
def test_analytic_edit_keeps_other_rows_and_strength_zero(bear: scenes.DemoScene, name: str) -> None:
    edit, members = analytic_edits.bear_edits(bear)[name]
    assert _same(edit.apply(bear.gaussians, members, 0.0), bear.gaussians)
    edited = edit.apply(bear.gaussians, members, 0.7)
    others = torch.ones(len(bear.gaussians), dtype=torch.bool)
    others[members] = False
    assert _same(edited[others], bear.gaussians[others])
    assert not _same(edited[members], bear.gaussians[members])


def test_scale_edit_doubles_sizes_and_distances_from_the_pivot(bear: scenes.DemoScene) -> None:
    ears = bear.members("ears")
    pivot = torch.tensor([[0.0, 1.0, 0.0]])
    edited = analytic_edits.scale_edit(3.0, pivot).apply(bear.gaussians, ears, 0.5)
    before = bear.gaussians[ears]
    assert torch.allclose(edited.means[ears] - pivot, 2 * (before.means - pivot), atol=1e-5)
    assert torch.allclose(edited.scales[ears], 2 * before.scales, rtol=1e-5)


def test_swing_edit_is_a_rigid_rotation(bear: scenes.DemoScene) -> None:
    ears = bear.members("ears")
    pivot = torch.tensor([[0.0, 1.0, 0.0]])
    edit = analytic_edits.swing_edit(180.0, torch.tensor([0.0, 0.0, 2.0]), pivot)
    half = edit.apply(bear.gaussians, ears, 0.5)[ears]
    arm = bear.gaussians.means[ears] - pivot
    expected = torch.stack([-arm[:, 1], arm[:, 0], arm[:, 2]], dim=1)
    assert torch.allclose(half.means - pivot, expected, atol=1e-5)
    # the picture rotates too: a quarter turn about z of the whole scene, with a camera rotated alike
    camera = bear.cameras[0].resize(96, 96)
    whole = torch.arange(len(bear.gaussians))
    plain = bear.gaussians
    turned = analytic_edits.swing_edit(180.0, torch.tensor([0.0, 0.0, 1.0]), torch.zeros(1, 3)).apply(
        plain, whole, 0.5
    )
    quarter = torch.eye(4)
    quarter[:2, :2] = torch.tensor([[0.0, 1.0], [-1.0, 0.0]])
    same = render(turned, replace(camera, viewmat=camera.viewmat @ quarter)).image
    assert (same - render(plain, camera).image).abs().max() < 1e-2


def test_deformation_matches_an_equal_rotation_or_scaling(bear: scenes.DemoScene) -> None:
    ears, pivot, camera = bear.members("ears"), torch.tensor([0.0, 1.0, 0.0]), bear.cameras[3].resize(96, 96)
    axis = torch.tensor([1.0, 0.0, 0.0])

    def turned(places: torch.Tensor, s: float) -> torch.Tensor:
        x, y, z = (places - pivot).unbind(1)
        c = math.cos(s * math.radians(30))
        d = math.sin(s * math.radians(30))
        return pivot + torch.stack([x, c * y - d * z, d * y + c * z], dim=1)

    def larger(places: torch.Tensor, s: float) -> torch.Tensor:
        return pivot + (1 + 0.5 * s) * (places - pivot)

    for move, plain in (
        (turned, analytic_edits.swing_edit(30.0, axis, pivot[None])),
        (larger, analytic_edits.scale_edit(1.5, pivot[None])),
    ):
        pictures = [
            render(edit.apply(bear.gaussians, ears, 0.6), camera).image
            for edit in (analytic_edits.warp_edit("same", move), plain)
        ]
        assert float((pictures[0] - pictures[1]).abs().max()) < 1e-3


def test_stretch_keeps_cross_sections_and_bend_keeps_pivot_distances(
    bear: scenes.DemoScene,
) -> None:
    ears = bear.members("ears")
    pivot = torch.tensor([0.0, 1.0, 0.0])
    up = torch.tensor([0.0, 2.0, 0.0])
    side = torch.tensor([1.0, 0.0, 0.0])
    before = bear.gaussians.means[ears]
    long = analytic_edits.stretch_edit(3.0, up, pivot).apply(bear.gaussians, ears, 0.5).means[ears]
    assert torch.allclose(long[:, [0, 2]], before[:, [0, 2]], atol=1e-6)
    assert torch.allclose(long[:, 1] - 1, 2 * (before[:, 1] - 1), atol=1e-5)
    bent = (
        analytic_edits.bend_edit(45.0, side, up, pivot, length=0.5)
        .apply(bear.gaussians, ears, 1.0)
        .means[ears]
    )
    assert torch.allclose((bent - pivot).norm(dim=1), (before - pivot).norm(dim=1), atol=1e-5)
    angle = torch.atan2(*(bent - pivot)[:, [2, 1]].T) - torch.atan2(*(before - pivot)[:, [2, 1]].T)
    assert torch.allclose(angle, math.radians(45) * (before[:, 1] - 1) / 0.5, atol=1e-4)


def test_recolor_edit_is_exact_at_full_strength(bear: scenes.DemoScene) -> None:
    scarf = bear.members("scarf")
    target = torch.tensor([0.1, 0.5, 0.3])
    edited = analytic_edits.recolor_edit(target).apply(bear.gaussians, scarf, 1.0)
    assert torch.allclose(typical_color(sh0_to_rgb(edited.sh0[scarf])), target, atol=0.12)


def test_panda_picture_changes_the_coat_and_keeps_the_rest(bear: scenes.DemoScene) -> None:
    camera = bear.cameras[2].resize(200, 200)

    def cover(parts: tuple[str, ...]) -> torch.Tensor:
        shown = torch.zeros(len(bear.gaussians), 3).index_fill(0, bear.members(*parts), 1.0)
        return render(bear.gaussians, camera, (0.0, 0.0, 0.0), colors=shown).image[..., 0].clamp(0, 1)

    picture = render(bear.gaussians, camera, bear.background).image.clamp(0, 1)
    painted = scenes.paint_panda(picture, camera, cover)
    limbs = cover(("ears", "arms", "legs")) > 0.98
    trunk = cover(("body",)) > 0.98
    assert float(painted[limbs].mean()) < 0.3
    assert float(picture[limbs].mean()) > 0.4
    assert float(painted[trunk].mean()) > 0.8
    assert float(picture[trunk].mean()) < 0.75
    rest = cover(("head", "body", "ears", "arms", "legs")) < 0.002
    assert torch.allclose(painted[rest], picture[rest], atol=0.01)
    features = (cover(("head",)) > 0.98) & (picture.amax(dim=2) < 0.15)
    assert int(features.sum()) > 20
    assert float((painted - picture)[features].abs().mean()) < 0.03


@pytest.mark.parametrize("strength", [-0.1, 1.1, math.nan])
def test_strength_out_of_range_is_refused(bear: scenes.DemoScene, strength: float) -> None:
    with pytest.raises(ProgdfError, match="between 0 and 1"):
        analytic_edits.darken_edit().apply(bear.gaussians, torch.arange(3), strength)


def test_leftover_gaussian_of_equal_parts_is_independent_of_rounding() -> None:
    random = np.random.default_rng(0)
    counts = set()
    for _ in range(6):
        radii = 0.2 * (1.0 + 1e-7 * random.integers(-2, 3, 3))
        balls = [
            surface.Part("head", name, surface.ball(), torch.tensor([i, 0.0, 0.0]), r * torch.eye(3))
            for i, (name, r) in enumerate(zip("abc", radii.tolist(), strict=True))
        ]
        _, labels = assemble(balls, ("a", "b", "c"), paint_bear, 100, 0)
        counts.add(tuple(labels.bincount().tolist()))
    assert len(counts) == 1, counts
