"""Painted strength: a weight per member of a layer, and the strokes of a brush that change it.

A stroke keeps the weights it began with and how far the brush has reached each member; what it gives does not
depend on how many events the hand's way was cut into.
"""

from __future__ import annotations

import base64
import binascii
import zlib
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.compose.layers import Gains, Layer
from progdf.errors import ProgdfError
from progdf.gdf.file import Gdf
from progdf.scene.selection import Surface

from .view_state import LARGEST_PX, SMALLEST_PX, Brush

FULL = ""
"""The paint of a layer that was never painted: weight 1 everywhere."""

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Stroke:
    """A stroke under way."""

    before: Floats  # weights when it began, 0..1. [M]
    # where each member is in the picture, pixels, and f·log(depth), so that neighbors are as far apart as
    # they look; NaN where the brush cannot reach it. [M,3]
    places: Floats
    reached: Floats  # largest touch of the brush so far, 0..1. [M]
    mode: str = "erase"  # of `BRUSH_MODES`
    last: tuple[float, float] | None = None  # where the brush was last, pixels


def mode_while(mode: str, modifier: str) -> str:
    """What a stroke does that begins with a modifier held: Ctrl the opposite, Shift smooths, as elsewhere."""
    if modifier == "Shift":
        return "smooth"
    return {"add": "erase", "erase": "add"}.get(mode, mode) if modifier == "Ctrl" else mode


def radius(pixels: float) -> float:
    """A radius that a hand can use."""
    return min(LARGEST_PX, max(SMALLEST_PX, round(pixels, 1)))


def softness(share: float) -> float:
    """A softness, 0..1."""
    return min(1.0, max(0.0, round(share, 3)))


def encode(weights: Floats) -> str:
    """Weights 0..1 as the text that a state and a session keep; `FULL` where all are 1."""
    levels = np.round(np.clip(weights, 0.0, 1.0) * 255.0).astype(np.uint8)
    if (levels == 255).all():
        return FULL
    return base64.b64encode(zlib.compress(levels.tobytes(), 1)).decode()


@lru_cache(maxsize=48)  # the composer knows weights by their identity
def decode(paint: str, members: int, from_others: int = 0) -> Tensor | None:
    """Weight of every member, None for `FULL`. [M] float32

    Args:
        paint: as `encode` writes it
        members: M
        from_others: how many of the last members other edits add; what came after it was painted has 1

    Raises:
        ProgdfError: the text is damaged, or holds weights of more members, or of fewer than that.
    """
    if paint == FULL:
        return None
    unpacker = zlib.decompressobj()
    try:
        levels = unpacker.decompress(base64.b64decode(paint, validate=True), members + 1)
    except (ValueError, binascii.Error, zlib.error):
        raise ProgdfError("the painted weights of a layer are damaged; paint it again") from None
    if not members - from_others <= len(levels) <= members:
        raise ProgdfError(f"a layer's painted weights do not fit its {members} members; paint it again")
    return torch.from_numpy(
        np.frombuffer(levels.ljust(members, b"\xff"), np.uint8).astype(np.float32) / 255.0
    )


def layer_of(gdf: Gdf, strength: float, gains: Gains, paint: str) -> Layer:
    """The layer that the composer takes, with the painted weights.

    Raises:
        ProgdfError: see `decode`.
    """
    return Layer(gdf, strength, True, gains, decode(paint, len(gdf.region), gdf.from_others))


