"""Selection of an object from strokes on it and strokes beside it, by a random walker.

A Gaussian belongs to the kind of stroke that a random walk from it is more likely to reach first (Grady,
Random Walks for Image Segmentation, 2006). Steps to near neighbors of like color are more probable. Distances
and color differences are measured in units of their medians between neighbors. (Scales chosen by
cross-validation over strokes are no better: docs/lab/experiments.md, Regions from strokes.)

The probabilities solve a linear system with one unknown per Gaussian, by conjugate gradients. The
preconditioner is one multigrid cycle over groups of neighbors (Notay, An Aggregation-Based Algebraic
Multigrid Method, 2010).
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

_WALK_NEIGHBORS = 10  # neighbors that a walk may step to
_COLOR_EXPONENT = 2.0  # a step over the median color difference of neighbors has its weight scaled by e⁻²
_MIN_STEP_WEIGHT = (
    1e-6  # smallest weight of a step; the walk would never reach areas behind steps of weight 0
)
_STROKE_WEIGHT = 1e3  # weight that fixes a stroked Gaussian, in sums of its steps' weights
_OUTSIDE_WEIGHT = 1e-6  # weight that pulls every Gaussian outside; decides those connected with no stroke
_RESIDUAL_SHARE = 1e-3  # share of the initial residual; smaller residuals change no selection
_MIN_COARSENED_ROWS = (
    500  # rows; smaller levels are not coarsened, and up to four times as many are solved directly
)
_MAX_COARSENING_RATIO = 0.7  # coarsening stops if a level keeps more than this share of the rows
_JACOBI_DAMPING = 0.7  # damping of Jacobi smoothing
_OVERCORRECTION = 1.6  # scale of a coarse correction, which is too small by this factor (Braess, 1995)
_MAX_STEPS = 200  # conjugate gradient steps per level


class Scribbles:
    """Random walker over a scene. Building it takes about 0.5 s for 125 000 Gaussians.

    Args:
        points: finite centers of the Gaussians. [N,3]
        colors: their colors, OKLab. [N,3]
    """

    def __init__(self, points: NDArray[np.floating], colors: Floats) -> None:
        self._levels = _Multigrid(likely_steps(points, colors))
        self._count = len(points)

    def select(self, inside: Rows, outside: Rows) -> Mask:
        """Select the Gaussians that belong to the strokes on an object.

        Args:
            inside: rows under strokes on the object
            outside: rows under strokes beside it; rows under both kinds count for neither

        Returns:
            Mask [N]. It is empty without strokes on the object. Without strokes beside it, it holds all
            Gaussians connected with the object.
        """
        on = np.zeros(self._count, bool)
        beside = np.zeros(self._count, bool)
        on[inside] = True
        beside[outside] = True
        both = on & beside
        on &= ~both
        beside &= ~both
        if not on.any() or self._count == 1:
            return on
        return self._levels.chances(on, beside) > 0.5


def rows_under(painted: Mask, seen: Surface) -> Rows:
    """Return the Gaussians on the front surface whose centers lie under painted pixels [H,W]."""
    points = seen.centers.points
    height, width = painted.shape
    within = (points >= 0) & (points < (width, height))  # also false where a point is not a number
    rows = np.flatnonzero(within.all(axis=1))
    column, row = points[rows].astype(np.intp).T
    covered: Rows = rows[painted[row, column]]
    return covered[seen.front(covered)] if len(covered) else covered


def likely_steps(points: NDArray[np.floating], colors: Floats) -> csr_array:
    """Return the symmetric weight of each step between neighbors. [N,N]"""
    count = len(points)
    k = min(_WALK_NEIGHBORS, count - 1)
    if k < 1:
        return csr_array((count, count), dtype=np.float32)
    distances, near = PointTree(points, k + 1).query(points, k + 1)
    distances = distances[:, 1:]
    near = near[:, 1:].astype(np.int32)
    spacing = np.maximum(np.median(distances, axis=1), 1e-30)
    scaled_squares = distances * distances / (spacing[:, None] * spacing[near])
    color_distances = np.linalg.norm(colors[:, None] - colors[near], axis=2)
    weights = (
        np.exp(
            -scaled_squares - _COLOR_EXPONENT * color_distances / max(float(np.median(color_distances)), 1e-6)
        )
        + _MIN_STEP_WEIGHT
    )
    start = np.arange(0, count * k + 1, k, dtype=np.int32)
    steps = csr_array((weights.astype(np.float32).ravel(), near.ravel(), start), shape=(count, count))
    both: csr_array = (steps + steps.T).tocsr()
    return both


class _Multigrid:
    """Hierarchy of graphs; each level groups the nodes of the finer one."""

    def __init__(self, weights: csr_array) -> None:
        self._weights = [weights]
        self._groups: list[NDArray[np.int32]] = []
        while len(self._groups) < 20 and self._weights[-1].shape[0] > _MIN_COARSENED_ROWS:
            coarse, groups = _coarsen(*_coarsen(self._weights[-1], None))
            if coarse.shape[0] > _MAX_COARSENING_RATIO * self._weights[-1].shape[0]:
                break
            self._weights.append(coarse)
            self._groups.append(groups)
        self._steps = [np.asarray(level.sum(axis=1), np.float32).ravel() for level in self._weights]

    def chances(self, on: Mask, beside: Mask) -> Floats:
        """Return the probability that a walk from each node ends on the object, 0 to 1. [N]

        The solution of each coarse level starts the next finer one.
        """
        anchors: Floats = (_STROKE_WEIGHT * (on | beside) + _OUTSIDE_WEIGHT).astype(np.float32) * self._steps[
            0
        ]
        target: Floats = np.float32(_STROKE_WEIGHT) * on * self._steps[0]
        targets = [target]
        self._diagonals = [self._steps[0] + anchors]
        for level in range(len(self._groups)):
            anchors = self._gather(level, anchors)
            target = self._gather(level, target)
            self._diagonals.append(self._steps[level + 1] + anchors)
            targets.append(target)
        coarsest = self._weights[-1]
        is_small = coarsest.shape[0] <= 4 * _MIN_COARSENED_ROWS
        self._factors = None
        if is_small:
            self._factors = cho_factor(np.diag(self._diagonals[-1].astype(np.float64)) - coarsest.toarray())
        x = np.zeros(coarsest.shape[0], np.float32)
        for level in reversed(range(len(targets))):
            x = self._solve(
                level, targets[level], x if level == len(self._groups) else x[self._groups[level]]
            )
        return x

    def _solve(self, level: int, target: Floats, x: Floats) -> Floats:
        """Solve a level by preconditioned conjugate gradients from the start value x. [N]"""
        spread = np.sqrt(self._diagonals[level])
        jacobi_guess = target / self._diagonals[level]
        min_residual = _RESIDUAL_SHARE * float(
            np.linalg.norm((target - self._apply(level, jacobi_guess)) / spread)
        )
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
