"""Selections that change by the nearest neighbors of their Gaussians."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from progdf.gaussians import Gaussians

from .point_tree import PointTree
from .scribbles import Scribbles
from .selection import Floats, Mask, alike_in_color, base_colors

# neighbors: of a step, of a vote, of a connection
_RING = 8
_AROUND = 24
_LINKS = 8
_REACH = 3.0  # times how far neighbors commonly are; what is farther is none, also where none is nearer
_TOUCH = 1.0
RIM_PERCENT = 35
# what is held lies as deep as this share of the rim, or of what a thin part has
_MIDDLE = 0.6
_DEEP = 0.95


class Neighborhood:
    """The centers of a scene's Gaussians in a k-d tree; make it once for a scene (1M: about a second).

    Args:
        scene: its centers; those that are not finite count as at the origin
    """

    def __init__(self, scene: Gaussians) -> None:
        self._scene = scene
        self._points = np.nan_to_num(scene.means.numpy().astype(np.float64))
        self._sizes = np.exp(scene.log_scales.numpy().max(axis=1))
        self._tree = PointTree(self._points, _AROUND + 1)

    def grow(self, mask: Mask) -> Mask:
        """Return the mask with the nearest neighbors of its Gaussians. [N]"""
        near, reached = self._near(np.flatnonzero(mask), _RING)
        grown = mask.copy()
        grown[near[reached]] = True
        return self._tree.with_copies(grown)

    def shrink(self, mask: Mask) -> Mask:
        """Without what has a nearest neighbor that is not selected. [N]"""
        rows = np.flatnonzero(mask)
        near, reached = self._near(rows, _RING)
        shrunk = mask.copy()
        shrunk[rows[(reached & ~mask[near]).any(axis=1)]] = False
        return shrunk

    def smooth(self, mask: Mask) -> Mask:
        """At its border what most neighbors are: strays and holes go, edges get straighter. [N]"""
        near, reached = self._near(np.flatnonzero(mask), _RING)
        across = reached & ~mask[near]
        border = np.zeros_like(mask)
        border[near[across]] = True
        border[np.flatnonzero(mask)[across.any(axis=1)]] = True
        rows = np.flatnonzero(border)
        near, reached = self._near(rows, _AROUND)
        votes = (reached & mask[near]).sum(axis=1) + mask[rows]
        voters = reached.sum(axis=1) + 1
        smoothed = mask.copy()
        smoothed[rows] = 2 * votes > voters
        return smoothed

    @cached_property
    def scribbles(self) -> Scribbles:
        """What strokes spread over, made when it is first asked for."""
        return Scribbles(self._points, base_colors(self._scene))

    def refine(self, mask: Mask, percent: int = RIM_PERCENT) -> Mask:
        """With its rim where color and gaps have it, for a lasso that was drawn roughly. [N]

        What lies well inside and well outside stays, and a random walk from there decides on what lies
        between (see `Scribbles`). A part that is thin for the rim is held along its middle.

        Args:
            percent: width of the rim outside, of the selection's radius; inside it is `_MIDDLE` of that
        """
        inside = np.flatnonzero(mask)
        outside = np.flatnonzero(~mask)
        if not (len(inside) and len(outside)):
            return mask
        radius = float(np.sqrt(self._points[inside].var(axis=0).sum()))
        width = max(percent / 100.0 * radius, 1e-30)
        depths = np.minimum(_distances(self._points, outside, inside, width), width)
        held = inside[depths >= _MIDDLE * float(np.quantile(depths, _DEEP))]
        far = outside[np.isinf(_distances(self._points, inside, outside, width))]
        return self.scribbles.select(held, far)

    def largest_part(self, mask: Mask) -> Mask:
        """Only the connected part that has most members; nothing of nothing. [N]"""
        rows = np.flatnonzero(mask)
        largest = np.zeros_like(mask)
        if not len(rows):
            return largest
        tree = PointTree(self._points[rows], _LINKS + 1)
        start, end = self._links(tree, rows, np.arange(len(rows)))
        part = join_pairs(start, end, len(rows))
        largest[rows[part == np.bincount(part).argmax()]] = True
        return largest

    def connected_part(self, mask: Mask, seeds: NDArray[np.int64]) -> Mask:
        """Return the part of `mask` that is connected within it with any of the rows `seeds` in it. [N]"""
        rows = np.flatnonzero(mask)
        reached = np.zeros(len(rows), bool)
        frontier = np.flatnonzero(np.isin(rows, seeds))
        part = np.zeros_like(mask)
        if not len(frontier):
            return part
        tree = PointTree(self._points[rows], _LINKS + 1)
        while len(frontier):
            reached[frontier] = True
            linked = np.zeros(len(rows), bool)
            linked[self._links(tree, rows, frontier)[1]] = True
            frontier = np.flatnonzero(tree.with_copies(linked) & ~reached)
        part[rows[reached]] = True
        return part

    def nearest(self, point: tuple[float, float, float]) -> int:
        """Return the Gaussian whose center is nearest to a point in world units."""
        rows = self._tree.query(np.asarray(point)[None], 1)[1]
        return int(rows[0, 0])

    def _near(self, rows: NDArray[np.int64], k: int) -> tuple[NDArray[np.int64], Mask]:
        """Return the k nearest others of some Gaussians [M,k], and which of them are within reach [M,k]."""
        k = min(k, len(self._points) - 1)
        if not len(rows) or k < 1:
            return np.zeros((len(rows), 0), np.int64), np.zeros((len(rows), 0), bool)
        distances, near = self._tree.query(self._points[rows], k + 1)
        distances = distances[:, 1:]
        near = near[:, 1:]
        return near, distances <= _REACH * np.median(distances[:, -1])

    def _links(
        self, tree: PointTree, rows: NDArray[np.int64], some: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the pairs of touching Gaussians in a tree of `rows` that begin in `some`.

        Both ends of a pair are indices into `rows`, as `some` is.
        """
        k = min(_LINKS + 1, len(rows))
        distances, near = tree.query(self._points[rows[some]], k)
        sizes = self._sizes[rows]
        touch = distances <= _TOUCH * (sizes[some][:, None] + sizes[near])
        return np.broadcast_to(some[:, None], near.shape)[touch], near[touch]