def begin_stroke(paint: str, gdf: Gdf, surface: Surface, through: bool, mode: str = "erase") -> Stroke:
    """A stroke that has touched nothing yet.

    Args:
        paint: of the layer
        gdf: its edit
        surface: of the scene on screen
        through: also what lies behind the front surface
        mode: of `BRUSH_MODES`
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
    """The stroke with the brush moved in a straight line to a pixel position.

    Args:
        stroke: under way
        x, y: pixels of the picture
        brush: its radius is in pixels at 1×
        density: pixels of the picture per pixel at 1×
    """
    here = np.array([x, y], np.float32)
    there = here if stroke.last is None else np.array(stroke.last, np.float32)
    way = here - there
    places = stroke.places[:, :2]
    along = np.clip(((places - there) @ way) / max(float(way @ way), 1e-12), 0.0, 1.0)
    away = np.linalg.norm(places - there - along[:, None] * way, axis=1) / (brush.radius * density)
    fall = np.clip((1.0 - away) / max(brush.softness, 1e-3), 0.0, 1.0)
    touch = np.nan_to_num(fall * fall * (3.0 - 2.0 * fall)).astype(np.float32)
    return replace(stroke, reached=np.maximum(stroke.reached, touch), last=(x, y))


def apply_stroke(stroke: Stroke, brush: Brush, density: float = 1.0) -> str:
    """The paint that the stroke has made so far: to the brush's value, to 0, or to the mean of neighbors
    under the brush, as far as its flow goes.

    Args:
        stroke: under way
        brush, density: as for `extend_stroke`; smoothing reaches as far as half the brush
    """
    goal = np.full_like(stroke.before, brush.value if stroke.mode == "add" else 0.0)
    if stroke.mode == "smooth":
        under = np.flatnonzero(stroke.reached)
        width = 0.5 * brush.radius * density
        goal[under] = near_mean(stroke.places[under], stroke.before[under], width)
    return encode(stroke.before + (goal - stroke.before) * stroke.reached * np.float32(brush.flow))


def invert(paint: str, members: int, from_others: int = 0) -> str:
    """The paint with each weight w replaced by 1 − w; arguments as of `decode`.

    Raises:
        ProgdfError: see `decode`.
    """
    weights = decode(paint, members, from_others)
    return encode(np.zeros(members, np.float32) if weights is None else (1.0 - weights).numpy())


def feather(paint: str, points: Floats, width: float, from_others: int = 0) -> str:
    """The paint with its edges softened, wherever one looks from.

    Args:
        paint: of a layer
        points: the centers of its members, world units. [M,3]
        width: see `near_mean`, world units, > 0
        from_others: see `decode`

    Raises:
        ProgdfError: see `decode`.
    """
    weights = decode(paint, len(points), from_others)
    if weights is None:
        return FULL
    soft = weights.numpy().copy()
    somewhere = np.isfinite(points).all(1)
    soft[somewhere] = near_mean(points[somewhere], soft[somewhere], width)
    return encode(soft)


_MINIMUM = float(np.finfo(np.float64).tiny)  # a corner without a share has no mean, and gives none


_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])


def near_mean(points: Floats, values: Floats, width: float) -> Floats:
    """Mean of the values around each point: continuous, and its cost grows with the points alone.

    Each point gives its value to the eight corners of its cell and takes their means, by its place among
    them: a kernel of about 0.6 `width` standard deviation.

    Args:
        points: finite, in any unit. [M,3]
        values: at the points. [M]
        width: side of a cell, in the unit of the points, > 0

    Returns:
        Within the range of the values. [M]
    """
    if not len(points):
        return values.copy()
    places = points / np.float32(width)
    low = np.floor(places)
    ends = np.stack([1.0 - (places - low), places - low], 2)  # to the lower corner and to the upper one
    shares = (ends[:, 0, :, None, None] * ends[:, 1, None, :, None] * ends[:, 2, None, None, :]).reshape(
        -1, 8
    )
    low -= low.min(0)
    _, y_side, z_side = (low.max(0) + 2).tolist()
    steps = np.array([y_side * z_side, z_side, 1.0])
    cells = (low @ steps)[:, None] + _CORNERS @ steps  # whole numbers, exact in float64 up to 2⁵³
    corners = np.unique(cells, return_inverse=True)[1].reshape(cells.shape)
    given = np.bincount(corners.ravel(), shares.ravel())[corners]
    total = np.bincount(corners.ravel(), (shares * values[:, None]).ravel())[corners]
    means: Floats = (shares * (total / np.maximum(given, _MINIMUM))).sum(1).astype(np.float32)
    return np.clip(means, values.min(), values.max())
