"""Kernel: blend the splats of each tile front to back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .binning import TILE_H, TILE_W
from .conventions import ALPHA_MAX, TRANSMITTANCE_MIN
from .jit import Number, kernel
from .lanes import WIDTH, choose, count, load, store
from .pixels import (  # fmt: skip
    BATCH,
    BLUE,
    CARD,
    EIGHT,
    END,
    FIRST,
    GREEN,
    LEAST,
    MOST,
    ONE,
    PLANE,
    RED,
    STEP,
    exp2,
    make_cards,
    new_cards,
    row_of,
    tile_bounds,
)
from .shares import pieces

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
    start, stop, p, u_peak, top = row_of(cards, card, row)
    step = cards[card + STEP]
    red, green, blue = cards[card + RED], cards[card + GREEN], cards[card + BLUE]
    offset = start + count()
    while start < stop:
        u = u_peak + step * offset
        alpha = exp2(top - u * u, cards)
        alpha = choose(alpha < cards[MOST], alpha, cards[MOST])
        alpha = choose(offset < stop, alpha, _ZERO)
        before = load(state, p)
        after = before * (cards[ONE] - alpha)
        taken = after > cards[LEAST]
        weight = choose(taken, alpha * before, _ZERO)
        store(state, p, choose(taken, after, choose(before < _ZERO, before, _ZERO - before)))
        store(state, p + PLANE, load(state, p + PLANE) + weight * red)
        store(state, p + _G, load(state, p + _G) + weight * green)
        store(state, p + _B, load(state, p + _B) + weight * blue)
        store(state, p + _LAST, choose(weight > _ZERO, place, load(state, p + _LAST)))
        p += np.uint64(WIDTH)
        offset += cards[EIGHT]
        start += cards[EIGHT]


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
            for line in range(np.int32(cards[card + FIRST]), np.int32(cards[card + END])):
                blend_row(state, cards, card, np.uint64(line), np.float32(place))
        if not _shrink(state, bounds):
            break


@kernel(allocates=True)
def blend(
    splats: Array, rgb: Array, window: Array, grid: Array, tile_starts: Array, members: Array,
    background: Array, image: Array, transmittance: Array, last: Array, seat: int,
    claims: Array, step: int,
) -> None:  # fmt: skip
    """Blend all tiles.

    Args:
        splats, rgb: nearest first. [V,8] float64, [V,4] float32
        window: x0, y0, x1, y1 pixels. [4] int64
        grid: first tile column and row, and how many of each. [4] int64
        tile_starts, members: the tiles' lists, see `binning`
        background: [3] float32
        image: out, [h,w,3] float32
        transmittance: out, [h,w] float32
        last: out, place in the tile's list of each pixel's last contributor, -1 if none. [h,w] float32
        seat, claims, step: see `shares.pieces`
    """
    tiles = tile_starts.size - 1
    plane = np.int64(PLANE)
    state, cards = np.empty(5 * plane, np.float32), new_cards()
    bounds = np.empty(4, np.int64)
    for tile in pieces(claims, step, seat, tiles):
        x, y = (grid[0] + tile % grid[2]) * TILE_W, (grid[1] + tile // grid[2]) * TILE_H
        tile_bounds(x, y, window, bounds)
        listed = members[tile_starts[tile] : tile_starts[tile + 1]]
        blend_tile(state, x, y, listed, splats, rgb, bounds, cards)
        tile_bounds(x, y, window, bounds)  # blending shrank it
        left, width = np.uint64(x + bounds[0] - window[0]), np.uint64(bounds[2] - bounds[0])
        for row in range(np.uint64(bounds[1]), np.uint64(bounds[3])):
            i = np.uint64(y - window[1]) + row
            p = row * np.uint64(TILE_W) + np.uint64(bounds[0])
            for k in range(width):
                transmittance[i, left + k] = abs(state[p + k])
            for k in range(width):
                last[i, left + k] = state[p + _LAST + k]
            for k in range(width):
                through = abs(state[p + k])
                image[i, left + k, 0] = state[p + PLANE + k] + through * background[0]
                image[i, left + k, 1] = state[p + _G + k] + through * background[1]
                image[i, left + k, 2] = state[p + _B + k] + through * background[2]
