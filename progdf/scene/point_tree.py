"""k-d tree with bounded searches where many points share one position.

A k-d tree cannot split equal points: it keeps them in one leaf, and each search near them visits them all.
100 000 equal points take 10^10 steps. This tree holds only as many points per position as a search can
return. Distances stay exact. A search returns an arbitrary choice of equal points.
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
    """Nearest-neighbor search among N points (1 000 000 points: 0.2 s to build).

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
            remaining = np.delete(np.arange(count), self._surplus)
            self._rows = np.append(remaining, count)
            self._tree = _build(self._points[remaining])

    def query(
        self, places: NDArray[np.floating], k: int, within: float = np.inf, workers: int | None = None
    ) -> tuple[Floats, Rows]:
        """Return the k nearest points of some positions, nearest first.

        Args:
            places: [M,D]
            k: at most `most`. If there are fewer points, the remaining distances are infinite and the rows N
            within: largest distance of a point that counts
            workers: threads; None uses all for enough positions. The result does not depend on the number

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
        """Return the distance from some positions [M,D] to the k-th nearest point, k at most `most`. [M]

        Distances beyond `within` are infinite.
        """
        workers = _workers(len(places))
        distances: Floats = self._tree.query(places, [k], distance_upper_bound=within, workers=workers)[0]
        return distances[:, 0]

    @property
    def order(self) -> Rows:
        """Rows in tree order, which puts most neighbors close to each other. [N]"""
        order: Rows = self._tree.indices
        if self._rows is None:
            return order
        return np.concatenate([self._rows[order], self._surplus])

    @property
    def largest_leaf(self) -> int:
        """Largest number of points that a search visits at once."""
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
        """Return the mask extended to all copies of its points at crowded positions. [N]

        A search returns only some of the points at a crowded position. A selection that spreads by searches
        would never reach the others.
        """
        if not len(self._surplus):
            return mask
        selected = np.zeros(self._crowds.max() + 2, bool)  # the last entry is for rows at no crowded position
        selected[self._crowds[mask]] = True
        selected[-1] = False
        return np.asarray(mask | selected[self._crowds])

    @cached_property
    def _crowds(self) -> Rows:
        """Index of the crowded position of each point; -1 for other points. [N]"""
        positions = np.unique(self._points[self._surplus], axis=0)
        distances, crowds = _build(positions).query(self._points)
        crowds[distances > 0.0] = -1
        return np.asarray(crowds, np.int64)

    def _find_surplus(self, copies: int) -> Rows:
        """Return the points beyond the first `copies` at their position. [S]

        Equal points are consecutive in the order of the tree's leaves if there are more than a leaf holds.
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
