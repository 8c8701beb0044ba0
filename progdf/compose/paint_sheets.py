"""Discs of painted layers, and the overlaps of two layers.

All values are those at strength 1, so they do not change with the sliders.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.quaternions import normalize_quats, rotation_matrices
from progdf.system.equality import equal_fields
from progdf.threads import run_chunks, threads

from .overlap_kernel import MIN_WEIGHT, cover_points

_CLEARANCE_THICKNESSES = 10.0  # distance between the rows of two layers, in thicknesses of a disc
_BLUR_THICKNESSES = 5.5  # standard deviation of a renderer's blur (0.3 px²), in thicknesses of a disc
_REACH_DEVIATIONS = 3.0  # extent of a disc, in standard deviations
_WEIGHT_DEVIATIONS = float(np.sqrt(-2.0 * np.log(MIN_WEIGHT)))  # beyond it, a disc is beside a point
_CORNER_DEVIATIONS = 1.5  # points at which the coverage of a row is measured, in its standard deviations
_COVERED = (0.5, 0.95)  # coverage at which a row begins to fade, and at which it is gone
_SCATTER_QUANTILE = 0.9  # quantile of the pushed Gaussians' movements; surfaces within it are the same one
_NEAREST_PUSHED = 8  # pushed Gaussians whose movement gives the direction of the painted picture
_CELLS_PER_DISC = 16  # limits the memory of a grid
_POINTS_AT_ONCE = 2_048  # points per task of a thread
_MAX_REMEMBERED = 512  # entries of a cache; twenty layers have 380 pairs
_SHAPES = ("means", "log_scales", "quats", "logit_opacities")

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Result = TypeVar("Result")


@dataclass(frozen=True)
class Overlap:
    """Overlap of two painted layers of an extended scene, if one lies above the other.

    Rows are indices into `PaintRows.rows`.
    """

    __eq__ = equal_fields

    over: Rows  # rows of the upper layer on the lower one. [P]
    under: Rows  # row of the lower layer that is most visible there. [P]
    cover: Floats  # opacity of the lower layer there at strength 1. [P]
    rise: Floats  # distance by which the row has to rise to be above the lower layer. [P]
    hidden: Rows  # rows of the lower layer that the upper one covers. [H]
    above: Rows  # row of the upper layer that is most visible there. [H]
    share: Floats  # share of their opacity that fades below the upper layer at strength 1. [H]


@dataclass(frozen=True)
class Sheet:
    """Discs of a painted layer at strength 1."""

    __eq__ = equal_fields

    points: Floats  # centers. [B,3]
    axes: Floats  # columns are the axes. [B,3,3]
    scales: Floats  # standard deviations along the axes. [B,3]
    opacity: Floats  # 0 to 1. [B]
    outward: Floats  # directions away from the surface. [B,3]
    scatter: float  # distance from the surface within which Gaussians were pushed, world units
    key: bytes  # digest of all numbers on which the sheet depends


@dataclass(frozen=True)
class Grid:
    """Discs of similar size of a sheet, sorted into cells of a grid."""

    __eq__ = equal_fields

    discs: Floats  # see `cover_points`. [b,16]
    ids: Rows  # their indices in the sheet. [b]
    starts: Rows  # first disc of each cell, and the number of discs. [x y z + 1]
    shape: tuple[int, int, int]  # number of cells along each axis
    low: Floats  # corner of the grid. [3]
    cell: float  # side of a cell, which is at least the distance at which a disc can cover a point


_LOCK = threading.Lock()  # of the caches: windows and exports make composers in several threads
_SHEETS: dict[bytes, Sheet] = {}
_OVERLAPS: dict[bytes, Overlap | None] = {}


def added_count(gdf: Gdf) -> int:
    """Return the number of rows that a painted edit adds."""
    return 0 if gdf.anchors is None else len(gdf.anchors)


def find_sheet(scene: Gaussians, gdf: Gdf) -> Sheet:
    """Return the discs of a painted edit of the extended scene, from the cache if nothing has changed."""
    assert gdf.anchors is not None
    members = gdf.region.members
    ends = {name: bases.end for name, bases in gdf.field.attributes.items() if name in _SHAPES}
    rows = [getattr(scene, name)[members] for name in _SHAPES]
    surface = scene.means[gdf.anchors.rows]
    key = _digest(",".join(ends), [*rows, *ends.values(), surface, gdf.anchors.weights])
    return _look_up(_SHEETS, key, partial(_make_sheet, scene, gdf, key))


def find_overlap(upper: Sheet, lower: Sheet) -> Overlap | None:
    """Return the overlap of a layer above another, from the cache if it is there; None if they do not meet.

    Rows of the result are indices of the rows that each edit adds.
    """
    return _look_up(_OVERLAPS, upper.key + lower.key, partial(measure_overlap, upper, lower))


def _digest(name: str, parts: Sequence[Tensor]) -> bytes:
    """Return a digest of some tensors and their name."""
    digest = hashlib.blake2b(name.encode(), digest_size=16)
    for part in parts:
        digest.update(repr(tuple(part.shape)).encode())
        digest.update(part.detach().contiguous().numpy().data)
    return digest.digest()


def _look_up(cache: dict[bytes, Result], key: bytes, make: Callable[[], Result]) -> Result:
    """Return a result, from the cache if it is there.

    Adding a layer to a stack, or removing one, does not change the overlaps of the others.
    """
    with _LOCK:
        if key in cache:
            return cache[key]
    result = make()
    with _LOCK:
        cache[key] = result
        while len(cache) > _MAX_REMEMBERED:
            cache.pop(next(iter(cache)))
    return result


def _make_sheet(scene: Gaussians, gdf: Gdf, key: bytes) -> Sheet:
    """Return the discs of a painted edit of the extended scene."""
    count = len(gdf.region.members) - added_count(gdf)
    rows = gdf.region.members[count:]
    ends = {name: bases.end for name, bases in gdf.field.attributes.items()}
    end = {}
    for name in _SHAPES:
        old = getattr(scene, name)[rows].double()
        change = ends[name][count:].double().reshape(old.shape) if name in ends else 0.0
        end[name] = old + change
    points = end["means"].numpy()
    axes = rotation_matrices(normalize_quats(end["quats"])).numpy()
    moves = ends["means"][:count].double().numpy() if "means" in ends else np.zeros((count, 3))
    lengths = np.linalg.norm(moves, axis=1)
    starts = scene.means[gdf.region.members[:count]].double().numpy()
    pushed = (lengths > 0) & np.isfinite(starts).all(axis=1)
    if pushed.any():
        number = min(_NEAREST_PUSHED, int(pushed.sum()))
        nearest = cKDTree(starts[pushed]).query(points, list(range(1, number + 1)), workers=threads())[1]
        outward = -(moves[pushed] / lengths[pushed, None])[nearest].mean(axis=1)
        scatter = float(np.quantile(lengths[pushed], _SCATTER_QUANTILE))
    else:
        # nothing was in the way; the thin axis shows the direction, away from the surface
        assert gdf.anchors is not None
        share = gdf.anchors.weights.double()[..., None]
        surface = (share * scene.means[gdf.anchors.rows].double()).sum(dim=1).numpy()
        thin = axes[:, :, 2]
        outward = np.where(((points - surface) * thin).sum(axis=1, keepdims=True) < 0, -thin, thin)
        scatter = float(end["log_scales"].exp().amin(dim=1).median()) * _CLEARANCE_THICKNESSES
    length = np.linalg.norm(outward, axis=1, keepdims=True)
    return Sheet(
        points,
        axes,
        end["log_scales"].exp().numpy(),
        end["logit_opacities"].sigmoid().numpy(),
        outward / np.maximum(length, 1e-12),
        scatter,
        key,
    )


def measure_overlap(upper: Sheet, lower: Sheet) -> Overlap | None:
    """Return the overlap of a layer above another, in rows that each adds; None if they do not meet."""
    scatter = max(upper.scatter, lower.scatter)
    margin = scatter + _REACH_DEVIATIONS * max(float(upper.scales.max()), float(lower.scales.max()))
    inside = _near(upper.points, lower.points, margin)
    below = _near(lower.points, upper.points, margin)
    distance = _distance(lower, upper.points[inside], upper.outward[inside], scatter)
    if distance is None or not len(below):
        return None
    grids = make_grids(lower, distance)
    cover, height, under = measure_cover(grids, upper.points[inside], upper.outward[inside], distance)
    meets = height > -np.inf
    over = inside[meets]
    clearance = _CLEARANCE_THICKNESSES * upper.scales[over].min(axis=1)
    rise = np.maximum(height[meets] + clearance, 0.0)
    hidden, above, share = _hidden(upper, lower, below, distance)
    return Overlap(over, under[meets], cover[meets], rise, hidden, above, share)


def _distance(sheet: Sheet, points: Floats, outward: Floats, scatter: float) -> float | None:
    """Return a distance that joins points to the planes of discs of the same surface; None if none is near.

    It is the largest distance from the plane of the nearest disc, and the distance between two layers.

    Args:
        sheet: a layer
        points: centers of the discs of another layer. [P,3]
        outward: directions away from their surface. [P,3]
        scatter: surfaces within this distance are the same one
    """
    if not len(points):
        return None
    disc = cKDTree(sheet.points).query(points, workers=threads())[1]
    apart = sheet.points[disc] - points
    thin = np.argmin(sheet.scales[disc], axis=1)
    normal = np.take_along_axis(sheet.axes[disc], thin[:, None, None], axis=2)[:, :, 0]
    across = np.abs((apart * normal).sum(axis=1))
    along = np.sqrt(np.maximum((apart**2).sum(axis=1) - across**2, 0.0))
    near = (across <= scatter) & ((sheet.outward[disc] * outward).sum(axis=1) > 0)
    near &= along <= _REACH_DEVIATIONS * sheet.scales[disc].max(axis=1)
    if not near.any():
        return None
    return float(across[near].max() + _CLEARANCE_THICKNESSES * np.median(sheet.scales.min(axis=1)))


def _near(points: Floats, others: Floats, margin: float) -> Rows:
    """Return the points in the bounding box of others, extended by a margin."""
    low = others.min(axis=0) - margin
    high = others.max(axis=0) + margin
    return np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))


def _hidden(upper: Sheet, lower: Sheet, below: Rows, distance: float) -> tuple[Rows, Rows, Floats]:
    """Return the covered lower rows, the rows that cover them, and the shares that fade. [H] each"""
    least, full = _COVERED
    grids = make_grids(upper, distance)
    cover, _, above = measure_cover(grids, lower.points[below], lower.outward[below], distance)
    covered = np.flatnonzero(cover > least)
    smallest = cover[covered]
    rows = below[covered]
    sides = np.argsort(lower.scales[rows], axis=1)[:, 1:]  # the two wide axes
    for side in sides.T:
        axis = np.take_along_axis(lower.axes[rows], side[:, None, None], axis=2)[:, :, 0]
        step = _CORNER_DEVIATIONS * np.take_along_axis(lower.scales[rows], side[:, None], axis=1) * axis
        for corner in (lower.points[rows] + step, lower.points[rows] - step):
            found = measure_cover(grids, corner, lower.outward[rows], distance, enough=full)[0]
            smallest = np.minimum(smallest, found)
    share = np.clip((smallest - least) / (full - least), 0.0, 1.0)
    share = share * share * (3.0 - 2.0 * share)
    fades = share > 0
    return rows[fades], above[covered][fades], share[fades]


def make_grids(sheet: Sheet, distance: float) -> list[Grid]:
    """Return the discs of a sheet by size, each in a grid, so that a point has few neighbors.

    Args:
        sheet: the discs
        distance: largest distance of a covered point from a disc's plane
    """
    order = np.argsort(sheet.scales, axis=1)
    axes = np.take_along_axis(sheet.axes, order[:, None, :], axis=2)
    scales = np.take_along_axis(sheet.scales, order, axis=1)
    wide = np.hypot(scales[:, 1:], _BLUR_THICKNESSES * scales[:, :1])
    columns = [sheet.points, axes[:, :, 0], axes[:, :, 1] / wide[:, :1], axes[:, :, 2] / wide[:, 1:]]
    discs = np.concatenate([*columns, sheet.outward, sheet.opacity[:, None]], axis=1)
    classes = np.floor(np.log2(np.maximum(scales[:, 2], 1e-30)))
    grids = []
    for size_class in np.unique(classes):
        ids = np.flatnonzero(classes == size_class)
        reach = _WEIGHT_DEVIATIONS * float(wide[ids, 1].max())
        grids.append(_make_grid(discs[ids], ids, float(np.hypot(reach, distance))))
    return grids


def _make_grid(discs: Floats, ids: Rows, reach: float) -> Grid:
    """Return discs in a grid of cells that are at least as wide as their reach."""
    points = discs[:, :3]
    low = points.min(axis=0)
    extent = points.max(axis=0) - low
    cell = max(reach, 1e-30)
    while np.prod(np.floor(extent / cell) + 1.0) > _CELLS_PER_DISC * len(discs) + 27:
        cell *= 1.5
    sides = np.floor(extent / cell).astype(np.int64) + 1
    at = np.minimum(np.floor((points - low) / cell).astype(np.int64), sides - 1)
    cells = (at[:, 0] * sides[1] + at[:, 1]) * sides[2] + at[:, 2]
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[order], np.arange(np.prod(sides) + 1))
    shape = int(sides[0]), int(sides[1]), int(sides[2])
    return Grid(np.ascontiguousarray(discs[order]), ids[order], starts, shape, low, cell)


def measure_cover(
    grids: Sequence[Grid], points: Floats, outward: Floats, distance: float, enough: float = 1.0
) -> tuple[Floats, Floats, Rows]:
    """Return the coverage of points on the same surface by a layer.

    Args:
        grids: the layer's discs, see `make_grids`
        points: [P,3]
        outward: direction away from the surface. [P,3]
        distance: largest distance of a point from a disc's plane
        enough: coverage above which further discs may be left out

    Returns:
        Opacity of the layer's discs at the points, 0 to 1. [P]
        Height of the highest of them above the point, −∞ without any. [P]
        The most opaque of them. [P]
    """
    passing = np.ones(len(points))
    height = np.full(len(points), -np.inf)
    most = np.zeros(len(points))
    under = np.zeros(len(points), np.int64)

    def measure(chunk: int) -> None:
        part = slice(chunk * _POINTS_AT_ONCE, (chunk + 1) * _POINTS_AT_ONCE)
        found = passing[part], height[part], most[part], under[part]
        for grid in grids:
            cells = grid.starts, grid.shape, grid.low, grid.cell
            cover_points((grid.discs, grid.ids), cells, points[part], outward[part], distance, enough, found)

    run_chunks(measure, -(-len(points) // _POINTS_AT_ONCE))
    return 1.0 - passing, height, under
