"""A thing selected by a few strokes on it and a few beside it: a random walk from neighbor to neighbor.

A Gaussian belongs to the strokes that a walk begun at it more likely meets first (Grady, Random Walks for
Image Segmentation, 2006). A step to a near neighbor of like color is likely; what counts as near and alike is
what neighbors commonly are in this scene. (A scale chosen by foretelling strokes that are left out does no
better: docs/experiments.md, Regions from strokes.)

The chances solve a linear system as large as the scene: conjugate gradients, each step behind one cycle of
multigrid over groups of neighbors (Notay, An Aggregation-Based Algebraic Multigrid Method, 2010).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array, csr_array

from progdf.rasterize.cpu.jit import Number, kernel

from .point_tree import PointTree
from .selection import Floats, Mask, Surface

Rows = NDArray[np.int64]

_NEAREST = 10  # steps that a walk may take
_UNLIKE = 2.0  # in e⁻²: how likely a step is over the difference in color that neighbors commonly have
_WALL = 1e-6  # of a likely step: behind what no walk passes there would be no chances at all
_HELD = 1e3  # of its steps: how firmly a stroke holds its Gaussians
_LOOSE = 1e-6  # of its steps: how firmly what no stroke is connected with is held outside
_ERROR = 1e-3  # of the system's error at the start: less changes no selection
_SMALLEST = 500  # rows that are solved at once
_SHRINKS = 0.7  # a level that has more of its finer one is none
_DAMPED = 0.7  # Jacobi
_OVER = 1.6  # what a coarse correction is too small by (Braess, 1995)
_MAX_STEPS = 200


class Scribbles:
    """What strokes spread over; make it once for a scene (125 000 Gaussians: half a second).

    Args:
        points: the centers of its Gaussians, finite. [N,3]
        colors: theirs, OKLab. [N,3]
    """

    def __init__(self, points: NDArray[np.floating], colors: Floats) -> None:
        self._levels = _Multigrid(likely_steps(points, colors))
        self._count = len(points)

    def select(self, inside: Rows, outside: Rows) -> Mask:
        """What belongs to the strokes on a thing rather than to those beside it.

        Args:
            inside: rows under strokes on it
            outside: rows under strokes beside it; a row under both kinds counts for neither

        Returns:
            [N]; nothing without a stroke on the thing, what is connected with it without one beside it
        """
        on = np.zeros(self._count, bool)
        beside = np.zeros(self._count, bool)
        on[inside] = True
        beside[outside] = True
        on, beside = on & ~beside, beside & ~on
        return self._levels.chances(on, beside) > 0.5 if on.any() else on


def rows_under(painted: Mask, seen: Surface) -> Rows:
    """The Gaussians on the front surface whose centers lie under painted pixels [H,W]."""
    points, (height, width) = seen.centers.points, painted.shape
    within = (points >= 0) & (points < (width, height))  # also false where a point is not a number
    rows = np.flatnonzero(within.all(axis=1))
    column, row = points[rows].astype(np.intp).T
    under: Rows = rows[painted[row, column]]
    return under[seen.front(under)] if len(under) else under


def likely_steps(points: NDArray[np.floating], colors: Floats) -> csr_array:
    """Return how likely each step between neighbors is, the same both ways. [N,N]"""
    count = len(points)
    k = min(_NEAREST, count - 1)
    if k < 1:
        return csr_array((count, count), dtype=np.float32)
    apart, near = PointTree(points, k + 1).query(points, k + 1)
    apart = apart[:, 1:]
    near = near[:, 1:].astype(np.int32)
    spacing = np.maximum(np.median(apart, axis=1), 1e-30)
    far = apart * apart / (spacing[:, None] * spacing[near])
    unlike = np.linalg.norm(colors[:, None] - colors[near], axis=2)
    likely = np.exp(-far - _UNLIKE * unlike / max(float(np.median(unlike)), 1e-6)) + _WALL
    start = np.arange(0, count * k + 1, k, dtype=np.int32)
    steps = csr_array((likely.astype(np.float32).ravel(), near.ravel(), start), shape=(count, count))
    both: csr_array = (steps + steps.T).tocsr()
    return both


class _Multigrid:
    """A graph, and ever coarser ones of groups of its nodes."""

    def __init__(self, weights: csr_array) -> None:
        self._weights = [weights]
        self._groups: list[NDArray[np.int32]] = []
        while len(self._groups) < 20 and self._weights[-1].shape[0] > _SMALLEST:
            coarse, groups = _coarsen(*_coarsen(self._weights[-1], None))
            if coarse.shape[0] > _SHRINKS * self._weights[-1].shape[0]:
                break
            self._weights.append(coarse)
            self._groups.append(groups)
        self._steps = [np.asarray(level.sum(axis=1), np.float32).ravel() for level in self._weights]

    def chances(self, on: Mask, beside: Mask) -> Floats:
        """How likely a walk from each node ends on the thing, found on coarse graphs first. [N] 0..1"""
        held: Floats = (_HELD * (on | beside) + _LOOSE).astype(np.float32) * self._steps[0]
        target: Floats = np.float32(_HELD) * on * self._steps[0]
        targets = [target]
        self._diagonals = [self._steps[0] + held]
        for level in range(len(self._groups)):
            held = self._gather(level, held)
            target = self._gather(level, target)
            self._diagonals.append(self._steps[level + 1] + held)
            targets.append(target)
        rest = self._weights[-1]
        small = rest.shape[0] <= 4 * _SMALLEST
        matrix = np.diag(self._diagonals[-1].astype(np.float64)) - rest.toarray() if small else None
        self._factors = None if matrix is None else cho_factor(matrix)
        x = np.zeros(rest.shape[0], np.float32)
        for level in reversed(range(len(targets))):
            x = self._solve(
                level, targets[level], x if level == len(self._groups) else x[self._groups[level]]
            )
        return x

    def _solve(self, level: int, target: Floats, x: Floats) -> Floats:
        """Conjugate gradients on a level. [N]"""
        spread = np.sqrt(self._diagonals[level])
        held = target / self._diagonals[level]
        least = _ERROR * float(np.linalg.norm((target - self._apply(level, held)) / spread))
        residual: Floats = target - self._apply(level, x)
        direction = np.zeros_like(x)
        before = np.inf
        for _ in range(_MAX_STEPS):
            if float(np.linalg.norm(residual / spread)) <= least:
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
        """About what takes a residual away."""
        damped = np.float32(_DAMPED) / self._diagonals[level]
        if level == len(self._groups):
            if self._factors is None:
                return damped * residual
            solved: Floats = cho_solve(self._factors, residual).astype(np.float32)
            return solved
        x = damped * residual
        coarse = self._cycle(level + 1, self._gather(level, residual - self._apply(level, x)))
        x += np.float32(_OVER) * coarse[self._groups[level]]
        return x + damped * (residual - self._apply(level, x))


def _coarsen(weights: csr_array, groups: NDArray[np.int32] | None) -> tuple[csr_array, NDArray[np.int32]]:
    """A graph of pairs of nodes, each with its most likely neighbor, and which pair each node is in."""
    pairs, count = _pair(weights.indptr, weights.indices, weights.data)
    edges = weights.tocoo()
    row = pairs[edges.row]
    col = pairs[edges.col]
    across = row != col
    coarse = coo_array((edges.data[across], (row[across], col[across])), shape=(count, count)).tocsr()
    return coarse, pairs if groups is None else pairs[groups]


@kernel(cache=True, allocates=True)
def _pair(start: Number, neighbors: Number, weights: Number) -> Number:
    """Pairs of a node and its most likely free neighbor; which each is in [N] int32, and their count."""
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
