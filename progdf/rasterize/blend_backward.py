"""Kernel: gradients of the blending, back to front, into one row per (splat, tile) intersection.

Each row holds nine sums over the tile's pixels: the colour's gradient (3), and for g = alpha · dL/dalpha the moments
Σg, Σg·u, Σg·v, Σg·u², Σg·uv, Σg·v². In the whitened coordinates u, v they stay of the size of the result however thin
the Gaussian is; in pixels they would cancel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from progdf.rasterize.binning import TILE_H, TILE_W, row_bounds
from progdf.rasterize.conventions import ALPHA_MAX
from progdf.rasterize.jit import kernel
from progdf.rasterize.pixels import LANES, PEAK, PLANE, ROW_NUMBERS, START, STOP, TOP, U_PEAK, V, exp2, find_rows
from progdf.rasterize.projection import L11

Array = NDArray[Any]

SUMS = 9
"""Numbers of one intersection's row."""

_ALPHA_MAX = np.float32(ALPHA_MAX)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
# planes of the state: transmittance after the splat at hand; what lies behind it, times the gradient; the image's
# gradient (3); place of the last contributor
_BEHIND, _G0, _G1 = PLANE, PLANE * np.uint64(2), PLANE * np.uint64(3)
_G2, _LAST = PLANE * np.uint64(4), PLANE * np.uint64(5)


@kernel(fast=True, inline=True)
def unblend_row(
    state: Array, base: int, start: int, stop: int, peak: float, u_peak: float, l11: float, top: float,
    red: float, green: float, blue: float, place: float,
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    """Take one splat off columns start..stop of one row; arguments as in `blend_row`. Σ colour (3), Σg, Σgu, Σgu²"""
    sum_r = sum_g = sum_b = sum_0 = sum_u = sum_uu = _ZERO
    if start >= stop:
        return sum_r, sum_g, sum_b, sum_0, sum_u, sum_uu
    begin = np.uint64(start) // LANES * LANES
    end = (np.uint64(stop) + LANES - np.uint64(1)) // LANES * LANES
    for j in range(begin, end):
        p = np.uint64(base) + j
        column = np.int32(j)
        u = u_peak + l11 * (np.float32(column) - peak)
        raw = exp2(top - u * u)
        alpha = min(_ALPHA_MAX, raw)
        alpha = alpha if (column >= start) & (column < stop) & (place <= state[p + _LAST]) else _ZERO
        inverse = _ONE / (_ONE - alpha)
        before = state[p] * inverse
        g0, g1, g2 = state[p + _G0], state[p + _G1], state[p + _G2]
        shown = red * g0 + green * g1 + blue * g2
        behind = state[p + _BEHIND]
        weight = alpha * before
        g = alpha * (before * shown - behind * inverse)
        g = g if raw <= _ALPHA_MAX else _ZERO
        state[p] = before
        state[p + _BEHIND] = behind + weight * shown
        sum_r += weight * g0
        sum_g += weight * g1
        sum_b += weight * g2
        sum_0 += g
        sum_u += g * u
        sum_uu += g * u * u
    return sum_r, sum_g, sum_b, sum_0, sum_u, sum_uu


@kernel()
def unblend_tile(
    state: Array,
    x: int,
    y: int,
    members: Array,
    slots: Array,
    splats: Array,
    rgb: Array,
    window: Array,
    sums: Array,
) -> None:
    """Take the splats off a tile whose first pixel is (x, y), from its last contributor on. state: [6·PLANE]"""
    plane = np.int64(PLANE)
    deepest = -_ONE
    for p in range(5 * plane, 6 * plane):
        deepest = max(deepest, state[p])
    left, right = max(0, window[0] - x), min(TILE_W, window[2] - x)
    rows = np.empty(ROW_NUMBERS, np.float32)
    for place in range(members.size - 1, -1, -1):
        out = sums[slots[place]]
        out[:] = _ZERO
        if place > deepest:
            continue
        s = members[place]
        splat = splats[s]
        first, end = row_bounds(splat, window)
        first, end = max(first - y, 0), min(end - y, TILE_H)
        find_rows(splat, x, y, left, right, rows)
        l11 = np.float32(splat[L11])
        red, green, blue = rgb[s, 0], rgb[s, 1], rgb[s, 2]
        for k in range(np.uint64(first), np.uint64(end)):
            r, g, b, g_0, g_u, g_uu = unblend_row(
                state, k * np.uint64(TILE_W), np.int32(rows[START + k]), np.int32(rows[STOP + k]), rows[PEAK + k], rows[U_PEAK + k], l11,
                rows[TOP + k], red, green, blue, np.float32(place),
            )  # fmt: skip
            v = rows[V + k]
            out[0] += r
            out[1] += g
            out[2] += b
            out[3] += g_0
            out[4] += g_u
            out[5] += g_0 * v
            out[6] += g_uu
            out[7] += g_u * v
            out[8] += g_0 * v * v


@kernel(parallel=True, cache=True)
def unblend(
    splats: Array, rgb: Array, window: Array, grid: Array, tile_starts: Array, members: Array, slots: Array,
    background: Array, workers: int, transmittance: Array, last: Array, grad_image: Array, grad_transmittance: Array,
    sums: Array,
) -> None:  # fmt: skip
    """Gradients of `blend`, which has the same arguments.

    Args:
        slots: row of `sums` that belongs to each entry of `members`. [I] int64
        grad_image, grad_transmittance: [h,w,3], [h,w] float32
        sums: out, one row per intersection. [I,9] float32
    """
    tiles = tile_starts.size - 1
    plane = np.int64(PLANE)
    for worker in prange(workers):
        state = np.empty(6 * plane, np.float32)
        for tile in range(worker, tiles, workers):
            x, y = (grid[0] + tile % grid[2]) * TILE_W, (grid[1] + tile // grid[2]) * TILE_H
            state[:plane] = _ONE
            state[plane : 5 * plane] = _ZERO
            state[5 * plane :] = -_ONE
            for row in range(max(y, window[1]), min(y + TILE_H, window[3])):
                for column in range(max(x, window[0]), min(x + TILE_W, window[2])):
                    p = (row - y) * TILE_W + column - x
                    i, j = row - window[1], column - window[0]
                    g0, g1, g2 = grad_image[i, j, 0], grad_image[i, j, 1], grad_image[i, j, 2]
                    seen = (
                        g0 * background[0]
                        + g1 * background[1]
                        + g2 * background[2]
                        + grad_transmittance[i, j]
                    )
                    state[p] = transmittance[i, j]
                    state[plane + p] = transmittance[i, j] * seen
                    state[2 * plane + p], state[3 * plane + p], state[4 * plane + p] = g0, g1, g2
                    state[5 * plane + p] = last[i, j]
            listed = slice(tile_starts[tile], tile_starts[tile + 1])
            unblend_tile(state, x, y, members[listed], slots[listed], splats, rgb, window, sums)
