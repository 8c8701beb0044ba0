"""Nodes of a region: a deformation graph of some hundred nodes that moves as the pictures show.

The graph is that of pulls (`progdf.pull`). The unknowns are the positions of the nodes. Each node has the
affine map that fits its neighbors best, and a member blends the maps of the nodes near it. The rotations of
the nodes are those of as-rigid-as-possible deformation (Sorkine and Alexa 2007).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor
from torch.nn.functional import normalize

from progdf.gaussians import BASE_CHANNELS, attribute_slices, unpack
from progdf.pull.follow import bind
from progdf.pull.follow_kernel import MAX_STRETCH
from progdf.pull.graph import build_graph
from progdf.pull.solve import nearest_rotations
from progdf.quaternions import (
    matrix_quats,
    matrix_turns,
    multiply_quats,
    normalize_quats,
    quat_turns,
    rotation_matrices,
    turn_quats,
)
from progdf.system.equality import equal_fields

from .warp import MemberMaps, RegionMotion, rigid_path

Floats = NDArray[np.float64]

MAX_SEARCH_NODES = 300
"""Largest number of nodes of a search."""
_GRADIENT_PRIOR = 0.05  # weight of the rotation in a node's map, as a share of its edges' squares
_MAX_GROWTH = math.log(MAX_STRETCH)
_JACOBI_SWEEPS = 3
_PAIRS = ((0, 1), (0, 2), (1, 2))
_COLUMNS = attribute_slices(BASE_CHANNELS)


@dataclass(frozen=True)
class RegionNodes:
    """Nodes of a region, and the members that follow them."""

    __eq__ = equal_fields

    positions: Tensor  # [n,3]
    starts: Tensor  # start of each directed edge. [E] int64
    ends: Tensor  # end of each directed edge. [E] int64
    nearest: Tensor  # nodes that each member follows. [M,K] int64
    weights: Tensor  # their weights, with sum 1. [M,K]
    spacing: float  # median length of the edges, world units, > 0

    def __len__(self) -> int:
        return len(self.positions)

    @cached_property
    def arms(self) -> Tensor:
        """Vector from the start of each edge to its end. [E,3]"""
        return self.positions[self.ends] - self.positions[self.starts]

    @cached_property
    def prior(self) -> Tensor:
        """Weight of a node's rotation in its map, squared world units. [n]"""
        nothing = self.arms.new_zeros(len(self))
        squares = nothing.index_add(0, self.starts, self.arms.square().sum(dim=1))
        return (_GRADIENT_PRIOR * squares).clamp_min(1e-6 * self.spacing**2)

    @cached_property
    def inverse_squares(self) -> Tensor:
        """Inverse of the sum of each node's squared edges and its prior. [n,3,3]"""
        squares = self.products(self.positions) + self.prior[:, None, None] * torch.eye(3).to(self.arms)
        inverse: Tensor = torch.linalg.inv(squares.double())
        return inverse.to(self.arms)

    def products(self, positions: Tensor) -> Tensor:
        """Return Σ (x_j − x_i) (p_j − p_i)ᵀ over the edges of each node; differentiable. [n,3] -> [n,3,3]"""
        edges = positions.index_select(0, self.ends) - positions.index_select(0, self.starts)
        outer = (edges[:, :, None] * self.arms[:, None, :]).flatten(1)
        return outer.new_zeros(len(self), 9).index_add(0, self.starts, outer).view(-1, 3, 3)

    def gradients(self, motion: NodeMotion) -> Tensor:
        """Return the affine map at each node; differentiable in the positions. [n,3,3]"""
        rotations = rotation_matrices(turn_quats(motion.turn))
        products = self.products(motion.positions) + self.prior[:, None, None] * rotations
        return products @ self.inverse_squares


@dataclass(frozen=True)
class NodeMotion:
    """Motion of n nodes."""

    __eq__ = equal_fields

    positions: Tensor  # moved positions. [n,3]
    turn: Tensor  # rotation vector, axis times angle in radians. [n,3]


