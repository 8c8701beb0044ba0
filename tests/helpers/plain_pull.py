"""Plain versions of the pull's kernels: rounds of the solver, and following Gaussians."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from progdf.gaussians import BASE_CHANNELS
from progdf.pull.follow import MAX_STRETCH
from progdf.pull.graph import Floats, Mask, NodeGraph
from progdf.pull.solve import Pose
from progdf.quaternions import matrix_quats, normalize_quats, rotation_matrices
from progdf.similarity import band_change


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


def follow(
    rows: Tensor, binding: csr_array, graph: NodeGraph, pose: Pose, gradients: Floats
) -> tuple[Floats, Floats, Tensor]:
    """Return the means [M,3], covariances [M,3,3] and higher bands [M,C−14] that follow the nodes."""
    points = rows[:, :3].double().numpy()
    dense = binding.toarray()
    arms = points[:, None] - graph.positions[None]
    moved = np.einsum("nij,mnj->mni", gradients, arms) + pose.positions
    means = np.einsum("mn,mni->mi", dense, moved)
    left, values, right = np.linalg.svd(gradients)
    limited = (left * values.clip(1.0 / MAX_STRETCH, MAX_STRETCH)[:, None, :]) @ right
    gradient = np.einsum("mn,nij->mij", dense, limited)
    axes = rotation_matrices(normalize_quats(rows[:, 6:10].double())).numpy()
    half = gradient @ (axes * np.exp(rows[:, 3:6].double().numpy())[:, None, :])
    quats = matrix_quats(torch.from_numpy(polar(gradients))).numpy()
    base = quats[(dense > 0.0).argmax(axis=1)]
    signs = np.where(base @ quats.T < 0.0, -1.0, 1.0)
    blended = normalize_quats(torch.from_numpy((dense * signs) @ quats))
    bands = rows[:, BASE_CHANNELS:].double()
    return means, half @ np.swapaxes(half, 1, 2), bands + band_change(bands, blended)
