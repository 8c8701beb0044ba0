"""What the pixel kernels share: exp2, the layout of a tile's state, the spans of pixels that splats cover."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.conventions import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

from .bin import TILE_H, TILE_W
from .jit import Number, kernel
from .project import EXTENT_Y, INV_L11, L11, L22, MX, MY, R2, SLOPE, Pinhole, Splats
from .simd import WIDTH, Vector, ldexp, prefetch, truncate

Array = NDArray[Any]

PLANE = np.uint64(TILE_W * TILE_H + WIDTH)
"""A tile's state is planes of this many float32 in one buffer. Pixels are worked on in groups of eight, from
the first of a row that a splat covers; the surplus is masked, and in a tile's last row it is the padding of
the plane."""

LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)

# 2^x on [-1, 0], exact at 0, largest relative error 2.0e-9 before rounding (fitted by reweighted least
# squares)
_POLYNOMIAL = (
    0.6931470643273044, 0.240224367820186, 0.05549075707783424, 0.009579179674631904, 0.0012747482964304813,
    0.00010902322854050052,
)  # fmt: skip

BATCH = 32
"""Splats whose spans are found at once: the pixel loops then branch on numbers that are long known."""

BEGIN, START, STOP, U_PEAK, V, TOP = (np.uint64(TILE_H * field) for field in range(6))
"""Fields of a splat's spans, one number a row of the tile: first column from the tile's left edge; that and
one past the last, from the column nearest to the row's peak (none where the second is not the greater); u at
that column, so that u = u_peak + l11 · (column − peak); v; log2 of alpha where u is 0."""

FIRST, END, STEP, RED, GREEN, BLUE = (np.uint64(6 * TILE_H + k) for k in range(6))
"""Then one number each: first row and one past the last, from the tile's top; l11; color."""

SPLAT = np.uint64(64)
"""float32 numbers from one splat's spans to the next one's."""

MOST: Number = np.float32(ALPHA_MAX)
LEAST: Number = np.float32(TRANSMITTANCE_MIN)
ONE: Number = np.float32(1.0)
EIGHT: Number = np.float32(WIDTH)
_E1, _E2, _E3, _E4, _E5, _E6 = (np.float32(factor) for factor in _POLYNOMIAL)


class TileScratch(NamedTuple):
    """What a thread works in, tile by tile.

    Args:
        state: planes of pixels; what each holds is the kernel's. float32
        batch: spans of a batch. float32
        bounds: left, top, right, bottom of what is drawn of a tile, from its first pixel. [4] int64
    """

    state: Array
    batch: Array
    bounds: Array


def new_scratch() -> TileScratch:
    """Room for six planes and a batch."""
    batch = np.empty(BATCH * int(SPLAT), np.float32)
    return TileScratch(np.empty(6 * int(PLANE), np.float32), batch, np.empty(4, np.int64))


@kernel(fast=True, inline=True)
def exp2(x: Vector) -> Vector:
    """2^x for -126 ≤ x ≤ 0; anything for other lanes."""
    n = truncate(x)
    f = x - n
    p = _E4 + f * (_E5 + f * _E6)
    p = ONE + f * (_E1 + f * (_E2 + f * (_E3 + f * p)))
    return ldexp(p, n)


@kernel(inline=True)
def tile_corner(camera: Pinhole, tile: int) -> tuple[int, int]:
    """A tile's first pixel in the full image."""
    x = (camera.grid[0] + tile % camera.grid[2]) * TILE_W
    return x, (camera.grid[1] + tile // camera.grid[2]) * TILE_H


@kernel(inline=True)
def tile_bounds(camera: Pinhole, x: int, y: int, bounds: Array) -> None:
    """left, top, right, bottom of a tile's part in the window, from the tile's first pixel (x, y)."""
    bounds[0], bounds[1] = max(0, camera.window[0] - x), max(0, camera.window[1] - y)
    bounds[2], bounds[3] = min(TILE_W, camera.window[2] - x), min(TILE_H, camera.window[3] - y)


@kernel(fast=True, inline=True)
def find_spans(
    members: Array, begin: Number, end: Number, splats: Splats, x: int, y: int, bounds: Array, batch: Array
) -> None:
    """Where some splats of a tile are at least 1/255, row by row, decided in float64.

    Args:
        members: rows of the tile's splats. [I] int32
        begin, end: which of them, at most BATCH
        splats: see `project`
        x, y: the tile's first pixel in the full image
        bounds: left, top, right, bottom of what to look at, from (x, y). [4] int64
        batch: out
    """
    low, high = np.float64(bounds[0]), np.float64(bounds[2])
    shapes, colors = splats.shapes, splats.colors
    for place in range(begin, end):
        prefetch(shapes, members[place])
        prefetch(colors, members[place])
    for place in range(begin, end):
        at = np.uint64(place - begin) * SPLAT
        s = members[place]
        mx, my = shapes[s, MX] - x - 0.5, shapes[s, MY] - y - 0.5
        slope, l11 = shapes[s, SLOPE], shapes[s, L11]
        inv_l11, l22, r2 = shapes[s, INV_L11], shapes[s, L22], shapes[s, R2]
        for row in range(np.uint64(TILE_H)):
            dy = np.float64(np.int32(row)) - my
            v = l22 * dy
            rest = r2 - v * v
            center = mx - slope * dy
            half = np.sqrt(max(rest, 0.0)) * inv_l11
            start = max(np.ceil(center - half), low)
            stop = min(np.floor(center + half) + 1.0, high)
            # counting from the peak keeps u = l11·(column − center) free of cancellation in float32; far
            # peaks (needles, giants) lie where l11 is small
            peak = min(max(np.floor(center + 0.5), -65536.0), 65536.0)
            start, stop = min(start, high), max(stop, low) if rest >= 0.0 else low
            batch[at + BEGIN + row] = start
            batch[at + START + row] = start - peak
            batch[at + STOP + row] = stop - peak
            batch[at + U_PEAK + row] = l11 * (peak - center)
            batch[at + V + row] = v
            batch[at + TOP + row] = rest + LOG2_ALPHA_MIN
        batch[at + FIRST] = max(np.ceil(my - shapes[s, EXTENT_Y]), np.float64(bounds[1]))
        batch[at + END] = min(np.floor(my + shapes[s, EXTENT_Y]) + 1.0, np.float64(bounds[3]))
        batch[at + STEP] = l11
        batch[at + RED], batch[at + GREEN], batch[at + BLUE] = colors[s, 0], colors[s, 1], colors[s, 2]


@kernel(fast=True, inline=True)
def row_span(batch: Array, splat: Number, row: Number) -> tuple[Number, Number, Number, Number, Number]:
    """Where a row of a splat begins and ends, from its peak; its place in a tile's plane; u_peak and top."""
    begin = np.uint64(np.int32(batch[splat + BEGIN + row]))
    return (
        batch[splat + START + row], batch[splat + STOP + row], row * np.uint64(TILE_W) + begin,
        batch[splat + U_PEAK + row], batch[splat + TOP + row],
    )  # fmt: skip


@kernel(fast=True, inline=True)
def step_and_color(batch: Array, splat: Number) -> tuple[Number, Number, Number, Number]:
    """l11; red, green, blue."""
    return batch[splat + STEP], batch[splat + RED], batch[splat + GREEN], batch[splat + BLUE]
