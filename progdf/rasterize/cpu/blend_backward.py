"""Kernel: gradients of the blending, back to front, into one row per (splat, tile) intersection.

Each row holds nine sums over the tile's pixels: the color's gradient (3), and for g = alpha · dL/dalpha the
moments Σg, Σg·u, Σg·v, Σg·u², Σg·uv, Σg·v². In the whitened coordinates u, v they stay of the size of the
result however thin the Gaussian is; in pixels they would cancel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import spans
from .bin import TILE_W, TileLists
from .blend import Picture
from .jit import Number, kernel
from .project import Pinhole, Splats
from .simd import WIDTH, broadcast, lane_indices, lane_sum, lane_sums, load, select, store

Array = NDArray[Any]

SUMS = 9
"""Numbers of one intersection's row."""

_ZERO: Number = np.float32(0.0)
_ONE: Number = np.float32(1.0)
# planes of the state: transmittance after the current splat; what lies behind it, times the gradient; the
# image's gradient (3); place of the last contributor
_BEHIND, _G0, _G1 = spans.PLANE, spans.PLANE * np.uint64(2), spans.PLANE * np.uint64(3)
_G2, _LAST = spans.PLANE * np.uint64(4), spans.PLANE * np.uint64(5)


@kernel(fast=True, inline=True)
def _blend_splat_backward(
    state: Array, batch: Array, splat: Number, place: Number, sums: Array, slot: Number
) -> None:
    """Take one splat off a tile's state and write its row of `sums`; `splat` is where its spans begin."""
    step, red, green, blue = spans.step_and_color(batch, splat)
    s_r = s_g = s_b = s_0 = s_u = s_v = s_uu = s_uv = s_vv = broadcast(_ZERO)
    for line in range(np.int32(batch[splat + spans.FIRST]), np.int32(batch[splat + spans.END])):
        row = np.uint64(line)
        start, stop, p, u_peak, top = spans.row_span(batch, splat, row)
        v = batch[splat + spans.V + row]
        offset = start + lane_indices()
        while start < stop:
            u = u_peak + step * offset
            covered = (offset < stop) & (place <= load(state, p + _LAST))
            raw = select(covered, spans.exp2(top - u * u), _ZERO)
            alpha = select(raw < spans.MOST, raw, spans.MOST)
            inverse = spans.ONE / (spans.ONE - alpha)
            before = load(state, p) * inverse
            g0, g1, g2 = load(state, p + _G0), load(state, p + _G1), load(state, p + _G2)
            shown = red * g0 + green * g1 + blue * g2
            behind = load(state, p + _BEHIND)
            weight = alpha * before
            g = alpha * (before * shown - behind * inverse)
            g = select(raw <= spans.MOST, g, _ZERO)
            store(state, p, before)
            store(state, p + _BEHIND, behind + weight * shown)
            s_r += weight * g0
            s_g += weight * g1
            s_b += weight * g2
            g_u, g_v = g * u, g * v
            s_0 += g
            s_u += g_u
            s_v += g_v
            s_uu += g_u * u
            s_uv += g_u * v
            s_vv += g_v * v
            p += np.uint64(WIDTH)
            offset += spans.EIGHT
            start += spans.EIGHT
    at = np.uint64(slot) * np.uint64(SUMS)
    store(sums, at, lane_sums(s_r, s_g, s_b, s_0, s_u, s_v, s_uu, s_uv))
    sums[slot, 8] = lane_sum(s_vv)


@kernel(fast=True, inline=True)
def _restore_behind(state: Array, batch: Array, splat: Number, place: Number) -> None:
    """As `_blend_splat_backward` for a splat whose own gradient nobody wants."""
    step, red, green, blue = spans.step_and_color(batch, splat)
    for line in range(np.int32(batch[splat + spans.FIRST]), np.int32(batch[splat + spans.END])):
        row = np.uint64(line)
        start, stop, p, u_peak, top = spans.row_span(batch, splat, row)
        offset = start + lane_indices()
        while start < stop:
            u = u_peak + step * offset
            covered = (offset < stop) & (place <= load(state, p + _LAST))
            alpha = select(covered, spans.exp2(top - u * u), _ZERO)
            alpha = select(alpha < spans.MOST, alpha, spans.MOST)
            before = load(state, p) / (spans.ONE - alpha)
            shown = red * load(state, p + _G0) + green * load(state, p + _G1) + blue * load(state, p + _G2)
            store(state, p, before)
            store(state, p + _BEHIND, load(state, p + _BEHIND) + alpha * before * shown)
            p += np.uint64(WIDTH)
            offset += spans.EIGHT
            start += spans.EIGHT


