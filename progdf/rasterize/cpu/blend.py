"""Kernels: blend the splats of each tile front to back, and compute the gradients back to front.

The support of a splat is computed first, as one span of pixels per row. The loops over pixels then run in
plain groups of eight. The backward pass writes one row of sums for each (splat, tile) intersection: the
color's gradient (3), and for g = alpha · dL/dalpha the moments Σg, Σg·u, Σg·v, Σg·u², Σg·uv, Σg·v². In the
whitened coordinates u, v these have the magnitude of the result however thin the Gaussian is; in pixels they
would cancel. The last kernels compute the blending weights w = αT of the Gaussians, as sums or as lists.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.engines import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

from .forward import (
    EXTENT_Y,
    INV_L11,
    L11,
    L22,
    MX,
    MY,
    R2,
    SLOPE,
    TILE_H,
    TILE_W,
    Pinhole,
    Splats,
    TileLists,
)  # fmt: skip
from .jit import (
    WIDTH,
    Number,
    Vector,
    broadcast,
    kernel,
    lane_indices,
    lane_sum,
    lane_sums,
    ldexp,
    load,
    prefetch,
    select,
    store,
    truncate,
)  # fmt: skip

Array = NDArray[Any]

SUMS = 9
"""Length of one intersection's row in the backward pass."""

PLANE = np.uint64(TILE_W * TILE_H + WIDTH)
"""Pixels per plane. The state of a tile is a number of float32 planes of this size in one buffer.

Pixels are processed in groups of eight, from the first pixel of a row that a splat covers. The surplus is
masked; in the last row of a tile it falls into padding.
"""

LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)

# 2^x on [-1, 0], exact at 0, largest relative error 2.0e-9 before rounding. By reweighted least squares.
_E1, _E2, _E3, _E4, _E5, _E6 = map(np.float32, (
    0.6931470643273044, 0.240224367820186, 0.05549075707783424, 0.009579179674631904, 0.0012747482964304813,
    0.00010902322854050052,
))  # fmt: skip

BATCH = 32
"""Splats whose spans are computed at once.

The pixel loops then branch on values that are known long before.
"""

BEGIN, START, STOP, U_PEAK, V, TOP = (np.uint64(TILE_H * field) for field in range(6))
"""Fields of a splat's spans, one number per row of the tile.

- BEGIN: first column, from the tile's left edge
- START, STOP: first column and one past the last, relative to the column nearest to the row's peak. The span
  is empty unless STOP is greater than START
- U_PEAK: u at that column, so that u = u_peak + l11 · (column − peak)
- V: v
- TOP: log2 of alpha where u is 0
"""

FIRST, END, STEP, RED, GREEN, BLUE = (np.uint64(6 * TILE_H + k) for k in range(6))
"""Fields of one number per splat: first row and one past the last, from the tile's top; l11; color."""

SPLAT = np.uint64(64)
"""Length of one splat's spans in the batch, float32 numbers."""

ALPHA_LIMIT: Number = np.float32(ALPHA_MAX)
TRANSMITTANCE_LIMIT: Number = np.float32(TRANSMITTANCE_MIN)
ZERO: Number = np.float32(0.0)
ONE: Number = np.float32(1.0)
EIGHT: Number = np.float32(WIDTH)
# Planes of the forward pass: transmittance (negative: the pixel is done), rgb, and the index in the tile's
# list of the last contributor (-1: none). float32 holds the index exactly up to 2^24.
_R, _G, _B, _LAST = (PLANE * np.uint64(k) for k in (1, 2, 3, 4))
# Planes of the backward pass: transmittance after the current splat; color behind it times the gradient; the
# image's gradient (3); index of the last contributor.
_BEHIND, _G0, _G1, _G2, _DEEPEST = (PLANE * np.uint64(k) for k in (1, 2, 3, 4, 5))


