"""Kernel: gradients of the blending, back to front, into one row per (splat, tile) intersection.

Each row holds nine sums over the tile's pixels: the colour's gradient (3), and for g = alpha · dL/dalpha the
moments Σg, Σg·u, Σg·v, Σg·u², Σg·uv, Σg·v². In the whitened coordinates u, v they stay of the size of the
result however thin the Gaussian is; in pixels they would cancel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from progdf.rasterize.binning import TILE_H, TILE_W
from progdf.rasterize.conventions import ALPHA_MAX
from progdf.rasterize.jit import Number, kernel
from progdf.rasterize.pixels import (
    BATCH,
    BLUE,
    CARD,
    END,
    FIRST,
    GREEN,
    LANES,
    PEAK,
    PLANE,
    RED,
    START,
    STEP,
    STOP,
    TOP,
    U_PEAK,
    V,
    exp2,
    make_cards,
    tile_bounds,
)  # fmt: skip

Array = NDArray[Any]

SUMS = 9
"""Numbers of one intersection's row."""

_ALPHA_MAX: Number = np.float32(ALPHA_MAX)
_ZERO: Number = np.float32(0.0)
_ONE: Number = np.float32(1.0)
# planes of the state: transmittance after the splat at hand; what lies behind it, times the gradient; the
# image's gradient (3); place of the last contributor
_BEHIND, _G0, _G1 = PLANE, PLANE * np.uint64(2), PLANE * np.uint64(3)
_G2, _LAST = PLANE * np.uint64(4), PLANE * np.uint64(5)


@kernel(fast=True, inline=True)
def unblend_row(state: Array, cards: Array, card: Number, row: Number, place: Number) -> tuple[Number, ...]:
    """Take one row of a splat off a tile's state; as `blend_row`. Returns Σ colour (3), Σg, Σg·u, Σg·u²."""
    start, stop = np.int32(cards[card + START + row]), np.int32(cards[card + STOP + row])
    sum_r = sum_g = sum_b = sum_0 = sum_u = sum_uu = _ZERO
    peak, u_peak, step = cards[card + PEAK + row], cards[card + U_PEAK + row], cards[card + STEP]
    top = cards[card + TOP + row]
    red, green, blue = cards[card + RED], cards[card + GREEN], cards[card + BLUE]
    begin = np.uint64(start)
    end = begin + (np.uint64(stop - start) + LANES - np.uint64(1)) // LANES * LANES if start < stop else begin
    for j in range(begin, end):
        p = row * np.uint64(TILE_W) + j
        column = np.int32(j)
        u = u_peak + step * (np.float32(column) - peak)
        raw = exp2(top - u * u)
        alpha = min(_ALPHA_MAX, raw)
        alpha = alpha if (column < stop) & (place <= state[p + _LAST]) else _ZERO
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


@kernel(fast=True, inline=True)
def pass_row(state: Array, cards: Array, card: Number, row: Number, place: Number) -> None:
    """As `unblend_row` for a splat whose own gradient nobody wants."""
    start, stop = np.int32(cards[card + START + row]), np.int32(cards[card + STOP + row])
    peak, u_peak, step = cards[card + PEAK + row], cards[card + U_PEAK + row], cards[card + STEP]
    top = cards[card + TOP + row]
    red, green, blue = cards[card + RED], cards[card + GREEN], cards[card + BLUE]
    begin = np.uint64(start)
    end = begin + (np.uint64(stop - start) + LANES - np.uint64(1)) // LANES * LANES if start < stop else begin
    for j in range(begin, end):
        p = row * np.uint64(TILE_W) + j
        column = np.int32(j)
        u = u_peak + step * (np.float32(column) - peak)
        alpha = min(_ALPHA_MAX, exp2(top - u * u))
        alpha = alpha if (column < stop) & (place <= state[p + _LAST]) else _ZERO
        before = state[p] / (_ONE - alpha)
        shown = red * state[p + _G0] + green * state[p + _G1] + blue * state[p + _G2]
        state[p] = before
        state[p + _BEHIND] += alpha * before * shown


