"""Parity of the pull's kernels with their plain versions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array

from progdf.gaussians import pack
from progdf.pull.follow import bind, follow, follow_in_place, rest_frames, widen
from progdf.pull.graph import build_graph
from progdf.pull.solve import Pose, Solver, nearest_rotations
from progdf.quaternions import rotation_matrices, turn_quats
from tests.helpers import plain_pull
from tests.progdf.pull.test_pull import SPACING, bar, covariances


def test_accelerated_rounds_settle_where_plain_rounds_settle() -> None:
    graph = build_graph(bar(12))
    count = len(graph)
    held = graph.positions[:, 0] < 0.25
    handle = int(graph.positions[:, 0].argmax())
    target = graph.positions[handle] + np.array([-0.2, 0.5, 0.1])
    blends = csr_array(([1.0], ([0], [handle])), shape=(1, count))
    # at a node, a handle constrains only its position
    solver = Solver(graph, blends, graph.positions[[handle]], held, np.zeros(count))
    found = solver.solve(target[None], solver.rest())
    free = ~held
    free[handle] = False
    targets = graph.positions.copy()
    targets[handle] = target
    plain = plain_pull.settle(graph, free, targets, 1500)
    assert np.abs(found.positions - plain.positions).max() < 0.01 * SPACING
    assert np.abs(found.rotations - plain.rotations).max() < 0.02


def test_few_rounds_of_drag_steps_follow_the_settled_pose() -> None:
    graph = build_graph(bar(12))
    count = len(graph)
    handle = int(graph.positions[:, 0].argmax())
    blends = csr_array(([1.0], ([0], [handle])), shape=(1, count))
    solver = Solver(graph, blends, graph.positions[[handle]], graph.positions[:, 0] < 0.25, np.zeros(count))
    shift = np.array([[-0.2, 0.5, 0.1]])
    pose = solver.rest()
    for step in range(1, 21):
        pose = solver.solve(graph.positions[[handle]] + step / 20 * shift, pose, rounds=4)
    settled = solver.solve(graph.positions[[handle]] + shift, solver.rest())
    assert np.abs(pose.positions - settled.positions).max() < 0.3 * SPACING


@pytest.mark.parametrize(("degree", "growth"), [(0, 0.0), (1, 1.5), (2, -3.0), (3, 0.0)])
def test_following_gaussians_agree_with_the_plain_version(degree: int, growth: float) -> None:
    scene = bar(7, degree=degree)  # no multiple of eight
    scene.log_scales.add_(growth)  # up to wider than the distance of the nodes
    graph = build_graph(scene)
    generator = np.random.default_rng(degree)
    turns = torch.from_numpy(
        1.5 * generator.normal(size=(1, 3)) + 0.3 * generator.normal(size=(len(graph), 3))
    )
    stretch = np.eye(3) + 0.3 * generator.normal(size=(len(graph), 3, 3))
    gradients = rotation_matrices(turn_quats(turns)).numpy() @ (stretch @ np.swapaxes(stretch, 1, 2))
    pose = Pose(graph.positions + 0.1 * generator.normal(size=(len(graph), 3)), gradients)
    rows = pack(scene, with_shN=True)
    binding = widen(graph, bind(graph, scene.means.double().numpy(), graph.node_of), rows, graph.node_of)
    packed, _ = follow(rows, binding, graph, pose, gradients, rest_frames(rows))
    means, spread, bands = plain_pull.follow(rows, binding, graph, pose, gradients)
    followed = scene.replace_rows(torch.arange(len(scene)), packed)
    assert np.abs(packed[:, :3].numpy() - means).max() < 1e-5
    assert np.abs(covariances(followed).numpy() - spread).max() < 1e-5 * np.abs(spread).max()
    assert torch.equal(packed[:, 10:14], rows[:, 10:14])
    assert torch.allclose(packed[:, 14:].double(), bands, atol=1e-5)


def test_translated_gaussians_keep_their_bands_bit_for_bit() -> None:
    scene = bar(7, degree=3)
    graph = build_graph(scene)
    rows = pack(scene, with_shN=True)
    binding = widen(graph, bind(graph, scene.means.double().numpy(), graph.node_of), rows, graph.node_of)
    identity = np.tile(np.eye(3), (len(graph), 1, 1))
    pose = Pose(graph.positions + np.array([0.3, 0.0, 0.1]), identity)
    packed, _ = follow(rows, binding, graph, pose, identity, rest_frames(rows))
    assert torch.equal(packed[:, 14:], rows[:, 14:])


def test_thin_discs_keep_their_thickness() -> None:
    scene = bar(7)
    flat = scene.log_scales.clone()
    flat[:, 1] -= 12.0
    scene = scene.replace_rows(
        torch.arange(len(scene)), torch.cat([scene.means, flat, pack(scene)[:, 6:]], 1)
    )
    graph = build_graph(scene)
    rows = pack(scene)
    binding = widen(graph, bind(graph, scene.means.double().numpy(), graph.node_of), rows, graph.node_of)
    turn = rotation_matrices(turn_quats(torch.tensor([[0.4, -1.1, 0.7]], dtype=torch.float64))).numpy()
    turns = np.tile(turn, (len(graph), 1, 1))
    packed, _ = follow(
        rows, binding, graph, Pose(graph.positions @ turn[0].T, turns), turns, rest_frames(rows)
    )
    assert torch.allclose(packed[:, 3:6], rows[:, 3:6], atol=1e-4)


def test_nearest_rotation_of_a_half_turn_and_of_a_flat_matrix() -> None:
    half_turn = np.diag([1.0, -1.0, -1.0])[None]
    found = nearest_rotations(half_turn, np.eye(3)[None])
    assert np.allclose(found @ np.swapaxes(found, 1, 2), np.eye(3), atol=1e-12)
    flat = np.zeros((1, 3, 3))
    assert np.array_equal(nearest_rotations(flat, np.eye(3)[None]), np.eye(3)[None])


def test_offsets_written_in_place_are_those_of_the_followed_rows() -> None:
    scene = bar(9, degree=2)
    graph = build_graph(scene)
    generator = np.random.default_rng(4)
    turns = rotation_matrices(turn_quats(torch.from_numpy(generator.normal(size=(len(graph), 3))))).numpy()
    pose = Pose(graph.positions + 0.1 * generator.normal(size=(len(graph), 3)), turns)
    rows = pack(scene, with_shN=True)
    at_rest = rows.clone()
    binding = widen(graph, bind(graph, scene.means.double().numpy(), graph.node_of), rows, graph.node_of)
    packed, expected = follow(rows, binding, graph, pose, turns, rest_frames(rows))
    frames = rest_frames(rows)
    offsets = torch.full_like(rows, torch.nan)
    follow_in_place(rows, binding, graph, pose, turns, frames, offsets)
    assert torch.equal(offsets, packed - rows)
    assert torch.equal(rows, at_rest)
    assert np.array_equal(frames.turns, expected.turns)
    assert np.array_equal(frames.quats, expected.quats)
