"""Kernels: depth order by radix sort of the Gaussians, then a stable counting sort of them into tiles.

Sorting N Gaussians once is much less than sorting their intersections with tiles; both sorts are stable, so
the result does not depend on the number of threads.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from progdf.rasterize.jit import kernel
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


class Outline(NamedTuple):
    """What binning needs of a splat, see `projection`; side: dy of its support's leftmost point."""

    mx: float
    my: float
    slope: float
    inv_l11: float
    l22: float
    r2: float
    side: float


@kernel(contract=True, inline=True)
def _outline(splats: Array, s: int) -> Outline:
    slope, inv_l11, l22, r2 = splats[s, SLOPE], splats[s, INV_L11], splats[s, L22], splats[s, R2]
    inclined = slope / (l22 * l22)
    side = inclined * math.sqrt(r2 / (inv_l11 * inv_l11 + slope * inclined))
    return Outline(splats[s, MX], splats[s, MY], slope, inv_l11, l22, r2, side)


@kernel(inline=True)
def _row_bounds(my: float, extent: float, first: float, end: float) -> tuple[int, int]:
    """First pixel row and one past the last whose centres the splat may reach, within first..end."""
    top = max(np.ceil(my - extent - 0.5 - 1e-6), first)
    bottom = min(np.floor(my + extent - 0.5 + 1e-6) + 1.0, end)
    if not top < bottom:
        return 0, 0
    return int(top), int(bottom)


@kernel(contract=True, inline=True)
def _tile_columns(o: Outline, y_first: int, y_last: int, left: float, right: float) -> tuple[int, int]:
    """First tile column and one past the last that the splat may reach in pixel rows y_first..y_last.

    Columns count from the left edge of the full image; left, right: the window's. The bound is exact
    up to 1e-6 px: within a band of rows the support's left edge is farthest out where its leftmost point is,
    or at the band's nearest row.
    """
    low, high = y_first + 0.5 - o.my, y_last + 0.5 - o.my
    left_at, right_at = min(max(o.side, low), high), min(max(-o.side, low), high)
    v, w = o.l22 * left_at, o.l22 * right_at
    outermost = o.mx - o.slope * left_at - math.sqrt(max(0.0, o.r2 - v * v)) * o.inv_l11
    first = max(np.ceil(outermost - 0.5 - 1e-6), left)
    outermost = o.mx - o.slope * right_at + math.sqrt(max(0.0, o.r2 - w * w)) * o.inv_l11
    last = min(np.floor(outermost - 0.5 + 1e-6), right - 1.0)
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
    x0, y0 = np.float64(window[0]), np.float64(window[1])
    x1, y1 = np.float64(window[2]), np.float64(window[3])
    per_splat[0] = 0
    for p in prange(parts):
        counts[p] = 0
        for s in range(p * step, min(count, (p + 1) * step)):
            touched = 0
            top, bottom = _row_bounds(splats[s, MY], splats[s, EXTENT_Y], y0, y1)
            if top < bottom:
                outline = _outline(splats, s)
                for row in range(top // TILE_H, (bottom - 1) // TILE_H + 1):
                    y_first, y_last = max(top, row * TILE_H), min(bottom, (row + 1) * TILE_H) - 1
                    first, end = _tile_columns(outline, y_first, y_last, x0, x1)
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
    x0, y0 = np.float64(window[0]), np.float64(window[1])
    x1, y1 = np.float64(window[2]), np.float64(window[3])
    for p in prange(parts):
        for s in range(p * step, min(count, (p + 1) * step)):
            slot = per_splat[s]
            top, bottom = _row_bounds(splats[s, MY], splats[s, EXTENT_Y], y0, y1)
            if top < bottom:
                outline = _outline(splats, s)
                for row in range(top // TILE_H, (bottom - 1) // TILE_H + 1):
                    y_first, y_last = max(top, row * TILE_H), min(bottom, (row + 1) * TILE_H) - 1
                    first, end = _tile_columns(outline, y_first, y_last, x0, x1)
                    base = (row - grid[1]) * grid[2] - grid[0]
                    for column in range(first, end):
                        at = places[p, base + column]
                        places[p, base + column] = at + 1
                        members[at] = s
                        if slots.size > 0:
                            slots[at] = slot
                        slot += 1
