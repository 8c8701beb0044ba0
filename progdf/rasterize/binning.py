"""Kernels: which tiles each splat meets, and a stable counting sort of the splats into the tiles.

The splats come in the order of depth and stay in it, whatever the number of threads.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .gathers import Rows, gather, rows_from
from .jit import kernel
from .lanes import WIDTH, Lanes, any_of, choose, spread, store
from .projection import EXTENT_Y, INV_L11, L22, MX, MY, R2, SLOPE
from .shares import pieces

Array = NDArray[Any]

TILE_W, TILE_H = 64, 8
"""Pixels of a tile. Wide: a row of a tile is what the pixel loops vectorise over."""

_TILE_W, _TILE_H = float(TILE_W), float(TILE_H)


class Outline(NamedTuple):
    """What binning needs of eight splats, see `projection`; side: dy of a support's leftmost point."""

    mx: Lanes
    my: Lanes
    slope: Lanes
    inv_l11: Lanes
    l22: Lanes
    r2: Lanes
    side: Lanes


@kernel(contract=True, inline=True)
def _outline(splats: Array, s: Rows) -> Outline:
    slope, inv_l11 = gather(splats, s, SLOPE), gather(splats, s, INV_L11)
    l22, r2 = gather(splats, s, L22), gather(splats, s, R2)
    inclined = slope / (l22 * l22)
    side = inclined * math.sqrt(r2 / (inv_l11 * inv_l11 + slope * inclined))
    return Outline(gather(splats, s, MX), gather(splats, s, MY), slope, inv_l11, l22, r2, side)


