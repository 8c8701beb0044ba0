"""Which part of a picture some Gaussians can touch: cells of 8×8 pixels, and a few boxes around them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progdf.camera import Camera

from .conventions import ALPHA_MIN, DILATION
from .cpu.engine import make_pinhole
from .cpu.jit import kernel
from .cpu.project import Pinhole, Scene, footprint, largest_extents
from .engines import ActivatedGaussians, Crop, RasterView

Array = NDArray[Any]

CELL = 8
"""Pixels of a cell's side; a cell spans whole rows of the rasterizer's tiles."""

MOST_RECTANGLES = 6
"""Of `dirty_rectangles`."""

_MARGIN = 1.0  # px on each side: far more than rounding, far less than a cell


def no_cells(width: int, height: int) -> NDArray[np.bool_]:
    """No cell of a picture of this size marked. [⌈height/8⌉, ⌈width/8⌉]"""
    return np.zeros((-(-height // CELL), -(-width // CELL)), np.bool_)


def mark_cells(
    cells: NDArray[np.bool_],
    gaussians: ActivatedGaussians,
    rows: NDArray[np.int64],
    camera: Camera,
) -> None:
    """Mark every cell with a pixel that one of `rows` can have alpha ≥ 1/255 in, as `render` draws them.

    Args:
        cells: from `no_cells`; marks are added
        gaussians: all N, float32; colors are not read
        rows: which of them. [M]
        camera: the view; antialiasing only makes what is touched smaller
    """
    means, quats, scales, opacities, _ = (tensor.numpy() for tensor in gaussians.tensors)
    scene = Scene(means, quats, scales, opacities, np.empty((len(means), 1, 3), np.float32))
    _mark(cells, rows, scene, make_pinhole(RasterView.of(camera, gaussians)))


@kernel()
def _cells_of(
    px: float, py: float, wide: float, high: float, width: float, height: float
) -> tuple[int, int, int, int]:
    """First column and row of the cells of a box around px, py, and one past the last; 0, 0, 0, 0 outside."""
    left, right = px - wide - _MARGIN, px + wide + _MARGIN
    top, bottom = py - high - _MARGIN, py + high + _MARGIN
    if right < 0.0 or left >= width or bottom < 0.0 or top >= height:
        return 0, 0, 0, 0
    if not abs(left) + abs(right) + abs(top) + abs(bottom) < np.inf:  # beyond numbers: anywhere
        left, right, top, bottom = 0.0, width, 0.0, height
    return (
        int(max(left, 0.0)) // CELL,
        int(max(top, 0.0)) // CELL,
        int(min(right, width - 1.0)) // CELL + 1,
        int(min(bottom, height - 1.0)) // CELL + 1,
    )


@kernel()
def _are_all_marked(cells: Array, x0: int, y0: int, x1: int, y1: int) -> bool:
    for y in range(y0, y1):
        for x in range(x0, x1):
            if not cells[y, x]:
                return False
    return True


@kernel(contract=True, cache=True)
def _mark(cells: Array, rows: Array, scene: Scene, camera: Pinhole) -> None:
    width, height = float(camera.window[2]), float(camera.window[3])
    for i in rows:
        usable, px, py, _, wide2, high2 = largest_extents(camera, scene, i)
        if not usable:
            continue
        # first the bound that needs no covariance: most land where others did
        x0, y0, x1, y1 = _cells_of(px, py, math.sqrt(wide2), math.sqrt(high2), width, height)
        if _are_all_marked(cells, x0, y0, x1, y1):
            continue
        seen = footprint(camera, scene, i)
        radius2 = 2.0 * math.log(np.float64(scene.opacities[i]) / ALPHA_MIN)
        wide = math.sqrt(max(0.0, radius2 * (seen.a + DILATION)))
        high = math.sqrt(max(0.0, radius2 * (seen.c + DILATION)))
        x0, y0, x1, y1 = _cells_of(px, py, wide, high, width, height)
        for y in range(y0, y1):
            for x in range(x0, x1):
                cells[y, x] = True


def dirty_rectangles(cells: NDArray[np.bool_], size: tuple[int, int], worth: int) -> list[Crop]:
    """Boxes that do not overlap and hold all marked cells.

    Args:
        cells: see `no_cells`
        size: of the picture: width, height
        worth: pixels that a further box has to save

    Returns:
        x0, y0, x1, y1 in pixels, one past the last; at most `MOST_RECTANGLES`
    """
    least = worth / CELL**2
    found = _trim(cells, (0, 0, cells.shape[1], cells.shape[0]))
    whole = [found] if found else []
    while len(whole) < MOST_RECTANGLES:
        cuts = [(_cut(cells, box), i) for i, box in enumerate(whole)]
        (saved, parts), at = max(cuts, key=lambda cut: cut[0][0], default=((0, ()), 0))
        if not parts or saved < least:
            break
        whole[at : at + 1] = parts
    width, height = size
    return [(x0 * CELL, y0 * CELL, min(x1 * CELL, width), min(y1 * CELL, height)) for x0, y0, x1, y1 in whole]


def area(crops: list[Crop]) -> int:
    """Pixels in boxes that do not overlap."""
    return sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in crops)


def _cut(cells: NDArray[np.bool_], box: Crop) -> tuple[int, tuple[Crop, ...]]:
    """The straight cut through `box` that leaves most cells out, how many, and the two boxes it makes."""
    x0, y0, x1, y1 = box
    part = cells[y0:y1, x0:x1]
    best: tuple[int, tuple[Crop, ...]] = (0, ())
    for axis, offset in ((0, x0), (1, y0)):
        gaps = np.flatnonzero(~part.any(axis))  # never at an end, as boxes are trimmed
        # the ends of the runs of empty columns (rows): between them nothing can be gained
        for at in gaps[np.flatnonzero(np.diff(gaps, prepend=-2) > 1)] + offset:
            halves = (
                ((x0, y0, at, y1), (at, y0, x1, y1)) if axis == 0 else ((x0, y0, x1, at), (x0, at, x1, y1))
            )
            parts = tuple(half for half in (_trim(cells, half) for half in halves) if half)
            saved = area([box]) - area(list(parts))
            if saved > best[0]:
                best = saved, parts
    return best


def _trim(cells: NDArray[np.bool_], box: Crop) -> Crop | None:
    """The least box around the marked cells in `box`."""
    x0, y0, x1, y1 = (int(value) for value in box)
    part = cells[y0:y1, x0:x1]
    columns, rows = np.flatnonzero(part.any(0)), np.flatnonzero(part.any(1))
    if not len(columns):
        return None
    return (x0 + int(columns[0]), y0 + int(rows[0]), x0 + int(columns[-1]) + 1, y0 + int(rows[-1]) + 1)
