"""Tests of cuts: things that touch and look alike move apart only where a cut separates them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from progdf.gaussians import Gaussians, concatenate
from progdf.pull.course import Handle, pull
from progdf.pull.cuts import NO_CUTS, CutLine, Cuts, Floats, Mask, Rows, find_cut_links
from progdf.pull.graph import build_graph
from progdf.pull.grips import connected_rows, grip_points, with_grips
from progdf.pull.live import HandlePose, LivePull
from progdf.region import whole_scene

COUNT = 1500  # Gaussians of each ball


def touching_balls() -> Gaussians:
    """Return two balls of one color that touch at the origin, left and right along x."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(COUNT, 3, generator=generator), dim=1)
    quats = torch.nn.functional.normalize(torch.randn(COUNT, 4, generator=generator), dim=1)
    balls = [
        Gaussians(
            directions + torch.tensor([side, 0.0, 0.0]),
            quats,
            torch.full((COUNT, 3), -2.8),
            torch.full((COUNT,), 3.0),
            torch.full((COUNT, 3), 0.4),
            torch.zeros(COUNT, 0, 3),
        )
        for side in (-1.0, 1.0)
    ]
    return concatenate(balls)


def right_ball(scene: Gaussians) -> Mask:
    mask = np.zeros(len(scene), bool)
    mask[COUNT:] = True
    return mask


def line_between(depth: float = 4.0) -> CutLine:
    """Return a line along y through the contact, seen along −z."""
    heights = np.linspace(-0.6, 0.6, 9)
    points = np.stack([np.zeros(9), heights, np.zeros(9)], axis=1)
    return CutLine(np.array([0.0, 0.0, depth]), points)


def handle_of(scene: Gaussians, falloff: float | None) -> Handle:
    row = int(scene.means[:, 0].argmax()) if falloff is None else int(scene.means.norm(dim=1).argmin())
    x, y, z = scene.means[row].tolist()
    return Handle(whole_scene(scene), (x, y, z), (0.2, 0.3, 0.0), falloff)


CUTS = {"region": Cuts((right_ball(touching_balls()),)), "line": Cuts(lines=(line_between(),))}


def test_balls_that_touch_move_together_without_a_cut() -> None:
    scene = touching_balls()
    course = pull(scene, [handle_of(scene, None)])
    assert course.region.mask[:COUNT].any()
    assert course.cut_count == 0
    assert "cut" not in course.describe()


@pytest.mark.parametrize("kind", ["region", "line"])
@pytest.mark.parametrize("falloff", [None, 0.7])
def test_cut_leaves_the_other_ball_in_place(kind: str, falloff: float | None) -> None:
    scene = touching_balls()
    handle = handle_of(scene, falloff)
    pulled = handle.point[0] > 0.0
    cuts = CUTS[kind]
    handles, owners = with_grips(scene, [handle], cuts=cuts)
    assert all((grip.point[0] > 0.0) == pulled for grip in handles), "grips stay on the pulled ball"
    course = pull(scene, handles, cuts=cuts)
    other = course.region.mask[:COUNT] if pulled else course.region.mask[COUNT:]
    moved = course.region.mask[COUNT:] if pulled else course.region.mask[:COUNT]
    assert int(other.sum()) <= (0 if kind == "region" else 4)
    assert moved.any()
    assert f"{course.cut_count} links cut" in course.describe()
    live = LivePull(scene, handles, cuts=cuts)
    assert live.cut_count == course.cut_count > 0
    live.step(HandlePose.of_shifts(np.array([handle.pull] * len(handles))[owners]), 8)
    assert np.isin(course.region.members.numpy(), live.members).all()


def test_connected_rows_and_grips_stop_at_a_cut() -> None:
    scene = touching_balls()
    first = np.array([int(scene.means[:, 0].argmin())])
    assert len(connected_rows(scene, first)) > COUNT
    rows = connected_rows(scene, first, CUTS["region"])
    assert rows.max() < COUNT
    rows = np.arange(len(scene))
    x, y, z = scene.means[int(scene.means.norm(dim=1).argmin())].tolist()
    assert len({bool(value > 0.0) for value in grip_points(scene, (x, y, z), rows, 1.0)[:, 0]}) == 2
    grips = grip_points(scene, (x, y, z), rows, 1.0, CUTS["line"])
    assert len({bool(value > 0.0) for value in grips[:, 0]}) == 1


def test_line_cuts_only_what_lies_behind_it() -> None:
    scene = touching_balls()
    behind = build_graph(scene, cuts=Cuts(lines=(line_between(-4.0),)))
    assert behind.cut_count > 0, "from the other side it is the same cut"
    away = CutLine(np.array([0.0, 0.0, 4.0]), np.array([[0.0, -0.6, 8.0], [0.0, 0.6, 8.0]]))
    assert build_graph(scene, cuts=Cuts(lines=(away,))).cut_count == 0
    short = CutLine(np.array([0.0, 0.0, 4.0]), np.array([[0.0, 0.5, 0.0], [0.0, 0.6, 0.0]]))
    assert build_graph(scene, cuts=Cuts(lines=(short,))).cut_count < behind.cut_count


def test_cuts_that_separate_nothing_change_no_graph() -> None:
    scene = touching_balls()
    plain = build_graph(scene)
    for cuts in (NO_CUTS, Cuts((np.ones(len(scene), bool),)), Cuts((np.zeros(len(scene), bool),))):
        graph = build_graph(scene, cuts=cuts)
        assert np.array_equal(graph.node_of, plain.node_of)
        assert np.array_equal(graph.ends, plain.ends)


def crosses_plainly(line: CutLine, first: Floats, last: Floats) -> bool:
    """Return True if a segment meets a triangle between the eye and a far part of the line."""
    for left, right in zip(line.points[:-1], line.points[1:], strict=True):
        far = [1e3 * (corner - line.eye) for corner in (left, right)]
        matrix = np.stack([first - last, *far], axis=1)
        if abs(np.linalg.det(matrix)) < 1e-9:
            continue
        share, a, b = np.linalg.solve(matrix, first - line.eye)
        if 0.0 <= share <= 1.0 and a >= 0.0 and b >= 0.0 and a + b <= 1.0:
            return True
    return False


def test_cut_links_are_those_that_cross_the_swept_line() -> None:
    random = np.random.default_rng(0)
    points = random.normal(size=(60, 3))
    start: Rows = np.repeat(np.arange(60), 20)
    end: Rows = random.integers(0, 60, len(start))
    line = CutLine(np.array([0.3, 0.2, 2.0]), random.normal(size=(5, 3)) * np.array([1.0, 1.0, 0.3]))
    found = find_cut_links(Cuts(lines=(line,)), points, start, end)
    expected = [crosses_plainly(line, points[a], points[b]) for a, b in zip(start, end, strict=True)]
    assert found.tolist() == expected
    assert 20 < found.sum() < len(found) // 2