@kernel(fast=True)
def unblend_tile(
    state: Array, x: int, y: int, members: Array, slots: Array, splats: Array, rgb: Array, bounds: Array,
    cards: Array, sums: Array, wanted: Array,
) -> None:  # fmt: skip
    """Take the splats off a tile, last contributor first; state is [6·PLANE], the rest as in `make_cards`."""
    plane = np.int64(PLANE)
    deepest: Number = -_ONE
    for p in range(5 * plane, 6 * plane):
        deepest = max(deepest, state[p])
    seen: Number = np.int64(deepest) + 1
    for place in range(seen, members.size):
        for k in range(SUMS):
            sums[slots[place], k] = _ZERO
    for batch in range((seen + BATCH - 1) // BATCH - 1, -1, -1):
        begin: Number = batch * BATCH
        end: Number = min(begin + BATCH, seen)
        make_cards(members, begin, end, splats, rgb, x, y, bounds, cards)
        for place in range(end - 1, begin - 1, -1):
            card = np.uint64(place - begin) * CARD
            if not wanted[members[place]]:
                for row in range(np.uint64(cards[card + FIRST]), np.uint64(max(_ZERO, cards[card + END]))):
                    pass_row(state, cards, card, row, np.float32(place))
                continue
            s_r = s_g = s_b = s_0 = s_u = s_v = s_uu = s_uv = s_vv = _ZERO
            for row in range(np.uint64(cards[card + FIRST]), np.uint64(max(_ZERO, cards[card + END]))):
                r, g, b, g_0, g_u, g_uu = unblend_row(state, cards, card, row, np.float32(place))
                v = cards[card + V + row]
                s_r += r
                s_g += g
                s_b += b
                s_0 += g_0
                s_u += g_u
                s_v += g_0 * v
                s_uu += g_uu
                s_uv += g_u * v
                s_vv += g_0 * v * v
            slot = slots[place]
            sums[slot, 0], sums[slot, 1], sums[slot, 2] = s_r, s_g, s_b
            sums[slot, 3], sums[slot, 4], sums[slot, 5] = s_0, s_u, s_v
            sums[slot, 6], sums[slot, 7], sums[slot, 8] = s_uu, s_uv, s_vv


@kernel(parallel=True, cache=True)
def unblend(
    splats: Array, rgb: Array, window: Array, grid: Array, tile_starts: Array, members: Array, slots: Array,
    background: Array, workers: int, transmittance: Array, last: Array, grad_image: Array,
    grad_transmittance: Array, sums: Array, wanted: Array,
) -> None:  # fmt: skip
    """Gradients of `blend`, which has the same arguments.

    Args:
        slots: row of `sums` that belongs to each entry of `members`. [I] int64
        grad_image, grad_transmittance: [h,w,3], [h,w] float32
        sums: out, one row per intersection; not set where nobody wants it. [I,9] float32
        wanted: splats whose gradients are wanted. [V] bool
    """
    tiles = tile_starts.size - 1
    plane = np.int64(PLANE)
    for worker in prange(workers):
        state, cards = np.empty(6 * plane, np.float32), np.empty(BATCH * np.int64(CARD), np.float32)
        bounds = np.empty(4, np.int64)
        for tile in range(worker, tiles, workers):
            x, y = (grid[0] + tile % grid[2]) * TILE_W, (grid[1] + tile // grid[2]) * TILE_H
            state[:plane] = _ONE
            state[plane : 5 * plane] = _ZERO
            state[5 * plane :] = -_ONE
            tile_bounds(x, y, window, bounds)
            for row in range(y + bounds[1], y + bounds[3]):
                for column in range(x + bounds[0], x + bounds[2]):
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
            unblend_tile(
                state, x, y, members[listed], slots[listed], splats, rgb, bounds, cards, sums, wanted
            )
