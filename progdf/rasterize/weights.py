"""Kernel: how much each splat contributes to a view, inside a mask and in all."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from progdf.rasterize.binning import TILE_H, TILE_W, row_bounds
from progdf.rasterize.conventions import ALPHA_MAX, TRANSMITTANCE_MIN
from progdf.rasterize.jit import kernel
from progdf.rasterize.pixels import PEAK, ROW_NUMBERS, START, STOP, TOP, U_PEAK, exp2, find_rows
from progdf.rasterize.projection import L11

Array = NDArray[Any]

SUMS = 4
"""Numbers of one intersection: Σ w·m, Σ m, Σ w, n."""

_ALPHA_MAX = np.float32(ALPHA_MAX)
_T_MIN = np.float32(TRANSMITTANCE_MIN)
_ONE = np.float32(1.0)


@kernel(parallel=True, cache=True)
def weigh(
    splats: Array, window: Array, grid: Array, tile_starts: Array, members: Array, slots: Array, mask: Array,
    workers: int, sums: Array,
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
        rows = np.empty(ROW_NUMBERS, np.float32)
        for tile in range(worker, tiles, workers):
            x, y = (grid[0] + tile % grid[2]) * TILE_W, (grid[1] + tile // grid[2]) * TILE_H
            state[:] = _ONE
            left, right = max(0, window[0] - x), min(TILE_W, window[2] - x)
            for place in range(tile_starts[tile], tile_starts[tile + 1]):
                splat = splats[members[place]]
                out = sums[slots[place]]
                first, end = row_bounds(splat, window)
                first, end = max(first - y, 0), min(end - y, TILE_H)
                find_rows(splat, x, y, left, right, rows)
                for k in range(np.uint64(first), np.uint64(end)):
                    for j in range(np.uint64(rows[START + k]), np.uint64(rows[STOP + k])):
                        p = k * np.uint64(TILE_W) + j
                        u = rows[U_PEAK + k] + np.float32(splat[L11]) * (np.float32(np.int32(j)) - rows[PEAK + k])
                        alpha = min(_ALPHA_MAX, exp2(rows[TOP + k] - u * u))
                        before = state[p]
                        after = before * (_ONE - alpha)
                        if after > _T_MIN:
                            weight = alpha * before
                            m = mask[np.uint64(y) + k, np.uint64(x) + j]
                            state[p] = after
                            out[0] += weight * m
                            out[1] += m
                            out[2] += weight
                            out[3] += 1.0
                        else:
                            state[p] = -abs(before)


@kernel(parallel=True, cache=True)
def gather(ids: Array, per_splat: Array, sums: Array, totals: Array) -> None:
    """Add up each splat's intersections in their fixed order. totals: out, [N,4] float64, zero on entry"""
    chunk = 256
    count = ids.size
    for part in prange((count + chunk - 1) // chunk):
        for s in range(part * chunk, min(count, (part + 1) * chunk)):
            for slot in range(per_splat[s], per_splat[s + 1]):
                for k in range(SUMS):
                    totals[ids[s], k] += sums[slot, k]
