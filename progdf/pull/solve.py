"""As-rigid-as-possible deformation of a node graph (Sorkine and Alexa 2007) with point handles.

The energy is Σ |x_j − x_i − R_i (p_j − p_i)|² over all edges, with unknown positions x and rotations R. Two
steps alternate: rotations for given positions, node by node; and positions for given rotations, a linear
system whose factorization stays the same for the whole course.

A handle constrains a point of the surface, which is a blend of the nodes near it, so that no node sticks out.
A falloff adds springs to the rest positions, which are stiff at its radius. Held nodes are eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from .graph import Floats, Mask, NodeGraph, Rows

_HANDLE_STIFFNESS = 1e5  # edges; the error of a handle's position is about 1 / 1e5 of its pull
_ROTATION_STEPS = 3  # iterations of the rotations between two linear solves, warm-started
_MAX_ROUNDS = 200
_SETTLED = 1e-4  # node spacings; the solve ends if no node moves farther in a round
_GRADIENT_PRIOR = 0.05  # weight of the rotation in a node's gradient, as a share of its edges' squares


@dataclass(frozen=True)
class Pose:
    """Deformed state of the n nodes."""

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
        self._free: Rows = np.flatnonzero(~held)
        self._held: Rows = np.flatnonzero(held)
        count = len(graph)
        self._to_products, self._to_right = _edge_maps(graph)
        squares = self._products(graph.positions)
        prior = _GRADIENT_PRIOR * np.trace(squares, axis1=1, axis2=2)
        self._prior = np.maximum(prior, 1e-12 * graph.spacing**2)
        self._inverse_squares = np.linalg.inv(squares + self._prior[:, None, None] * np.eye(3))
        # a handle is at Σ w (x + G (point − p)), where G is linear in the positions and rotations
        self._steering = self._arm_weights(blends, points)
        self._handles = csr_array(blends + self._steering @ self._to_products)
        self._steering = csr_array(self._steering @ diags_array(np.repeat(self._prior, 3)))
        edges = np.ones(len(graph.starts))
        adjacency = csr_array((edges, (graph.starts, graph.ends)), shape=(count, count))
        degree = np.bincount(graph.starts, minlength=count)
        pinned = _HANDLE_STIFFNESS * (self._handles.T @ self._handles)
        system = csr_array(diags_array(degree + springs) - adjacency + pinned)
        self._springs = springs
        inner = csc_array(system[self._free][:, self._free])
        self._factor = splu(inner, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        self._to_held = csr_array(system[self._free][:, self._held])

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
        pose = start
        for _ in range(rounds):
            positions = self._solve_positions(targets, pose)
            rotations = nearest_rotations(self._products(positions), pose.rotations, _ROTATION_STEPS)
            moved = float(np.abs(positions - pose.positions).max())
            pose = Pose(positions, rotations)
            if moved <= _SETTLED * self._graph.spacing:
                break
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

    def _solve_positions(self, targets: Floats, pose: Pose) -> Floats:
        rest = self._graph.positions
        columns = np.swapaxes(pose.rotations, 1, 2).reshape(-1, 3)
        right = self._to_right @ columns + self._springs[:, None] * rest
        right = right + _HANDLE_STIFFNESS * (self._handles.T @ (targets - self._steering @ columns))
        positions = rest.copy()
        positions[self._free] = self._factor.solve(right[self._free] - self._to_held @ rest[self._held])
        return positions

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
        transposed = (self._to_products @ positions).reshape(-1, 3, 3)
        products: Floats = np.swapaxes(transposed, 1, 2)
        return products


def _edge_maps(graph: NodeGraph) -> tuple[csr_array, csr_array]:
    """Return the matrices of the two sums over edges that each round computes.

    Returns:
        Matrix from positions to the transposed products of `Solver._products`. [3n,n]
        Matrix from the columns of the rotations to Σ ½ (R_i + R_j) (p_i − p_j). [n,3n]
    """
    count = len(graph)
    arms = graph.arms.ravel()
    coordinates = np.tile(np.arange(3), len(graph.starts))
    starts = np.repeat(graph.starts, 3)
    ends = np.repeat(graph.ends, 3)
    rows = 3 * starts + coordinates
    to_products = csr_array((arms, (rows, ends)), shape=(3 * count, count))
    to_products = to_products - csr_array((arms, (rows, starts)), shape=(3 * count, count))
    shape = (count, 3 * count)
    to_right = csr_array((-0.5 * arms, (starts, 3 * ends + coordinates)), shape=shape)
    to_right = to_right + csr_array((-0.5 * arms, (starts, rows)), shape=shape)
    return csr_array(to_products), csr_array(to_right)


def nearest_rotations(matrices: Floats, start: Floats, steps: int) -> Floats:
    """Return the rotations nearest to matrices, iterated from a warm start (Müller and others 2016).

    A direction in which a matrix is zero keeps the rotation of the warm start.

    Args:
        matrices: [n,3,3]
        start: rotations, at less than 180° from the result. [n,3,3]
        steps: number of iterations
    """
    rotations = start
    size = np.maximum(np.abs(matrices).max(axis=(1, 2)), 1e-30)
    scaled = matrices / size[:, None, None]
    for _ in range(steps):
        # Σ over columns of their cross products, the antisymmetric part of M Rᵀ
        mixed = scaled @ np.swapaxes(rotations, 1, 2)
        torque = np.stack(
            [
                mixed[:, 2, 1] - mixed[:, 1, 2],
                mixed[:, 0, 2] - mixed[:, 2, 0],
                mixed[:, 1, 0] - mixed[:, 0, 1],
            ],
            axis=1,
        )
        work = np.abs(np.einsum("nii->n", mixed))
        rotations = _rotations(torque / (work + 1e-9)[:, None]) @ rotations
    return rotations


def _rotations(turns: Floats) -> Floats:
    """Convert rotation vectors to matrices, by Rodrigues' formula. [n,3] -> [n,3,3]"""
    angle = np.linalg.norm(turns, axis=1)
    safe = np.maximum(angle, 1e-12)
    cross = np.zeros((len(turns), 3, 3))
    cross[:, 0, 1] = -turns[:, 2]
    cross[:, 0, 2] = turns[:, 1]
    cross[:, 1, 0] = turns[:, 2]
    cross[:, 1, 2] = -turns[:, 0]
    cross[:, 2, 0] = -turns[:, 1]
    cross[:, 2, 1] = turns[:, 0]
    first = (np.sin(safe) / safe)[:, None, None]
    second = ((1.0 - np.cos(safe)) / safe**2)[:, None, None]
    rotations: Floats = np.eye(3) + first * cross + second * (cross @ cross)
    return rotations
