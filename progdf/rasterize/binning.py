"""Kernels: depth order by radix sort of the Gaussians, then a stable counting sort of them into tiles.

Sorting N Gaussians once is much less than sorting their intersections with tiles; both sorts are stable, so
the result does not depend on the number of threads.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.jit import kernel
from progdf.rasterize.projection import EXTENT_Y, INV_L11, L22, MX, MY, R2, SLOPE
from progdf.rasterize.shares import claim, share

Array = NDArray[Any]

TILE_W, TILE_H = 32, 8
"""Pixels of a tile. Wide: a row of a tile is what the pixel loops vectorise over."""

_DIGIT = 11  # bits
DIGITS = 3
"""Digits of a key, least significant first."""

BUCKETS = 1 << _DIGIT
"""Values of a digit."""

_WORTH_A_THREAD = 65_536  # keys below which handing half of them over takes longer than moving them


@kernel(cache=True)
def gather_keys(depths: Array, candidates: Array) -> tuple[Array, Array, Array]:
    """The candidates, ready to be sorted.

    Args:
        depths: > 0. [N] float32
        candidates: [N] bool

    Returns:
        their indices, ascending [V] int64; keys that sort as their depths do [V] uint32; 0, 1, 2, … [V] int32
    """
    count = 0
    for i in range(depths.size):
        count += candidates[i]
    bits = depths.view(np.uint32)  # positive floats sort as their bits
    ids, keys, items = np.empty(count, np.int64), np.empty(count, np.uint32), np.empty(count, np.int32)
    at = 0
    for i in range(depths.size):
        if candidates[i]:
            ids[at], keys[at], items[at] = i, bits[i], at
            at += 1
    return ids, keys, items


@kernel(cache=True)
def count_digits(keys: Array, digit: int, places: Array, claims: Array) -> None:
    """How often each value of a digit occurs in each part of the keys; places: out, [parts, BUCKETS]."""
    parts = places.shape[0]
    step = (keys.size + parts - 1) // parts
    shift = np.uint32(digit * _DIGIT)
    part = claim(claims)
    while part < parts:
        places[part] = 0
        for k in range(part * step, min(keys.size, (part + 1) * step)):
            places[part, (keys[k] >> shift) & np.uint32(BUCKETS - 1)] += 1
        part = claim(claims)


@kernel(cache=True)
def place_digits(places: Array) -> None:
    """Turn counts into the places where each part puts its keys, bucket by bucket; in place."""
    total = 0
    for bucket in range(BUCKETS):
        for part in range(places.shape[0]):
            here = places[part, bucket]
            places[part, bucket] = total
            total += here


@kernel(cache=True)
def move_digits(
    keys: Array, items: Array, digit: int, places: Array, new_keys: Array, new_items: Array, claims: Array
) -> None:
    """Put keys and items where `places` says, which is used up."""
    parts = places.shape[0]
    step = (keys.size + parts - 1) // parts
    shift = np.uint32(digit * _DIGIT)
    part = claim(claims)
    while part < parts:
        for k in range(part * step, min(keys.size, (part + 1) * step)):
            bucket = (keys[k] >> shift) & np.uint32(BUCKETS - 1)
            at = places[part, bucket]
            places[part, bucket] = at + 1
            new_keys[at], new_items[at] = keys[k], items[k]
        part = claim(claims)


@kernel(cache=True)
def rank_items(items: Array) -> Array:
    """The place of each item. [V] int64"""
    ranks = np.empty(items.size, np.int64)
    for place in range(items.size):
        ranks[items[place]] = place
    return ranks


def depth_order(depths: Array, candidates: Array, workers: int) -> tuple[Array, Array]:
    """The candidates and their places in the order of depth, ties by index.

    Args:
        depths: > 0. [N] float32
        candidates: [N] bool
        workers: threads

    Returns:
        indices of the candidates, ascending [V] int64; rank of each, 0 is nearest [V] int64
    """
    ids, keys, items = gather_keys(depths, candidates)
    new_keys, new_items = np.empty_like(keys), np.empty_like(items)
    workers = min(workers, 1 + len(keys) // _WORTH_A_THREAD)
    places = np.empty((workers, BUCKETS), np.int64)
    for digit in range(DIGITS):
        share(workers, count_digits, keys, digit, places)
        place_digits(places)
        share(workers, move_digits, keys, items, digit, places, new_keys, new_items)
        keys, new_keys, items, new_items = new_keys, keys, new_items, items
    return ids, rank_items(items)


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


@kernel(cache=True)
def find_tiles(
    splats: Array, part: int, window: Array, grid: Array, most: int, counts: Array, per_splat: Array
) -> Array:
    """The tiles that one part of the splats meets, and how many splats each tile has of it.

    Args:
        splats: nearest first. [V,8] float64
        part: a row of `counts`; as many parts as it has rows
        window: x0, y0, x1, y1 pixels. [4] int64
        grid: first tile column and row, and how many of each. [4] int64
        most: tiles beyond which they are only counted
        counts: out, splats of the part in each tile, in its row. [parts, tiles] int64
        per_splat: out, tiles of splat s at s + 1, for the part's splats. [V+1] int64

    Returns:
        tiles of the part's splats, one splat's after the other's. [≥ their number] int32
    """
    count = splats.shape[0]
    step = (count + counts.shape[0] - 1) // counts.shape[0]
    begin, stop = part * step, min(count, (part + 1) * step)
    x0, y0 = np.float64(window[0]), np.float64(window[1])
    x1, y1 = np.float64(window[2]), np.float64(window[3])
    tiles = np.empty(4 * max(0, stop - begin) + 64, np.int32)
    at = 0
    counts[part] = 0
    for s in range(begin, stop):
        touched = 0
        top, bottom = _row_bounds(splats[s, MY], splats[s, EXTENT_Y], y0, y1)
        if top < bottom:
            outline = _outline(splats, s)
            for row in range(top // TILE_H, (bottom - 1) // TILE_H + 1):
                y_first, y_last = max(top, row * TILE_H), min(bottom, (row + 1) * TILE_H) - 1
                first, end = _tile_columns(outline, y_first, y_last, x0, x1)
                touched += end - first
                if at + end - first > tiles.size and at < most:
                    more = np.empty(2 * (at + end - first), np.int32)
                    more[:at] = tiles[:at]
                    tiles = more
                base = (row - grid[1]) * grid[2] - grid[0]
                for column in range(first, end):
                    counts[part, base + column] += 1
                    if at < most:
                        tiles[at] = base + column
                    at += 1
        per_splat[s + 1] = touched
    return tiles


@kernel(cache=True)
def place_tiles(counts: Array, tile_starts: Array, per_splat: Array) -> int:
    """Turn counts into places, in place: where each part writes in each tile, and where each splat's list
    begins.

    Args:
        counts: as from `find_tiles`; out: the first place of each part in each tile. [parts, tiles] int64
        tile_starts: out. [tiles+1] int64
        per_splat: as from `find_tiles`; out: running sum. [V+1] int64

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
    per_splat[0] = 0
    for s in range(per_splat.size - 1):
        per_splat[s + 1] += per_splat[s]
    return total


@kernel(cache=True)
def fill_tiles(
    tiles: Array, part: int, places: Array, per_splat: Array, members: Array, slots: Array
) -> None:
    """List the splats of each tile, nearest first.

    Args:
        tiles: as from `find_tiles`, of this part
        part: a row of `places`
        places, per_splat: as from `place_tiles`; the part's places are used up
        members: out, the splats of all tiles, tile after tile. [I] int32
        slots: out, for each member its place in an order by splat, so that gradients can be added up in one
            fixed order. [I] int64, or [0] where nobody will ask
    """
    count = per_splat.size - 1
    step = (count + places.shape[0] - 1) // places.shape[0]
    begin = min(count, part * step)
    before = per_splat[begin]
    for s in range(begin, min(count, begin + step)):
        for slot in range(per_splat[s], per_splat[s + 1]):
            tile = tiles[slot - before]
            at = places[part, tile]
            places[part, tile] = at + 1
            members[at] = s
            if slots.size > 0:
                slots[at] = slot