def _distances(
    points: NDArray[np.float64], to: NDArray[np.int64], rows: NDArray[np.int64], most: float
) -> NDArray[np.float64]:
    """Return the distance from each of some rows to the nearest of others, infinite beyond `most`. [R]"""
    distances = PointTree(points[to], 1).query(points[rows], 1, within=most)[0]
    return distances[:, 0]


def grow_along_surface(
    neighborhood: Neighborhood, colors: Floats, seeds: NDArray[np.int64], color: Floats, tolerance: float
) -> Mask:
    """What is connected with the seeds and alike in color.

    Args:
        neighborhood: of the scene
        colors: of its Gaussians, OKLab. [N,3]
        seeds: rows to begin at, also where they are not alike themselves. [M]
        color: what others are compared with, OKLab. [3]
        tolerance: how far a color may be from it
    """
    alike = alike_in_color(colors, color, tolerance)
    alike[seeds] = True
    return neighborhood.connected_part(alike, seeds)


def join_pairs(start: NDArray[np.integer], end: NDArray[np.integer], count: int) -> NDArray[np.int64]:
    """Which group each of so many things is in, where a chain of pairs joins those of one. [P], [P] -> [N]"""
    pairs = coo_array((np.ones(len(start), bool), (start, end)), shape=(count, count))
    groups: NDArray[np.int64] = connected_components(pairs, directed=False)[1].astype(np.int64)
    return groups


def nearest_rows(points: Tensor, rows: Tensor, k: int, workers: int = 1) -> tuple[Tensor, Tensor]:
    """Return the k nearest other points of some of the points, exactly.

    Args:
        points: all points, finite. [N,3]
        rows: those whose neighbors are wanted. [Q] int64
        k: how many, 1..N−1; fewer where there are not as many points
        workers: threads; the result does not depend on them

    Returns:
        Their rows, nearest first, [Q,k] int64; their distances [Q,k] float64.
    """
    k = min(k, len(points) - 1)
    places = points.double().numpy()
    distances, neighbors = PointTree(places, k + 1).query(places[rows.numpy()], k + 1, workers=workers)
    dropped = neighbors == rows.numpy()[:, None]
    dropped[~dropped.any(axis=1), -1] = True  # more points than k in its own place, and it is not among them
    others = ~dropped
    return (
        torch.from_numpy(neighbors[others].reshape(len(rows), k)),
        torch.from_numpy(distances[others].reshape(len(rows), k)),
    )
