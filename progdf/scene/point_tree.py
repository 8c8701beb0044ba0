"""k-d tree whose searches stay bounded where many points share one place.

A k-d tree cannot split equal points: it keeps them in one leaf, and each search near them visits them all.
100 000 rows at one place take 10^10 steps. This tree holds only as many points of a place as a search can
return. Distances stay exact; which of the equal points is returned is arbitrary.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from progdf.threads import threads

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]

LEAF_SIZE = 16
WORTH_THREADS = 2000  # searches; fewer run faster on one thread


class PointTree:
    """The nearest of N points, for searches of up to `most` neighbors (1 000 000 points: 0.2 s to build).

    Args:
        points: finite, of any dimension D. [N,D]
        most: the largest number of neighbors that a search requests, at least 1
    """

    def __init__(self, points: NDArray[np.floating], most: int) -> None:
        self._points = np.asarray(points, np.float64)
        self._tree = _build(self._points)
        self._rows: Rows | None = None  # the rows in the tree, then N; None: all of them
        self._surplus = self._find_surplus(max(most + 1, LEAF_SIZE))
        if len(self._surplus):
            count = len(self._points)
            kept = np.delete(np.arange(count), self._surplus)
            self._rows = np.append(kept, count)
            self._tree = _build(self._points[kept])

    def query(
        self, places: NDArray[np.floating], k: int, within: float = np.inf, workers: int | None = None
    ) -> tuple[Floats, Rows]:
        """Return the k nearest points of some places, the nearest first.

        Args:
            places: [M,D]
            k: at most `most`; where there are fewer points, the remaining distances are infinite and rows N
            within: distance beyond which points do not count
            workers: threads; None: all, if there are enough places. The result does not depend on them

        Returns:
            Distances and rows, [M,k] each.
        """
        if workers is None:
            workers = _workers(len(places))
        neighbors = list(range(1, k + 1))
        distances, found = self._tree.query(places, neighbors, distance_upper_bound=within, workers=workers)
        rows: Rows = found if self._rows is None else self._rows[found]
        return distances, rows

    def kth_distances(self, places: NDArray[np.floating], k: int, within: float = np.inf) -> Floats:
        """Return the distance from some places [M,D] to the k-th nearest point, k at most `most`. [M]

        It is infinite beyond `within`.
        """
        workers = _workers(len(places))
        distances: Floats = self._tree.query(places, [k], distance_upper_bound=within, workers=workers)[0]
        return distances[:, 0]

    @property
    def order(self) -> Rows:
        """The rows in an order in which most neighbors are near each other. [N]"""
        order: Rows = self._tree.indices
        if self._rows is None:
            return order
        return np.concatenate([self._rows[order], self._surplus])

    @property
    def largest_leaf(self) -> int:
        """The largest number of points that a search visits at once."""
        leaves = [self._tree.tree]
        largest = 0
        while leaves:
            node = leaves.pop()
            if node.lesser is None:
                largest = max(largest, node.children)
            else:
                leaves += [node.lesser, node.greater]
        return largest

    def with_copies(self, mask: Mask) -> Mask:
        """Return the mask with all points of each crowded place that it selects a point of. [N]

        A search returns some of the points of a crowded place, so a selection that spreads by searches would
        never reach the others.
        """
        if not len(self._surplus):
            return mask
        selected = np.zeros(self._crowds.max() + 2, bool)  # the last is for the rows in no crowd
        selected[self._crowds[mask]] = True
        selected[-1] = False
        return np.asarray(mask | selected[self._crowds])

    @cached_property
    def _crowds(self) -> Rows:
        """The crowded place that each point is in; -1: in none. [N]"""
        places = np.unique(self._points[self._surplus], axis=0)
        distances, crowds = _build(places).query(self._points)
        crowds[distances > 0.0] = -1
        return np.asarray(crowds, np.int64)

    def _find_surplus(self, copies: int) -> Rows:
        """Return the points beyond the first `copies` of their place. [S]

        Equal points are one run in the order of the tree's leaves, if there are more than a leaf holds.
        """
        order = self._tree.indices
        column = self._points[order, 0]
        equal = np.flatnonzero(column[copies:] == column[:-copies])
        later = order[equal + copies]
        same = (self._points[later] == self._points[order[equal]]).all(axis=1)
        return np.asarray(later[same], np.int64)


def _workers(searches: int) -> int:
    return threads() if searches > WORTH_THREADS else 1


def _build(points: Floats) -> cKDTree:
    return cKDTree(points, LEAF_SIZE, balanced_tree=False, compact_nodes=False)