def make_nodes(original: Tensor, max_nodes: int = MAX_SEARCH_NODES) -> RegionNodes:
    """Return the nodes of packed raw member rows. The result is deterministic. [M,C]"""
    rows = original.detach().cpu()
    bands = rows.new_zeros(len(rows), (rows.shape[1] - BASE_CHANNELS) // 3, 3)
    graph = build_graph(unpack(rows, bands), max_nodes)
    binding = bind(graph, rows[:, _COLUMNS["means"]].double().numpy(), graph.node_of)
    nearest, weights = _pad_rows(binding)
    arrays = graph.positions, graph.starts, graph.ends, nearest, weights
    positions, starts, ends, near, shares = (torch.from_numpy(array).to(original.device) for array in arrays)
    return RegionNodes(positions.to(original), starts, ends, near, shares.to(original), graph.spacing)


def _pad_rows(binding: csr_array) -> tuple[NDArray[np.int64], Floats]:
    """Return the columns and values of a sparse matrix, rows filled up with weight 0. [M,K] each"""
    counts = np.diff(binding.indptr)
    width = int(counts.max())
    columns = np.zeros((len(counts), width), np.int64)
    values = np.zeros((len(counts), width))
    rows = np.repeat(np.arange(len(counts)), counts)
    slots = np.arange(len(rows)) - binding.indptr[rows]
    columns[rows, slots] = binding.indices
    values[rows, slots] = binding.data
    return columns, values


def rest_nodes(nodes: RegionNodes) -> NodeMotion:
    """Return the motion that moves nothing."""
    return NodeMotion(nodes.positions, torch.zeros_like(nodes.positions))


def map_members(original: Tensor, nodes: RegionNodes, motion: NodeMotion) -> MemberMaps:
    """Return the maps of the members, differentiable in the positions. `original`: raw rows [M,C]"""
    gradients = nodes.gradients(motion)
    shift = motion.positions - (gradients @ nodes.positions[..., None])[..., 0]
    numbers = torch.cat([gradients.flatten(1), shift, turn_quats(motion.turn)], dim=1)
    # not numbers[nearest]: threads sum its gradient in any order
    followed = numbers.index_select(0, nodes.nearest.flatten()).view(*nodes.nearest.shape, -1)
    blended = (nodes.weights[..., None] * followed).sum(dim=1)
    matrix = blended[:, :9].reshape(-1, 3, 3)
    turn = normalize(blended[:, 12:], dim=1)
    axes = rotation_matrices(normalize_quats(original[:, _COLUMNS["quats"]]))
    growth = (matrix @ axes).norm(dim=1).clamp_min(1e-6).log()
    axes_turn, exact = _stretched_axes(original, axes, matrix.detach(), turn.detach())
    growth = (growth + (exact - growth).detach()).clamp(-_MAX_GROWTH, _MAX_GROWTH)
    return MemberMaps(matrix, blended[:, 9:12], turn, growth, axes_turn)


def _stretched_axes(original: Tensor, axes: Tensor, matrix: Tensor, turn: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rotation of the principal axes by a map, and the growth along each. [M,4], [M,3]

    The covariance J Σ Jᵀ is diagonalized by Jacobi rotations, from the axes that turn with the member.

    Args:
        original: raw member rows. [M,C]
        axes: principal axes at rest, as columns. [M,3,3]
        matrix: J. [M,3,3]
        turn: rotation of the map, unit quaternion. [M,4]
    """
    log_scales = original[:, _COLUMNS["log_scales"]].double()
    relative = log_scales - log_scales.amax(dim=1, keepdim=True)
    frame = rotation_matrices(turn).double() @ axes.double()
    local = frame.mT @ matrix.double() @ (axes.double() * relative.exp()[:, None, :])
    covariance = local @ local.mT
    for _ in range(_JACOBI_SWEEPS):
        for i, j in _PAIRS:
            angle = 0.5 * torch.atan2(2.0 * covariance[:, i, j], covariance[:, i, i] - covariance[:, j, j])
            # at most 45°, so that the axes keep their order
            angle = angle - 0.5 * math.pi * (angle / (0.5 * math.pi)).round()
            rotation = torch.eye(3).double().repeat(len(angle), 1, 1).to(angle.device)
            rotation[:, i, i] = angle.cos()
            rotation[:, j, j] = angle.cos()
            rotation[:, i, j] = -angle.sin()
            rotation[:, j, i] = angle.sin()
            frame = frame @ rotation
            covariance = rotation.mT @ covariance @ rotation
    variances = torch.diagonal(covariance, dim1=1, dim2=2).clamp_min(1e-30)
    quats = matrix_quats(frame @ axes.double().mT)
    quats = torch.where(quats[:, :1] < 0.0, -quats, quats)
    return quats.to(original), (0.5 * variances.log() - relative).to(original)


def place_nodes(original: Tensor, nodes: RegionNodes, placement: RegionMotion) -> NodeMotion:
    """Return the motion of the nodes that follows another placement of the members as closely as they can.

    A node moves to the weighted mean of its members' shifts. `original`: raw member rows. [M,C]
    """
    means = _COLUMNS["means"]
    shifts = placement.carry(original, torch.zeros_like(original))[:, means]
    nothing = torch.zeros_like(nodes.positions)
    weights = nodes.weights.flatten()
    index = nodes.nearest.flatten()
    weighted = weights[:, None] * shifts.repeat_interleave(nodes.nearest.shape[1], dim=0)
    totals = nothing[:, :1].index_add(0, index, weights[:, None])
    moved = nodes.positions + nothing.index_add(0, index, weighted) / totals.clamp_min(1e-9)
    return settle_turns(nodes, NodeMotion(moved, nothing))


def settle_turns(nodes: RegionNodes, motion: NodeMotion) -> NodeMotion:
    """Return the motion with the rotations that fit its positions best, continued from its own."""
    products = nodes.products(motion.positions).detach().cpu().double().numpy()
    start = rotation_matrices(turn_quats(motion.turn)).cpu().double().numpy()
    rotations = torch.from_numpy(nearest_rotations(products, start))
    return NodeMotion(motion.positions, matrix_turns(rotations).to(motion.positions))


def interpolate_nodes(nodes: RegionNodes, a: NodeMotion, b: NodeMotion, share: float) -> NodeMotion:
    """Interpolate two motions as rigidly as possible.

    The rotations are interpolated along the great circle, the stretches linearly and the positions by
    `rigid_path`.
    """
    remaining = quat_turns(multiply_quats(turn_quats(-a.turn), turn_quats(b.turn)))
    turn = quat_turns(multiply_quats(turn_quats(a.turn), turn_quats(share * remaining)))
    rotation_a = rotation_matrices(turn_quats(a.turn))
    rotation_b = rotation_matrices(turn_quats(b.turn))
    rotation = rotation_matrices(turn_quats(turn))
    gradients_a = nodes.gradients(a)
    gradients_b = nodes.gradients(b)
    stretches = torch.lerp(rotation_a.mT @ gradients_a, rotation_b.mT @ gradients_b, share)
    positions = rigid_path(
        nodes.positions,
        torch.stack([nodes.starts, nodes.ends], dim=1),
        nodes.spacing,
        (a.positions, b.positions),
        (gradients_a, rotation @ stretches, gradients_b),
        (rotation_a, rotation, rotation_b),
        share,
    )
    return settle_turns(nodes, NodeMotion(positions, turn))


@dataclass(frozen=True)
class NodePlacement:
    """Motion of a region that follows nodes."""

    nodes: RegionNodes
    motion: NodeMotion

    def carry(self, original: Tensor, offsets: Tensor) -> Tensor:
        """See `RegionMotion`."""
        return map_members(original, self.nodes, self.motion).carry(original, offsets)

    def carry_back(self, original: Tensor, offsets: Tensor) -> Tensor:
        """See `RegionMotion`."""
        return map_members(original, self.nodes, self.motion).carry_back(original, offsets)

    def rest(self) -> NodePlacement:
        """See `RegionMotion`."""
        return NodePlacement(self.nodes, rest_nodes(self.nodes))

    def interpolate(self, other: NodePlacement, share: float) -> NodePlacement:
        """See `RegionMotion`."""
        return NodePlacement(self.nodes, interpolate_nodes(self.nodes, self.motion, other.motion, share))

    def lines(self) -> list[str]:
        """Return the motion of the nodes, in units of their spacing."""
        nodes = self.nodes
        shift = (self.motion.positions - nodes.positions).norm(dim=1) / nodes.spacing
        turn = self.motion.turn.norm(dim=1)
        edges = self.motion.positions[nodes.ends] - self.motion.positions[nodes.starts]
        stretch = edges.norm(dim=1) / nodes.arms.norm(dim=1).clamp_min(1e-9)
        low, high = (1.0, 1.0) if not len(stretch) else (float(stretch.min()), float(stretch.max()))
        return [
            f"moved by {len(nodes)} nodes: shifted by up to {float(shift.max()):.2f} of their spacing, "
            f"rotated by up to {math.degrees(float(turn.max())):.0f} degrees, edges {low:.2f} to "
            f"{high:.2f} times as long"
        ]
