"""Warps: control points bend a region to match the views, and nothing else moves."""

from __future__ import annotations

import math
from functools import cache

import pytest
import torch
from torch import Tensor

from benchmarks.analytic_warps import bend_warp, stretch_warp
from progdf.gaussians import attribute_slices, pack
from progdf.rasterize import render
from progdf.similarity import Motion, make_parts, move_rows
from tests.helpers.trained import WHITE, Small, small
from trainer.evaluate.suite.analytic_edits import AnalyticEdit, warp_edit
from trainer.motion.parts import connected_parts
from trainer.motion.warp import (
    ControlPoints,
    WarpMotion,
    disagreement,
    extrapolate_warp,
    farthest_points,
    interpolate_warp,
    make_control_points,
    map_members,
    rest_warp,
    transfer_warp,
    warp_of_parts,
    warp_rows,
)
from trainer.optimize.groups import group_path, group_stage, restore_groups
from trainer.views.crops import CropScene, crop_scene
from trainer.views.view import crop

UP = torch.tensor([0.0, 1.0, 0.0])
SIDE = torch.tensor([1.0, 0.0, 0.0])
MEANS = attribute_slices(14)["means"]


@cache
def body() -> Small:
    return small("body", size=1500, count=6, image_size=72)


def held(count: int = 12) -> tuple[Tensor, ControlPoints]:
    """Return packed rows of a bear's arms, and their control points."""
    case = small("arms")
    rows = pack(case.scene[case.region.members], with_shN=True)
    return rows, make_control_points(rows[:, MEANS], connected_parts(rows[:, MEANS]), count)


def some_motion(control: ControlPoints, seed: int = 0, size: float = 0.3) -> WarpMotion:
    rng = torch.Generator().manual_seed(seed)
    shift, turn, stretch = torch.randn(len(control), 12, generator=rng).mul(size).split([3, 3, 6], dim=1)
    return WarpMotion(control.spacing * shift, turn, 0.3 * stretch)


def bent(case: Small, degrees: float = 30.0, factor: float = 1.3) -> AnalyticEdit:
    """Return an edit that stretches and bends the body from its feet, which is no similarity."""
    means = case.scene.means[case.region.members]
    base = means.mean(dim=0) * (1 - UP) + means.amin(dim=0) * UP
    length = float(means[:, 1].max() - means[:, 1].min())
    stretch, bend = stretch_warp(base, UP, factor), bend_warp(base, UP, SIDE, factor * length, degrees)
    return warp_edit("bent", lambda points, strength: bend(stretch(points, strength), strength))


def pictured(
    case: Small, edit: AnalyticEdit, strengths: tuple[float, ...]
) -> tuple[Tensor, list[CropScene], list[list[Tensor]], list[Tensor]]:
    """Return members' rows, views with boxes around the edit, edited boxes, and true rows by strength."""
    truths = [edit.apply(case.scene, case.region.members, s) for s in strengths]
    with torch.no_grad():
        whole = [[render(t, v.camera, WHITE).image.clamp(0, 1) for v in case.views] for t in truths]
    views = [v.widen([pictures[i] for pictures in whole]) for i, v in enumerate(case.views)]
    crops = [crop_scene(case.scene, case.region.members, v.camera, v.box, WHITE) for v in views]
    boxes = [[crop(p, v.box) for p, v in zip(pictures, views, strict=True)] for pictures in whole]
    rows, *ends = (pack(scene[case.region.members], with_shN=True) for scene in (case.scene, *truths))
    return rows, crops, boxes, ends


def test_control_points_are_split_by_part_and_followed_within_it() -> None:
    rows, control = held(12)
    part = connected_parts(rows[:, MEANS])
    assert set(control.part.tolist()) == {0, 1}
    assert 11 <= len(control) <= 13
    followed = control.weights > 1e-3
    assert bool((control.part[control.nearest] == part[:, None])[followed].all())
    assert torch.allclose(control.weights.sum(dim=1), torch.ones(len(rows)))
    assert bool((control.part[control.links[:, 0]] == control.part[control.links[:, 1]]).all())


def test_farthest_points_are_distinct_and_far_apart() -> None:
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0))
    chosen = farthest_points(points, 20)
    assert len(set(chosen.tolist())) == 20
    apart = torch.cdist(points[chosen], points[chosen]) + 9 * torch.eye(20)
    assert float(apart.min()) > 0.2


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_members_have_a_control_point_each(count: int) -> None:
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
    control = make_control_points(points, torch.zeros(count, dtype=torch.int64), 54)
    assert len(control) == count
    assert control.spacing > 0
    assert torch.allclose(control.weights.sum(dim=1), torch.ones(count))


def test_rest_warp_moves_nothing() -> None:
    rows, control = held()
    assert torch.allclose(warp_rows(rows, control, rest_warp(control)), rows, atol=1e-5)


def test_carried_offsets_can_be_carried_back() -> None:
    rows, control = held()
    maps = map_members(rows, control, some_motion(control))
    offsets = 0.1 * torch.randn(rows.shape, generator=torch.Generator().manual_seed(1))
    there = maps.carry(rows, offsets)
    assert torch.allclose(maps.carry_back(rows, there), offsets, atol=1e-4)
    assert torch.equal(there[:, 10:14], offsets[:, 10:14])


