"""Gaussians that follow a node graph: means, scales, rotations and view-dependent colors.

Each Gaussian is bound to the nodes near it, but only to its own node and those connected with it. Its mean
moves by the blend of their affine maps. Its covariance takes the blended gradient G, as G Σ Gᵀ. The principal
axes are continued from the last strength, so that the slider interpolates like axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from progdf.gaussians import BASE_CHANNELS, attribute_slices
from progdf.quaternions import matrix_quats, normalize_quats, rotation_matrices
from progdf.similarity import band_change

from .graph import Floats, NodeGraph, Rows
from .solve import Pose, nearest_rotations

MAX_STRETCH = 3.0
"""Largest factor by which a Gaussian grows or shrinks; more shows as hairs."""
_BOUND_NODES = 6  # nodes that a Gaussian follows
_CHUNK = 1 << 16  # Gaussians that are bound at once
_JACOBI_SWEEPS = 4
_PAIRS = ((0, 1), (0, 2), (1, 2))
_COLUMNS = attribute_slices(BASE_CHANNELS)


@dataclass(frozen=True)
class Frames:
    """Principal axes of M Gaussians at one strength, the start for the next."""

    axes: Floats  # columns are axes. [M,3,3]
    quats: Floats  # their quaternions wxyz, with the lengths in the scene. [M,4]
    rotations: Floats  # rotations from the original. [M,3,3]


def bind(graph: NodeGraph, points: Floats, nodes: Rows) -> csr_array:
    """Return the weights of the nodes that points follow; each row sums to 1. [P,n]

    Args:
        graph: deformation graph
        points: positions at rest. [P,3]
        nodes: the node that each point belongs to. [P]
    """
    table = _neighbor_table(graph)
    parts = [
        _bind_chunk(graph, points[first : first + _CHUNK], table[nodes[first : first + _CHUNK]])
        for first in range(0, len(points), _CHUNK)
    ]
    found = np.concatenate([part[0] for part in parts])
    weights = np.concatenate([part[1] for part in parts])
    rows = np.repeat(np.arange(len(points)), found.shape[1])
    return csr_array((weights.ravel(), (rows, found.ravel())), shape=(len(points), len(graph)))


def _neighbor_table(graph: NodeGraph) -> Rows:
    """Return each node and those connected with it, filled up with −1. [n,1+K]"""
    degree = np.bincount(graph.starts, minlength=len(graph))
    table = np.full((len(graph), 1 + int(degree.max(initial=0))), -1, np.int64)
    table[:, 0] = np.arange(len(graph))
    first = np.cumsum(degree) - degree
    table[graph.starts, 1 + np.arange(len(graph.starts)) - first[graph.starts]] = graph.ends
    return table


def _bind_chunk(graph: NodeGraph, points: Floats, candidates: Rows) -> tuple[Rows, Floats]:
    """Return the followed nodes of points [P,K] and their weights [P,K]."""
    distance = np.linalg.norm(graph.positions[candidates] - points[:, None], axis=2)
    distance[candidates < 0] = np.inf
    kept = min(_BOUND_NODES + 1, candidates.shape[1])
    order = np.argsort(distance, axis=1)[:, :kept]
    near = np.take_along_axis(distance, order, axis=1)
    found = np.maximum(np.take_along_axis(candidates, order, axis=1), 0)
    usable = np.isfinite(near)
    # the weights fall to 0 at the farthest candidate if there are more than enough
    reach = 1.001 * np.where(usable, near, 0.0).max(axis=1, keepdims=True) + 1e-9 * graph.spacing
    weights = np.where(usable, 1.0 - near / reach, 0.0).clip(0.0) ** 2
    total = weights.sum(axis=1, keepdims=True)
    weights = np.where(
        total > 0.0, weights / np.maximum(total, 1e-300), usable / usable.sum(axis=1, keepdims=True)
    )
    return found, weights


def rest_frames(rows: Tensor) -> Frames:
    """Return the principal axes of packed raw rows at strength 0. [M,C]"""
    raw = rows[:, _COLUMNS["quats"]].double()
    axes = rotation_matrices(normalize_quats(raw)).numpy()
    identity = np.broadcast_to(np.eye(3), axes.shape)
    return Frames(axes, raw.numpy(), identity)


def follow(
    rows: Tensor, binding: csr_array, graph: NodeGraph, pose: Pose, gradients: Floats, last: Frames
) -> tuple[Tensor, Frames]:
    """Return packed raw rows that follow the nodes, and their axes.

    Args:
        rows: raw rows at rest. [M,C] float64
        binding: weights of the nodes. [M,n]
        graph: deformation graph with n nodes
        pose: deformed nodes
        gradients: their deformation gradients. [n,3,3]
        last: axes at a similar pose
    """
    means = rows[:, _COLUMNS["means"]].numpy()
    shifts = pose.positions - np.einsum("nij,nj->ni", gradients, graph.positions)
    table = np.concatenate(
        [gradients.reshape(-1, 9), shifts, _limit_stretch(gradients).reshape(-1, 9)], axis=1
    )
    blended = binding @ table
    moved = np.einsum("mij,mj->mi", blended[:, :9].reshape(-1, 3, 3), means) + blended[:, 9:12]
    gradient = blended[:, 12:].reshape(-1, 3, 3)
    rotations = nearest_rotations(gradient, last.rotations, steps=4)
    axes, log_scales = _stretch_axes(rows, gradient, last)
    quats = _continued_quats(axes, last.quats)
    bands = rows[:, BASE_CHANNELS:]
    turned = bands + band_change(bands, matrix_quats(torch.from_numpy(rotations)))
    packed = torch.cat(
        [
            torch.from_numpy(moved),
            torch.from_numpy(log_scales),
            torch.from_numpy(quats),
            rows[:, _COLUMNS["quats"].stop : BASE_CHANNELS],
            turned,
        ],
        dim=1,
    )
    return packed, Frames(axes, quats, rotations)


def _limit_stretch(gradients: Floats) -> Floats:
    """Return gradients with singular values limited to 1 / MAX_STRETCH to MAX_STRETCH. [n,3,3]"""
    left, values, right = np.linalg.svd(gradients)
    bounded: Floats = (left * values.clip(1.0 / MAX_STRETCH, MAX_STRETCH)[:, None, :]) @ right
    return bounded


def _stretch_axes(rows: Tensor, gradient: Floats, last: Frames) -> tuple[Floats, Floats]:
    """Return axes [M,3,3] and log-scales [M,3] of G Σ Gᵀ, with the axes nearest to the last ones.

    The scales are computed relative to each Gaussian's largest one, so that tiny and huge ones stay in range.
    """
    log_scales = rows[:, _COLUMNS["log_scales"]].numpy()
    largest = log_scales.max(axis=1, keepdims=True)
    original = rotation_matrices(normalize_quats(rows[:, _COLUMNS["quats"]])).numpy()
    half = gradient @ (original * np.exp(log_scales - largest)[:, None, :])
    # cyclic Jacobi rotations of at most 45° from the last axes, which keep their order
    axes = last.axes
    local = np.swapaxes(axes, 1, 2) @ half
    matrix = local @ np.swapaxes(local, 1, 2)
    for _ in range(_JACOBI_SWEEPS):
        for i, j in _PAIRS:
            turn = _jacobi(matrix[:, i, i], matrix[:, j, j], matrix[:, i, j])
            axes = _turn_columns(axes, turn, i, j)
            matrix = _turn_columns(matrix, turn, i, j)
            matrix = np.swapaxes(_turn_columns(np.swapaxes(matrix, 1, 2), turn, i, j), 1, 2)
    values = np.einsum("mii->mi", matrix)
    floor = np.exp(2.0 * (log_scales.min(axis=1, keepdims=True) - largest)) / MAX_STRETCH**4
    return axes, largest + 0.5 * np.log(np.maximum(values, np.maximum(floor, 1e-300)))


def _jacobi(first: Floats, second: Floats, mixed: Floats) -> tuple[Floats, Floats]:
    """Return cosine and sine of the smaller rotation that removes the mixed entry. [M] each"""
    difference = second - first
    small = np.abs(mixed) <= 1e-16 * (first + second)
    safe = np.where(small, 1.0, mixed)
    ratio = difference / (2.0 * safe)
    tangent = np.where(ratio < 0.0, -1.0, 1.0) / (np.abs(ratio) + np.sqrt(1.0 + ratio * ratio))
    tangent = np.where(small, 0.0, tangent)
    cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
    return cosine, tangent * cosine


def _turn_columns(matrices: Floats, turn: tuple[Floats, Floats], i: int, j: int) -> Floats:
    cosine, sine = turn
    turned = matrices.copy()
    turned[:, :, i] = cosine[:, None] * matrices[:, :, i] - sine[:, None] * matrices[:, :, j]
    turned[:, :, j] = sine[:, None] * matrices[:, :, i] + cosine[:, None] * matrices[:, :, j]
    return turned


def _continued_quats(axes: Floats, last: Floats) -> Floats:
    """Return the quaternions of axes with the lengths and the sign of the last ones. [M,4]"""
    quats = matrix_quats(torch.from_numpy(axes)).numpy()
    length = np.linalg.norm(last, axis=1, keepdims=True)
    length = np.where(length > 0.0, length, 1.0)
    sign = np.where((quats * last).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    continued: Floats = quats * sign * length
    return continued
