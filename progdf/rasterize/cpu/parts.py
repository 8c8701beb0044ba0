"""Kernel that blends a picture and some Gaussians' part of it in one pass."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .blend import (
    ALPHA_LIMIT,
    BATCH,
    EIGHT,
    END,
    FIRST,
    ONE,
    PLANE,
    SPLAT,
    TRANSMITTANCE_LIMIT,
    ZERO,
    TileScratch,
    exp2,
    find_spans,
    row_span,
    skip_done_rows,
    step_and_color,
    tile_bounds,
    tile_corner,
)
from .forward import TILE_W, Pinhole, Splats, TileLists
from .jit import WIDTH, Number, kernel, lane_indices, load, select, store

Array = NDArray[Any]

PLANES = 8
"""Planes of a tile: transmittance (negative: the pixel is done), image in rgb, part in rgb, part's weight."""

_R, _G, _B, _PART_R, _PART_G, _PART_B, _SHARE = (PLANE * np.uint64(k) for k in range(1, PLANES))


class PartBuffers(NamedTuple):
    """Output buffers of a picture and a part of it."""

    image: Array  # [h,w,3] float32
    share: Array  # Σ αT over the part. [h,w] float32
    part: Array  # Σ αT·color over the part. [h,w,3] float32


@kernel(fast=True, inline=True)
def _blend_row(state: Array, batch: Array, splat: Number, row: Number, is_part: Number, color: Array) -> None:
    """Blend one row of a splat into a tile's state.

    Args:
        splat: start of its spans in `batch`
        is_part: blend it into the part too
        color: its color as in `batch`. Read a second time, because a product that two sums share is not fused
            with either, and the image would have other bits than that of `blend`. [4]
    """
    start, stop, p, u_peak, top = row_span(batch, splat, row)
    step, red, green, blue = step_and_color(batch, splat)
    offset = start + lane_indices()
    while start < stop:
        u = u_peak + step * offset
        alpha = exp2(top - u * u)
        alpha = select(alpha < ALPHA_LIMIT, alpha, ALPHA_LIMIT)
        alpha = select(offset < stop, alpha, ZERO)
        before = load(state, p)
        after = before * (ONE - alpha)
        taken = after > TRANSMITTANCE_LIMIT
        weight = select(taken, alpha * before, ZERO)
        store(state, p, select(taken, after, select(before < ZERO, before, ZERO - before)))
        store(state, p + _R, load(state, p + _R) + weight * red)
        store(state, p + _G, load(state, p + _G) + weight * green)
        store(state, p + _B, load(state, p + _B) + weight * blue)
        if is_part:
            store(state, p + _PART_R, load(state, p + _PART_R) + weight * color[0])
            store(state, p + _PART_G, load(state, p + _PART_G) + weight * color[1])
            store(state, p + _PART_B, load(state, p + _PART_B) + weight * color[2])
            store(state, p + _SHARE, load(state, p + _SHARE) + weight)
        p += np.uint64(WIDTH)
        offset += EIGHT
        start += EIGHT


@kernel(fast=True)
def _blend_tile(
    state: Array, x: int, y: int, members: Array, splats: Splats, bounds: Array, batch: Array, is_part: Array
) -> None:
    """Blend a tile. state: initialized here, [PLANES·PLANE] float32; others: see `find_spans`"""
    plane = np.int64(PLANE)
    state[:plane] = ONE
    state[plane:] = ZERO
    for begin in range(0, members.size, BATCH):
        end = min(begin + BATCH, members.size)
        find_spans(members, begin, end, splats, x, y, bounds, batch)
        for index in range(begin, end):
            splat = np.uint64(index - begin) * SPLAT
            s = members[index]
            for line in range(np.int32(batch[splat + FIRST]), np.int32(batch[splat + END])):
                _blend_row(state, batch, splat, np.uint64(line), is_part[s], splats.colors[s])
        if not skip_done_rows(state, bounds):
            break


@kernel(cache=True)
def blend_part(
    begin: int, end: int, scratch: TileScratch, splats: Splats, lists: TileLists, camera: Pinhole,
    background: Array, is_part: Array, out: PartBuffers,
) -> None:  # fmt: skip
    """Blend tiles begin … end − 1 into the picture and the part.

    Args:
        background: rgb behind the picture; black is behind the part. [3] float32
        is_part: the Gaussians of the part. [N] bool
    """
    state, batch, bounds = scratch
    for tile in range(begin, end):
        x, y = tile_corner(camera, tile)
        tile_bounds(camera, x, y, bounds)
        members = lists.members[lists.starts[tile] : lists.starts[tile + 1]]
        _blend_tile(state, x, y, members, splats, bounds, batch, is_part)
        tile_bounds(camera, x, y, bounds)  # blending narrowed them
        left = np.uint64(x + bounds[0] - camera.window[0])
        for row in range(np.uint64(bounds[1]), np.uint64(bounds[3])):
            i = np.uint64(y - camera.window[1]) + row
            p = row * np.uint64(TILE_W) + np.uint64(bounds[0])
            for k in range(np.uint64(bounds[2] - bounds[0])):
                through = abs(state[p + k])
                out.image[i, left + k, 0] = state[p + _R + k] + through * background[0]
                out.image[i, left + k, 1] = state[p + _G + k] + through * background[1]
                out.image[i, left + k, 2] = state[p + _B + k] + through * background[2]
                out.share[i, left + k] = state[p + _SHARE + k]
                out.part[i, left + k, 0] = state[p + _PART_R + k]
                out.part[i, left + k, 1] = state[p + _PART_G + k]
                out.part[i, left + k, 2] = state[p + _PART_B + k]
