"""Kernel: how much each splat contributes to a view, inside a mask and in all."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .binning import TILE_H, TILE_W
from .jit import Number, kernel
from .lanes import WIDTH, choose, count, load, spread, store, total
from .pixels import (  # fmt: skip
    BATCH,
    CARD,
    EIGHT,
    END,
    FIRST,
    LEAST,
    MOST,
    ONE,
    PLANE,
    STEP,
    exp2,
    make_cards,
    new_cards,
    row_of,
    tile_bounds,
)
from .shares import enter, leave, pieces

Array = NDArray[Any]

SUMS = 4
"""Numbers of one intersection: Σ w·m, Σ m, Σ w, n."""

_ZERO: Number = np.float32(0.0)
_ONE: Number = np.float32(1.0)


@kernel(fast=True, inline=True)
def add_weights(state: Array, cards: Array, card: Number, out: Array) -> None:
    """Blend one splat's transmittance into a tile and add its weights to `out`.

    Args:
        state: transmittance (negative: the pixel is done) and mask. [2·PLANE] float32
        cards, card: see `pixels`
        out: [4] float64
    """
    inside = within = weights = pixels = spread(_ZERO)
    step = cards[card + STEP]
    for line in range(np.int32(cards[card + FIRST]), np.int32(cards[card + END])):
        row = np.uint64(line)
        start, stop, p, u_peak, top = row_of(cards, card, row)
        offset = start + count()
        while start < stop:
            u = u_peak + step * offset
            reached = offset < stop
            alpha = choose(reached, exp2(top - u * u, cards), _ZERO)
            alpha = choose(alpha < cards[MOST], alpha, cards[MOST])
            before, mask = load(state, p), load(state, p + PLANE)
            after = before * (cards[ONE] - alpha)
            taken = reached & (after > cards[LEAST])
            weight = choose(taken, alpha * before, _ZERO)
            done = choose(before < _ZERO, before, _ZERO - before)
            store(state, p, choose(reached, choose(taken, after, done), before))
            inside += weight * mask
            within += choose(taken, mask, _ZERO)
            weights += weight
            pixels += choose(taken, _ONE, _ZERO)
            p += np.uint64(WIDTH)
            offset += cards[EIGHT]
            start += cards[EIGHT]
    out[0] += total(inside)
    out[1] += total(within)
    out[2] += total(weights)
    out[3] += total(pixels)


@kernel(cache=True, allocates=True)
def weigh(
    splats: Array, rgb: Array, window: Array, grid: Array, tile_starts: Array, members: Array, slots: Array,
    mask: Array, sums: Array, claims: Array,
) -> None:  # fmt: skip
    """Add up the weights of every (splat, tile) intersection; the first arguments as in `blend.blend`.

    Args:
        slots: row of `sums` that belongs to each entry of `members`. [I] int64
        mask: of the full image. [H,W] float32
        sums: out, zero on entry. [I,4] float64
        claims: as `shares.Team` gives them
    """
    tiles = tile_starts.size - 1
    state = np.empty(2 * np.int64(PLANE), np.float32)
    cards, bounds = new_cards(), np.empty(4, np.int64)
    seat = enter(claims)
    for tile in pieces(claims, 0, seat, tiles):
        x, y = (grid[0] + tile % grid[2]) * TILE_W, (grid[1] + tile // grid[2]) * TILE_H
        state[:] = _ONE
        tile_bounds(x, y, window, bounds)
        for row in range(bounds[1], bounds[3]):
            for column in range(bounds[0], bounds[2]):
                state[np.int64(PLANE) + row * TILE_W + column] = mask[y + row, x + column]
        for begin in range(tile_starts[tile], tile_starts[tile + 1], BATCH):
            end = min(begin + BATCH, tile_starts[tile + 1])
            make_cards(members, begin, end, splats, rgb, x, y, bounds, cards)
            for place in range(begin, end):
                card = np.uint64(place - begin) * CARD
                add_weights(state, cards, card, sums[slots[place]])
    leave(seat, claims)


@kernel(cache=True)
def gather(ids: Array, ranks: Array, per_splat: Array, sums: Array, totals: Array) -> None:
    """Add up each splat's intersections in their fixed order. totals: out, [N,4] float64, zero on entry"""
    for n in range(ids.size):
        for slot in range(per_splat[ranks[n]], per_splat[ranks[n] + 1]):
            for k in range(SUMS):
                totals[ids[n], k] += sums[slot, k]
