"""Nodes: a deformation graph moves the region as pictures show, and turned parts keep their size."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import pytest
import torch
from torch import Tensor

from progdf.gaussians import attribute_slices, pack
from progdf.pull.course import Handle, PullCourse, pull
from progdf.quaternions import rotate_vectors, turn_quats
from progdf.rasterize import render
from progdf.similarity import make_parts
from tests.helpers.trained import WHITE, Small, small
from trainer.motion.node_search import NodeSearch
from trainer.motion.nodes import (
    NodeMotion,
    NodePlacement,
    RegionNodes,
    interpolate_nodes,
    make_nodes,
    place_nodes,
    rest_nodes,
    settle_turns,
)
from trainer.motion.parts import connected_parts
from trainer.optimize.groups import Groups, move_nodes, restore_groups
from trainer.views.crops import CropScene, crop_scene
from trainer.views.view import crop

MEANS = attribute_slices(14)["means"]


@dataclass(frozen=True)
class Pulled:
    """A pulled region with its pictures."""

    rows: Tensor  # raw member rows. [M,C]
    crops: list[CropScene]
    boxes: list[Tensor]  # pictures of the full pull. [h,w,3] each
    course: PullCourse  # the truth


@cache
def pulled(size: int = 1500) -> Pulled:
    """Return a small bear's body with its front pulled out. `size`: Gaussians of the bear"""
    case: Small = small("body", size=size, count=6, image_size=72)
    scene = case.scene
    means = scene.means[case.region.members]
    front = means[means[:, 2].argmax()]
    x, y, z = front.tolist()
    course = pull(scene, [Handle(case.region, (x, y, z), (0.0, 0.0, 0.2), 0.5)])
    rows = pack(scene[case.region.members], with_shN=True)
    full = scene.replace_rows(
        course.region.members,
        pack(scene[course.region.members], with_shN=scene.sh_degree > 0) + course.offsets_at(1.0),
    )
    with torch.no_grad():
        pictures = [render(full, view.camera, WHITE).image.clamp(0, 1) for view in case.views]
    views = [view.widen([picture]) for view, picture in zip(case.views, pictures, strict=True)]
    crops = [crop_scene(scene, case.region.members, v.camera, v.box, WHITE) for v in views]
    boxes = [crop(picture, view.box) for picture, view in zip(pictures, views, strict=True)]
    return Pulled(rows, crops, boxes, course)


def graph() -> tuple[Tensor, RegionNodes]:
    rows = pulled().rows
    return rows, make_nodes(rows)


def some_motion(nodes: RegionNodes, seed: int = 0) -> NodeMotion:
    shift = torch.randn(len(nodes), 3, generator=torch.Generator().manual_seed(seed))
    return settle_turns(nodes, NodeMotion(nodes.positions + 0.2 * nodes.spacing * shift, 0.0 * shift))


def test_members_follow_near_nodes_with_weights_of_sum_one() -> None:
    rows, nodes = graph()
    assert len(nodes) <= len(rows) // 8
    assert torch.allclose(nodes.weights.sum(dim=1), torch.ones(len(rows)))
    distance = (nodes.positions[nodes.nearest] - rows[:, None, MEANS]).norm(dim=2)
    assert float((nodes.weights * distance).sum(dim=1).median()) < nodes.spacing


def test_rest_nodes_move_nothing() -> None:
    rows, nodes = graph()
    carried = NodePlacement(nodes, rest_nodes(nodes)).carry(rows, torch.zeros_like(rows))
    assert torch.allclose(carried, torch.zeros_like(rows), atol=1e-5)


def test_carried_offsets_can_be_carried_back() -> None:
    rows, nodes = graph()
    placement = NodePlacement(nodes, some_motion(nodes))
    offsets = 0.1 * torch.randn(rows.shape, generator=torch.Generator().manual_seed(1))
    there = placement.carry(rows, offsets)
    assert torch.allclose(placement.carry_back(rows, there), offsets, atol=1e-3)
    assert torch.equal(there[:, 10:14], offsets[:, 10:14])


def test_turned_nodes_turn_the_members_rigidly() -> None:
    rows, nodes = graph()
    turn = torch.tensor([0.2, 0.9, -0.3])
    quat = turn_quats(turn[None])
    moved = rotate_vectors(nodes.positions, quat.expand(len(nodes), 4))
    motion = settle_turns(nodes, NodeMotion(moved, turn.expand(len(nodes), 3)))
    carried = rows + NodePlacement(nodes, motion).carry(rows, torch.zeros_like(rows))
    expected = rotate_vectors(rows[:, MEANS], quat.expand(len(rows), 4))
    assert torch.allclose(carried[:, MEANS], expected, atol=1e-4)
    assert torch.allclose(carried[:, 3:6], rows[:, 3:6], atol=1e-3)


