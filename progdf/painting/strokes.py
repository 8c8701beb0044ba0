"""Brush strokes in RGBA pictures: dabs of a round brush, painting, erasing, and storage as bytes.

A stroke stores the picture before it and the largest influence of the brush on each pixel. Its result does
not depend on the number of pointer events along the path.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from progdf.errors import ProgdfError

Floats = NDArray[np.float32]
Pixels = NDArray[np.uint8]
Box = tuple[int, int, int, int]
"""Columns and rows of a part of a picture: left, top, right and bottom; the last two are exclusive."""
Point = tuple[float, float]

NO_BOX: Box = (0, 0, 0, 0)
"""Box without pixels."""
MAX_SIDE_PX = 8192
"""Largest side of a painted picture, pixels."""
_MIN_EDGE_PX = 1.0  # the edge of the hardest brush fades over this width, pixels


@dataclass(frozen=True)
class BrushTip:
    """Round brush."""

    radius: float  # pixels of the picture, > 0
    hardness: float = 1.0  # share of the radius with full influence, 0 to 1
    flow: float = 1.0  # influence of a stroke at its center, 0 to 1


@dataclass(frozen=True, eq=False)
class ColorStroke:
    """Brush stroke in progress on one picture. Its arrays are never changed in place."""

    before: Pixels  # straight RGBA before the stroke. [H,W,4]
    pixels: Pixels  # straight RGBA after the stroke so far. [H,W,4]
    coverage: Floats  # largest influence of the brush so far, 0 to 1. [H,W]
    reachable: Floats  # share of each pixel that can be painted, 0 to 1. [H,W]
    colors: Floats | None  # color of each pixel of the paint, 0 to 1 [H,W,3] or [3]; None erases
    last: Point | None = None  # last position of the brush, pixels
    box: Box = NO_BOX  # pixels that the stroke has changed
    dab: Box = NO_BOX  # pixels that its last part has changed
    parts: int = 0  # number of parts that changed pixels


def begin_stroke(before: Pixels, reachable: Floats, colors: Floats | None) -> ColorStroke:
    """Begin a stroke that has not changed any pixel yet. Arguments as in `ColorStroke`."""
    return ColorStroke(before, before, np.zeros(before.shape[:2], np.float32), reachable, colors)


def extend_stroke(stroke: ColorStroke, x: float, y: float, tip: BrushTip) -> ColorStroke:
    """Extend a stroke in a straight line to a position.

    Args:
        stroke: the stroke
        x, y: pixels from the upper left corner, pixel centers at +0.5
        tip: the brush

    Returns:
        The stroke; the same object if the position is unchanged.
    """
    if stroke.last == (x, y):
        return stroke
    start = stroke.last or (x, y)
    box = _clip(_reach(start, (x, y), tip.radius), stroke.coverage.shape)
    if _is_empty(box):
        return replace(stroke, last=(x, y), dab=NO_BOX)
    part = np.s_[box[1] : box[3], box[0] : box[2]]
    influence = line_influence(box, start, (x, y), tip) * stroke.reachable[part]
    coverage = stroke.coverage.copy()
    coverage[part] = np.maximum(coverage[part], influence)
    pixels = stroke.pixels.copy()
    if stroke.colors is None:
        pixels[part] = erase(stroke.before[part], coverage[part])
    else:
        colors = stroke.colors if stroke.colors.ndim == 1 else stroke.colors[part]
        pixels[part] = paint_over(stroke.before[part], colors, coverage[part])
    return replace(
        stroke,
        pixels=pixels,
        coverage=coverage,
        last=(x, y),
        box=join_boxes(stroke.box, box),
        dab=box,
        parts=stroke.parts + 1,
    )


def line_influence(box: Box, start: Point, end: Point, tip: BrushTip) -> Floats:
    """Return the influence of a brush that moves in a straight line, 0 to 1.

    Args:
        box: pixels to return, h rows and w columns
        start, end: positions of the brush, pixels
        tip: the brush

    Returns:
        [h,w]
    """
    left, top, right, bottom = box
    x = np.arange(left, right, dtype=np.float32) + np.float32(0.5 - start[0])
    y = (np.arange(top, bottom, dtype=np.float32) + np.float32(0.5 - start[1]))[:, None]
    dx = np.float32(end[0] - start[0])
    dy = np.float32(end[1] - start[1])
    along = np.clip((x * dx + y * dy) / max(float(dx * dx + dy * dy), 1e-12), 0.0, 1.0)
    away = np.sqrt(np.square(x - along * dx) + np.square(y - along * dy))
    edge = max(_MIN_EDGE_PX, (1.0 - tip.hardness) * tip.radius)
    # half of a hard edge lies outside the radius, so that a brush of one pixel is visible
    outer = max(tip.radius, 0.5 * edge) + 0.5 * _MIN_EDGE_PX
    fall = np.clip((outer - away) / np.float32(edge), 0.0, 1.0)
    influence: Floats = (np.float32(tip.flow) * fall * fall * (3.0 - 2.0 * fall)).astype(np.float32)
    return influence


def paint_over(before: Pixels, colors: Floats, coverage: Floats) -> Pixels:
    """Paint colors over straight RGBA.

    Args:
        before: straight RGBA. [h,w,4]
        colors: 0 to 1. [h,w,3] or [3]
        coverage: opacity of the paint, 0 to 1. [h,w]

    Returns:
        straight RGBA. [h,w,4]
    """
    share = coverage[..., None]
    below = before[..., 3:].astype(np.float32) / 255.0 * (1.0 - share)
    alpha = share + below
    weight = np.divide(share, alpha, out=np.zeros_like(alpha), where=alpha > 0.0)
    mixed = weight * colors + (1.0 - weight) * (before[..., :3].astype(np.float32) / 255.0)
    return to_bytes(np.concatenate([mixed, alpha], axis=2))


def erase(before: Pixels, coverage: Floats) -> Pixels:
    """Reduce the opacity of straight RGBA [h,w,4] by a share of 0 to 1 [h,w]."""
    after = before.copy()
    after[..., 3] = to_bytes(before[..., 3].astype(np.float32) / 255.0 * (1.0 - coverage))
    return after


def composite(below: Pixels, above: Pixels) -> Pixels:
    """Composite straight RGBA over straight RGBA. [h,w,4] each"""
    if not above[..., 3].any():
        return below
    if not below[..., 3].any():
        return above
    return paint_over(
        below,
        above[..., :3].astype(np.float32) / 255.0,
        (above[..., 3] / np.float32(255.0)).astype(np.float32),
    )


def composite_over_picture(picture: Pixels, paint: Pixels) -> Pixels:
    """Composite straight RGBA [H,W,4] over an opaque picture [H,W,3]."""
    alpha = paint[..., 3:] / np.float32(255.0)
    mixed = picture.astype(np.float32) * (1.0 - alpha) + paint[..., :3].astype(np.float32) * alpha
    return to_bytes((mixed / 255.0).astype(np.float32))


def to_bytes(values: Floats) -> Pixels:
    """Round values of 0 to 1 to 8 bits."""
    rounded: Pixels = (np.clip(values, 0.0, 1.0) * np.float32(255.0) + np.float32(0.5)).astype(np.uint8)
    return rounded


def painted_box(pixels: Pixels) -> Box:
    """Return the smallest box with all visible pixels of RGBA [H,W,4]; `NO_BOX` if there are none."""
    alpha = pixels[..., 3] > 0
    columns = np.flatnonzero(alpha.any(axis=0))
    rows = np.flatnonzero(alpha.any(axis=1))
    if not len(rows):
        return NO_BOX
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def pack(pixels: Pixels, box: Box) -> bytes:
    """Compress the pixels of RGBA [H,W,4] inside a box."""
    left, top, right, bottom = box
    return zlib.compress(np.ascontiguousarray(pixels[top:bottom, left:right]).tobytes(), 1)


@lru_cache(maxsize=24)
def unpack(packed: bytes, width: int, height: int, box: Box) -> Pixels:
    """Return a picture from its packed box. The pixels outside the box are transparent.

    Args:
        packed: bytes from `pack`
        width, height: size of the picture, pixels
        box: box of `pack`

    Returns:
        Read-only straight RGBA. [H,W,4]

    Raises:
        ProgdfError: the bytes are damaged or do not fit the box, or the box does not fit the picture.
    """
    left, top, right, bottom = box
    is_valid = 0 <= left <= right <= width <= MAX_SIDE_PX and 0 <= top <= bottom <= height <= MAX_SIDE_PX
    size = (bottom - top) * (right - left) * 4 if is_valid else 0
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(packed, size + 1) if is_valid else b""
    except zlib.error:
        content = b""
    if not is_valid or len(content) != size:
        raise ProgdfError("a painted picture is damaged; paint it again")
    pixels = np.zeros((height, width, 4), np.uint8)
    pixels[top:bottom, left:right] = np.frombuffer(content, np.uint8).reshape(bottom - top, right - left, 4)
    pixels.flags.writeable = False
    return pixels


def join_boxes(one: Box, other: Box) -> Box:
    """Return the smallest box with both boxes."""
    if _is_empty(one):
        return other
    if _is_empty(other):
        return one
    return (
        min(one[0], other[0]),
        min(one[1], other[1]),
        max(one[2], other[2]),
        max(one[3], other[3]),
    )


def _is_empty(box: Box) -> bool:
    return box[0] >= box[2] or box[1] >= box[3]


def _reach(start: Point, end: Point, radius: float) -> Box:
    """Return the box of all pixels that a brush touches on a line."""
    reach = radius + 1.5 * _MIN_EDGE_PX
    return (
        int(np.floor(min(start[0], end[0]) - reach)),
        int(np.floor(min(start[1], end[1]) - reach)),
        int(np.ceil(max(start[0], end[0]) + reach)),
        int(np.ceil(max(start[1], end[1]) + reach)),
    )


def _clip(box: Box, shape: tuple[int, ...]) -> Box:
    """Return the part of a box inside a picture of this shape (rows, columns)."""
    height, width = shape[:2]
    return max(box[0], 0), max(box[1], 0), min(box[2], width), min(box[3], height)
