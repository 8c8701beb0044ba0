"""Plain versions of the pull's kernels: rounds of the solver, and following Gaussians."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from progdf.gaussians import BASE_CHANNELS
from progdf.pull.follow import Binding
from progdf.pull.follow_kernel import MAX_STRETCH
from progdf.pull.graph import Floats, Mask, NodeGraph
from progdf.pull.solve import Pose
from progdf.quaternions import matrix_quats, normalize_quats, rotation_matrices
from progdf.similarity import band_change
from tests.helpers.plain_graph import dense_slopes


def polar(matrices: Floats) -> Floats:
    """Return the nearest rotations of matrices, by their singular values. [n,3,3]"""
    left, _, right = np.linalg.svd(matrices)
    left[:, :, 2] *= np.where(np.linalg.det(left @ right) < 0.0, -1.0, 1.0)[:, None]
    rotations: Floats = left @ right
    return rotations


def settle(graph: NodeGraph, free: Mask, targets: Floats, rounds: int) -> Pose:
    """Repeat plain rounds from rest. Nodes that are not free are at their targets. [n,3]"""
    count = len(graph)
    starts = graph.starts
    ends = graph.ends
    laplacian = np.diag(np.bincount(starts, minlength=count).astype(float))
    laplacian[starts, ends] -= 1.0
    positions = np.where(free[:, None], graph.positions, targets)
    rotations = np.broadcast_to(np.eye(3), (count, 3, 3))
    for _ in range(rounds):
        products = np.zeros((count, 3, 3))
        steps = positions[ends] - positions[starts]
        np.add.at(products, starts, steps[:, :, None] * graph.arms[:, None, :])
        rotations = polar(products)
        mixed = rotations[starts] + rotations[ends]
        right = np.zeros((count, 3))
        np.add.at(right, starts, -0.5 * np.einsum("eij,ej->ei", mixed, graph.arms))
        known = right[free] - laplacian[free][:, ~free] @ targets[~free]
        positions = positions.copy()
        positions[free] = np.linalg.solve(laplacian[free][:, free], known)
    return Pose(positions, rotations)


def limit_axes(halves: Floats, at_rest: Floats) -> Floats:
    """Return principal axes times standard deviations, each limited by its length at rest. [M,3,3]"""
    left, values, right = np.linalg.svd(halves)
    lengths = np.linalg.norm(at_rest @ np.swapaxes(right, 1, 2), axis=1)
    limited: Floats = left * values.clip(lengths / MAX_STRETCH, lengths * MAX_STRETCH)[:, None, :]
    return limited


def follow(
    rows: Tensor, binding: Binding, graph: NodeGraph, pose: Pose, gradients: Floats
) -> tuple[Floats, Floats, Tensor]:
    """Return the means [M,3], covariances [M,3,3] and higher bands [M,C−14] that follow the nodes."""
    points = rows[:, :3].double().numpy()
    dense = binding.weights.toarray()
    slopes, differences = np.split(dense_slopes(binding, len(graph)), 2, axis=2)
    arms = points[:, None] - graph.positions[None]
    moved = np.einsum("nij,mnj->mni", gradients, arms) + pose.positions
    axes = rotation_matrices(normalize_quats(rows[:, 6:10].double())).numpy()
    at_rest = axes * np.exp(rows[:, 3:6].double().numpy())[:, None, :]
    means = np.einsum("mn,mni->mi", dense, moved)
    means += np.einsum("nij,mjk,mnk->mi", gradients, at_rest, slopes)
    gradient = np.einsum("mn,nij->mij", dense, gradients)
    bends = np.einsum("mni,mnk->mik", moved - points[:, None], slopes)
    bends += np.einsum("nij,mjk,mnk->mik", gradients, at_rest, differences)
    half = limit_axes(gradient @ at_rest + bends, at_rest)
    quats = matrix_quats(torch.from_numpy(polar(gradients))).numpy()
    base = quats[(dense > 0.0).argmax(axis=1)]
    signs = np.where(base @ quats.T < 0.0, -1.0, 1.0)
    blended = normalize_quats(torch.from_numpy((dense * signs) @ quats))
    bands = rows[:, BASE_CHANNELS:].double()
    return means, half @ np.swapaxes(half, 1, 2), bands + band_change(bands, blended)
