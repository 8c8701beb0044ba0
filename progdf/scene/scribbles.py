"""Selection of an object from strokes on it and strokes beside it, by a random walker.

A Gaussian belongs to the kind of stroke that a random walk from it is more likely to reach first (Grady,
Random Walks for Image Segmentation, 2006). Steps to near neighbors of like color are more probable. Distances
and color differences are measured in units of their medians between neighbors. (Scales chosen by
cross-validation over strokes are no better: docs/lab/experiments.md, Regions from strokes.)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from progdf.surface.graph_solver import GraphSolver

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
_ACCURACY = 1e-3  # see `GraphSolver.solve`; smaller errors change no selection


class Scribbles:
    """Random walker over a scene. Building it takes about 0.5 s for 125 000 Gaussians.

    Args:
        points: finite centers of the Gaussians. [N,3]
        colors: their colors, OKLab. [N,3]
    """

    def __init__(self, points: NDArray[np.floating], colors: Floats) -> None:
        self._solver = GraphSolver(likely_steps(points, colors))
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
        steps = self._solver.sums
        anchors = (_STROKE_WEIGHT * (on | beside) + _OUTSIDE_WEIGHT).astype(np.float32) * steps
        chances = self._solver.solve(anchors, np.float32(_STROKE_WEIGHT) * on * steps, _ACCURACY)
        return chances > 0.5


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