@kernel(fast=True)
def _blend_tile_backward(
    state: Array, x: int, y: int, members: Array, slots: Array, splats: Splats, bounds: Array, batch: Array,
    sums: Array, wanted: Array,
) -> None:  # fmt: skip
    """Take the splats off a tile, last contributor first; state: six planes, the rest as in `find_spans`."""
    plane = np.int64(spans.PLANE)
    deepest: Number = -_ONE
    for p in range(5 * plane, 6 * plane):
        deepest = max(deepest, state[p])
    drawn: Number = np.int64(deepest) + 1
    for place in range(drawn, members.size):
        for k in range(SUMS):
            sums[slots[place], k] = _ZERO
    for group in range((drawn + spans.BATCH - 1) // spans.BATCH - 1, -1, -1):
        begin: Number = group * spans.BATCH
        end: Number = min(begin + spans.BATCH, drawn)
        spans.find_spans(members, begin, end, splats, x, y, bounds, batch)
        for place in range(end - 1, begin - 1, -1):
            splat = np.uint64(place - begin) * spans.SPLAT
            if wanted.size == 0 or wanted[members[place]]:
                _blend_splat_backward(state, batch, splat, np.float32(place), sums, slots[place])
            else:
                _restore_behind(state, batch, splat, np.float32(place))


@kernel(cache=True)
def blend_backward(
    begin: int, end: int, scratch: spans.TileScratch, splats: Splats, lists: TileLists, camera: Pinhole,
    background: Array, out: Picture, gradients: Picture, wanted: Array, sums: Array,
) -> None:  # fmt: skip
    """Gradients of `blend`, which has the same first arguments.

    Args:
        out: what `blend` made; the image is not read
        gradients: of the loss to the image and the transmittance; the rest is not read
        wanted: rows whose gradients are wanted; [0]: all. [N] bool
        sums: out, a row for each slot; not set where nobody wants it. [I,9] float32
    """
    plane = np.int64(spans.PLANE)
    state, batch, bounds = scratch
    by_image, by_transmittance = gradients.image, gradients.transmittance
    for tile in range(begin, end):
        x, y = spans.tile_corner(camera, tile)
        state[:plane] = _ONE
        state[plane : 5 * plane] = _ZERO
        state[5 * plane :] = -_ONE
        spans.tile_bounds(camera, x, y, bounds)
        left, width = np.uint64(x + bounds[0] - camera.window[0]), np.uint64(bounds[2] - bounds[0])
        for row in range(np.uint64(bounds[1]), np.uint64(bounds[3])):
            i = np.uint64(y - camera.window[1]) + row
            p = row * np.uint64(TILE_W) + np.uint64(bounds[0])
            for k in range(width):
                state[p + _G0 + k] = by_image[i, left + k, 0]
                state[p + _G1 + k] = by_image[i, left + k, 1]
                state[p + _G2 + k] = by_image[i, left + k, 2]
            for k in range(width):
                state[p + k] = out.transmittance[i, left + k]
                state[p + _LAST + k] = out.last[i, left + k]
            for k in range(width):
                behind = state[p + _G0 + k] * background[0] + state[p + _G1 + k] * background[1]
                behind += state[p + _G2 + k] * background[2] + by_transmittance[i, left + k]
                state[p + _BEHIND + k] = state[p + k] * behind
        listed = slice(lists.starts[tile], lists.starts[tile + 1])
        _blend_tile_backward(
            state, x, y, lists.members[listed], lists.slots[listed], splats, bounds, batch, sums, wanted
        )
