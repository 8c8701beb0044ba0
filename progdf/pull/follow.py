"""Gaussians that follow a node graph: means, scales, rotations and view-dependent colors.

Each Gaussian is bound to the nodes near it, but only to its own node and those connected with it. They blend
their affine maps. Where the map bends within a Gaussian, its tangent at the center is wrong at the ends and
shows as hairs. So the mean takes the mean of the map over the Gaussian's extent, and the covariance the mean
gradient G, as G Σ Gᵀ. The principal axes are continued from the last strength, so that the slider
interpolates like axes. Its higher bands take the blend of the nodes' rotations, as quaternions.

The work is done by `progdf.pull.follow_kernel`, on all threads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from torch import Tensor

from progdf.gaussians import BASE_CHANNELS, attribute_slices
from progdf.quaternions import normalize_quats, rotation_matrices
from progdf.sh import basis, spread_directions
from progdf.system.equality import equal_fields
from progdf.threads import run_chunks

from .follow_kernel import MAX_STRETCH, Bands, Singles, follow_rows
from .graph import Floats, NodeGraph, Rows
from .graph_kernel import average_weights, bind_points
from .node_kernel import NODE_WIDTH, write_nodes
from .solve import Pose

_BOUND_NODES = 6  # nodes that a Gaussian follows
# Largest scale of a small Gaussian, in spacings of the nodes. Its map is nearly affine; pictures of pulls
# differ by less than 0.1 dB from those with a limit of 0.
_WIDE_SPACINGS = 1 / 6
_BIND_CHUNK = 1 << 14  # Gaussians that a thread binds at once
_FOLLOW_CHUNK = 1 << 11  # Gaussians that a thread moves at once
_LEAST_SQUARE = 1e-30  # squared relative scale; keeps logarithms finite
_SPREAD_DIRECTIONS = 20  # size of the even lattice from which the directions of a band are taken
_COLUMNS = attribute_slices(BASE_CHANNELS)


@dataclass(frozen=True)
class Binding:
    """Nodes that M Gaussians follow."""

    __eq__ = equal_fields

    weights: csr_array  # weights of the nodes; rows sum to 1, each has an entry. [M,n] float32
    firsts: NDArray[np.int32]  # first entry of each Gaussian in the next two; small ones have none. [M+1]
    nodes: NDArray[np.int32]  # nodes that wide Gaussians follow. [E]
    # change of each weight per standard deviation along the principal axes, and its mean on each axis less
    # the mean on all axes. [E,6]
    slopes: Singles


@dataclass(frozen=True)
class Frames:
    """Principal axes of M Gaussians at one strength, the start for the next."""

    __eq__ = equal_fields

    # axes times scales at rest relative to the largest, least squared scale, log of the largest, the largest.
    # [M,12]
    halves: Singles
    turns: Singles  # rotation of the columns of G R S that makes them orthogonal. [M,9]
    quats: Singles  # quaternions wxyz of the axes, with the lengths in the scene. [M,4]


def bind(graph: NodeGraph, points: Floats, nodes: Rows) -> csr_array:
    """Return the weights of the nodes that points follow; each row sums to 1. [P,n]

    Args:
        graph: deformation graph
        points: positions at rest. [P,3]
        nodes: the node that each point belongs to. [P]
    """
    table = _neighbor_table(graph)
    count = len(points)
    width = min(_BOUND_NODES + 1, table.shape[1])
    found = np.empty((count, width), np.int32)
    weights = np.empty((count, width))
    positions = np.ascontiguousarray(graph.positions)
    points = np.ascontiguousarray(points)

    def bind_chunk(chunk: int) -> None:
        first = chunk * _BIND_CHUNK
        part = (first, min(first + _BIND_CHUNK, count))
        bind_points(positions, graph.spacing, points, table, nodes, part, found, weights)

    run_chunks(bind_chunk, -(-count // _BIND_CHUNK))
    firsts = width * np.arange(1 + count, dtype=np.int32)
    return csr_array((weights.ravel(), found.ravel(), firsts), shape=(count, len(graph)))


def widen(graph: NodeGraph, binding: csr_array, rows: Tensor, nodes: Rows) -> Binding:
    """Return a binding of centers in which wide Gaussians take the mean over their extents.

    Args:
        graph: deformation graph
        binding: weights of the nodes at the centers, see `bind`. [M,n]
        rows: packed raw rows at rest. [M,C]
        nodes: the node that each Gaussian belongs to. [M]
    """
    count = len(rows)
    scales = rows[:, _COLUMNS["log_scales"]].double().exp()
    wide = np.flatnonzero((scales.amax(dim=1) > _WIDE_SPACINGS * graph.spacing).numpy())
    points = np.ascontiguousarray(rows[wide, _COLUMNS["means"]].double().numpy())
    axes = rotation_matrices(normalize_quats(rows[wide, _COLUMNS["quats"]].double()))
    halves = np.ascontiguousarray((axes * scales[wide, None, :]).numpy())
    table = _neighbor_table(graph)
    own = np.ascontiguousarray(nodes[wide])
    kept = min(_BOUND_NODES + 1, table.shape[1])
    nearby = (np.ascontiguousarray(graph.positions), graph.spacing, table)

    def average_chunk(chunk: int) -> tuple[Rows, Rows, Floats, Floats]:
        first = chunk * _BIND_CHUNK
        last = min(first + _BIND_CHUNK, len(wide))
        part = slice(first, last)
        weights = np.empty((last - first, table.shape[1]))
        slopes = np.empty((*weights.shape, 6))
        gaussians = (points[part], halves[part], own[part])
        average_weights(nearby, gaussians, kept, (0, last - first), weights, slopes)
        row, slot = np.nonzero(weights)
        return first + row, table[own[first + row], slot], weights[row, slot], slopes[row, slot]

    parts = run_chunks(average_chunk, -(-len(wide) // _BIND_CHUNK))
    if not parts:
        return Binding(
            binding.astype(np.float32),
            np.zeros(count + 1, np.int32),
            np.zeros(0, np.int32),
            np.zeros((0, 6), np.float32),
        )
    row, node, weight, slopes = (np.concatenate(part) for part in zip(*parts, strict=True))
    entry_counts = np.zeros(count, np.int64)
    entry_counts[wide] = np.bincount(row, minlength=len(wide))
    firsts = np.append(0, np.cumsum(entry_counts)).astype(np.int32)
    averaged = csr_array((weight, node, firsts), shape=binding.shape)
    is_small = np.ones(count)
    is_small[wide] = 0.0
    centers = csr_array(diags_array(is_small) @ binding)
    return Binding(
        csr_array(centers + averaged).astype(np.float32),
        firsts,
        node.astype(np.int32),
        np.ascontiguousarray(slopes, np.float32),
    )


def _neighbor_table(graph: NodeGraph) -> Rows:
    """Return each node and those connected with it, filled up with −1. [n,1+K]"""
    degree = np.bincount(graph.starts, minlength=len(graph))
    table = np.full((len(graph), 1 + int(degree.max(initial=0))), -1, np.int64)
    table[:, 0] = np.arange(len(graph))
    first = np.cumsum(degree) - degree
    table[graph.starts, 1 + np.arange(len(graph.starts)) - first[graph.starts]] = graph.ends
    return table


def rest_frames(rows: Tensor) -> Frames:
    """Return the principal axes of packed raw rows at strength 0. [M,C]"""
    quats = rows[:, _COLUMNS["quats"]]
    log_scales = rows[:, _COLUMNS["log_scales"]].double()
    largest = log_scales.amax(dim=1, keepdim=True)
    axes = rotation_matrices(normalize_quats(quats.double())) * (log_scales - largest).exp()[:, None, :]
    floor = (2.0 * (log_scales.amin(dim=1, keepdim=True) - largest)).exp() / MAX_STRETCH**4
    floor = floor.clamp_min(_LEAST_SQUARE)
    halves = torch.cat([axes.flatten(1), floor, largest, largest.exp()], dim=1).float().numpy()
    turns = np.tile(np.eye(3, dtype=np.float32).ravel(), (len(rows), 1))
    return Frames(halves, turns, np.array(quats.detach().float().numpy(), order="C"))


def follow(
    rows: Tensor,
    binding: Binding,
    graph: NodeGraph,
    pose: Pose,
    gradients: Floats,
    last: Frames,
    out: Tensor | None = None,
) -> tuple[Tensor, Frames]:
    """Return packed raw rows that follow the nodes, and their axes.

    Args:
        rows: raw rows at rest. [M,C]; float32 needs no conversion
        binding: nodes that they follow
        graph: deformation graph with n nodes
        pose: deformed nodes
        gradients: their deformation gradients. [n,3,3]
        last: axes at a similar pose
        out: rows of an earlier call to overwrite, contiguous. [M,C] float32

    Returns:
        Rows [M,C] float32 and their axes.
    """
    raw = np.ascontiguousarray(rows.detach().float().numpy())
    packed = torch.empty(raw.shape) if out is None else out
    frames = Frames(last.halves, np.empty_like(last.turns), np.empty_like(last.quats))
    _follow(raw, binding, (graph, pose, gradients), (last, frames), packed.numpy(), is_offset=False)
    return packed, frames


def follow_in_place(
    rows: Tensor,
    binding: Binding,
    graph: NodeGraph,
    pose: Pose,
    gradients: Floats,
    frames: Frames,
    offsets: Tensor,
) -> None:
    """Write the offsets of rows that follow the nodes, without new memory that grows with M.

    Args: see `follow`.
        frames: axes at a similar pose, replaced by those at this pose
        offsets: packed offsets from the rows at rest, contiguous; written. [M,C] float32
    """
    raw = rows.numpy()
    _follow(raw, binding, (graph, pose, gradients), (frames, frames), offsets.numpy(), is_offset=True)


def _follow(
    raw: Singles,
    binding: Binding,
    nodes: tuple[NodeGraph, Pose, Floats],
    frames: tuple[Frames, Frames],
    result: Singles,
    is_offset: bool,
) -> None:
    """Write the rows that follow the nodes, or their offsets, and the axes; the last axes come first."""
    graph, pose, gradients = nodes
    last, written = frames
    count = len(raw)
    center = graph.positions.mean(axis=0)
    table = np.zeros((len(graph), NODE_WIDTH), np.float32)
    write_nodes(
        np.ascontiguousarray(gradients, np.float64),
        graph.positions,
        np.ascontiguousarray(pose.positions, np.float64),
        center,
        table,
    )
    weights = (
        binding.weights.indptr.astype(np.int32, copy=False),
        binding.weights.indices.astype(np.int32, copy=False),
        binding.weights.data.astype(np.float32, copy=False),
    )
    bends = (binding.firsts, binding.nodes, binding.slopes.ravel())
    degree = min(3, math.isqrt((raw.shape[1] - BASE_CHANNELS) // 3 + 1) - 1)
    bands = (_band_samples(1), _band_samples(2), _band_samples(3))
    motions = (table.ravel(), center.astype(np.float32))
    start = (last.halves, last.turns, last.quats)
    end = (written.turns, written.quats)

    def move(chunk: int) -> None:
        first = chunk * _FOLLOW_CHUNK
        part = (first, min(first + _FOLLOW_CHUNK, count), degree, is_offset)
        follow_rows(raw, (weights, bends), motions, start, end, bands, result, part)

    run_chunks(move, -(-count // _FOLLOW_CHUNK))


@cache
def _band_samples(degree: int) -> Bands:
    """Return directions of a band, and the matrix from colors along them to its coefficients."""
    count = 2 * degree + 1
    directions = spread_directions(_SPREAD_DIRECTIONS)[:count]
    values = basis(degree, directions)[:, degree * degree :]
    inverse = torch.linalg.inv(values)
    return (
        np.ascontiguousarray(directions.float().numpy().ravel()),
        np.ascontiguousarray(inverse.float().numpy().ravel()),
    )
