"""As-rigid-as-possible deformation of a node graph (Sorkine and Alexa 2007) with point handles.

The energy is Σ |x_j − x_i − R_i (p_j − p_i)|² over all edges, with unknown positions x and rotations R. Two
steps alternate: rotations for given positions, node by node; and positions for given rotations, a linear
system whose factorization stays the same for the whole course.

The rounds are accelerated, see `progdf.pull.solve_kernel`.

A handle constrains a point of the surface, which is a blend of the nodes near it, so that no node sticks out.
A falloff adds springs to the rest positions, which are stiff at its radius. Held nodes are eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from progdf.system.equality import equal_fields

from . import solve_kernel
from .graph import Floats, Mask, NodeGraph, Rows

DRAG_ROUNDS = 12
"""Rounds of a step while a handle is dragged; the next steps continue them."""
_MAX_ROUNDS = 500
_HANDLE_STIFFNESS = 1e5  # edges; the error of a handle's position is about 1 / 1e5 of its pull
_SETTLED_SHARE = 2e-5  # of the free nodes' diagonal; a round that moves no coordinate farther is the last
_GRADIENT_PRIOR = 0.05  # weight of the rotation in a node's gradient, as a share of its edges' squares


@dataclass(frozen=True)
class Pose:
    """Deformed state of the n nodes."""

    __eq__ = equal_fields

    positions: Floats  # [n,3]
    rotations: Floats  # [n,3,3]


class Solver:
    """Factorized system of one graph with fixed handles, held nodes and springs.

    Args:
        graph: deformation graph with n nodes
        blends: weights of the nodes in each of H handles; rows sum to 1. [H,n]
        points: positions of the handles at rest. [H,3]
        held: nodes that keep their positions. [n]
        springs: stiffness of the springs to the rest positions, in edges, ≥ 0. [n]
    """

    def __init__(
        self, graph: NodeGraph, blends: csr_array, points: Floats, held: Mask, springs: Floats
    ) -> None:
        self._graph = graph
        free: Rows = np.flatnonzero(~held)
        self._held: Rows = np.flatnonzero(held)
        count = len(graph)
        first = np.concatenate([[0], np.cumsum(np.bincount(graph.starts, minlength=count))])
        arms = np.ascontiguousarray(graph.arms)
        self._rest = np.ascontiguousarray(graph.positions)
        self._edges = (_rows(first), _rows(graph.ends), arms, np.ascontiguousarray(springs, np.float64))
        squares = self._products(self._rest)
        prior = _GRADIENT_PRIOR * np.trace(squares, axis1=1, axis2=2)
        self._prior = np.maximum(prior, 1e-12 * graph.spacing**2)
        self._inverse_squares = np.linalg.inv(squares + self._prior[:, None, None] * np.eye(3))
        # a handle is at Σ w (x + G (point − p)), where G is linear in the positions and rotations
        steering = self._arm_weights(blends, points)
        handles = csr_array(blends + steering @ _to_products(graph))
        steering = csr_array(steering @ diags_array(np.repeat(self._prior, 3)))
        self._handles = (_sparse(handles), _sparse(steering))
        edges = np.ones(len(graph.starts))
        adjacency = csr_array((edges, (graph.starts, graph.ends)), shape=(count, count))
        degree = np.bincount(graph.starts, minlength=count)
        pinned = _HANDLE_STIFFNESS * (handles.T @ handles)
        system = csr_array(diags_array(degree + springs) - adjacency + pinned)
        inner = csc_array(system[free][:, free])
        factor = splu(inner, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        self._factor = (
            _sparse(csc_array(factor.L)),
            _sparse(csc_array(factor.U)),
            _rows(factor.perm_r),
            _rows(factor.perm_c),
        )
        to_held = csr_array(system[free])
        to_held.data[~held[to_held.indices]] = 0.0
        to_held.eliminate_zeros()
        self._nodes = (_rows(free), _sparse(to_held))
        extent = np.ptp(graph.positions[free], axis=0) if len(free) else np.zeros(3)
        self._tolerance = _SETTLED_SHARE * max(float(np.linalg.norm(extent)), graph.spacing)

    def rest(self) -> Pose:
        """Return the pose in which no node has moved."""
        rotations = np.broadcast_to(np.eye(3), (len(self._graph), 3, 3)).copy()
        return Pose(self._graph.positions.copy(), rotations)

    def solve(self, targets: Floats, start: Pose, rounds: int = _MAX_ROUNDS) -> Pose:
        """Return the pose with the handles at some positions.

        Args:
            targets: positions of the handles. [H,3]
            start: pose for similar targets, the warm start
            rounds: largest number of rounds; a live drag takes few at a time
        """
        pose = Pose(
            np.array(start.positions, np.float64, order="C"), np.array(start.rotations, np.float64, order="C")
        )
        pose.positions[self._held] = self._rest[self._held]
        solve_kernel.settle(
            self._edges,
            self._factor,
            self._nodes,
            (*self._handles, np.ascontiguousarray(targets, np.float64), _HANDLE_STIFFNESS),
            self._rest,
            (pose.positions, pose.rotations),
            (rounds, self._tolerance),
        )
        return pose

    def gradients(self, pose: Pose) -> Floats:
        """Return the affine deformation gradient at each node, by least squares over its edges. [n,3,3]

        Directions in which a node has no edges follow its rotation.
        """
        products = self._products(pose.positions) + self._prior[:, None, None] * pose.rotations
        gradients: Floats = products @ self._inverse_squares
        return gradients

    def stretches(self, pose: Pose) -> Floats:
        """Return the length of each edge per length at rest. [E]"""
        graph = self._graph
        moved = np.linalg.norm(pose.positions[graph.ends] - pose.positions[graph.starts], axis=1)
        stretches: Floats = moved / np.maximum(np.linalg.norm(graph.arms, axis=1), 1e-12 * graph.spacing)
        return stretches

    def _arm_weights(self, blends: csr_array, points: Floats) -> csr_array:
        """Return the weights w Q⁻¹ (point − p) of the nodes' edge products in each handle. [H,3n]

        Q is the sum of the squares of a node's edges, with its prior.
        """
        entries = blends.tocoo()
        handle, node = entries.coords
        offsets = points[handle] - self._graph.positions[node]
        arms = np.einsum("eij,ej->ei", self._inverse_squares[node], offsets) * entries.data[:, None]
        columns = 3 * node[:, None] + np.arange(3)
        shape = (len(points), 3 * len(self._graph))
        return csr_array((arms.ravel(), (np.repeat(handle, 3), columns.ravel())), shape=shape)

    def _products(self, positions: Floats) -> Floats:
        """Return Σ (x_j − x_i) (p_j − p_i)ᵀ over the edges of each node. [n,3] -> [n,3,3]"""
        products: Floats = solve_kernel.edge_products(self._edges, np.ascontiguousarray(positions))
        return products


def nearest_rotations(matrices: Floats, start: Floats) -> Floats:
    """Return the rotations nearest to matrices, by Newton's method from a warm start.

    A direction in which a matrix is zero keeps the rotation of the warm start.

    Args:
        matrices: [n,3,3]
        start: rotations, at less than 180° from the result. [n,3,3]
    """
    rotations: Floats = np.array(np.broadcast_to(start, matrices.shape), np.float64, order="C")
    solve_kernel.nearest_rotations_fast(np.ascontiguousarray(matrices, np.float64), rotations)
    return rotations


def _to_products(graph: NodeGraph) -> csr_array:
    """Return the matrix from positions to the transposed products of `Solver._products`. [3n,n]"""
    count = len(graph)
    arms = graph.arms.ravel()
    coordinates = np.tile(np.arange(3), len(graph.starts))
    starts = np.repeat(graph.starts, 3)
    ends = np.repeat(graph.ends, 3)
    rows = 3 * starts + coordinates
    to_products = csr_array((arms, (rows, ends)), shape=(3 * count, count))
    return csr_array(to_products - csr_array((arms, (rows, starts)), shape=(3 * count, count)))


def _rows(values: NDArray[np.int64] | NDArray[np.int32]) -> NDArray[np.int32]:
    return np.ascontiguousarray(values, np.int32)


def _sparse(matrix: csr_array | csc_array) -> solve_kernel.Sparse:
    """Return the arrays of a sparse matrix for the kernels, with sorted indices."""
    matrix.sort_indices()
    return _rows(matrix.indptr), _rows(matrix.indices), np.ascontiguousarray(matrix.data, np.float64)
