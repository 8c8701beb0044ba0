"""Kernel: blend the splats of each tile front to back."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import spans
from .bin import TILE_W, TileLists
from .jit import Number, kernel
from .project import Pinhole, Splats
from .simd import WIDTH, lane_indices, load, select, store

Array = NDArray[Any]

_ZERO: Number = np.float32(0.0)
_ONE: Number = np.float32(1.0)
# planes of the state: transmittance (negative: the pixel is done), rgb, place in the tile's list of the last
# contributor (-1: none; float32 holds it exactly up to 2^24)
_G, _B, _LAST = spans.PLANE * np.uint64(2), spans.PLANE * np.uint64(3), spans.PLANE * np.uint64(4)


class Picture(NamedTuple):
    """The window as it is drawn.

    Args:
        image, transmittance: [h,w,3], [h,w] float32
        last: place in the tile's list of each pixel's last contributor, -1 if none. [h,w] float32
    """

    image: Array
    transmittance: Array
    last: Array


@kernel(fast=True, inline=True)
def _blend_row(state: Array, batch: Array, splat: Number, row: Number, place: Number) -> None:
    """Blend one row of a splat into a tile's state; `splat` is where its spans begin."""
    start, stop, p, u_peak, top = spans.row_span(batch, splat, row)
    step, red, green, blue = spans.step_and_color(batch, splat)
    offset = start + lane_indices()
    while start < stop:
        u = u_peak + step * offset
        alpha = spans.exp2(top - u * u)
        alpha = select(alpha < spans.MOST, alpha, spans.MOST)
        alpha = select(offset < stop, alpha, _ZERO)
        before = load(state, p)
        after = before * (spans.ONE - alpha)
        taken = after > spans.LEAST
        weight = select(taken, alpha * before, _ZERO)
        store(state, p, select(taken, after, select(before < _ZERO, before, _ZERO - before)))
        store(state, p + spans.PLANE, load(state, p + spans.PLANE) + weight * red)
        store(state, p + _G, load(state, p + _G) + weight * green)
        store(state, p + _B, load(state, p + _B) + weight * blue)
        store(state, p + _LAST, select(weight > _ZERO, place, load(state, p + _LAST)))
        p += np.uint64(WIDTH)
        offset += spans.EIGHT
        start += spans.EIGHT


@kernel(fast=True, inline=True)
def _leave_out_done_rows(state: Array, bounds: Array) -> Number:
    """Take rows whose pixels are all done off `bounds`, from above and below; whether any row is left."""
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
def _blend_tile(
    state: Array, x: int, y: int, members: Array, splats: Splats, bounds: Array, batch: Array
) -> None:
    """Blend a tile; state is [5·spans.PLANE] float32, set up here, the rest as in `find_spans`."""
    plane = np.int64(spans.PLANE)
    state[:plane] = _ONE
    state[plane : 4 * plane] = _ZERO
    state[4 * plane : 5 * plane] = -_ONE
    for begin in range(0, members.size, spans.BATCH):
        end = min(begin + spans.BATCH, members.size)
        spans.find_spans(members, begin, end, splats, x, y, bounds, batch)
        for place in range(begin, end):
            splat = np.uint64(place - begin) * spans.SPLAT
            for line in range(np.int32(batch[splat + spans.FIRST]), np.int32(batch[splat + spans.END])):
                _blend_row(state, batch, splat, np.uint64(line), np.float32(place))
        if not _leave_out_done_rows(state, bounds):
            break


@kernel(cache=True)
def blend(
    begin: int, end: int, scratch: spans.TileScratch, splats: Splats, lists: TileLists, camera: Pinhole,
    background: Array, out: Picture,
) -> None:  # fmt: skip
    """Blend tiles begin … end − 1 into the picture. background: [3] float32"""
    state, batch, bounds = scratch
    for tile in range(begin, end):
        x, y = spans.tile_corner(camera, tile)
        spans.tile_bounds(camera, x, y, bounds)
        members = lists.members[lists.starts[tile] : lists.starts[tile + 1]]
        _blend_tile(state, x, y, members, splats, bounds, batch)
        spans.tile_bounds(camera, x, y, bounds)  # blending narrowed it
        left, width = np.uint64(x + bounds[0] - camera.window[0]), np.uint64(bounds[2] - bounds[0])
        for row in range(np.uint64(bounds[1]), np.uint64(bounds[3])):
            i = np.uint64(y - camera.window[1]) + row
            p = row * np.uint64(TILE_W) + np.uint64(bounds[0])
            for k in range(width):
                out.transmittance[i, left + k] = abs(state[p + k])
            for k in range(width):
                out.last[i, left + k] = state[p + _LAST + k]
            for k in range(width):
                through = abs(state[p + k])
                out.image[i, left + k, 0] = state[p + spans.PLANE + k] + through * background[0]
                out.image[i, left + k, 1] = state[p + _G + k] + through * background[1]
                out.image[i, left + k, 2] = state[p + _B + k] + through * background[2]
