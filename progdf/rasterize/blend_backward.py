"""Kernel: gradients of the blending, back to front, into one row per (splat, tile) intersection.

Each row holds nine sums over the tile's pixels: the colour's gradient (3), and for g = alpha · dL/dalpha the
moments Σg, Σg·u, Σg·v, Σg·u², Σg·uv, Σg·v². In the whitened coordinates u, v they stay of the size of the
result however thin the Gaussian is; in pixels they would cancel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .binning import TILE_H, TILE_W
from .jit import Number, kernel
from .lanes import WIDTH, choose, count, load, spread, store, total, totals
from .pixels import (  # fmt: skip
    BATCH,
    BLUE,
    CARD,
    EIGHT,
    END,
    FIRST,
    GREEN,
    MOST,
    ONE,
    PLANE,
    RED,
    STEP,
    V,
    exp2,
    make_cards,
    new_cards,
    row_of,
    tile_bounds,
)
from .shares import pieces

Array = NDArray[Any]

SUMS = 9
"""Numbers of one intersection's row."""

_ZERO: Number = np.float32(0.0)
_ONE: Number = np.float32(1.0)
# planes of the state: transmittance after the splat at hand; what lies behind it, times the gradient; the
# image's gradient (3); place of the last contributor
_BEHIND, _G0, _G1 = PLANE, PLANE * np.uint64(2), PLANE * np.uint64(3)
_G2, _LAST = PLANE * np.uint64(4), PLANE * np.uint64(5)


@kernel(fast=True, inline=True)
def unblend_splat(state: Array, cards: Array, card: Number, place: Number, sums: Array, slot: Number) -> None:
    """Take one splat off a tile's state and write its row of `sums`; the rest as in `blend_row`."""
    red, green, blue, step = cards[card + RED], cards[card + GREEN], cards[card + BLUE], cards[card + STEP]
    s_r = s_g = s_b = s_0 = s_u = s_v = s_uu = s_uv = s_vv = spread(_ZERO)
    for line in range(np.int32(cards[card + FIRST]), np.int32(cards[card + END])):
        row = np.uint64(line)
        start, stop, p, u_peak, top = row_of(cards, card, row)
        v = cards[card + V + row]
        offset = start + count()
        while start < stop:
            u = u_peak + step * offset
            reached = (offset < stop) & (place <= load(state, p + _LAST))
            raw = choose(reached, exp2(top - u * u, cards), _ZERO)
            alpha = choose(raw < cards[MOST], raw, cards[MOST])
            inverse = cards[ONE] / (cards[ONE] - alpha)
            before = load(state, p) * inverse
            g0, g1, g2 = load(state, p + _G0), load(state, p + _G1), load(state, p + _G2)
            shown = red * g0 + green * g1 + blue * g2
            behind = load(state, p + _BEHIND)
            weight = alpha * before
            g = alpha * (before * shown - behind * inverse)
            g = choose(raw <= cards[MOST], g, _ZERO)
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
            offset += cards[EIGHT]
            start += cards[EIGHT]
    at = np.uint64(slot) * np.uint64(SUMS)
    store(sums, at, totals(s_r, s_g, s_b, s_0, s_u, s_v, s_uu, s_uv))
    sums[slot, 8] = total(s_vv)


@kernel(fast=True, inline=True)
def pass_splat(state: Array, cards: Array, card: Number, place: Number) -> None:
    """As `unblend_splat` for a splat whose own gradient nobody wants."""
    red, green, blue, step = cards[card + RED], cards[card + GREEN], cards[card + BLUE], cards[card + STEP]
    for line in range(np.int32(cards[card + FIRST]), np.int32(cards[card + END])):
        row = np.uint64(line)
        start, stop, p, u_peak, top = row_of(cards, card, row)
        offset = start + count()
        while start < stop:
            u = u_peak + step * offset
            reached = (offset < stop) & (place <= load(state, p + _LAST))
            alpha = choose(reached, exp2(top - u * u, cards), _ZERO)
            alpha = choose(alpha < cards[MOST], alpha, cards[MOST])
            before = load(state, p) / (cards[ONE] - alpha)
            shown = red * load(state, p + _G0) + green * load(state, p + _G1) + blue * load(state, p + _G2)
            store(state, p, before)
            store(state, p + _BEHIND, load(state, p + _BEHIND) + alpha * before * shown)
            p += np.uint64(WIDTH)
            offset += cards[EIGHT]
            start += cards[EIGHT]


