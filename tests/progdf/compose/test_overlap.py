"""Tests of the order of painted layers: the upper one covers the lower one, and rims take what lies below."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

from progdf.camera import Camera, intrinsics, look_at
from progdf.compose import paint_sheets
from progdf.compose.added import extend
from progdf.compose.composer import Composer
from progdf.compose.layers import BLENDS, Gains, Layer
from progdf.compose.overlap import find_paint
from progdf.compose.paint_sheets import Sheet, find_sheet, make_grids, measure_cover
from progdf.compose.reference import compose_layers
from progdf.errors import ProgdfError
from progdf.field.separable import course_field
from progdf.gaussians import Gaussians, pack
from progdf.gdf.anchors import PUSHED_SHAPE
from progdf.gdf.file import ADDED_LOGIT, Gdf, anchor_added, load_gdf, save_gdf
from progdf.rasterize import render
from progdf.region import from_mask
from progdf.sh import rgb_to_sh0
from progdf.tidy import Step, similarity, tidy
from tests.helpers.draws import Draws
from tests.helpers.edits import bits, curved_field, edit_of, painted, rimmed, some_rows, whole_grade
from tests.helpers.fuzz_changes import header_of, signed_gdf
from tests.helpers.plain_cover import measure_cover as measure_cover_plainly
from tests.helpers.scenes import random_gaussians

COUNT = 300


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return random_gaussians(COUNT, seed=5, sh_degree=1)


@pytest.mark.parametrize("blend", BLENDS)
def test_composer_orders_paint_like_compose_and_reports_every_change(scene: Gaussians, blend: str) -> None:
    draws = Draws(3)
    motion = similarity((1, 0, 2), (0.2, 0, 0), 0.7)
    half = scene.means[:, 0] > 0
    gdfs = [
        rimmed(painted(scene, 40, 9), 1),
        rimmed(painted(scene, 45, 12, "heart"), 2),
        painted(scene, 30, 14, "star"),
        edit_of(scene, some_rows(scene, 120, 2), curved_field(120, 2, moving=("sh0",)), "tint"),
        edit_of(scene, some_rows(scene, 90, 3), curved_field(90, 3), "shirt"),
        tidy(scene, [Step("transform", from_mask("half", half), motion)], "move"),
        whole_grade(scene),
    ]
    extended, converted = extend(scene, gdfs)
    paint = find_paint(extended, converted)
    assert paint is not None
    assert paint.pairs
    composer = Composer(scene, gdfs)
    arranged = 0
    for _ in range(60):
        layers = [
            Layer(
                gdfs[i],
                float(draws.uniform(1)) * 1.2,
                enabled=float(draws.uniform(1)) < 0.7,
                gains=Gains(*draws.uniform(4).tolist()) if float(draws.uniform(1)) < 0.3 else Gains(),
                weights=draws.uniform(len(converted[i].region)) if float(draws.uniform(1)) < 0.4 else None,
            )
            for i in draws.order(len(gdfs)).tolist()
        ]
        before = pack(composer.gaussians, True)
        change = composer.update(layers, blend)
        after = pack(composer.gaussians, True)
        none = [Layer(gdf, 0.0) for gdf in gdfs]
        plain = pack(compose_layers(scene, [*none, *layers], blend), True)
        torch.testing.assert_close(after, plain, atol=1e-5, rtol=1e-5)
        turned = pack(compose_layers(scene, [*none, *layers[::-1]], blend), True)
        arranged += not torch.equal(plain, turned)
        changed = (after != before).any(dim=1).nonzero()[:, 0].tolist()
        assert set(changed) <= set(change.rows.tolist())
        steps = (after - before)[:, :3].norm(dim=1)
        assert float(steps.max()) <= change.largest_move + 1e-5
    assert arranged > 20


@pytest.mark.parametrize("name", ["shirt", "leaves"])
def test_composer_changes_one_layer_at_a_time_like_compose(scene: Gaussians, name: str) -> None:
    motion = similarity((1, 0, 2), (0.2, 0, 0), 0.7)
    half = Step("transform", from_mask("half", scene.means[:, 0] > 0), motion)
    front = Step("transform", from_mask("front", scene.means[:, 1] > 0), motion)
    changed = {
        "shirt": edit_of(scene, some_rows(scene, 90, 3), curved_field(90, 3), "shirt"),
        "leaves": tidy(scene, [front], "leaves", leaves_paint=True),
    }[name]
    paints = [rimmed(painted(scene, 45, seed, f"paint {seed}"), seed) for seed in (9, 12)]
    below = [*paints, tidy(scene, [half], "move")]
    composer = Composer(scene, [*below, changed])
    for strength in (0.6, 1.0, 0.2):
        layers = [*(Layer(gdf, 0.6) for gdf in below), Layer(changed, strength)]
        composer.update(layers)
        plain = pack(compose_layers(scene, layers), True)
        torch.testing.assert_close(pack(composer.gaussians, True), plain, atol=1e-5, rtol=1e-5)


def test_adjust_leaves_rows_of_unchanged_layers_on_their_surface(scene: Gaussians) -> None:
    paints = [rimmed(painted(scene, 45, seed, f"paint {seed}"), seed) for seed in (9, 12)]
    everything = from_mask("all", torch.ones(COUNT, dtype=torch.bool))
    motion = similarity((1, 0, 2), (0.2, 0, 0), 0.7)
    below = [
        edit_of(scene, some_rows(scene, 120, 2), curved_field(120, 2, moving=("sh0",)), "tint"),
        whole_grade(scene),
        tidy(scene, [Step("transform", everything, motion)], "move"),
    ]
    composer = Composer(scene, [*paints, *below])
    for strength in (0.6, 0.9, 0.2):
        layers = [*(Layer(gdf, 0.6) for gdf in below), Layer(paints[0], 0.6), Layer(paints[1], strength)]
        before = pack(composer.gaussians, True)
        change = composer.update(layers, "adjust")
        after = pack(composer.gaussians, True)
        none = [Layer(gdf, 0.0) for gdf in [*paints, *below]]
        plain = pack(compose_layers(scene, [*none, *layers], "adjust"), True)
        torch.testing.assert_close(after, plain, atol=1e-5, rtol=1e-5)
        changed = (after != before).any(dim=1).nonzero()[:, 0].tolist()
        assert set(changed) <= set(change.rows.tolist())


@pytest.mark.parametrize("dragged", [0, 1, 2])
def test_dragged_paint_on_a_moving_and_fading_surface_is_like_compose(scene: Gaussians, dragged: int) -> None:
    below = edit_of(scene, some_rows(scene, 200, 3), curved_field(200, 3), "below")
    paints = [rimmed(painted(scene, 45, seed, f"paint {seed}"), seed) for seed in (9, 12, 14)]
    composer = Composer(scene, [*paints, below])
    for strength in (0.3, 0.9, 1.0, 0.0, 0.6):
        strengths = [strength if index == dragged else 0.9 for index in range(len(paints))]
        layers = [Layer(below, 0.8), *map(Layer, paints, strengths)]
        composer.update(layers)
        plain = pack(compose_layers(scene, layers), True)
        torch.testing.assert_close(pack(composer.gaussians, True), plain, atol=1e-5, rtol=1e-5)


def test_rim_above_a_tinted_rim_changes_with_it() -> None:
    wall = flat_wall()
    lower = rimmed(flat_paint("lower", 0.03, (0.1, 0.1, 0.9)), 1)
    upper = rimmed(flat_paint("upper", 0.045, (0.9, 0.1, 0.1)), 2)
    assert upper.anchors is not None
    alone = torch.zeros_like(upper.anchors.weights)
    alone[:, 0] = 1.0
    elsewhere = replace(upper.anchors, rows=torch.zeros_like(upper.anchors.rows), weights=alone)
    upper = replace(upper, anchors=elsewhere)
    rows = torch.arange(1, len(wall))
    tint = edit_of(wall, rows, curved_field(len(rows), 2, moving=("sh0",)), "tint")
    composer = Composer(wall, [lower, upper, tint])
    for strength in (0.5, 1.0):
        layers = [Layer(lower, 1.0), Layer(upper, 1.0), Layer(tint, strength)]
        composer.update(layers)
        plain = pack(compose_layers(wall, layers), True)
        torch.testing.assert_close(pack(composer.gaussians, True), plain, atol=1e-5, rtol=1e-5)


def test_paint_takes_no_part_in_the_average(scene: Gaussians) -> None:
    logo = painted(scene, 20, 9)
    rows = logo.region.members
    tint = edit_of(scene, rows, curved_field(len(rows), 2, moving=("sh0",)), "tint")
    both = compose_layers(scene, [Layer(tint, 1.0), Layer(logo, 1.0)], "normalized").sh0[rows]
    tinted = compose_layers(scene, [Layer(tint, 1.0)]).sh0[rows]
    pushed = compose_layers(scene, [Layer(logo, 1.0)]).sh0[rows]
    torch.testing.assert_close(both, tinted + pushed - scene.sh0[rows], atol=1e-5, rtol=0)


@pytest.mark.parametrize("blend", BLENDS)
def test_largest_push_of_several_layers_holds(scene: Gaussians, blend: str) -> None:
    logo = painted(scene, 20, 9)
    weaker = Layer(logo, 0.5)
    stack = [weaker, Layer(replace(logo, name="again"), 1.0)]
    both = compose_layers(scene, stack, blend)
    alone = compose_layers(scene, [Layer(logo, 1.0)])
    rows = logo.region.members
    for name in ("means", "logit_opacities", "sh0"):
        assert torch.equal(getattr(both, name)[rows], getattr(alone, name)[rows])


def test_stronger_one_of_two_layers_of_an_edit_covers_the_paint_below() -> None:
    lower = flat_paint("lower", 0.05, (0.9, 0.1, 0.1))
    upper = flat_paint("upper", 0.03, (0.1, 0.1, 0.9))
    wall = flat_wall()
    once = compose_layers(wall, [Layer(lower, 1.0), Layer(upper, 1.0)])
    twice = compose_layers(wall, [Layer(lower, 1.0), Layer(upper, 1.0), Layer(upper, 0.3)])
    assert bits(once) == bits(twice)


def test_rim_takes_the_color_of_the_surface_as_far_as_it_repeats_it(scene: Gaussians) -> None:
    logo = painted(scene, 20, 9)
    anchors = logo.anchors
    assert anchors is not None
    rim = torch.linspace(0, 1, 20)
    logo = replace(logo, anchors=replace(anchors, rim=rim))
    everything = torch.arange(COUNT)
    offsets = torch.zeros(2, COUNT, 14)
    offsets[1, :, 11:14] = torch.tensor([0.3, -0.2, 0.1])
    field = course_field(torch.tensor([0.0, 1.0]), offsets)
    tint = edit_of(scene, everything, field, "tint")
    for blend in BLENDS:
        tinted = compose_layers(scene, [Layer(logo, 1.0), Layer(tint, 0.5)], blend).sh0[COUNT:]
        plain = compose_layers(scene, [Layer(logo, 1.0)], blend).sh0[COUNT:]
        expected = rim[:, None] * torch.tensor([0.15, -0.1, 0.05])
        torch.testing.assert_close(tinted - plain, expected, atol=2e-3, rtol=0)


def flat_paint(name: str, height: float, color: tuple[float, float, float], push: float = -0.1) -> Gdf:
    """Return a square of 15 x 15 opaque discs at a height above a wall, which it pushes along z."""
    grid = torch.cartesian_prod(torch.linspace(-0.7, 0.7, 15), torch.linspace(-0.7, 0.7, 15))
    count = len(grid)
    discs = replace(
        random_gaussians(count, seed=1, sh_degree=1),
        means=torch.cat([grid, torch.full((count, 1), height)], dim=1),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.tensor([0.06, 0.06, 0.01]).log().repeat(count, 1),
        logit_opacities=torch.full((count,), ADDED_LOGIT),
        sh0=rgb_to_sh0(torch.tensor([color])).repeat(count, 1),
        shN=torch.zeros(count, 3, 3),
    )
    scene = flat_wall()
    offsets = torch.zeros(2, len(scene) + count, 14)
    offsets[1, : len(scene), 2] = push
    offsets[1, len(scene) :, 10] = 4.0 - ADDED_LOGIT
    field = course_field(torch.tensor([0.0, 1.0]), offsets)
    edit = edit_of(scene, torch.arange(len(scene)), curved_field(len(scene)), name)
    return anchor_added(replace(edit, field=field, added=discs), scene, PUSHED_SHAPE | {"color"})


def flat_wall() -> Gaussians:
    """Return a gray wall at z = 0."""
    grid = torch.cartesian_prod(torch.linspace(-1, 1, 12), torch.linspace(-1, 1, 12), torch.zeros(1))
    count = len(grid)
    return replace(
        random_gaussians(count, seed=1, sh_degree=1),
        means=grid,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.tensor([0.12, 0.12, 0.01]).log().repeat(count, 1),
        logit_opacities=torch.full((count,), 4.0),
        sh0=torch.zeros(count, 3),
        shN=torch.zeros(count, 3, 3),
    )


def test_paint_beside_upper_paint_follows_a_surface_that_moves_at_the_same_time() -> None:
    wall = flat_wall()
    upper = flat_paint("upper", 0.03, (0.9, 0.1, 0.1))
    lower = flat_paint("lower", 0.045, (0.1, 0.1, 0.9))
    assert lower.added is not None
    shifted = lower.added.means + torch.tensor([0.9, 0.0, 0.0])
    lower = replace(lower, added=replace(lower.added, means=shifted))
    everything = from_mask("all", torch.ones(len(wall), dtype=torch.bool))
    motion = similarity((0.1, 0, 0.2), (0.3, 0, 0.2), 1.3)
    moved = tidy(wall, [Step("transform", everything, motion)], "move")
    composer = Composer(wall, [lower, upper, moved])
    for strength in (1.0, 0.7, 0.4):
        layers = [Layer(lower, 1.0), Layer(upper, strength), Layer(moved, strength)]
        composer.update(layers)
        plain = pack(compose_layers(wall, layers), True)
        torch.testing.assert_close(pack(composer.gaussians, True), plain, atol=1e-5, rtol=1e-5)


def sheet_of(gdf: Gdf) -> Sheet:
    """Return the discs of paint on a wall."""
    extended, converted = extend(flat_wall(), [gdf])
    return find_sheet(extended, converted[0])


@pytest.mark.parametrize("distance", [0.02, 0.5])
def test_coverage_by_discs_is_that_of_the_plain_measure(distance: float) -> None:
    draws = Draws(4)
    flat = sheet_of(flat_paint("flat", 0.03, (0.9, 0.1, 0.1)))
    size = np.exp(4.0 * draws.uniform(len(flat.points), 1).numpy() - 2.0)
    opacity = draws.uniform(len(flat.points)).double().numpy()
    sheet = replace(flat, scales=flat.scales * size, opacity=opacity)
    far = torch.tensor([[30.0, 0.0, 0.0], [0.0, 0.0, -40.0], [math.nan, 0.0, 0.0]]).double()
    scattered = 1.2 * (2.0 * draws.uniform(500, 3).double() - 1.0) * torch.tensor([1.0, 1.0, 0.1])
    points = torch.cat([scattered, torch.from_numpy(flat.points), far]).numpy()
    outward = np.where(draws.uniform(len(points), 1).numpy() < 0.9, flat.outward[0], -flat.outward[0])
    finite = np.isfinite(points).all(axis=1)
    plain = measure_cover_plainly(sheet, points[finite], outward[finite], distance)
    grids = make_grids(sheet, distance)
    fast = measure_cover(grids, points, outward, distance)
    for found, expected in zip(fast, plain, strict=True):
        np.testing.assert_allclose(found[finite], expected, atol=1e-12)
    assert fast[0][-1] == 0.0
    early = measure_cover(grids, points, outward, distance, enough=0.9)[0][finite]
    np.testing.assert_allclose(np.minimum(early, 0.9), np.minimum(plain[0], 0.9), atol=1e-12)


def test_moved_discs_of_one_field_have_their_own_overlap() -> None:
    upper = flat_paint("upper", 0.045, (0.9, 0.1, 0.1))
    lower = flat_paint("lower", 0.03, (0.1, 0.1, 0.9))
    assert lower.added is not None
    away = lower.added.means + torch.tensor([9.0, 0.0, 0.0])
    for means, meets in ((lower.added.means, True), (away, False)):
        stack = [upper, replace(lower, added=replace(lower.added, means=means))]
        paint = find_paint(*extend(flat_wall(), stack))
        assert (paint is not None and bool(paint.pairs)) == meets


def test_overlaps_of_many_layers_are_measured_once(monkeypatch: pytest.MonkeyPatch) -> None:
    stack = [flat_paint(f"layer {i}", 0.03 + 0.002 * i, (0.9, 0.1, 0.1)) for i in range(9)]
    extended, converted = extend(flat_wall(), stack)
    first = find_paint(extended, converted)
    assert first is not None
    monkeypatch.setattr(paint_sheets, "measure_overlap", lambda *_: pytest.fail("measured again"))
    again = find_paint(extended, converted)
    assert again is not None
    assert again.pairs.keys() == first.pairs.keys()


def seen_from(scene: Gaussians, degrees: float) -> torch.Tensor:
    """Return the color in the middle of a picture from aside. [3]"""
    angle = math.radians(degrees)
    eye = torch.tensor([4 * math.sin(angle), 0.0, 4 * math.cos(angle)])
    pose = look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    camera = Camera(pose, intrinsics(math.radians(30), 64, 64), 64, 64)
    return render(scene, camera, (0.0, 0.0, 0.0)).image[26:38, 28:36].mean(dim=(0, 1))


def share_of(before: torch.Tensor, after: torch.Tensor, color: tuple[float, float, float]) -> float:
    """Return how far a color has come on the way to another one."""
    way = torch.tensor(color) - before
    return float((after - before) @ way / way.square().sum())


@pytest.mark.parametrize("degrees", [-50.0, 0.0, 30.0])
@pytest.mark.parametrize("upper", [0, 1, 2])
def test_upper_layer_covers_the_others_whatever_their_heights(degrees: float, upper: int) -> None:
    colors = [(0.9, 0.1, 0.1), (0.1, 0.1, 0.9), (0.9, 0.9, 0.1)]
    layers = [flat_paint(f"layer {i}", 0.03 + 0.015 * i, color) for i, color in enumerate(colors)]
    below = [Layer(gdf, 1.0) for i, gdf in enumerate(layers) if i != upper]
    wall = flat_wall()
    for strength in (1.0, 0.6):
        stack = [*below, Layer(layers[upper], strength)]
        start = seen_from(compose_layers(wall, below), degrees)
        share = share_of(start, seen_from(compose_layers(wall, stack), degrees), colors[upper])
        painted_wall = seen_from(compose_layers(wall, [Layer(layers[upper], strength)]), degrees)
        expected = share_of(seen_from(wall, degrees), painted_wall, colors[upper])
        assert abs(share - expected) < 0.15, (strength, share, expected)


def test_paint_on_the_other_side_of_a_thin_thing_is_not_covered() -> None:
    front = flat_paint("front", 0.02, (0.9, 0.1, 0.1))
    back = flat_paint("back", -0.13, (0.1, 0.1, 0.9), push=0.0)
    scene = flat_wall()
    for order in ([front, back], [back, front]):
        composed = compose_layers(scene, [Layer(gdf, 1.0) for gdf in order])
        assert float(seen_from(composed, 0.0)[0]) > 0.8
        assert float(seen_from(composed, 180.0)[2]) > 0.8


def test_strengths_of_zero_and_layers_apart_keep_every_bit(scene: Gaussians) -> None:
    one = flat_paint("one", 0.03, (0.9, 0.1, 0.1))
    other = flat_paint("other", 0.03, (0.1, 0.1, 0.9))
    wall = flat_wall()
    alone = compose_layers(wall, [Layer(one, 0.7), Layer(other, 0.0)])
    swapped = compose_layers(wall, [Layer(other, 0.0), Layer(one, 0.7)])
    assert bits(alone) == bits(swapped[rows_swapped(alone)])
    assert bits(compose_layers(wall, [Layer(one, 0.0), Layer(other, 0.0)])[: len(wall)]) == bits(wall)


def rows_swapped(composed: Gaussians) -> torch.Tensor:
    """Return the rows of a scene with the added rows of two layers in the other order."""
    wall = len(flat_wall())
    half = (len(composed) - wall) // 2
    return torch.cat([torch.arange(wall), wall + half + torch.arange(half), wall + torch.arange(half)])


def test_rims_and_pushed_kinds_are_saved_and_format_8_is_read(scene: Gaussians, tmp_path: Path) -> None:
    logo = painted(scene, 20, 9)
    assert logo.anchors is not None
    rim = (torch.arange(20) * 10).float() / 255
    logo = replace(logo, anchors=replace(logo.anchors, rim=rim))
    path = tmp_path / "logo.gdf"
    save_gdf(path, logo)
    loaded = load_gdf(path, scene).anchors
    assert loaded is not None
    assert loaded.rim is not None
    assert torch.equal(loaded.rim, rim)
    assert loaded.pushes == PUSHED_SHAPE | {"color"}
    header = header_of(path.read_bytes())
    tensors = safetensors.torch.load(path.read_bytes())
    tensors.pop("anchors.rim")
    old = {**header, "format": 8, "pushes": True}
    old.pop("rim")
    path.write_bytes(signed_gdf(old, tensors))
    earlier = load_gdf(path, scene).anchors
    assert earlier is not None
    assert earlier.rim is None
    assert earlier.pushes == PUSHED_SHAPE
    path.write_bytes(signed_gdf({**old, "format": 9, "pushes": ["smell"]}, tensors))
    with pytest.raises(ProgdfError, match="unknown kind of change smell"):
        load_gdf(path, scene)
