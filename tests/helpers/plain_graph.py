"""Plain versions of the kernels of the deformation graph."""

from __future__ import annotations

import math

import numpy as np

from progdf.gaussians import Gaussians
from progdf.pull.follow import Binding
from progdf.pull.graph import Floats, NodeGraph, Rows
from progdf.quaternions import rotation_matrices
from progdf.scene.neighbors import join_pairs


def measure_pairs(
    members: Gaussians, colors: Floats, near: Rows, distance: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return the gaps, color distances and cosines of the normals of Gaussians and neighbors. [M,K] each"""
    points = members.means.double().numpy()
    axes = rotation_matrices(members.unit_quats.double()).numpy()
    scales = members.scales.double().numpy()
    direction = (points[near] - points[:, None]) / np.maximum(distance, 1e-30)[..., None]
    own = np.einsum("mij,mki->mkj", axes, direction) * scales[:, None]
    other = np.einsum("mkij,mki->mkj", axes[near], direction) * scales[near]
    reach = np.linalg.norm(own, axis=2) + np.linalg.norm(other, axis=2)
    normals = axes[np.arange(len(points)), :, scales.argmin(axis=1)]
    cosines = np.abs((normals[:, None] * normals[near]).sum(axis=2))
    color_distance = np.linalg.norm(colors[:, None] - colors[near], axis=2)
    return distance / np.maximum(reach, 1e-30), color_distance, cosines


def count_cells(points: Floats, low: Floats, size: float) -> int:
    """Return the number of grid cells that hold points. [M,3]"""
    return len(np.unique(((points - low) / size).astype(np.int64), axis=0))


def join_links(start: Rows, end: Rows, cell: Rows) -> Rows:
    """Return the group of each row: rows of one cell that are joined by pairs. [M]"""
    within = cell[start] == cell[end]
    return join_pairs(start[within], end[within], len(cell))


def bind(graph: NodeGraph, points: Floats, nodes: Rows, bound: int) -> Floats:
    """Return the weights of the nodes in points that follow at most `bound` − 1 of them. [P,n]"""
    weights = np.zeros((len(points), len(graph)))
    for row, (point, node) in enumerate(zip(points, nodes.tolist(), strict=True)):
        candidates = np.append(node, graph.ends[graph.starts == node])
        distance = np.linalg.norm(graph.positions[candidates] - point, axis=1)
        order = np.argsort(distance, kind="stable")[:bound]
        near = distance[order]
        share = (1.0 - near / (1.001 * near.max() + 1e-9 * graph.spacing)).clip(0.0) ** 2
        weights[row, candidates[order]] = share / share.sum()
    return weights


def average(
    graph: NodeGraph, points: Floats, halves: Floats, nodes: Rows, bound: int
) -> tuple[Floats, Floats]:
    """Return weights averaged over six points of Gaussians [M,n], and slopes and differences [M,n,6].

    Args:
        graph: deformation graph
        points: centers. [M,3]
        halves: principal axes times standard deviations, as columns. [M,3,3]
        nodes: the node that each Gaussian belongs to. [M]
        bound: see `bind`
    """
    distance = math.sqrt(3.0)
    slopes = []
    means = []
    for axis in range(3):
        ahead = bind(graph, points + distance * halves[:, :, axis], nodes, bound)
        behind = bind(graph, points - distance * halves[:, :, axis], nodes, bound)
        slopes.append((ahead - behind) / (2.0 * distance))
        means.append(0.5 * (ahead + behind))
    weights = (means[0] + means[1] + means[2]) / 3.0
    return weights, np.stack([*slopes, *(mean - weights for mean in means)], axis=2)


def dense_slopes(binding: Binding, count: int) -> Floats:
    """Return the slopes and differences of a binding for all of `count` nodes. [M,n,6]"""
    members = len(binding.firsts) - 1
    slopes = np.zeros((members, count, 6))
    slopes[np.repeat(np.arange(members), np.diff(binding.firsts)), binding.nodes] = binding.slopes
    return slopes