class TileScratch(NamedTuple):
    """Scratch arrays of one thread, reused for every tile."""

    state: Array  # planes of pixels; each kernel defines their meaning. float32
    batch: Array  # spans of a batch of splats. float32
    bounds: Array  # left, top, right, bottom of the drawn part of a tile, from its first pixel. [4] int64


def new_scratch() -> TileScratch:
    """Allocate eight planes and a batch."""
    state = np.empty(8 * int(PLANE), np.float32)
    batch = np.empty(BATCH * int(SPLAT), np.float32)
    return TileScratch(state, batch, np.empty(4, np.int64))


@kernel(fast=True, inline=True)
def exp2(x: Vector) -> Vector:
    """Return 2^x for -126 ≤ x ≤ 0. Lanes outside this range are undefined."""
    n = truncate(x)
    f = x - n
    p = _E4 + f * (_E5 + f * _E6)
    p = ONE + f * (_E1 + f * (_E2 + f * (_E3 + f * p)))
    return ldexp(p, n)


@kernel(inline=True)
def tile_corner(camera: Pinhole, tile: int) -> tuple[int, int]:
    """Return a tile's first pixel in the full image."""
    x = (camera.grid[0] + tile % camera.grid[2]) * TILE_W
    return x, (camera.grid[1] + tile // camera.grid[2]) * TILE_H


@kernel(inline=True)
def tile_bounds(camera: Pinhole, x: int, y: int, bounds: Array) -> None:
    """Compute left, top, right, bottom of a tile's part in the window, relative to its first pixel (x, y)."""
    bounds[0], bounds[1] = max(0, camera.window[0] - x), max(0, camera.window[1] - y)
    bounds[2], bounds[3] = min(TILE_W, camera.window[2] - x), min(TILE_H, camera.window[3] - y)


@kernel(fast=True, inline=True)
def find_spans(
    members: Array, begin: Number, end: Number, splats: Splats, x: int, y: int, bounds: Array, batch: Array
) -> None:
    """Compute the spans in which splats of a tile have alpha ≥ 1/255, row by row, decided in float64.

    Args:
        members: rows of the tile's splats. [I] int32
        begin, end: range of members, at most BATCH
        splats: see `project`
        x, y: the tile's first pixel in the full image
        bounds: left, top, right, bottom of the pixels to consider, from (x, y). [4] int64
        batch: out
    """
    low = np.float64(bounds[0])
    high = np.float64(bounds[2])
    shapes = splats.shapes
    colors = splats.colors
    for index in range(begin, end):
        prefetch(shapes, members[index])
        prefetch(colors, members[index])
    for index in range(begin, end):
        at = np.uint64(index - begin) * SPLAT
        s = members[index]
        mx = shapes[s, MX] - x - 0.5
        my = shapes[s, MY] - y - 0.5
        slope = shapes[s, SLOPE]
        l11 = shapes[s, L11]
        inv_l11 = shapes[s, INV_L11]
        l22 = shapes[s, L22]
        r2 = shapes[s, R2]
        for row in range(np.uint64(TILE_H)):
            dy = np.float64(np.int32(row)) - my
            v = l22 * dy
            remaining = r2 - v * v
            center = mx - slope * dy
            half = np.sqrt(max(remaining, 0.0)) * inv_l11
            start = max(np.ceil(center - half), low)
            stop = min(np.floor(center + half) + 1.0, high)
            # Columns relative to the peak keep u = l11·(column − center) free of cancellation in float32. Far
            # peaks (needles, giant Gaussians) occur where l11 is small.
            peak = min(max(np.floor(center + 0.5), -65536.0), 65536.0)
            start = min(start, high)
            stop = max(stop, low) if remaining >= 0.0 else low
            batch[at + BEGIN + row] = start
            batch[at + START + row] = start - peak
            batch[at + STOP + row] = stop - peak
            batch[at + U_PEAK + row] = l11 * (peak - center)
            batch[at + V + row] = v
            batch[at + TOP + row] = remaining + LOG2_ALPHA_MIN
        batch[at + FIRST] = max(np.ceil(my - shapes[s, EXTENT_Y]), np.float64(bounds[1]))
        batch[at + END] = min(np.floor(my + shapes[s, EXTENT_Y]) + 1.0, np.float64(bounds[3]))
        batch[at + STEP] = l11
        batch[at + RED], batch[at + GREEN], batch[at + BLUE] = colors[s, 0], colors[s, 1], colors[s, 2]


@kernel(fast=True, inline=True)
def row_span(batch: Array, splat: Number, row: Number) -> tuple[Number, Number, Number, Number, Number]:
    """Return start and stop of a splat's row, from its peak; its index in a tile's plane; u_peak; top."""
    begin = np.uint64(np.int32(batch[splat + BEGIN + row]))
    return (
        batch[splat + START + row], batch[splat + STOP + row], row * np.uint64(TILE_W) + begin,
        batch[splat + U_PEAK + row], batch[splat + TOP + row],
    )  # fmt: skip


@kernel(fast=True, inline=True)
def step_and_color(batch: Array, splat: Number) -> tuple[Number, Number, Number, Number]:
    """Return l11, red, green and blue."""
    return batch[splat + STEP], batch[splat + RED], batch[splat + GREEN], batch[splat + BLUE]


class RenderBuffers(NamedTuple):
    """Output buffers of a rendered window of the picture."""

    image: Array  # [h,w,3] float32
    transmittance: Array  # [h,w] float32
    # index of each pixel's last contributor in the tile's list, -1 if none. None if no gradient is needed:
    # the picture then takes a third less time. [h,w] float32
    last: Array | None


@kernel(fast=True, inline=True)
def _blend_row(
    state: Array, batch: Array, splat: Number, row: Number, index: Number, last: Array | None
) -> None:
    """Blend one row of a splat into a tile's state. splat: start of its spans in `batch`"""
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
        if last is not None:  # numba compiles this branch only if the type of `last` allows it
            store(state, p + _LAST, select(weight > ZERO, index, load(state, p + _LAST)))
        p += np.uint64(WIDTH)
        offset += EIGHT
        start += EIGHT


@kernel(fast=True, inline=True)
def skip_done_rows(state: Array, bounds: Array) -> Number:
    """Remove finished rows from the top and bottom of `bounds`. Return true if any row is left."""
    while bounds[1] < bounds[3] and _is_done(state, bounds[1], bounds):
        bounds[1] += 1
    while bounds[1] < bounds[3] and _is_done(state, bounds[3] - 1, bounds):
        bounds[3] -= 1
    return bounds[1] < bounds[3]


@kernel(fast=True, inline=True)
def _is_done(state: Array, row: int, bounds: Array) -> Number:
    highest = ZERO
    for j in range(np.uint64(bounds[0]), np.uint64(bounds[2])):
        highest = max(highest, state[np.uint64(row) * np.uint64(TILE_W) + j])
    return highest <= ZERO


@kernel(fast=True)
def _blend_tile(
    state: Array, x: int, y: int, members: Array, splats: Splats, bounds: Array, batch: Array,
    last: Array | None,
) -> None:  # fmt: skip
    """Blend a tile.

    state: initialized here, [5·PLANE] float32; last: see `RenderBuffers`; others: see `find_spans`
    """
    plane = np.int64(PLANE)
    state[:plane] = ONE
    state[plane : 4 * plane] = ZERO
    state[4 * plane : 5 * plane] = -ONE
    for begin in range(0, members.size, BATCH):
        end = min(begin + BATCH, members.size)
        find_spans(members, begin, end, splats, x, y, bounds, batch)
        for index in range(begin, end):
            splat = np.uint64(index - begin) * SPLAT
            for line in range(np.int32(batch[splat + FIRST]), np.int32(batch[splat + END])):
                _blend_row(state, batch, splat, np.uint64(line), np.float32(index), last)
        if not skip_done_rows(state, bounds):
            break


@kernel(cache=True)
def blend(
    begin: int, end: int, scratch: TileScratch, splats: Splats, lists: TileLists, camera: Pinhole,
    background: Array, out: RenderBuffers, last: Array | None,
) -> None:  # fmt: skip
    """Blend tiles begin … end − 1 into the picture. background: [3] float32; last: the picture's"""
    state, batch, bounds = scratch
    for tile in range(begin, end):
        x, y = tile_corner(camera, tile)
        tile_bounds(camera, x, y, bounds)
        members = lists.members[lists.starts[tile] : lists.starts[tile + 1]]
        _blend_tile(state, x, y, members, splats, bounds, batch, last)
        tile_bounds(camera, x, y, bounds)  # blending narrowed them
        left = np.uint64(x + bounds[0] - camera.window[0])
        width = np.uint64(bounds[2] - bounds[0])
        for row in range(np.uint64(bounds[1]), np.uint64(bounds[3])):
            i = np.uint64(y - camera.window[1]) + row
            p = row * np.uint64(TILE_W) + np.uint64(bounds[0])
            for k in range(width):
                out.transmittance[i, left + k] = abs(state[p + k])
            if last is not None:
                for k in range(width):
                    last[i, left + k] = state[p + _LAST + k]
            for k in range(width):
                through = abs(state[p + k])
                out.image[i, left + k, 0] = state[p + _R + k] + through * background[0]
                out.image[i, left + k, 1] = state[p + _G + k] + through * background[1]
                out.image[i, left + k, 2] = state[p + _B + k] + through * background[2]


@kernel(fast=True, inline=True)
def _blend_splat_backward(
    state: Array, batch: Array, splat: Number, index: Number, sums: Array, slot: Number
) -> None:
    """Remove one splat from a tile's state and write its row of `sums`.

    splat: start of its spans in `batch`
    """
    step, red, green, blue = step_and_color(batch, splat)
    s_r = s_g = s_b = s_0 = s_u = s_v = s_uu = s_uv = s_vv = broadcast(ZERO)
    for line in range(np.int32(batch[splat + FIRST]), np.int32(batch[splat + END])):
        row = np.uint64(line)
        start, stop, p, u_peak, top = row_span(batch, splat, row)
        v = batch[splat + V + row]
        offset = start + lane_indices()
        while start < stop:
            u = u_peak + step * offset
            covered = (offset < stop) & (index <= load(state, p + _DEEPEST))
            raw = select(covered, exp2(top - u * u), ZERO)
            alpha = select(raw < ALPHA_LIMIT, raw, ALPHA_LIMIT)
            inverse = ONE / (ONE - alpha)
            before = load(state, p) * inverse
            g0 = load(state, p + _G0)
            g1 = load(state, p + _G1)
            g2 = load(state, p + _G2)
            front = red * g0 + green * g1 + blue * g2
            behind = load(state, p + _BEHIND)
            weight = alpha * before
            g = alpha * (before * front - behind * inverse)
            g = select(raw <= ALPHA_LIMIT, g, ZERO)
            store(state, p, before)
            store(state, p + _BEHIND, behind + weight * front)
            s_r += weight * g0
            s_g += weight * g1
            s_b += weight * g2
            g_u = g * u
            g_v = g * v
            s_0 += g
            s_u += g_u
            s_v += g_v
            s_uu += g_u * u
            s_uv += g_u * v
            s_vv += g_v * v
            p += np.uint64(WIDTH)
            offset += EIGHT
            start += EIGHT
    at = np.uint64(slot) * np.uint64(SUMS)
    store(sums, at, lane_sums(s_r, s_g, s_b, s_0, s_u, s_v, s_uu, s_uv))
    sums[slot, 8] = lane_sum(s_vv)


@kernel(fast=True, inline=True)
def _restore_behind(state: Array, batch: Array, splat: Number, index: Number) -> None:
    """Remove a splat that gets no gradient from a tile's state. Arguments as in `_blend_splat_backward`."""
    step, red, green, blue = step_and_color(batch, splat)
    for line in range(np.int32(batch[splat + FIRST]), np.int32(batch[splat + END])):
        row = np.uint64(line)
        start, stop, p, u_peak, top = row_span(batch, splat, row)
        offset = start + lane_indices()
        while start < stop:
            u = u_peak + step * offset
            covered = (offset < stop) & (index <= load(state, p + _DEEPEST))
            alpha = select(covered, exp2(top - u * u), ZERO)
            alpha = select(alpha < ALPHA_LIMIT, alpha, ALPHA_LIMIT)
            before = load(state, p) / (ONE - alpha)
            front = red * load(state, p + _G0) + green * load(state, p + _G1) + blue * load(state, p + _G2)
            store(state, p, before)
            store(state, p + _BEHIND, load(state, p + _BEHIND) + alpha * before * front)
            p += np.uint64(WIDTH)
            offset += EIGHT
            start += EIGHT


@kernel(fast=True)
def _blend_tile_backward(
    state: Array, x: int, y: int, members: Array, slots: Array, splats: Splats, bounds: Array, batch: Array,
    sums: Array, grad_mask: Array,
) -> None:  # fmt: skip
    """Remove the splats of a tile, last contributor first. state: six planes; others: see `find_spans`"""
    plane = np.int64(PLANE)
    deepest: Number = -ONE
    for p in range(5 * plane, 6 * plane):
        deepest = max(deepest, state[p])
    drawn: Number = np.int64(deepest) + 1
    for index in range(drawn, members.size):
        for k in range(SUMS):
            sums[slots[index], k] = ZERO
    for group in range((drawn + BATCH - 1) // BATCH - 1, -1, -1):
        begin: Number = group * BATCH
        end: Number = min(begin + BATCH, drawn)
        find_spans(members, begin, end, splats, x, y, bounds, batch)
        for index in range(end - 1, begin - 1, -1):
            splat = np.uint64(index - begin) * SPLAT
            if grad_mask.size == 0 or grad_mask[members[index]]:
                _blend_splat_backward(state, batch, splat, np.float32(index), sums, slots[index])
            else:
                _restore_behind(state, batch, splat, np.float32(index))


@kernel(cache=True)
def blend_backward(
    begin: int, end: int, scratch: TileScratch, splats: Splats, lists: TileLists, camera: Pinhole,
    background: Array, out: RenderBuffers, gradients: RenderBuffers, grad_mask: Array, sums: Array,
) -> None:  # fmt: skip
    """Compute the gradients of `blend`, which has the same first arguments.

    Args:
        out: result of `blend`; the image is not read
        gradients: gradients of the loss to the image and to the transmittance; its `last` is not read
        grad_mask: rows that get gradients; [0] selects all. [N] bool
        sums: out, one row per slot; not set for rows outside `grad_mask`. [I,9] float32
    """
    plane = np.int64(PLANE)
    state, batch, bounds = scratch
    by_image = gradients.image
    by_transmittance = gradients.transmittance
    for tile in range(begin, end):
        x, y = tile_corner(camera, tile)
        state[:plane] = ONE
        state[plane : 5 * plane] = ZERO
        state[5 * plane :] = -ONE
        tile_bounds(camera, x, y, bounds)
        left = np.uint64(x + bounds[0] - camera.window[0])
        width = np.uint64(bounds[2] - bounds[0])
        for row in range(np.uint64(bounds[1]), np.uint64(bounds[3])):
            i = np.uint64(y - camera.window[1]) + row
            p = row * np.uint64(TILE_W) + np.uint64(bounds[0])
            for k in range(width):
                state[p + _G0 + k] = by_image[i, left + k, 0]
                state[p + _G1 + k] = by_image[i, left + k, 1]
                state[p + _G2 + k] = by_image[i, left + k, 2]
            for k in range(width):
                state[p + k] = out.transmittance[i, left + k]
                state[p + _DEEPEST + k] = out.last[i, left + k]  # type: ignore[index]
            for k in range(width):
                behind = state[p + _G0 + k] * background[0] + state[p + _G1 + k] * background[1]
                behind += state[p + _G2 + k] * background[2] + by_transmittance[i, left + k]
                state[p + _BEHIND + k] = state[p + k] * behind
        listed = slice(lists.starts[tile], lists.starts[tile + 1])
        _blend_tile_backward(
            state, x, y, lists.members[listed], lists.slots[listed], splats, bounds, batch, sums, grad_mask
        )


WEIGHT_SUMS = 4
"""Length of one intersection's row in `accumulate_weights`: Σ w·m, Σ m, Σ w, n."""

_LOG2_ALPHA_MIN: Number = np.float32(LOG2_ALPHA_MIN)


@kernel(fast=True, inline=True)
def _add_weights(state: Array, batch: Array, splat: Number, out: Array) -> None:
    """Blend one splat's transmittance into a tile and add its weights to `out`.

    Args:
        state: transmittance (negative: the pixel is done) and mask. [2·PLANE] float32
        batch, splat: spans of a batch, and the start of the splat's spans
        out: [4] float64
    """
    inside = within = weights = pixels = broadcast(ZERO)
    step = batch[splat + STEP]
    for line in range(np.int32(batch[splat + FIRST]), np.int32(batch[splat + END])):
        row = np.uint64(line)
        start, stop, p, u_peak, top = row_span(batch, splat, row)
        offset = start + lane_indices()
        while start < stop:
            u = u_peak + step * offset
            covered = offset < stop
            alpha = select(covered, exp2(top - u * u), ZERO)
            alpha = select(alpha < ALPHA_LIMIT, alpha, ALPHA_LIMIT)
            before = load(state, p)
            mask = load(state, p + PLANE)
            after = before * (ONE - alpha)
            taken = covered & (after > TRANSMITTANCE_LIMIT)
            weight = select(taken, alpha * before, ZERO)
            done = select(before < ZERO, before, ZERO - before)
            store(state, p, select(covered, select(taken, after, done), before))
            inside += weight * mask
            within += select(taken, mask, ZERO)
            weights += weight
            pixels += select(taken, ONE, ZERO)
            p += np.uint64(WIDTH)
            offset += EIGHT
            start += EIGHT
    out[0] += lane_sum(inside)
    out[1] += lane_sum(within)
    out[2] += lane_sum(weights)
    out[3] += lane_sum(pixels)


@kernel(cache=True)
def accumulate_weights(
    begin: int, end: int, scratch: TileScratch, splats: Splats, lists: TileLists, camera: Pinhole,
    mask: Array, sums: Array,
) -> None:  # fmt: skip
    """Sum the weights of every (splat, tile) intersection in tiles begin … end − 1.

    Args:
        mask: mask of the full image. [H,W] float32
        sums: out, one row per slot, zero on entry. [I,4] float64
    """
    plane = np.int64(PLANE)
    state, batch, bounds = scratch
    for tile in range(begin, end):
        x, y = tile_corner(camera, tile)
        state[: 2 * plane] = ONE
        tile_bounds(camera, x, y, bounds)
        for row in range(bounds[1], bounds[3]):
            for column in range(bounds[0], bounds[2]):
                state[plane + row * TILE_W + column] = mask[y + row, x + column]
        for first in range(lists.starts[tile], lists.starts[tile + 1], BATCH):
            last = min(first + BATCH, lists.starts[tile + 1])
            find_spans(lists.members, first, last, splats, x, y, bounds, batch)
            for index in range(first, last):
                _add_weights(state, batch, np.uint64(index - first) * SPLAT, sums[lists.slots[index]])
            if not skip_done_rows(state, bounds):
                break
