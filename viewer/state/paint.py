"""Painted strength: a weight per member of a layer, changed by brush strokes.

A stroke stores the initial weights and the largest brush influence on each member. Its result does not depend
on the number of pointer events along the path.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from progdf.compose.layer_paint import FULL, Floats, decode, encode
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.scene.selection import Surface

from .view_state import LARGEST_PX, SMALLEST_PX, Brush


@dataclass(frozen=True, eq=False)
class Stroke:
    """Brush stroke in progress."""

    before: Floats  # initial weights, 0 to 1. [M]
    # x, y and focal length · log(depth) of each member, px, so that depth differences count like distances in
    # the picture; NaN for members that the brush cannot reach. [M,3]
    places: Floats
    reached: Floats  # largest brush influence so far, 0 to 1. [M]
    mode: str = "erase"  # one of `BRUSH_MODES`
    last: tuple[float, float] | None = None  # last position of the brush, px


def mode_while(mode: str, modifier: str) -> str:
    """Return the mode of a stroke begun with a modifier: Ctrl swaps add and erase, Shift smooths."""
    if modifier == "Shift":
        return "smooth"
    return {"add": "erase", "erase": "add"}.get(mode, mode) if modifier == "Ctrl" else mode


def radius(pixels: float) -> float:
    """Clamp a brush radius to `SMALLEST_PX` to `LARGEST_PX` and round it to 0.1 px."""
    return min(LARGEST_PX, max(SMALLEST_PX, round(pixels, 1)))


def softness(share: float) -> float:
    """Clamp a softness to 0 to 1 and round it to 0.001."""
    return min(1.0, max(0.0, round(share, 3)))


def erase_rows(paint: str, gdf: Gdf, scene: Gaussians, original_count: int, mask: NDArray[np.bool_]) -> str:
    """Return a layer's paint with weight 0 for some of the rows that its edit adds.

    Gaussians that the edit moves out of the way of such a row get weight 0 too, and so return to their place.

    Args:
        paint: paint of the layer
        gdf: its edit, extended to the rows of the scene
        scene: the scene with the rows that edits add
        original_count: number of its Gaussians without these rows
        mask: rows to erase. [N] bool
    """
    members = gdf.region.members.numpy()
    own_count = len(members)
    if gdf.anchors is not None:
        own_count -= len(gdf.anchors)
    elif not gdf.from_others:  # rows without anchors, as in a copy
        own_count -= int((members >= original_count).sum())
    erased = mask[members[own_count:]]
    if not erased.any():
        return paint
    decoded = decode(paint, len(members), gdf.from_others)
    weights = np.ones(len(members), np.float32) if decoded is None else decoded.numpy().copy()
    weights[own_count:][erased] = 0.0
    if gdf.anchors is not None and gdf.anchors.pushes and own_count:
        means = scene.means.numpy()[members]
        _, nearest = cKDTree(means[own_count:], balanced_tree=False).query(means[:own_count])
        weights[:own_count][erased[nearest]] = 0.0
    return encode(weights)


def begin_stroke(paint: str, gdf: Gdf, surface: Surface, through: bool, mode: str = "erase") -> Stroke:
    """Begin a stroke that has not affected any member yet.

    Args:
        paint: paint of the layer
        gdf: edit of the layer
        surface: surface of the scene on screen
        through: also affect members behind the front surface
        mode: one of `BRUSH_MODES`
    """
    count = len(gdf.region)
    weights = decode(paint, count, gdf.from_others)
    before = np.ones(count, np.float32) if weights is None else weights.numpy()
    members = gdf.region.members.numpy()
    points = surface.centers.points[members]
    depths = surface.centers.depths[members]
    with np.errstate(divide="ignore", invalid="ignore"):
        places = np.column_stack([points, float(surface.camera.K[0, 0]) * np.log(depths)])
    reachable = np.isfinite(places).all(1)
    if not through:
        reachable &= surface.front(members)
    places = np.where(reachable[:, None], places, np.nan).astype(np.float32)
    return Stroke(before, places, np.zeros(count, np.float32), mode)


def extend_stroke(stroke: Stroke, x: float, y: float, brush: Brush, density: float = 1.0) -> Stroke:
    """Extend a stroke in a straight line to a pixel position.

    Args:
        stroke: the stroke in progress
        x, y: position in the picture, px
        brush: the brush, with its radius in pixels at 1×
        density: pixels of the picture per pixel at 1×

    Returns:
        The stroke; the same object if the brush rests and reaches nothing new.
    """
    here = np.array([x, y], np.float32)
    there = here if stroke.last is None else np.array(stroke.last, np.float32)
    motion = here - there
    places = stroke.places[:, :2]
    along = np.clip(((places - there) @ motion) / max(float(motion @ motion), 1e-12), 0.0, 1.0)
    away = np.linalg.norm(places - there - along[:, None] * motion, axis=1) / (brush.radius * density)
    fall = np.clip((1.0 - away) / max(brush.softness, 1e-3), 0.0, 1.0)
    touch = np.nan_to_num(fall * fall * (3.0 - 2.0 * fall)).astype(np.float32)
    reached = np.maximum(stroke.reached, touch)
    if stroke.last == (x, y) and np.array_equal(reached, stroke.reached):
        return stroke
    return replace(stroke, reached=reached, last=(x, y))


def apply_stroke(stroke: Stroke, brush: Brush, density: float = 1.0) -> str:
    """Return the paint after the stroke so far.

    Weights move by the brush's flow towards its value (add), 0 (erase), or the mean of neighbors under the
    brush (smooth).

    Args:
        stroke: the stroke in progress
        brush, density: see `extend_stroke`; smoothing averages over half the brush radius
    """
    goal = np.full_like(stroke.before, brush.value if stroke.mode == "add" else 0.0)
    if stroke.mode == "smooth":
        under = np.flatnonzero(stroke.reached)
        width = 0.5 * brush.radius * density
        goal[under] = near_mean(stroke.places[under], stroke.before[under], width)
    return encode(stroke.before + (goal - stroke.before) * stroke.reached * np.float32(brush.flow))


def invert(paint: str, members: int, from_others: int = 0) -> str:
    """Replace each weight w by 1 − w. The arguments are those of `decode`.

    Raises:
        ProgdfError: see `decode`.
    """
    weights = decode(paint, members, from_others)
    return encode(np.zeros(members, np.float32) if weights is None else (1.0 - weights).numpy())


def feather(paint: str, points: Floats, width: float, from_others: int = 0) -> str:
    """Soften the edges of the paint in world space, independent of the view.

    Args:
        paint: paint of a layer
        points: centers of its members, world units. [M,3]
        width: cell size of `near_mean`, world units, > 0
        from_others: see `decode`

    Raises:
        ProgdfError: see `decode`.
    """
    weights = decode(paint, len(points), from_others)
    if weights is None:
        return FULL
    soft = weights.numpy().copy()
    finite = np.isfinite(points).all(1)
    soft[finite] = near_mean(points[finite], soft[finite], width)
    return encode(soft)


_MIN_WEIGHT = float(np.finfo(np.float64).tiny)  # avoids a division by 0 at corners without weight


# offsets of the eight corners of a cell, in cells. [8,3]
_CELL_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])


def near_mean(points: Floats, values: Floats, width: float) -> Floats:
    """Return a smooth local mean of the values around each point, at a cost linear in the points.

    Each point spreads its value to the eight corners of its grid cell and gathers their means, both with
    trilinear weights. The kernel has a standard deviation of about 0.6 `width`.

    Args:
        points: finite positions in any unit. [M,3]
        values: values at the points. [M]
        width: side of a cell, in the unit of the points, > 0

    Returns:
        Means within the range of the values. [M]
    """
    if not len(points):
        return values.copy()
    places = points / np.float32(width)
    low = np.floor(places)
    ends = np.stack([1.0 - (places - low), places - low], 2)  # weights of the lower and the upper corner
    shares = (ends[:, 0, :, None, None] * ends[:, 1, None, :, None] * ends[:, 2, None, None, :]).reshape(
        -1, 8
    )
    low -= low.min(0)
    _, y_side, z_side = (low.max(0) + 2).tolist()
    steps = np.array([y_side * z_side, z_side, 1.0])
    cells = (low @ steps)[:, None] + _CELL_CORNERS @ steps  # integers, exact in float64 up to 2⁵³
    corners = np.unique(cells, return_inverse=True)[1].reshape(cells.shape)
    weight_sums = np.bincount(corners.ravel(), shares.ravel())[corners]
    total = np.bincount(corners.ravel(), (shares * values[:, None]).ravel())[corners]
    means: Floats = (shares * (total / np.maximum(weight_sums, _MIN_WEIGHT))).sum(1).astype(np.float32)
    return np.clip(means, values.min(), values.max())
