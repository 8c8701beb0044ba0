"""Kernel: blend the splats of each tile front to back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from progdf.rasterize.binning import TILE_H, TILE_W, row_bounds
from progdf.rasterize.conventions import ALPHA_MAX, TRANSMITTANCE_MIN
from progdf.rasterize.jit import kernel
from progdf.rasterize.pixels import LANES, PEAK, PLANE, ROW_NUMBERS, START, STOP, TOP, U_PEAK, exp2, find_rows
from progdf.rasterize.projection import L11

Array = NDArray[Any]

_CHECK_EVERY = 16  # splats between two looks at whether a tile's pixels are done
_ALPHA_MAX = np.float32(ALPHA_MAX)
_T_MIN = np.float32(TRANSMITTANCE_MIN)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
# planes of the state: transmittance (negative: the pixel is done), rgb, place in the tile's list of the last
# contributor (-1: none; float32 holds it exactly up to 2^24)
_G, _B, _LAST = PLANE * np.uint64(2), PLANE * np.uint64(3), PLANE * np.uint64(4)


@kernel(fast=True, inline=True)
def blend_row(
    state: Array, base: int, start: int, stop: int, peak: float, u_peak: float, l11: float, top: float,
    red: float, green: float, blue: float, place: float,
) -> None:  # fmt: skip
    """Blend one splat into columns start..stop of one row of a tile; alpha = 2^(top − u²). All floats float32."""
    if start >= stop:
        return
    begin = np.uint64(start) // LANES * LANES
    end = (np.uint64(stop) + LANES - np.uint64(1)) // LANES * LANES
    for j in range(begin, end):
        p = np.uint64(base) + j
        column = np.int32(j)
        u = u_peak + l11 * (np.float32(column) - peak)
        alpha = min(_ALPHA_MAX, exp2(top - u * u))
        alpha = alpha if (column >= start) & (column < stop) else _ZERO
        before = state[p]
        after = before * (_ONE - alpha)
        taken = after > _T_MIN
        weight = alpha * before if taken else _ZERO
        state[p] = after if taken else -abs(before)
        state[p + PLANE] += weight * red
        state[p + _G] += weight * green
        state[p + _B] += weight * blue
        state[p + _LAST] = place if weight > _ZERO else state[p + _LAST]


@kernel()
def blend_tile(
    state: Array, x: int, y: int, members: Array, splats: Array, rgb: Array, window: Array
) -> None:
    """Blend a tile whose first pixel is (x, y); state is [5·PLANE] float32, set up here."""
    plane = np.int64(PLANE)
    state[:plane] = _ONE
    state[plane : 4 * plane] = _ZERO
    state[4 * plane :] = -_ONE
    left, right = max(0, window[0] - x), min(TILE_W, window[2] - x)
    rows = np.empty(ROW_NUMBERS, np.float32)
    for place in range(members.size):
        if place % _CHECK_EVERY == _CHECK_EVERY - 1:
            highest = _ZERO
            for p in range(plane):
                highest = max(highest, state[p])
            if highest <= _ZERO:
                break
        s = members[place]
        splat = splats[s]
        first, end = row_bounds(splat, window)
        first, end = max(first - y, 0), min(end - y, TILE_H)
        find_rows(splat, x, y, left, right, rows)
        l11 = np.float32(splat[L11])
        red, green, blue = rgb[s, 0], rgb[s, 1], rgb[s, 2]
        for k in range(np.uint64(first), np.uint64(end)):
            blend_row(
                state, k * np.uint64(TILE_W), np.int32(rows[START + k]), np.int32(rows[STOP + k]), rows[PEAK + k], rows[U_PEAK + k], l11,
                rows[TOP + k], red, green, blue, np.float32(place),
            )  # fmt: skip


@kernel(parallel=True, cache=True)
def blend(
    splats: Array, rgb: Array, window: Array, grid: Array, tile_starts: Array, members: Array, background: Array,
    workers: int, image: Array, transmittance: Array, last: Array,
) -> None:  # fmt: skip
    """Blend all tiles.

    Args:
        splats, rgb: nearest first. [V,8] float64, [V,4] float32
        window: x0, y0, x1, y1 pixels. [4] int64
        grid: first tile column and row, and how many of each. [4] int64
        tile_starts, members: the tiles' lists, see `binning`
        background: [3] float32
        workers: in how many shares to work at once
        image: out, [h,w,3] float32
        transmittance: out, [h,w] float32
        last: out, place in the tile's list of each pixel's last contributor, -1 if none. [h,w] float32
    """
    tiles = tile_starts.size - 1
    plane = np.int64(PLANE)
    for worker in prange(workers):
        state = np.empty(5 * plane, np.float32)
        for tile in range(worker, tiles, workers):
            x, y = (grid[0] + tile % grid[2]) * TILE_W, (grid[1] + tile // grid[2]) * TILE_H
            blend_tile(state, x, y, members[tile_starts[tile] : tile_starts[tile + 1]], splats, rgb, window)
            for row in range(max(y, window[1]), min(y + TILE_H, window[3])):
                for column in range(max(x, window[0]), min(x + TILE_W, window[2])):
                    p = (row - y) * TILE_W + column - x
                    i, j = row - window[1], column - window[0]
                    left = abs(state[p])
                    transmittance[i, j] = left
                    last[i, j] = state[4 * plane + p]
                    image[i, j, 0] = state[plane + p] + left * background[0]
                    image[i, j, 1] = state[2 * plane + p] + left * background[1]
                    image[i, j, 2] = state[3 * plane + p] + left * background[2]