@kernel(inline=True)
def _tile_rows(splats: Array, s: Rows, first: float, end: float) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Pixel rows whose centres a splat may reach and the rows of tiles that they lie in.

    first, end: what to look at, pixel rows

    Returns:
        the first pixel row and the last, the first row of tiles, and the number of them, 0 where none is met
    """
    my, extent = gather(splats, s, MY), gather(splats, s, EXTENT_Y)
    top = max(np.ceil(my - extent - 0.5 - 1e-6), first)
    bottom = min(np.floor(my + extent - 0.5 + 1e-6), end - 1.0)
    first_tile, last_tile = np.floor(top / _TILE_H), np.floor(bottom / _TILE_H)
    return top, bottom, first_tile, choose(top <= bottom, last_tile - first_tile + 1.0, 0.0)


@kernel(contract=True, inline=True)
def _tile_columns(o: Outline, top: Lanes, bottom: Lanes, left: float, right: float) -> tuple[Lanes, Lanes]:
    """First tile column and one past the last that a splat may reach in the pixel rows top..bottom.

    Columns count from the left edge of the full image; left, right: the window's. The bound is exact
    up to 1e-6 px: within a band of rows the support's left edge is farthest out where its leftmost point is,
    or at the band's nearest row.
    """
    low, high = top + 0.5 - o.my, bottom + 0.5 - o.my
    left_at, right_at = min(max(o.side, low), high), min(max(-o.side, low), high)
    v, w = o.l22 * left_at, o.l22 * right_at
    outermost = o.mx - o.slope * left_at - math.sqrt(max(0.0, o.r2 - v * v)) * o.inv_l11
    first = max(np.ceil(outermost - 0.5 - 1e-6), left)
    outermost = o.mx - o.slope * right_at + math.sqrt(max(0.0, o.r2 - w * w)) * o.inv_l11
    last = min(np.floor(outermost - 0.5 + 1e-6), right - 1.0)
    met = first <= last
    return choose(met, np.floor(first / _TILE_W), 0.0), choose(met, np.floor(last / _TILE_W) + 1.0, 0.0)


@kernel(inline=True)
def _find_spans(splats: Array, s: Rows, window: Array, spans: Array) -> Lanes:
    """The tiles that eight splats meet, row by row; how many each meets.

    spans: out; first row of tiles, number of rows, then for each row its first column and one past its last.
        [≥ 2 + 2 · rows of tiles in the window, 8] float64
    """
    x0, y0 = np.float64(window[0]), np.float64(window[1])
    x1, y1 = np.float64(window[2]), np.float64(window[3])
    outline = _outline(splats, s)
    top, bottom, first, rows = _tile_rows(splats, s, y0, y1)
    at = np.uint64(0)
    store(spans, at, first)
    store(spans, at + np.uint64(WIDTH), rows)
    met, row = spread(0.0), 0.0
    while any_of(row < rows):
        edge = (first + row) * _TILE_H
        upper, lower = max(top, edge), min(bottom, edge + _TILE_H - 1.0)
        left, right = _tile_columns(outline, upper, lower, x0, x1)
        at += np.uint64(2 * WIDTH)
        store(spans, at, left)
        store(spans, at + np.uint64(WIDTH), right)
        met += choose(row < rows, right - left, 0.0)
        row += 1.0
    return met


@kernel(inline=True)
def _list_spans(spans: Array, lanes: int, grid: Array, at: int, tiles: Array, counts: Array) -> None:
    """Count the tiles of the first lanes and write them from tiles[at] on, one splat's after the other's."""
    place = np.uint64(at)
    for lane in range(lanes):
        base = (int(spans[0, lane]) - grid[1]) * grid[2] - grid[0]
        for row in range(int(spans[1, lane])):
            for column in range(int(spans[2 + 2 * row, lane]), int(spans[3 + 2 * row, lane])):
                counts[base + column] += 1
                if place < np.uint64(tiles.size):
                    tiles[place] = base + column
                place += np.uint64(1)
            base += grid[2]


@kernel(allocates=True)
def _find_tiles(
    splats: Array, begin: int, stop: int, window: Array, grid: Array, most: int, counts: Array,
    per_splat: Array, tiles: Array,
) -> None:  # fmt: skip
    """The tiles that some splats meet, how many of the splats each tile has, and how many each splat."""
    spans, met = np.empty((2 + 2 * grid[3], WIDTH)), np.empty(WIDTH)
    counts[:] = 0
    at = 0
    for eight in range(begin, stop, WIDTH):
        lanes, here = min(WIDTH, stop - eight), 0
        store(met, np.uint64(0), _find_spans(splats, rows_from(eight, stop), window, spans))
        for lane in range(lanes):
            per_splat[eight + lane + 1] = int(met[lane])
            here += int(met[lane])
        if at + here <= most:
            _list_spans(spans, lanes, grid, at, tiles, counts)
        at += here


@kernel(allocates=True)
def find_tiles(
    splats: Array, window: Array, grid: Array, most: int, counts: Array, per_splat: Array, tiles: Array,
    tile_starts: Array, found: Array, seat: int, claims: Array, step: int,
) -> None:  # fmt: skip
    """The tiles that each splat meets, and where each tile's list will be; all threads take part.

    Args:
        splats: nearest first. [V,8] float64
        window: x0, y0, x1, y1 pixels. [4] int64
        grid: first tile column and row, and how many of each. [4] int64
        most: intersections beyond which only their number is right
        counts: out, the first place of each part of the splats in each tile. [parts, tiles] int64
        per_splat: out, where each splat's intersections begin, counted splat by splat. [V+1] int64
        tiles: out, tiles of each part's splats, one splat's after the other's, as far as there is room.
            [parts, room] int32
        tile_starts: out. [tiles+1] int64
        found: out, the number of (splat, tile) intersections in its second place. [2] int64
        seat, claims: see `shares`
        step: the first of 2
    """
    count, parts = splats.shape[0], counts.shape[0]
    size = (count + parts - 1) // parts
    for part in pieces(claims, step, seat, parts):
        begin, stop = min(count, part * size), min(count, (part + 1) * size)
        _find_tiles(splats, begin, stop, window, grid, most, counts[part], per_splat, tiles[part])
    step += 1
    for _ in pieces(claims, step, seat, 1):
        _place_tiles(counts, tile_starts, per_splat)
        found[1] = per_splat[count]


@kernel(inline=True)
def _place_tiles(counts: Array, tile_starts: Array, per_splat: Array) -> None:
    """Turn counts into places, in place: where each part writes in each tile, and where each splat's list
    begins."""
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


@kernel(allocates=True)
def fill_tiles(
    splats: Array, window: Array, grid: Array, places: Array, per_splat: Array, tiles: Array,
    members: Array, slots: Array, seat: int, claims: Array, step: int,
) -> None:  # fmt: skip
    """List the splats of each tile, nearest first; all threads take part.

    Args:
        splats, window, grid, tiles, per_splat: as in `find_tiles`
        places: `counts` of `find_tiles`, which are used up. [parts, tiles] int64
        members: out, the splats of all tiles, tile after tile. [I] int32
        slots: out, for each member its place in an order by splat, so that gradients can be added up in one
            fixed order. [I] int64, or [0] where nobody will ask
        seat, claims, step: see `shares.pieces`
    """
    count, parts = splats.shape[0], places.shape[0]
    size = (count + parts - 1) // parts
    for part in pieces(claims, step, seat, parts):
        begin, stop = min(count, part * size), min(count, (part + 1) * size)
        before = per_splat[begin]
        found = per_splat[stop] - before
        listed = tiles[part]
        if found > listed.size:  # no room: once more
            listed = np.empty(found, np.int32)
            spare = np.empty(per_splat.size, np.int64)
            _find_tiles(splats, begin, stop, window, grid, found, np.empty_like(places[0]), spare, listed)
        for s in range(begin, stop):
            for slot in range(per_splat[s], per_splat[s + 1]):
                tile = listed[slot - before]
                at = places[part, tile]
                places[part, tile] = at + 1
                members[at] = s
                if slots.size > 0:
                    slots[at] = slot
