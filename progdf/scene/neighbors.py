"""Tools based on nearest neighbors: grow, smooth, refine, connected parts, cells, distance to a surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.system.equality import equal_fields
from progdf.threads import run_chunks

from .bounds import quantile
from .point_tree import PointTree
from .scribbles import Scribbles
from .selection import Floats, Mask, alike_in_color, base_colors

_STEP_NEIGHBORS = 8  # neighbors that one grow or shrink step checks
_VOTING_NEIGHBORS = 24  # neighbors that vote when smoothing
_LINKED_NEIGHBORS = 8  # neighbors that a Gaussian may be connected with
_MAX_NEIGHBOR_DISTANCE = (
    3.0  # median distances of the k-th neighbor; a Gaussian farther away is never a neighbor
)
_TOUCH_FACTOR = 1.0  # two Gaussians touch within this many times the sum of their longest standard deviations
RIM_PERCENT = 35  # default width of the uncertain band outside a selection, % of its radius
_SPACING_SAMPLE = 2_000  # places whose neighbors are searched
_SPACING_NEIGHBORS = 4  # neighbors within the spacing of a place
_SPACING_QUANTILE = 0.9  # share of the places that have so many
_CELLS_ACROSS = 32  # cells of space along the longest side of an object
_CELL_SPAN = 2 * _CELLS_ACROSS + 2  # cells along each side of the grid, with half an object on both sides
_CORE_DEPTH_SHARE = 0.6  # share of the depth at `_DEPTH_QUANTILE`; members that lie deeper stay selected
_DEPTH_QUANTILE = 0.95  # quantile of the members' depths, at most the width of the band; small in thin parts
SURFACE_NEIGHBORS = 16
"""Nearest opaque Gaussians through which a disc is fitted."""

_MIN_NEIGHBORS = 3  # fewer define no plane
_OPACITY_SHARE = 0.5  # share of the scene's total opacity that its opaque Gaussians hold
_DISC_SIGMAS = 3.0  # the corner of an even square lies within this many standard deviations
_CHUNK_ROWS = 1 << 14  # Gaussians measured at once


class Neighborhood:
    """k-d tree over the centers of a scene. Building it takes about 1 s for a million Gaussians.

    Args:
        scene: Gaussians; centers that are not finite are treated as the origin
    """

    def __init__(self, scene: Gaussians) -> None:
        self._scene = scene
        self._points = np.nan_to_num(scene.means.numpy().astype(np.float64))
        self._sizes = np.exp(scene.log_scales.numpy().max(axis=1))
        self._tree = PointTree(self._points, _VOTING_NEIGHBORS + 1)

    def grow(self, mask: Mask) -> Mask:
        """Return the mask with the nearest neighbors of its Gaussians. [N]"""
        near, reached = self._near(np.flatnonzero(mask), _STEP_NEIGHBORS)
        grown = mask.copy()
        grown[near[reached]] = True
        return self._tree.with_copies(grown)

    def shrink(self, mask: Mask) -> Mask:
        """Return the mask without the Gaussians that have an unselected nearest neighbor. [N]"""
        rows = np.flatnonzero(mask)
        near, reached = self._near(rows, _STEP_NEIGHBORS)
        shrunk = mask.copy()
        shrunk[rows[(reached & ~mask[near]).any(axis=1)]] = False
        return shrunk

    def smooth(self, mask: Mask) -> Mask:
        """Return the mask after a majority vote at its border. [N]

        Each border Gaussian follows most of its neighbors, which removes strays and holes and
        straightens edges.
        """
        near, reached = self._near(np.flatnonzero(mask), _STEP_NEIGHBORS)
        across = reached & ~mask[near]
        border = np.zeros_like(mask)
        border[near[across]] = True
        border[np.flatnonzero(mask)[across.any(axis=1)]] = True
        rows = np.flatnonzero(border)
        near, reached = self._near(rows, _VOTING_NEIGHBORS)
        votes = (reached & mask[near]).sum(axis=1) + mask[rows]
        voters = reached.sum(axis=1) + 1
        smoothed = mask.copy()
        smoothed[rows] = 2 * votes > voters
        return smoothed

    @cached_property
    def scribbles(self) -> Scribbles:
        """Random walker over the scene, built on first use."""
        return Scribbles(self._points, base_colors(self._scene))

    def refine(self, mask: Mask, percent: int = RIM_PERCENT) -> Mask:
        """Return the mask with its edge snapped to color edges and gaps, for a rough lasso. [N]

        Gaussians well inside and well outside are unchanged. A random walk from them decides the band between
        (see `Scribbles`). Parts thinner than the band stay selected along their middle.

        Args:
            percent: width of the band outside, % of the selection's radius.
                Inside it is `_CORE_DEPTH_SHARE` times as wide
        """
        inside = np.flatnonzero(mask)
        outside = np.flatnonzero(~mask)
        if not (len(inside) and len(outside)):
            return mask
        radius = float(np.sqrt(self._points[inside].var(axis=0).sum()))
        width = max(percent / 100.0 * radius, 1e-30)
        depths = np.minimum(_distances(self._points, outside, inside, width), width)
        fixed_inside = inside[depths >= _CORE_DEPTH_SHARE * float(np.quantile(depths, _DEPTH_QUANTILE))]
        fixed_outside = outside[np.isinf(_distances(self._points, inside, outside, width))]
        return self.scribbles.select(fixed_inside, fixed_outside)

    def largest_part(self, mask: Mask) -> Mask:
        """Return the connected part with the most members; an empty mask stays empty. [N]"""
        rows, part = self.touching_parts(mask)
        largest = np.zeros_like(mask)
        if len(rows):
            largest[rows[part == np.bincount(part).argmax()]] = True
        return largest

    def touching_parts(self, mask: Mask) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the rows of a mask [M] and the index of the connected part of each [M]."""
        rows = np.flatnonzero(mask)
        if not len(rows):
            return rows, rows
        tree = PointTree(self._points[rows], _LINKED_NEIGHBORS + 1)
        start, end = self._links(tree, rows, np.arange(len(rows)))
        return rows, join_pairs(start, end, len(rows))

    def connected_part(self, mask: Mask, seeds: NDArray[np.int64]) -> Mask:
        """Return the part of `mask` that is connected within it with any of the rows `seeds` in it. [N]"""
        rows = np.flatnonzero(mask)
        reached = np.zeros(len(rows), bool)
        frontier = np.flatnonzero(np.isin(rows, seeds))
        part = np.zeros_like(mask)
        if not len(frontier):
            return part
        tree = PointTree(self._points[rows], _LINKED_NEIGHBORS + 1)
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
        """Return the k nearest other Gaussians of each row [M,k], and a mask of those within reach [M,k]."""
        k = min(k, len(self._points) - 1)
        if not len(rows) or k < 1:
            return np.zeros((len(rows), 0), np.int64), np.zeros((len(rows), 0), bool)
        distances, near = self._tree.query(self._points[rows], k + 1)
        distances = distances[:, 1:]
        near = near[:, 1:]
        return near, distances <= _MAX_NEIGHBOR_DISTANCE * np.median(distances[:, -1])

    def _links(
        self, tree: PointTree, rows: NDArray[np.int64], some: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the pairs of touching Gaussians in a tree of `rows` that begin in `some`.

        Both ends of a pair are indices into `rows`, as `some` is.
        """
        k = min(_LINKED_NEIGHBORS + 1, len(rows))
        distances, near = tree.query(self._points[rows[some]], k)
        sizes = self._sizes[rows]
        touch = distances <= _TOUCH_FACTOR * (sizes[some][:, None] + sizes[near])
        return np.broadcast_to(some[:, None], near.shape)[touch], near[touch]


def _distances(
    points: NDArray[np.float64], to: NDArray[np.int64], rows: NDArray[np.int64], most: float
) -> NDArray[np.float64]:
    """Return the distance from each point of `rows` to the nearest of `to`, infinite beyond `most`. [R]"""
    distances = PointTree(points[to], 1).query(points[rows], 1, within=most)[0]
    return distances[:, 0]


def grow_along_surface(
    neighborhood: Neighborhood, colors: Floats, seeds: NDArray[np.int64], color: Floats, tolerance: float
) -> Mask:
    """Return the Gaussians of like color that are connected with the seeds. [N]

    Args:
        neighborhood: the scene's neighborhood
        colors: colors of the scene's Gaussians, OKLab. [N,3]
        seeds: start rows, selected whatever their color. [M]
        color: reference color, OKLab. [3]
        tolerance: largest accepted distance from `color`, OKLab
    """
    alike = alike_in_color(colors, color, tolerance)
    alike[seeds] = True
    return neighborhood.connected_part(alike, seeds)


def join_pairs(start: NDArray[np.integer], end: NDArray[np.integer], count: int) -> NDArray[np.int64]:
    """Return the connected component of each of `count` nodes joined by pairs. [P], [P] -> [count]"""
    pairs = coo_array((np.ones(len(start), bool), (start, end)), shape=(count, count))
    groups: NDArray[np.int64] = connected_components(pairs, directed=False)[1].astype(np.int64)
    return groups


def nearest_rows(points: Tensor, rows: Tensor, k: int, workers: int = 1) -> tuple[Tensor, Tensor]:
    """Return the k nearest other points of some of the points, exactly.

    Args:
        points: all points, finite. [N,3]
        rows: rows of the points whose neighbors are searched. [Q] int64
        k: number of neighbors, at least 1; limited to N − 1
        workers: threads; the result does not depend on them

    Returns:
        Rows of the neighbors, nearest first, [Q,k] int64, and their distances [Q,k] float64.
    """
    if not len(rows):
        k = min(k, len(points) - 1)
        return rows.new_zeros(0, k), torch.zeros(0, k, dtype=torch.float64)
    ((_, neighbors, distances),) = iterate_nearest_rows(points, rows, k, len(rows), workers)
    return neighbors, distances


def iterate_nearest_rows(
    points: Tensor, rows: Tensor, k: int, block: int, workers: int = 1
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield blocks of rows with the results of `nearest_rows`.

    Args:
        points, rows, k, workers: see `nearest_rows`
        block: number of rows in a block; limits memory
    """
    k = min(k, len(points) - 1)
    positions = points.double().numpy()
    tree = PointTree(positions, k + 1)
    for searched in torch.split(rows, block):
        distances, neighbors = tree.query(positions[searched.numpy()], k + 1, workers=workers)
        dropped = neighbors == searched.numpy()[:, None]
        # where more than k points are equal, the point itself may be absent from the results
        dropped[~dropped.any(axis=1), -1] = True
        others = ~dropped
        yield (
            searched,
            torch.from_numpy(neighbors[others].reshape(len(searched), k)),
            torch.from_numpy(distances[others].reshape(len(searched), k)),
        )


def typical_spacing(places: Tensor) -> float:
    """Return the distance within which most places have a few neighbors. [R,3], at least two"""
    rows = torch.linspace(0, len(places) - 1, min(len(places), _SPACING_SAMPLE)).long()
    _, distances = nearest_rows(places, rows, _SPACING_NEIGHBORS)
    return float(distances[:, -1].quantile(_SPACING_QUANTILE))


@dataclass(frozen=True)
class CellGrid:
    """Cells of space in and around an object."""

    __eq__ = equal_fields

    low: Tensor  # corner of the object. [3]
    side: float  # size of a cell

    @classmethod
    def around(cls, places: Tensor, spacing: float = 0.0) -> CellGrid:
        """Return cells that are a share of an object's extent, and not smaller than a spacing. [R,3]"""
        low, high = (torch.stack([quantile(c, q) for c in places.unbind(1)]) for q in (0.01, 0.99))
        side = float((high - low).amax().clamp_min(1e-9)) / _CELLS_ACROSS
        return cls(low, max(side, spacing))

    def find_objects(self, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the connected objects of places; cells that touch, corners included, are one object. [R,3]

        Returns:
            Occupied cells, ascending, [B], the cell of each place [R], and the object of each cell [B].
        """
        cells, cell_of_place = torch.unique(self._keys(places), return_inverse=True)
        steps = torch.tensor([-1, 0, 1])
        touching = ((steps[:, None, None] * _CELL_SPAN + steps[:, None]) * _CELL_SPAN + steps).flatten()
        around = cells[:, None] + touching
        found = torch.searchsorted(cells, around).clamp_max(len(cells) - 1)
        cell, neighbor = (cells[found] == around).nonzero(as_tuple=True)
        objects = join_pairs(cell.numpy(), found[cell, neighbor].numpy(), len(cells))
        return cells, cell_of_place, torch.from_numpy(objects)

    def outside(self, places: Tensor, object_places: Tensor) -> Mask:
        """Return the places outside an object that no cell of it touches. [N,3], [R,3] -> [N]

        A cell is outside unless cells of the object lie on both sides of it along two of the three axes.
        """
        occupied = np.zeros((_CELL_SPAN,) * 3, bool)
        occupied.ravel()[self._keys(object_places).numpy()] = True
        touched = binary_dilation(occupied, np.ones((3, 3, 3)))
        axes_inside = np.sum([_between(touched, axis) for axis in range(3)], axis=0)
        outside: Mask = (axes_inside < 2).ravel()[self._keys(places).numpy()]
        return outside

    def _keys(self, places: Tensor) -> Tensor:
        """Return the key of each place's cell; places far outside share the cells at the border. [R]"""
        cells = (places - self.low) / self.side + 0.5 * _CELLS_ACROSS
        cells = cells.clamp(0, _CELL_SPAN - 3).long() + 1
        return (cells[:, 0] * _CELL_SPAN + cells[:, 1]) * _CELL_SPAN + cells[:, 2]


def _between(occupied: Mask, axis: int) -> Mask:
    """Return the cells with an occupied cell on both sides along an axis. [C,C,C]"""
    before = np.logical_or.accumulate(occupied, axis)
    after = np.flip(np.logical_or.accumulate(np.flip(occupied, axis), axis), axis)
    between: Mask = before & after
    return between


def surface_distances(scene: Gaussians) -> NDArray[np.float64]:
    """Return the distance of each center to the surface (1 000 000 Gaussians: 9 s on one core).

    The surface near a Gaussian is a disc through its nearest opaque neighbors. A neighbor counts by the
    density of the opaque centers around it, so that a dense surface outweighs the floaters beside it. The fit
    is repeated once with smaller weights for the neighbors that lie off the first disc. The disc spans three
    standard deviations of these centers: a floater level with a tabletop, but far outside it, is far from the
    surface.

    The distances turn, scale and reorder with the scene. They do not depend on the number of threads.

    Args:
        scene: N Gaussians

    Returns:
        Distances in world units, ≥ 0. NaN where the center is not finite, or where the scene has fewer than
        three other opaque Gaussians. [N]

    Raises:
        StoppedError: see `run_chunks`.
    """
    points = scene.means.detach().double().numpy()
    distances = np.full(len(points), np.nan)
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    opaque = finite[_most_opaque(scene.opacities.detach().double().numpy()[finite])]
    neighbor_count = min(SURFACE_NEIGHBORS, len(opaque) - 1)
    if neighbor_count < _MIN_NEIGHBORS:
        return distances
    surface = points[opaque]
    tree = PointTree(surface, neighbor_count + 1)
    densities = _densities(tree, surface, neighbor_count)
    order = finite[PointTree(points[finite], 1).order]  # neighbors in space become neighbors in memory

    def measure(chunk: int) -> None:
        rows = order[chunk * _CHUNK_ROWS : (chunk + 1) * _CHUNK_ROWS]
        found = tree.query(points[rows], neighbor_count + 1, workers=1)[1]
        dropped = opaque[found] == rows[:, None]
        dropped[~dropped.any(axis=1), -1] = True  # a Gaussian is not its own surface
        neighbors = found[~dropped].reshape(len(rows), neighbor_count)
        arms = surface[neighbors] - points[rows][:, None]
        distances[rows] = _disc_distances(arms, densities[neighbors])

    run_chunks(measure, -(-len(order) // _CHUNK_ROWS))
    return distances


def _most_opaque(opacities: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the Gaussians with the highest opacities, which hold half of the total. [N] -> [M]"""
    known = np.nan_to_num(opacities)
    descending = np.sort(known)[::-1]
    total = descending.cumsum()
    if not len(total) or total[-1] <= 0.0:
        return np.zeros(0, np.int64)
    least = descending[np.searchsorted(total, _OPACITY_SHARE * total[-1])]
    return np.flatnonzero(known >= least)


def _densities(tree: PointTree, points: NDArray[np.float64], neighbor_count: int) -> NDArray[np.float64]:
    """Return the number of points per area around each point, relative to the sparsest, ≥ 1. [M,3] -> [M]"""
    reach = np.empty(len(points))
    order = tree.order

    def measure(chunk: int) -> None:
        rows = order[chunk * _CHUNK_ROWS : (chunk + 1) * _CHUNK_ROWS]
        reach[rows] = tree.query(points[rows], neighbor_count + 1, workers=1)[0][:, -1]

    run_chunks(measure, -(-len(order) // _CHUNK_ROWS))
    largest = max(float(reach.max()), 1e-300)
    densities: NDArray[np.float64] = (largest / reach.clip(1e-9 * largest)) ** 2
    return densities


def _disc_distances(neighbors: NDArray[np.float64], densities: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances of the origin to the discs through some points. [M,k,3], [M,k] -> [M]"""
    center, normal, _ = _fit_discs(neighbors, densities)
    heights = ((neighbors - center[:, None]) @ normal[:, :, None])[:, :, 0]
    squares = heights * heights
    typical = np.median(squares, axis=1, keepdims=True)
    on_disc = np.divide(typical, typical + squares, out=np.ones_like(squares), where=squares > 0.0)
    center, normal, radius = _fit_discs(neighbors, densities * on_disc)
    height = (center * normal).sum(axis=1)
    across = np.linalg.norm(center - height[:, None] * normal, axis=1)
    distances: NDArray[np.float64] = np.hypot(height, np.maximum(across - radius, 0.0))
    return distances


def _fit_discs(
    points: NDArray[np.float64], weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return centers [M,3], unit normals [M,3] and radii [M] of the discs through weighted points.

    Args:
        points: [M,k,3]
        weights: at least one of each row is positive. [M,k]
    """
    shares = (weights / weights.sum(axis=1, keepdims=True))[:, None]
    center = (shares @ points)[:, 0]
    arms = points - center[:, None]
    covariance = (shares * arms.transpose(0, 2, 1)) @ arms
    variances, axes = np.linalg.eigh(covariance)  # ascending
    radius = _DISC_SIGMAS * np.sqrt(variances[:, 1:].sum(axis=1).clip(0.0))
    return center, axes[:, :, 0], radius