def test_uniform_control_points_move_a_part_as_a_whole() -> None:
    rows, control = held()
    parts = make_parts(rows, connected_parts(rows[:, MEANS]))
    motion = Motion(
        torch.randn(2, 3), torch.tensor([0.3, -0.2]), torch.tensor([[0.5, 0.9, -0.3], [0, 1.2, 0]])
    )
    warp = warp_of_parts(control, parts, motion)
    moved = warp_rows(rows, control, warp)
    expected = move_rows(rows, parts, motion)
    assert torch.allclose(moved[:, :6], expected[:, :6], atol=1e-4)
    turned = (
        torch.nn.functional.normalize(moved[:, 6:10]) * torch.nn.functional.normalize(expected[:, 6:10])
    ).sum(1)
    assert float(turned.abs().min()) > 0.9999
    assert float(disagreement(control, warp)) < 1e-8


def test_motion_is_unchanged_on_more_control_points() -> None:
    rows, control = held(12)
    finer = held(40)[1]
    parts = make_parts(rows, connected_parts(rows[:, MEANS]))
    motion = Motion(
        torch.randn(2, 3), torch.tensor([0.3, -0.2]), torch.tensor([[0.5, 0.9, -0.3], [0, 1.2, 0]])
    )
    whole = warp_of_parts(control, parts, motion)
    there = warp_rows(rows, finer, transfer_warp(control, whole, finer))
    assert torch.allclose(there[:, :6], warp_rows(rows, control, whole)[:, :6], atol=1e-3)


def test_interpolated_motion_meets_its_ends_and_turns_evenly() -> None:
    _, control = held()
    a = some_motion(control, 1)
    b = some_motion(control, 2)
    for share, expected in ((0.0, a), (1.0, b)):
        found = interpolate_warp(control, a, b, share)
        assert torch.allclose(found.turn, expected.turn, atol=1e-5)
        assert torch.allclose(found.stretch, expected.stretch, atol=1e-6)
        assert torch.allclose(found.shift, expected.shift, atol=1e-4)
    half = interpolate_warp(control, rest_warp(control), b, 0.5)
    assert torch.allclose(half.turn, extrapolate_warp(b, 0.5).turn, atol=1e-5)


def test_gaussian_grows_along_a_stretch() -> None:
    rows, control = held()
    rows[:, attribute_slices(14)["quats"]] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    motion = rest_warp(control)
    motion.stretch[:, 1] = math.log(1.5)
    grown = (warp_rows(rows, control, motion) - rows)[:, attribute_slices(14)["log_scales"]].exp()
    assert torch.allclose(grown, torch.tensor([1.0, 1.5, 1.0]).expand(len(rows), 3), atol=1e-4)


@pytest.mark.slow
def test_known_bend_is_recovered_better_than_by_whole_parts() -> None:
    case = body()
    rows, crops, boxes, ends = pictured(case, bent(case), (0.5, 1.0))
    groups = group_stage(rows, crops, boxes, steps=60)
    assert groups.warps
    assert "bent by" in groups.lines()[0]
    size = float((rows[:, MEANS] - rows[:, MEANS].mean(dim=0)).norm(dim=1).mean())
    for placement, motion, truth in zip(groups.warps, groups.motions, ends, strict=True):
        moved = rows + placement.carry(rows, torch.zeros_like(rows))
        missed = (moved - truth)[:, MEANS].norm(dim=1).median()
        stiff = (move_rows(rows, groups.parts, motion) - truth)[:, MEANS].norm(dim=1).median()
        assert float(missed) < 0.06 * size
        assert float(missed) < 0.5 * float(stiff)


def test_warp_is_deterministic_and_restored_from_saved_state() -> None:
    case = body()
    rows, crops, boxes, _ = pictured(case, bent(case), (1.0,))
    first, again = (group_stage(rows, crops, boxes, steps=16, seed=3) for _ in range(2))
    saved = first.capture_state()
    assert "warps" in saved
    assert all(torch.equal(saved[name], values) for name, values in again.capture_state().items())
    back = restore_groups(rows, saved)
    offsets = 0.01 * torch.randn(rows.shape, generator=torch.Generator().manual_seed(1))
    assert torch.equal(back.warps[0].carry(rows, offsets), first.warps[0].carry(rows, offsets))


@pytest.mark.slow
def test_path_of_a_bend_has_exact_ends_and_a_half_bend_between() -> None:
    case = body()
    rows, crops, boxes, _ = pictured(case, bent(case), (1.0,))
    groups = group_stage(rows, crops, boxes, steps=60)
    end = groups.warps[0].carry(rows, torch.zeros_like(rows))
    path = group_path(rows, groups, [end], [10], 8)
    assert torch.equal(path[-1].offsets, end.half())
    truth = pack(bent(case).apply(case.scene, case.region.members, 0.5)[case.region.members], with_shN=True)
    (half,) = (one.offsets.float() for one in path if one.step == 5)
    own, line = ((rows + x - truth)[:, MEANS].norm(dim=1).mean() for x in (half, 0.5 * end))
    assert float(own) < float(line) + 1e-3
