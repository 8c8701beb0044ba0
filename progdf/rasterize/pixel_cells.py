"""Which part of a picture some Gaussians can touch, in cells of 8×8 pixels."""

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
from .engines import ActivatedGaussians, RasterView

Array = NDArray[Any]

CELL = 8
"""Pixels of a cell's side; a cell spans whole rows of the rasterizer's tiles."""

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