@pytest.mark.parametrize("degrees", [40.0, 100.0])
def test_half_a_turn_about_held_nodes_keeps_lengths(degrees: float) -> None:
    nodes = graph()[1]
    low = nodes.positions[:, 1].quantile(0.3)
    turn = torch.zeros_like(nodes.positions)
    turn[:, 0] = math.radians(degrees) * (nodes.positions[:, 1] > low)
    pivot = nodes.positions.mean(dim=0) * torch.tensor([1.0, 0.0, 1.0]) + low * torch.tensor([0.0, 1.0, 0.0])
    moved = pivot + rotate_vectors(nodes.positions - pivot, turn_quats(turn))
    motion = settle_turns(nodes, NodeMotion(moved, turn))
    rest = rest_nodes(nodes)
    half = interpolate_nodes(nodes, rest, motion, 0.5)
    together = (turn[nodes.starts] == turn[nodes.ends]).all(dim=1)

    def lengths(positions: Tensor) -> Tensor:
        edges = positions[nodes.ends] - positions[nodes.starts]
        return (edges.norm(dim=1) / nodes.arms.norm(dim=1))[together]

    assert abs(float(lengths(half.positions).median()) - 1.0) < 0.02
    blend = float(lengths(0.5 * (nodes.positions + moved)).median())
    assert abs(float(lengths(half.positions).median()) - 1.0) < abs(blend - 1.0)
    for share, end in ((0.0, rest), (1.0, motion)):
        met = interpolate_nodes(nodes, rest, motion, share)
        assert torch.allclose(met.positions, end.positions, atol=1e-4)


def test_nodes_take_over_the_motion_of_another_placement() -> None:
    rows, nodes = graph()
    placement = NodePlacement(nodes, some_motion(nodes))
    taken = NodePlacement(nodes, place_nodes(rows, nodes, placement))
    truth = placement.carry(rows, torch.zeros_like(rows))[:, MEANS]
    found = taken.carry(rows, torch.zeros_like(rows))[:, MEANS]
    assert float((found - truth).norm()) < 0.7 * float(truth.norm())


@pytest.mark.slow
def test_known_pull_is_found_from_its_pictures_and_restored() -> None:
    case = pulled(size=6000)
    parts = make_parts(case.rows, connected_parts(case.rows[:, MEANS]))
    search = NodeSearch(case.rows, case.crops, 48)
    groups = Groups(parts, (parts.rest_motion(),))
    found, again = (
        move_nodes(groups, search, [case.boxes], (1.0,), lambda stage, step, loss: None) for _ in range(2)
    )
    assert "nodes" in found.lines()[0]
    saved = found.capture_state()
    assert all(torch.equal(saved[name], values) for name, values in again.capture_state().items())
    nothing = torch.zeros_like(case.rows)
    carried = found.placements[0].carry(case.rows, nothing)
    assert torch.equal(restore_groups(case.rows, saved).placements[0].carry(case.rows, nothing), carried)
    members = small("body", size=6000, count=6, image_size=72).region.members
    for strength in (0.5, 1.0):
        truth = nothing.clone()
        truth[torch.searchsorted(members, case.course.region.members)] = case.course.offsets_at(strength)
        there = found.rest.interpolate(found.placements[0], strength).carry(case.rows, nothing)
        missed = (there - truth)[:, MEANS].norm()
        assert float(missed) < 0.75 * float(truth[:, MEANS].norm())
    rest = search.distance(case.boxes, rest_nodes(search.nodes))
    assert search.distance(case.boxes, found.nodes[0].motion) < 0.4 * rest


def test_pictures_without_motion_need_no_nodes() -> None:
    case = pulled()
    parts = make_parts(case.rows, connected_parts(case.rows[:, MEANS]))
    search = NodeSearch(case.rows, case.crops[:2], 6)
    with torch.no_grad():
        boxes = [one.render(case.rows) for one in case.crops[:2]]
    groups = Groups(parts, (parts.rest_motion(),))
    assert not move_nodes(groups, search, [boxes], (1.0,), lambda stage, step, loss: None).nodes