@kernel(fast=True)
def unblend_tile(
    state: Array, x: int, y: int, members: Array, slots: Array, splats: Array, rgb: Array, bounds: Array,
    cards: Array, sums: Array, wanted: Array,
) -> None:  # fmt: skip
    """Take the splats off a tile, last contributor first; state is [6·PLANE], the rest as in `make_cards`."""
    plane = np.int64(PLANE)
    deepest: Number = -_ONE
    for p in range(5 * plane, 6 * plane):
        deepest = max(deepest, state[p])
    seen: Number = np.int64(deepest) + 1
    for place in range(seen, members.size):
        for k in range(SUMS):
            sums[slots[place], k] = _ZERO
    for batch in range((seen + BATCH - 1) // BATCH - 1, -1, -1):
        begin: Number = batch * BATCH
        end: Number = min(begin + BATCH, seen)
        make_cards(members, begin, end, splats, rgb, x, y, bounds, cards)
        for place in range(end - 1, begin - 1, -1):
            card = np.uint64(place - begin) * CARD
            if wanted.size == 0 or wanted[members[place]]:
                unblend_splat(state, cards, card, np.float32(place), sums, slots[place])
            else:
                pass_splat(state, cards, card, np.float32(place))


@kernel(allocates=True)
def unblend(
    splats: Array, rgb: Array, window: Array, grid: Array, tile_starts: Array, members: Array, slots: Array,
    background: Array, transmittance: Array, last: Array, grad_image: Array, grad_transmittance: Array,
    sums: Array, wanted: Array, seat: int, claims: Array, step: int,
) -> None:  # fmt: skip
    """Gradients of `blend`, which has the same arguments.

    Args:
        slots: row of `sums` that belongs to each entry of `members`. [I] int64
        grad_image, grad_transmittance: [h,w,3], [h,w] float32
        sums: out, one row per intersection; not set where nobody wants it. [I,9] float32
        wanted: splats whose gradients are wanted; [0]: all. [V] bool
        seat, claims, step: see `shares.pieces`
    """
    tiles = tile_starts.size - 1
    plane = np.int64(PLANE)
    state, cards = np.empty(6 * plane, np.float32), new_cards()
    bounds = np.empty(4, np.int64)
    for tile in pieces(claims, step, seat, tiles):
        x, y = (grid[0] + tile % grid[2]) * TILE_W, (grid[1] + tile // grid[2]) * TILE_H
        state[:plane] = _ONE
        state[plane : 5 * plane] = _ZERO
        state[5 * plane :] = -_ONE
        tile_bounds(x, y, window, bounds)
        left, width = np.uint64(x + bounds[0] - window[0]), np.uint64(bounds[2] - bounds[0])
        for row in range(np.uint64(bounds[1]), np.uint64(bounds[3])):
            i = np.uint64(y - window[1]) + row
            p = row * np.uint64(TILE_W) + np.uint64(bounds[0])
            for k in range(width):
                state[p + _G0 + k] = grad_image[i, left + k, 0]
                state[p + _G1 + k] = grad_image[i, left + k, 1]
                state[p + _G2 + k] = grad_image[i, left + k, 2]
            for k in range(width):
                state[p + k] = transmittance[i, left + k]
                state[p + _LAST + k] = last[i, left + k]
            for k in range(width):
                seen = state[p + _G0 + k] * background[0] + state[p + _G1 + k] * background[1]
                seen += state[p + _G2 + k] * background[2] + grad_transmittance[i, left + k]
                state[p + _BEHIND + k] = state[p + k] * seen
        listed = slice(tile_starts[tile], tile_starts[tile + 1])
        unblend_tile(state, x, y, members[listed], slots[listed], splats, rgb, bounds, cards, sums, wanted)
