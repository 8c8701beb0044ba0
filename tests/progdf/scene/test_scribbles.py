"""Tests of selecting objects by a few strokes."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.sparse import diags_array
from scipy.sparse.linalg import spsolve

from progdf.demo_scenes import DemoScene, room
from progdf.scene.scribbles import Scribbles, likely_steps, rows_under
from progdf.scene.selection import Surface, alike_in_color, base_colors

NONE = np.zeros(0, np.int64)

# Lines over the room's first camera at 800x600: on the table, on the floor below it and on objects on top.
ON_TABLE = [[(420, 290), (620, 300), (680, 290)], [(528, 350), (528, 420), (500, 430), (560, 440)]]
BESIDE = [
    [(420, 340), (490, 380)],
    [(580, 350), (650, 380)],
    [(515, 190), (570, 240)],
    [(440, 220), (480, 230)],
    [(620, 210), (630, 220)],
    [(480, 490), (600, 490)],
]


@cache
def furnished() -> tuple[DemoScene, Surface]:
    demo = room(30_000)
    return demo, Surface(demo.gaussians, demo.cameras[0].resize(800, 600))


def painted(lines: list[list[tuple[int, int]]]) -> NDArray[np.bool_]:
    image = Image.new("1", (800, 600))
    for line in lines:
        ImageDraw.Draw(image).line(line, fill=1, width=7)
    return np.asarray(image)


def iou(mask: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float:
    return float((mask & truth).sum() / (mask | truth).sum())


@cache
def strokes() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    _, seen = furnished()
    return rows_under(painted(ON_TABLE), seen), rows_under(painted(BESIDE), seen)


def test_strokes_select_a_table_that_no_color_selects() -> None:
    demo, _ = furnished()
    truth = demo.members("table").numpy()
    table = np.zeros(len(demo.gaussians), bool)
    table[truth] = True
    colors = base_colors(demo.gaussians)
    mask = Scribbles(demo.gaussians.means.numpy(), colors).select(*strokes())
    tolerances = np.linspace(0.02, 0.5, 25)
    by_color = max(iou(alike_in_color(colors, np.median(colors[table], 0), t), table) for t in tolerances)
    assert by_color < 0.4
    assert iou(mask, table) > 0.75
    inside, outside = strokes()
    assert mask[inside].all()
    assert not mask[outside].any()


def test_moved_rotated_and_scaled_scene_gives_the_same_selection() -> None:
    demo, _ = furnished()
    points = demo.gaussians.means.double()
    colors = base_colors(demo.gaussians)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).double())[0]
    moved = (7.0 * points @ turn + torch.tensor([30.0, -4.0, 9.0])).numpy()
    before, after = (Scribbles(at, colors).select(*strokes()) for at in (points.numpy(), moved))
    assert (before != after).mean() < 1e-3, "whose chances are even, up to rounding"


def test_selection_matches_the_exact_solution() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3000, 3))
    colors = rng.random((3000, 3)).astype(np.float32)
    inside = np.arange(20)
    outside = np.arange(20, 60)
    steps = likely_steps(points, colors).astype(np.float64)
    free = np.arange(60, 3000)
    matrix = (diags_array(steps.sum(axis=1)) - steps).tocsr()
    exact = spsolve(matrix[free][:, free].tocsc(), steps[free][:, inside].sum(axis=1))
    scribbles = Scribbles(points, colors)
    mask = scribbles.select(inside, outside)
    even = np.abs(exact - 0.5) < 0.02
    assert even.mean() < 0.1
    assert np.array_equal(mask[free][~even], exact[~even] > 0.5)


@pytest.mark.parametrize("count", [0, 1, 2, 5, 12])
def test_few_or_equal_points_are_selected_by_their_strokes(count: int) -> None:
    for points in (np.zeros((count, 3)), np.arange(3.0 * count).reshape(count, 3)):
        scribbles = Scribbles(points, np.full((count, 3), 0.5, np.float32))
        assert not scribbles.select(NONE, NONE).any()
        assert not scribbles.select(NONE, np.arange(count)).any()
        assert not scribbles.select(np.arange(count), np.arange(count)).any(), "both is neither"
        if count > 1:
            mask = scribbles.select(np.array([0]), np.array([count - 1]))
            assert mask[0]
            assert not mask[count - 1]
            assert scribbles.select(np.array([0]), NONE).all()


def test_unreachable_points_are_outside() -> None:
    near = np.random.default_rng(0).normal(size=(40, 3))
    far = np.concatenate([near, near + 1e6])
    mask = Scribbles(far, np.full((80, 3), 0.5, np.float32)).select(np.array([0, 1]), NONE)
    assert mask[:40].all()
    assert not mask[40:].any()


def test_border_is_at_the_color_change_for_far_strokes() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.random((4000, 2)), np.zeros((4000, 1))], axis=1)
    red = points[:, 0] < 0.8
    colors = np.where(red[:, None], [0.6, 0.2, 0.1], [0.6, -0.05, 0.1]) + rng.normal(0, 0.02, (4000, 3))
    inside = np.flatnonzero(points[:, 0] < 0.02)
    outside = np.flatnonzero(points[:, 0] > 0.98)
    for scale in (1.0, 1e-3, 1e3):
        mask = Scribbles(scale * points, colors.astype(np.float32)).select(inside, outside)
        assert iou(mask, red) > 0.98
