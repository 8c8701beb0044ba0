"""Kernels: which tiles each splat meets, and a stable counting sort of the splats into the tiles.

The splats of a tile are in the order of depth, whatever the number of threads.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .jit import kernel
from .project import EXTENT_Y, INV_L11, L22, MX, MY, R2, SLOPE, Pinhole, Splats
from .simd import prefetch

Array = NDArray[Any]

TILE_W, TILE_H = 64, 8
"""Pixels of a tile. Wide: a row of a tile is what the pixel loops vectorize over."""


_AHEAD = 8  # splats whose tiles are fetched before it is their turn: they lie far apart


class TileLists(NamedTuple):
    """The splats of each tile, nearest first.

    Args:
        starts: where each tile's list begins. [tiles+1] int64
        members: rows of the splats, tile after tile. [I] int32
        slots: of each member, its place in an order by row, so that what belongs to one Gaussian can be added
            up in one fixed order. [I] int32, or [0] where nobody will ask
        offsets: first slot of each Gaussian. [N+1] int32
    """

    starts: Array
    members: Array
    slots: Array
    offsets: Array


@kernel(contract=True, inline=True)
def _tile_columns(
    shape: Array, side: float, top: float, bottom: float, left: float, right: float
) -> tuple[int, int]:
    """First tile column and one past the last that a splat may touch in the pixel rows top..bottom.

    Columns count from the left edge of the full image; left, right: the window's. The bound is exact up to
    1e-6 px: within a band of rows the support's left edge is farthest out where its leftmost point is, or at
    the band's nearest row. side: dy of that point.
    """
    low, high = top + 0.5 - shape[MY], bottom + 0.5 - shape[MY]
    left_at, right_at = min(max(side, low), high), min(max(-side, low), high)
    v, w = shape[L22] * left_at, shape[L22] * right_at
    outermost = shape[MX] - shape[SLOPE] * left_at - math.sqrt(max(0.0, shape[R2] - v * v)) * shape[INV_L11]
    first = max(np.ceil(outermost - 0.5 - 1e-6), left)
    outermost = shape[MX] - shape[SLOPE] * right_at + math.sqrt(max(0.0, shape[R2] - w * w)) * shape[INV_L11]
    last = min(np.floor(outermost - 0.5 + 1e-6), right - 1.0)
    if not first <= last:
        return 0, 0
    return int(first) // TILE_W, int(last) // TILE_W + 1


@kernel(contract=True, cache=True)
def find_tiles(begin: int, end: int, splats: Splats, camera: Pinhole, tiles: Array, counts: Array) -> int:
    """The tiles that the splats of rows begin … end − 1 meet.

    Args:
        tiles: out, one splat's after the other's, as far as there is room. int32
        counts: out, the number of each row's tiles. [N] int32

    Returns:
        how many there are
    """
    window = camera.window
    x0, y0, x1, y1 = float(window[0]), float(window[1]), float(window[2]), float(window[3])
    at = 0
    for i in range(begin, end):
        counts[i] = 0
        if not splats.visible[i]:
            continue
        shape = splats.shapes[i]
        mx, my, high, slope = shape[MX], shape[MY], shape[EXTENT_Y], shape[SLOPE]
        inclined = slope / (shape[L22] * shape[L22])
        variance = shape[INV_L11] * shape[INV_L11] + slope * inclined
        wide = math.sqrt(shape[R2] * variance)
        # pixel rows and columns whose centers it may touch
        top = max(np.ceil(my - high - 0.5 - 1e-6), y0)
        bottom = min(np.floor(my + high - 0.5 + 1e-6), y1 - 1.0)
        first = max(np.ceil(mx - wide - 0.5 - 1e-6), x0)
        last = min(np.floor(mx + wide - 0.5 + 1e-6), x1 - 1.0)
        if not (top <= bottom and first <= last):
            continue
        left, right = int(first) // TILE_W, int(last) // TILE_W + 1
        narrow, side = right == left + 1, inclined * wide / variance
        before = at
        for row in range(int(top) // TILE_H, int(bottom) // TILE_H + 1):
            if not narrow:
                edge = float(row * TILE_H)
                upper, lower = max(top, edge), min(bottom, edge + (TILE_H - 1.0))
                left, right = _tile_columns(shape, side, upper, lower, x0, x1)
            base = (row - camera.grid[1]) * camera.grid[2] - camera.grid[0]
            for column in range(left, right):
                if at < tiles.size:
                    tiles[at] = base + column
                at += 1
        counts[i] = at - before
    return at


def bin_splats(order: Array, tiles: Array, counts: Array, tile_count: int, with_slots: bool) -> TileLists:
    """List the splats of each tile. On one thread: shared by two it takes as long.

    Args:
        order: rows of the splats, nearest first. [V] int32
        tiles, counts: of all rows, see `find_tiles`. [I], [N]
        tile_count: of the window
        with_slots: whether `TileLists.slots` is wanted
    """
    offsets = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=offsets[1:])
    starts = np.zeros(tile_count + 1, np.int64)
    np.cumsum(np.bincount(tiles, minlength=tile_count), out=starts[1:])
    members = np.empty(len(tiles), np.int32)
    slots = np.empty(len(tiles) if with_slots else 0, np.int32)
    _fill(order, tiles, offsets, starts[:-1].copy(), members, slots)
    return TileLists(starts, members, slots, offsets)


@kernel(cache=True)
def _fill(order: Array, tiles: Array, offsets: Array, places: Array, members: Array, slots: Array) -> None:
    """Put the splats into the lists of their tiles. places: where the next of each tile goes; used up."""
    last = order.size - 1
    for k in range(order.size):
        prefetch(offsets, order[min(k + 2 * _AHEAD, last)])
        prefetch(tiles, offsets[order[min(k + _AHEAD, last)]])
        i = order[k]
        for slot in range(offsets[i], offsets[i + 1]):
            at = places[tiles[slot]]
            places[tiles[slot]] = at + 1
            members[at] = i
            if slots.size > 0:
                slots[at] = slot


def depth_order(depths: NDArray[np.float32], visible: NDArray[np.bool_]) -> NDArray[Any]:
    """The rows of visible Gaussians, nearest first, ties by row. depths: > 0. [N], [N] -> [V] int32"""
    rows = np.flatnonzero(visible)
    bits = depths[rows].view(np.uint32)  # positive floats sort as their bits
    keys = (bits.astype(np.uint64) << np.uint64(32)) | rows.astype(np.uint64)
    keys.sort()  # all different, so any sort is stable
    return (keys & np.uint64(0xFFFF_FFFF)).astype(np.int32)
