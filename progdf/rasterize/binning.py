"""Kernels: depth order by radix sort of the Gaussians, then a stable counting sort of them into tiles.

Sorting N Gaussians once is much less than sorting their intersections with tiles; both sorts are stable, so
the result does not depend on the number of threads.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from progdf.rasterize.jit import Number, kernel
from progdf.rasterize.projection import EXTENT_Y, INV_L11, L22, MX, MY, R2, SLOPE

Array = NDArray[Any]

TILE_W, TILE_H = 32, 8
"""Pixels of a tile. Wide: a row of a tile is what the pixel loops vectorise over."""

_DIGIT = 11
_BUCKETS = 1 << _DIGIT


@kernel(parallel=True, cache=True)
def depth_order(depths: Array, candidates: Array, parts: int) -> tuple[Array, Array]:
    """The candidates and their places in the order of depth, ties by index.

    Args:
        depths: > 0. [N] float32
        candidates: [N] bool
        parts: in how many parts to work at once

    Returns:
        indices of the candidates, ascending [V] int64; rank of each, 0 is nearest [V] int64
    """
    n = depths.size
    bits = depths.view(np.uint32)  # positive floats sort as their bits
    step = (n + parts - 1) // parts
    found = np.zeros(parts + 1, np.int64)
    for p in prange(parts):
        inside = 0
        for i in range(p * step, min(n, (p + 1) * step)):
            inside += candidates[i]
        found[p + 1] = inside
    for p in range(parts):
        found[p + 1] += found[p]
    count = found[parts]
    keys, ids, items = np.empty(count, np.uint32), np.empty(count, np.int64), np.empty(count, np.int32)
    for p in prange(parts):
        at = found[p]
        for i in range(p * step, min(n, (p + 1) * step)):
            if candidates[i]:
                keys[at], ids[at], items[at] = bits[i], i, at
                at += 1
    other_keys, other_items = np.empty(count, np.uint32), np.empty(count, np.int32)
    place = np.empty((parts, _BUCKETS), np.int64)
    step = (count + parts - 1) // parts
    for digit in range(3):
        shift = np.uint32(digit * _DIGIT)
        for p in prange(parts):
            place[p] = 0
            for k in range(p * step, min(count, (p + 1) * step)):
                place[p, (keys[k] >> shift) & np.uint32(_BUCKETS - 1)] += 1
        total = 0
        for bucket in range(_BUCKETS):
            for p in range(parts):
                here = place[p, bucket]
                place[p, bucket] = total
                total += here
        for p in prange(parts):
            for k in range(p * step, min(count, (p + 1) * step)):
                bucket = (keys[k] >> shift) & np.uint32(_BUCKETS - 1)
                at = place[p, bucket]
                place[p, bucket] = at + 1
                other_keys[at], other_items[at] = keys[k], items[k]
        keys, other_keys = other_keys, keys
        items, other_items = other_items, items
    ranks = np.empty(count, np.int64)
    for p in prange(parts):
        for k in range(p * step, min(count, (p + 1) * step)):
            ranks[items[k]] = k
    return ids, ranks


@kernel(inline=True)
def row_bounds(splat: Array, window: Array) -> tuple[int, int]:
    """First pixel row and one past the last whose centres the splat may reach, within the window."""
    top = max(np.ceil(splat[MY] - splat[EXTENT_Y] - 0.5 - 1e-6), float(window[1]))
    bottom = min(np.floor(splat[MY] + splat[EXTENT_Y] - 0.5 + 1e-6) + 1.0, float(window[3]))
    if not top < bottom:
        return 0, 0
    return int(top), int(bottom)


@kernel(inline=True)
def side_points(splat: Array) -> Number:
    """dy of the leftmost point of the support, pixels; the rightmost has minus that."""
    inverse2 = 1.0 / (splat[L22] * splat[L22])
    inclined = splat[SLOPE] * inverse2
    return inclined * math.sqrt(splat[R2] / (splat[INV_L11] * splat[INV_L11] + splat[SLOPE] * inclined))


@kernel(inline=True)
def tile_columns(splat: Array, side: Number, y_first: int, y_last: int, window: Array) -> tuple[int, int]:
    """First tile column and one past the last that the splat may reach in pixel rows y_first..y_last.

    Columns count from the left edge of the full image. The bound is exact up to 1e-6 px: within a band of
    rows the support's left edge is farthest out where the leftmost point is, or at the band's nearest row.
    """
    low, high = y_first + 0.5 - splat[MY], y_last + 0.5 - splat[MY]
    left_at, right_at = min(max(side, low), high), min(max(-side, low), high)
    v = splat[L22] * left_at
    left = splat[MX] - splat[SLOPE] * left_at - math.sqrt(max(0.0, splat[R2] - v * v)) * splat[INV_L11]
    v = splat[L22] * right_at
    right = splat[MX] - splat[SLOPE] * right_at + math.sqrt(max(0.0, splat[R2] - v * v)) * splat[INV_L11]
    first = max(np.ceil(left - 0.5 - 1e-6), float(window[0]))
    last = min(np.floor(right - 0.5 + 1e-6), float(window[2] - 1))
    if not first <= last:
        return 0, 0
    return int(first) // TILE_W, int(last) // TILE_W + 1


@kernel(parallel=True, cache=True)
def count_tiles(splats: Array, window: Array, grid: Array, counts: Array, per_splat: Array) -> None:
    """Count the splats of each tile, part by part of the depth order.

    Args:
        splats: nearest first. [V,8] float64
        window: x0, y0, x1, y1 pixels. [4] int64
        grid: first tile column and row, and how many of each. [4] int64
        counts: out, splats of each part in each tile. [parts, tiles] int64
        per_splat: out, tiles of splat s at s + 1. [V+1] int64
    """
    parts = counts.shape[0]
    count = splats.shape[0]
    step = (count + parts - 1) // parts
    per_splat[0] = 0
    for p in prange(parts):
        counts[p] = 0
        for s in range(p * step, min(count, (p + 1) * step)):
            splat = splats[s]
            touched = 0
            top, bottom = row_bounds(splat, window)
            if top < bottom:
                side = side_points(splat)
                for row in range(top // TILE_H, (bottom - 1) // TILE_H + 1):
                    y_first, y_last = max(top, row * TILE_H), min(bottom, (row + 1) * TILE_H) - 1
                    first, end = tile_columns(splat, side, y_first, y_last, window)
                    base = (row - grid[1]) * grid[2] - grid[0]
                    for column in range(first, end):
                        counts[p, base + column] += 1
                    touched += end - first
            per_splat[s + 1] = touched


@kernel(cache=True)
def place_tiles(counts: Array, tile_starts: Array, per_splat: Array) -> int:
    """Turn counts into places, in place: where each part writes in each tile, and where each splat's list
    begins.

    Args:
        counts: as from `count_tiles`; out: the first place of each part in each tile. [parts, tiles] int64
        tile_starts: out. [tiles+1] int64
        per_splat: as from `count_tiles`; out: running sum. [V+1] int64

    Returns:
        The number of (splat, tile) intersections.
    """
    parts, tiles = counts.shape
    total = 0
    for tile in range(tiles):
        tile_starts[tile] = total
        for p in range(parts):
            here = counts[p, tile]
            counts[p, tile] = total
            total += here
    tile_starts[tiles] = total
    for s in range(per_splat.size - 1):
        per_splat[s + 1] += per_splat[s]
    return total


@kernel(parallel=True, cache=True)
def fill_tiles(
    splats: Array, window: Array, grid: Array, places: Array, per_splat: Array, members: Array, slots: Array
) -> None:
    """List the splats of each tile, nearest first.

    Args:
        splats, window, grid: as in `count_tiles`
        places, per_splat: as from `place_tiles`; places is used up
        members: out, the splats of all tiles, tile after tile. [I] int32
        slots: out, for each member its place in an order by splat, so that gradients can be added up in one
            fixed order. [I] int64, or [0] where nobody will ask
    """
    parts = places.shape[0]
    count = splats.shape[0]
    step = (count + parts - 1) // parts
    for p in prange(parts):
        for s in range(p * step, min(count, (p + 1) * step)):
            splat = splats[s]
            slot = per_splat[s]
            top, bottom = row_bounds(splat, window)
            if top < bottom:
                side = side_points(splat)
                for row in range(top // TILE_H, (bottom - 1) // TILE_H + 1):
                    y_first, y_last = max(top, row * TILE_H), min(bottom, (row + 1) * TILE_H) - 1
                    first, end = tile_columns(splat, side, y_first, y_last, window)
                    base = (row - grid[1]) * grid[2] - grid[0]
                    for column in range(first, end):
                        at = places[p, base + column]
                        places[p, base + column] = at + 1
                        members[at] = s
                        if slots.size > 0:
                            slots[at] = slot
                        slot += 1
