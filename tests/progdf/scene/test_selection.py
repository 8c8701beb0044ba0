"""Tests of manual selection: shapes over a picture, ball, color, front surface and neighborhood."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from matplotlib.path import Path as Outline

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.scene.neighbors import Neighborhood, grow_along_surface
from progdf.scene.selection import (
    MODES,
    Surface,
    alike_in_color,
    base_colors,
    combine,
    front_surface,
    inside_ball,
    inside_polygon,
    inside_rectangle,
    inside_stroke,
    project_centers,
)
from progdf.sh import rgb_to_sh0
from tests.helpers.scenes import front_camera, orbit_camera, random_gaussians

POINTS = np.random.default_rng(5).uniform(-50, 450, (20_000, 2)).astype(np.float32)
POINTS[::100] = np.nan


def star(count: int, turns: int = 1) -> np.ndarray:
    """Return an outline whose corners go in and out, around the middle `turns` times."""
    t = np.linspace(0, 2 * np.pi * turns, count, endpoint=False)
    r = 150 + 60 * np.sin(5.3 * t)
    return np.stack([200 + r * np.cos(t), 210 + 0.8 * r * np.sin(t)], axis=1)


def sheet(colors: torch.Tensor, z: float = 3.0, side: int = 20) -> Gaussians:
    """Return a square of touching opaque Gaussians that faces a camera at the origin. [side²,3] rgb"""
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    means = torch.tensor(np.stack([x.ravel(), y.ravel(), np.full(side**2, z)], axis=1)).float()
    scene = random_gaussians(side**2)
    scales = torch.full((side**2, 3), float(np.log(1.6 / side)))
    opaque = torch.full((side**2,), 4.0)
    return replace(scene, means=means, log_scales=scales, logit_opacities=opaque, sh0=rgb_to_sh0(colors))


def joined(*scenes: Gaussians) -> Gaussians:
    names = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
    return Gaussians(*(torch.cat([getattr(scene, name) for scene in scenes]) for name in names))


def gray(side: int = 20) -> torch.Tensor:
    return torch.full((side**2, 3), 0.5)


def camera() -> Camera:
    return front_camera(200, 200, 250.0)


@pytest.mark.slow
def test_projected_centers_match_the_camera_and_are_nan_behind_it() -> None:
    scene = random_gaussians(300)
    seen = orbit_camera(90, 60, distance=1.0)
    points, depths = project_centers(scene, seen)
    local = scene.means.double() @ seen.viewmat[:3, :3].double().T + seen.viewmat[:3, 3].double()
    image = local @ seen.K.double().T
    expected = image[:, :2] / image[:, 2:]
    front = (local[:, 2] > 0).numpy()
    assert 0 < front.sum() < 300
    assert np.allclose(points[front], expected.numpy()[front], rtol=1e-4, atol=1e-2)
    assert np.isnan(points[~front]).all()
    assert np.allclose(depths, local[:, 2], atol=1e-5)


@pytest.mark.parametrize("outline", [star(3), star(12), star(400), star(31, turns=2)], ids=len)
def test_polygon_contains_exactly_its_points_even_if_it_crosses_itself(outline: np.ndarray) -> None:
    expected = Outline(outline).contains_points(np.nan_to_num(POINTS.astype(float), nan=1e9))
    assert (inside_polygon(POINTS, outline) == expected).all()
    thin = outline * (1.0, 1e-3) + (0.0, 200.0)
    expected = Outline(thin).contains_points(np.nan_to_num(POINTS.astype(float), nan=1e9))
    assert (inside_polygon(POINTS, thin) == expected).all()


def test_two_corners_enclose_nothing() -> None:
    assert not inside_polygon(POINTS, [(0.0, 0.0), (400.0, 400.0)]).any()
    assert not inside_polygon(POINTS, np.full((5, 2), 100.0)).any()


def test_rectangle_takes_its_corners_in_any_order() -> None:
    x, y = POINTS.T
    expected = (x >= 30) & (x <= 120) & (y >= 60) & (y <= 90)
    assert (inside_rectangle(POINTS, (30, 90), (120, 60)) == expected).all()


def test_stroke_selects_points_within_its_radius() -> None:
    path = np.array([(20.0, 30.0), (200.0, 180.0), (200.0, 180.0), (90.0, 300.0)])
    dense = np.concatenate([np.linspace(a, b, 4000) for a, b in pairwise(path)])
    near = np.array(
        [np.hypot(*(dense - point).T).min() if point[0] == point[0] else 1e9 for point in POINTS[:3000]]
    )
    clear = np.abs(near - 25.0) > 0.05
    assert (inside_stroke(POINTS[:3000], path, 25.0) == (near <= 25.0))[clear].all()
    dot = np.hypot(*(POINTS - (100, 100)).T) <= 40
    assert (inside_stroke(POINTS, [(100, 100)], 40.0) == dot).all()


def test_ball_contains_centers_within_its_radius() -> None:
    scene = random_gaussians(500)
    expected = (scene.means - torch.tensor([0.2, 0.0, -0.3])).norm(dim=1) <= 0.9
    assert (inside_ball(scene, (0.2, 0.0, -0.3), 0.9) == expected.numpy()).all()


def test_modes_are_set_operations() -> None:
    a = np.array([1, 1, 0, 0], bool)
    b = np.array([1, 0, 1, 0], bool)
    results = [combine(a, b, mode).astype(int).tolist() for mode in MODES]
    assert results == [[1, 0, 1, 0], [1, 1, 1, 0], [0, 1, 0, 0], [1, 0, 0, 0]]


def test_only_colors_within_the_tolerance_are_alike() -> None:
    colors = base_colors(sheet(torch.linspace(0, 1, 400)[:, None].expand(-1, 3)))
    found = alike_in_color(colors, colors[200], 0.1)
    assert found[200]
    assert (np.abs(colors[found, 0] - colors[200, 0]) <= 0.1).all()
    assert 80 < found.sum() < 110


def test_front_surface_excludes_hidden_gaussians() -> None:
    scene = joined(sheet(gray(), 3.0), sheet(gray(), 4.0), sheet(gray(), -3.0))
    centers = project_centers(scene, camera())
    front = front_surface(scene, camera(), centers)
    assert front[:400].all()
    assert not front[800:].any(), "what is behind the camera is not seen"
    hidden = inside_rectangle(centers.points, (30, 30), (170, 170))[400:800]
    assert hidden.sum() > 100
    assert not front[400:800][hidden].any()


def test_front_surface_of_some_rows_matches_the_whole() -> None:
    scene = random_gaussians(3000, scale=0.08)
    seen = orbit_camera(160, 120)
    centers = project_centers(scene, seen)
    rows = np.flatnonzero(inside_rectangle(centers.points, (40, 30), (100, 90)))
    whole = front_surface(scene, seen, centers)
    assert 0 < whole[rows].sum() < len(rows)
    assert (front_surface(scene, seen, centers, rows) == whole[rows]).all()
    assert front_surface(scene, seen, centers, rows[:0]).shape == (0,)


def test_grow_and_shrink_move_the_border_by_one_neighbor() -> None:
    scene = sheet(gray())
    near = Neighborhood(scene)
    x = scene.means[:, 0].numpy()
    y = scene.means[:, 1].numpy()
    square = (np.abs(x) < 0.5) & (np.abs(y) < 0.5)
    grown = near.grow(square)
    shrunk = near.shrink(square)
    assert (grown & square).sum() == square.sum() < grown.sum() <= square.sum() + 4 * 12
    assert (shrunk & ~square).sum() == 0 < shrunk.sum() < square.sum()
    assert (near.shrink(grown) == square).mean() > 0.98


def test_empty_selection_stays_empty_and_full_stays_full() -> None:
    near = Neighborhood(sheet(gray()))
    for change in (near.grow, near.shrink, near.smooth, near.largest_part, near.refine):
        assert not change(np.zeros(400, bool)).any()
        assert change(np.ones(400, bool)).all()


def test_far_lone_gaussian_is_no_neighbor() -> None:
    far = replace(sheet(gray(), side=20), means=sheet(gray()).means + torch.tensor([40.0, 0.0, 0.0]))
    scene = joined(sheet(gray()), far[:1])
    mask = np.ones(401, bool)
    mask[400] = False
    assert not Neighborhood(scene).grow(mask)[400]


def test_smoothing_drops_strays_and_fills_holes() -> None:
    scene = sheet(gray())
    left = scene.means[:, 0].numpy() < 0
    noisy = left.copy()
    noisy[[45, 130, 205, 290]] ^= True
    assert (noisy != left).sum() == 4
    assert (Neighborhood(scene).smooth(noisy) == left).mean() > 0.99
    assert (Neighborhood(scene).smooth(noisy) == left)[[45, 130, 205, 290]].all()


@pytest.mark.parametrize(("shift", "percent"), [(-1, 35), (1, 35), (-3, 70), (3, 70)])
def test_refine_moves_a_rough_border_to_the_color_change(shift: int, percent: int) -> None:
    colors = gray(40).reshape(40, 40, 3)
    truth = np.zeros((40, 40), bool)
    truth[10:28, 8:30] = True
    colors[torch.from_numpy(truth)] = torch.tensor([0.8, 0.3, 0.1])
    rough = np.zeros_like(truth)
    rough[10 + shift : 28 + shift, 8 : 30 + abs(shift)] = True
    near = Neighborhood(sheet(colors.reshape(-1, 3), side=40))
    assert (near.refine(rough.ravel(), percent) == truth.ravel()).all()
    assert not (rough == truth).all()


def test_refine_moves_a_rough_border_to_a_gap() -> None:
    scene = joined(
        sheet(gray()), replace(sheet(gray()), means=sheet(gray()).means + torch.tensor([2.6, 0, 0]))
    )
    truth, rough = (scene.means[:, 0].numpy() < limit for limit in (1.3, 1.75))
    assert (Neighborhood(scene).refine(rough, 60) == truth).all()


def test_refine_keeps_a_thin_part() -> None:
    colors = gray(40).reshape(40, 40, 3)
    truth = np.zeros((40, 40), bool)
    truth[18:21, 4:36] = True
    colors[torch.from_numpy(truth)] = torch.tensor([0.8, 0.3, 0.1])
    rough = np.zeros_like(truth)
    rough[17:22, 4:36] = True
    near = Neighborhood(sheet(colors.reshape(-1, 3), side=40))
    refined = near.refine(rough.ravel(), 60).reshape(40, 40)
    assert (refined & truth).sum() / (refined | truth).sum() > 0.95


def test_largest_part_has_the_most_members() -> None:
    scene = joined(sheet(gray(), 3.0), sheet(torch.full((100, 3), 0.5), 9.0, side=10))
    assert Neighborhood(scene).largest_part(np.ones(500, bool)).tolist() == [True] * 400 + [False] * 100


def test_flood_stops_at_another_color_and_at_a_gap() -> None:
    colors = gray()
    colors[:200] = torch.tensor([0.8, 0.2, 0.1])  # the upper half
    scene = joined(sheet(colors, 3.0), sheet(colors, 9.0))
    near = Neighborhood(scene)
    lab = base_colors(scene)
    seed = near.nearest((0.0, -0.5, 3.0))
    assert np.flatnonzero(grow_along_surface(near, lab, np.array([seed]), lab[seed], 0.1)).tolist() == [
        *range(200)
    ]
    assert grow_along_surface(near, lab, np.array([seed]), lab[seed], 1.0).sum() == 400
    deep = near.nearest((0.0, -0.9, 3.0))
    assert np.flatnonzero(grow_along_surface(near, lab, np.array([deep]), lab[300], 0.1)).tolist() == [deep]


def test_prepared_surface_matches_an_unprepared_one() -> None:
    scene = random_gaussians(3000, seed=4)
    seen = camera()
    ahead = Surface(scene, seen)
    late = Surface(scene, seen)
    ahead.prepare(colors=True)
    rows = np.arange(0, 3000, 7)
    assert (ahead.front(rows) == late.front(rows)).all()
    assert (late.front(rows) == front_surface(scene, seen, project_centers(scene, seen), rows)).all()
    given_up = Surface(scene, seen)
    given_up.drop()
    given_up.prepare()
    assert (given_up.front(rows) == late.front(rows)).all(), "asked for all the same"
