"""Kernel: blend the splats of each tile front to back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from progdf.rasterize.binning import TILE_H, TILE_W
from progdf.rasterize.conventions import ALPHA_MAX, TRANSMITTANCE_MIN
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
    exp2,
    make_cards,
    tile_bounds,
)  # fmt: skip

Array = NDArray[Any]

_ALPHA_MAX: Number = np.float32(ALPHA_MAX)
_T_MIN: Number = np.float32(TRANSMITTANCE_MIN)
_ZERO: Number = np.float32(0.0)
_ONE: Number = np.float32(1.0)
# planes of the state: transmittance (negative: the pixel is done), rgb, place in the tile's list of the last
# contributor (-1: none; float32 holds it exactly up to 2^24)
_G, _B, _LAST = PLANE * np.uint64(2), PLANE * np.uint64(3), PLANE * np.uint64(4)


@kernel(fast=True, inline=True)
def blend_row(state: Array, cards: Array, card: Number, row: Number, place: Number) -> None:
    """Blend one row of a splat into a tile's state; `card` is where its card begins, see `pixels`."""
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
        alpha = alpha if (column < stop) else _ZERO
        before = state[p]
        after = before * (_ONE - alpha)
        taken = after > _T_MIN
        weight = alpha * before if taken else _ZERO
        state[p] = after if taken else -abs(before)
        state[p + PLANE] += weight * red
        state[p + _G] += weight * green
        state[p + _B] += weight * blue
        state[p + _LAST] = place if weight > _ZERO else state[p + _LAST]


@kernel(fast=True, inline=True)
def _shrink(state: Array, bounds: Array) -> Number:
    """Leave rows whose pixels are all done out of `bounds`, from above and below; whether any row is left."""
    while bounds[1] < bounds[3] and _is_done(state, bounds[1], bounds):
        bounds[1] += 1
    while bounds[1] < bounds[3] and _is_done(state, bounds[3] - 1, bounds):
        bounds[3] -= 1
    return bounds[1] < bounds[3]


@kernel(fast=True, inline=True)
def _is_done(state: Array, row: int, bounds: Array) -> Number:
    highest = _ZERO
    for j in range(np.uint64(bounds[0]), np.uint64(bounds[2])):
        highest = max(highest, state[np.uint64(row) * np.uint64(TILE_W) + j])
    return highest <= _ZERO


@kernel(fast=True)
def blend_tile(
    state: Array, x: int, y: int, members: Array, splats: Array, rgb: Array, bounds: Array, cards: Array
) -> None:
    """Blend a tile; state is [5·PLANE] float32, set up here, the rest as in `make_cards`."""
    plane = np.int64(PLANE)
    state[:plane] = _ONE
    state[plane : 4 * plane] = _ZERO
    state[4 * plane :] = -_ONE
    for begin in range(0, members.size, BATCH):
        end = min(begin + BATCH, members.size)
        make_cards(members, begin, end, splats, rgb, x, y, bounds, cards)
        for place in range(begin, end):
            card = np.uint64(place - begin) * CARD
            for row in range(np.uint64(cards[card + FIRST]), np.uint64(max(_ZERO, cards[card + END]))):
                blend_row(state, cards, card, row, np.float32(place))
        if not _shrink(state, bounds):
            break


@kernel(parallel=True, cache=True)
def blend(
    splats: Array, rgb: Array, window: Array, grid: Array, tile_starts: Array, members: Array,
    background: Array, workers: int, image: Array, transmittance: Array, last: Array,
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
        state, cards = np.empty(5 * plane, np.float32), np.empty(BATCH * np.int64(CARD), np.float32)
        bounds = np.empty(4, np.int64)
        for tile in range(worker, tiles, workers):
            x, y = (grid[0] + tile % grid[2]) * TILE_W, (grid[1] + tile // grid[2]) * TILE_H
            tile_bounds(x, y, window, bounds)
            listed = members[tile_starts[tile] : tile_starts[tile + 1]]
            blend_tile(state, x, y, listed, splats, rgb, bounds, cards)
            tile_bounds(x, y, window, bounds)  # blending shrank it
            for row in range(y + bounds[1], y + bounds[3]):
                for column in range(x + bounds[0], x + bounds[2]):
                    p = (row - y) * TILE_W + column - x
                    i, j = row - window[1], column - window[0]
                    left = abs(state[p])
                    transmittance[i, j] = left
                    last[i, j] = state[4 * plane + p]
                    image[i, j, 0] = state[plane + p] + left * background[0]
                    image[i, j, 1] = state[2 * plane + p] + left * background[1]
                    image[i, j, 2] = state[3 * plane + p] + left * background[2]
