"""Solver of values that spread over a graph from some of its nodes.

The system has one unknown per node and is solved by conjugate gradients. Plain ones move a value by one node
per step, so they need hundreds of steps to cross an object. The preconditioner is therefore one multigrid
cycle over groups of neighbors (Notay, An Aggregation-Based Algebraic Multigrid Method, 2010).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array, csr_array

from progdf.rasterize.cpu.jit import Number, kernel

Floats = NDArray[np.floating]

_MIN_COARSENED_ROWS = (
    500  # rows; smaller levels are not coarsened, and up to four times as many are solved directly
)
_MAX_COARSENING_RATIO = 0.7  # coarsening stops if a level keeps more than this share of the rows
_JACOBI_DAMPING = 0.7  # damping of Jacobi smoothing
_OVERCORRECTION = 1.6  # scale of a coarse correction, which is too small by this factor (Braess, 1995)
_MAX_STEPS = 200  # conjugate gradient steps per level


class GraphSolver:
    """Hierarchy of graphs; each level groups the nodes of the finer one.

    Args:
        weights: symmetric weights of the links between different nodes, ≥ 0. [N,N] float32
    """

    def __init__(self, weights: csr_array) -> None:
        self._weights = [weights]
        self._groups: list[NDArray[np.int32]] = []
        while len(self._groups) < 20 and self._weights[-1].shape[0] > _MIN_COARSENED_ROWS:
            coarse, groups = _coarsen(*_coarsen(self._weights[-1], None))
            if coarse.shape[0] > _MAX_COARSENING_RATIO * self._weights[-1].shape[0]:
                break
            self._weights.append(coarse)
            self._groups.append(groups)
        self._sums = [np.asarray(level.sum(axis=1), np.float32).ravel() for level in self._weights]

    @property
    def sums(self) -> Floats:
        """Sum of the weights of each node's links. [N]"""
        return self._sums[0]

    def solve(self, anchors: Floats, target: Floats, accuracy: float) -> Floats:
        """Return the x that minimizes Σ anchor · x² − 2 target · x + Σ weight · (x − x of the neighbor)².

        A node with an anchor of weight a at a value v has the target a · v. The solution of each coarse level
        starts the next finer one.

        Args:
            anchors: at least a millionth of the weights of a node's links, > 0. [N]
            target: [N]
            accuracy: remaining residual as a share of that of target / diagonal

        Returns:
            [N] float32
        """
        anchors, target = anchors.astype(np.float32), target.astype(np.float32)
        targets = [target]
        self._diagonals = [self._sums[0] + anchors]
        for level in range(len(self._groups)):
            anchors = self._gather(level, anchors)
            target = self._gather(level, target)
            self._diagonals.append(self._sums[level + 1] + anchors)
            targets.append(target)
        coarsest = self._weights[-1]
        is_small = coarsest.shape[0] <= 4 * _MIN_COARSENED_ROWS
        self._factors = None
        if is_small:
            self._factors = cho_factor(np.diag(self._diagonals[-1].astype(np.float64)) - coarsest.toarray())
        x = np.zeros(coarsest.shape[0], np.float32)
        for level in reversed(range(len(targets))):
            start = x if level == len(self._groups) else x[self._groups[level]]
            x = self._solve(level, targets[level], start, accuracy)
        return x

    def _solve(self, level: int, target: Floats, x: Floats, accuracy: float) -> Floats:
        """Solve a level by preconditioned conjugate gradients from the start value x. [N]"""
        spread = np.sqrt(self._diagonals[level])
        jacobi_guess = target / self._diagonals[level]
        min_residual = accuracy * float(np.linalg.norm((target - self._apply(level, jacobi_guess)) / spread))
        residual: Floats = target - self._apply(level, x)
        direction = np.zeros_like(x)
        before = np.inf
        for _ in range(_MAX_STEPS):
            if float(np.linalg.norm(residual / spread)) <= min_residual:
                break
            correction = self._cycle(level, residual)
            along = float(residual @ correction)
            direction = correction + np.float32(along / before) * direction
            image = self._apply(level, direction)
            step = np.float32(along / max(float(direction @ image), 1e-30))
            x = x + step * direction
            residual -= step * image
            before = along
        return x

    def _gather(self, level: int, values: Floats) -> Floats:
        count = self._weights[level + 1].shape[0]
        sums: Floats = np.bincount(self._groups[level], values, minlength=count).astype(np.float32)
        return sums

    def _apply(self, level: int, x: Floats) -> Floats:
        product: Floats = self._diagonals[level] * x - self._weights[level] @ x
        return product

    def _cycle(self, level: int, residual: Floats) -> Floats:
        """Return the correction of a residual by one multigrid cycle. [N]"""
        damped = np.float32(_JACOBI_DAMPING) / self._diagonals[level]
        if level == len(self._groups):
            if self._factors is None:
                return damped * residual
            solved: Floats = cho_solve(self._factors, residual).astype(np.float32)
            return solved
        x = damped * residual
        coarse = self._cycle(level + 1, self._gather(level, residual - self._apply(level, x)))
        x += np.float32(_OVERCORRECTION) * coarse[self._groups[level]]
        return x + damped * (residual - self._apply(level, x))


def _coarsen(weights: csr_array, groups: NDArray[np.int32] | None) -> tuple[csr_array, NDArray[np.int32]]:
    """Return the graph of pairs of strongly connected nodes, and the index of each node's pair.

    `groups` holds the node of `weights` for each node of a finer graph, whose pairs are then returned
    instead.
    """
    pairs, count = _pair(weights.indptr, weights.indices, weights.data)
    edges = weights.tocoo()
    row = pairs[edges.row]
    col = pairs[edges.col]
    across = row != col
    coarse = coo_array((edges.data[across], (row[across], col[across])), shape=(count, count)).tocsr()
    return coarse, pairs if groups is None else pairs[groups]


@kernel(cache=True, allocates=True)
def _pair(start: Number, neighbors: Number, weights: Number) -> Number:
    """Pair each node with its most likely free neighbor; return each pair index [N] int32 and the count."""
    count = len(start) - 1
    groups = np.full(count, -1, np.int32)
    used = 0
    for node in range(count):
        if groups[node] >= 0:
            continue
        free = -1
        likely = np.float32(0.0)
        other = -1
        other_likely = np.float32(0.0)
        for at in range(start[node], start[node + 1]):
            near = neighbors[at]
            if near == node:
                continue
            if groups[near] < 0:
                if weights[at] > likely:
                    free = near
                    likely = weights[at]
            elif weights[at] > other_likely:
                other = near
                other_likely = weights[at]
        if free < 0 and other >= 0:
            groups[node] = groups[other]
            continue
        groups[node] = used
        if free >= 0:
            groups[free] = used
        used += 1
    return groups, used
