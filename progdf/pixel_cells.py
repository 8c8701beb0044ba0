"""Which part of a picture some Gaussians can touch, in cells of 8×8 pixels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.conventions import ALPHA_MIN, DILATION
from progdf.rasterize.geometry import dot, footprint, make_lens, vec
from progdf.rasterize.jit import kernel

from .camera import Camera

Array = NDArray[Any]

CELL = 8
"""Pixels of a cell's side; a cell spans whole rows of the rasteriser's tiles."""

_REACH2 = 1.001 * 2.0 * math.log(1.0 / ALPHA_MIN)  # 1.001: a rotation is one only within rounding
_MARGIN = 1.0  # px on each side: far more than rounding, far less than a cell


def no_cells(width: int, height: int) -> NDArray[np.bool_]:
    """No cell of a picture of this size marked. [⌈height/8⌉, ⌈width/8⌉]"""
    return np.zeros((-(-height // CELL), -(-width // CELL)), np.bool_)


def mark_cells(
    cells: NDArray[np.bool_],
    means: NDArray[np.float32],
    quats: NDArray[np.float32],
    scales: NDArray[np.float32],
    opacities: NDArray[np.float32],
    rows: NDArray[np.int64],
    camera: Camera,
    near: float = 0.01,
) -> None:
    """Mark every cell with a pixel that one of `rows` can have alpha ≥ 1/255 in, as `rasterize` draws them.

    Args:
        cells: from `no_cells`; marks are added
        means, quats, scales, opacities: activated. [N,3], [N,4], [N,3], [N]
        rows: which Gaussians. [M]
        camera: the view; antialiasing only makes what is touched smaller
        near: least camera z, world units
    """
    k = camera.K.double().numpy()
    intrinsics = np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2]])
    viewmat = np.ascontiguousarray(camera.viewmat.double().numpy())
    size = np.array([camera.width, camera.height], np.int64)
    _mark(cells, means, quats, scales, opacities, rows, viewmat, intrinsics, size, near)


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
def _all_marked(cells: Array, x0: int, y0: int, x1: int, y1: int) -> bool:
    for y in range(y0, y1):
        for x in range(x0, x1):
            if not cells[y, x]:
                return False
    return True


@kernel(contract=True, cache=True)
def _mark(
    cells: Array, means: Array, quats: Array, scales: Array, opacities: Array, rows: Array, viewmat: Array,
    intrinsics: Array, size: Array, near: float,
) -> None:  # fmt: skip
    lens = make_lens(viewmat, intrinsics, size)
    width, height = np.float64(size[0]), np.float64(size[1])
    for k in range(rows.size):
        i = rows[k]
        mean, scale, opacity = vec(means, i), vec(scales, i), np.float64(opacities[i])
        z = dot(lens.rows[2], mean) + lens.shift[2]
        total = abs(mean[0]) + abs(mean[1]) + abs(mean[2]) + abs(scale[0]) + abs(scale[1]) + abs(scale[2])
        if not (z > near and opacity >= ALPHA_MIN and total + opacity < np.inf):
            continue
        inv_z = 1.0 / z
        px = lens.fx * (dot(lens.rows[0], mean) + lens.shift[0]) * inv_z + lens.cx
        py = lens.fy * (dot(lens.rows[1], mean) + lens.shift[1]) * inv_z + lens.cy
        # first a bound that needs no covariance, as in `projection.cull`: most land where others did
        tan_x = min(max((px - lens.cx) / lens.fx, lens.low_x), lens.high_x)
        tan_y = min(max((py - lens.cy) / lens.fy, lens.low_y), lens.high_y)
        largest = max(abs(scale[0]), max(abs(scale[1]), abs(scale[2]))) * inv_z
        jx, jy = lens.fx * largest, lens.fy * largest
        reach2 = _REACH2 if opacity <= 1.0 else 1.001 * 2.0 * math.log(opacity / ALPHA_MIN)
        wide = math.sqrt(reach2 * (jx * jx * (1.0 + tan_x * tan_x) + DILATION))
        high = math.sqrt(reach2 * (jy * jy * (1.0 + tan_y * tan_y) + DILATION))
        x0, y0, x1, y1 = _cells_of(px, py, wide, high, width, height)
        if _all_marked(cells, x0, y0, x1, y1):
            continue
        seen = footprint(
            lens, mean, np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]),
            np.float64(quats[i, 3]), scale,
        )  # fmt: skip
        reach2 = 2.0 * math.log(opacity / ALPHA_MIN)
        wide = math.sqrt(max(0.0, reach2 * (seen.a + DILATION)))
        high = math.sqrt(max(0.0, reach2 * (seen.c + DILATION)))
        x0, y0, x1, y1 = _cells_of(px, py, wide, high, width, height)
        for y in range(y0, y1):
            for x in range(x0, x1):
                cells[y, x] = True
