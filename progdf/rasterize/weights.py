"""Kernel: how much each splat contributes to a view, inside a mask and in all."""

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
    CARD,
    END,
    FIRST,
    PEAK,
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

SUMS = 4
"""Numbers of one intersection: Σ w·m, Σ m, Σ w, n."""

_ALPHA_MAX: Number = np.float32(ALPHA_MAX)
_T_MIN: Number = np.float32(TRANSMITTANCE_MIN)
_ZERO: Number = np.float32(0.0)
_ONE: Number = np.float32(1.0)


@kernel()
def add_weights(state: Array, cards: Array, card: Number, mask: Array, out: Array) -> None:
    """Blend one splat's transmittance into a tile and add its weights to `out`; mask begins at the tile."""
    for row in range(np.uint64(cards[card + FIRST]), np.uint64(max(_ZERO, cards[card + END]))):
        peak, u_peak, top = cards[card + PEAK + row], cards[card + U_PEAK + row], cards[card + TOP + row]
        for j in range(np.uint64(cards[card + START + row]), np.uint64(cards[card + STOP + row])):
            p = row * np.uint64(TILE_W) + j
            u = u_peak + cards[card + STEP] * (np.float32(np.int32(j)) - peak)
            alpha = min(_ALPHA_MAX, exp2(top - u * u))
            before = state[p]
            after = before * (_ONE - alpha)
            if after > _T_MIN:
                weight = alpha * before
                m = mask[row, j]
                state[p] = after
                out[0] += weight * m
                out[1] += m
                out[2] += weight
                out[3] += 1.0
            else:
                state[p] = -abs(before)


@kernel(parallel=True, cache=True)
def weigh(
    splats: Array, rgb: Array, window: Array, grid: Array, tile_starts: Array, members: Array, slots: Array,
    mask: Array, workers: int, sums: Array,
) -> None:  # fmt: skip
    """Add up the weights of every (splat, tile) intersection; the first arguments as in `blend.blend`.

    Args:
        slots: row of `sums` that belongs to each entry of `members`. [I] int64
        mask: of the full image. [H,W] float32
        sums: out, zero on entry. [I,4] float64
    """
    tiles = tile_starts.size - 1
    for worker in prange(workers):
        state = np.empty(TILE_H * TILE_W, np.float32)
        cards, bounds = np.empty(BATCH * np.int64(CARD), np.float32), np.empty(4, np.int64)
        for tile in range(worker, tiles, workers):
            x, y = (grid[0] + tile % grid[2]) * TILE_W, (grid[1] + tile // grid[2]) * TILE_H
            state[:] = _ONE
            tile_bounds(x, y, window, bounds)
            for begin in range(tile_starts[tile], tile_starts[tile + 1], BATCH):
                end = min(begin + BATCH, tile_starts[tile + 1])
                make_cards(members, begin, end, splats, rgb, x, y, bounds, cards)
                for place in range(begin, end):
                    card = np.uint64(place - begin) * CARD
                    add_weights(state, cards, card, mask[y:, x:], sums[slots[place]])


@kernel(parallel=True, cache=True)
def gather(ids: Array, ranks: Array, per_splat: Array, sums: Array, totals: Array) -> None:
    """Add up each splat's intersections in their fixed order. totals: out, [N,4] float64, zero on entry"""
    for n in prange(ids.size):
        for slot in range(per_splat[ranks[n]], per_splat[ranks[n] + 1]):
            for k in range(SUMS):
                totals[ids[n], k] += sums[slot, k]
