"""What the pixel kernels share: exp2, the layout of a tile's state, the support of a splat row by row."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .binning import TILE_H, TILE_W
from .conventions import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from .jit import Number, kernel
from .lanes import WIDTH, Lanes, prefetch, times_power, whole
from .projection import EXTENT_Y, INV_L11, L11, L22, MX, MY, R2, SLOPE

Array = NDArray[Any]

PLANE = np.uint64(TILE_W * TILE_H + WIDTH)
"""A tile's state is planes of this many float32 in one buffer. Pixels are worked on in groups of eight, from
the first of a row that a splat touches; the surplus is masked, and in a tile's last row it is the padding of
the plane."""

LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)

# 2^x on [-1, 0], exact at 0, largest relative error 2.0e-9 before rounding (fitted by reweighted least
# squares)
_POLYNOMIAL = (
    0.6931470643273044, 0.240224367820186, 0.05549075707783424, 0.009579179674631904, 0.0012747482964304813,
    0.00010902322854050052,
)  # fmt: skip

BATCH = 32
"""Splats whose cards are made out at once: the pixel loops then branch on numbers that are long known."""

BEGIN, START, STOP, U_PEAK, V, TOP = (np.uint64(TILE_H * plane) for plane in range(6))
"""Where a card holds its rows: first column of the support from the tile's left edge; that and one past its
last from the column nearest to the row's peak (none where the second is not the greater); u at that column,
so that u = u_peak + l11 · (column − peak); v; log2 of alpha where u is 0."""

FIRST, END, STEP, RED, GREEN, BLUE = (np.uint64(6 * TILE_H + k) for k in range(6))
"""Where a card holds: first row of the support and one past its last, from the tile's top; l11; colour."""

CARD = np.uint64(64)
"""float32 numbers of a card."""

_CONSTANTS = BATCH * int(CARD)
MOST, LEAST, ONE, EIGHT, _E1, _E2, _E3, _E4, _E5, _E6 = (np.uint64(_CONSTANTS + k) for k in range(10))
"""Where the cards are followed by constants: ALPHA_MAX, TRANSMITTANCE_MIN, 1, 8, the polynomial. Known to the
compiler, they would be at a dozen far addresses, built anew for every row."""

_VALUES = np.array([ALPHA_MAX, TRANSMITTANCE_MIN, 1.0, WIDTH, *_POLYNOMIAL], np.float32)


@kernel(inline=True, allocates=True)
def new_cards() -> Array:
    """An empty batch of cards, with the constants. float32"""
    cards = np.empty(_CONSTANTS + _VALUES.size, np.float32)
    cards[_CONSTANTS:] = _VALUES
    return cards


@kernel(fast=True, inline=True)
def exp2(x: Lanes, cards: Array) -> Lanes:
    """2^x for -126 ≤ x ≤ 0; anything for other lanes."""
    n = whole(x)
    f = x - n
    p = cards[_E4] + f * (cards[_E5] + f * cards[_E6])
    p = cards[ONE] + f * (cards[_E1] + f * (cards[_E2] + f * (cards[_E3] + f * p)))
    return times_power(p, n)


@kernel(fast=True, inline=True)
def make_cards(
    members: Array, begin: Number, end: Number, splats: Array, rgb: Array, x: int, y: int, bounds: Array,
    cards: Array,
) -> None:  # fmt: skip
    """Where some splats of a tile are at least 1/255, row by row, decided in float64.

    Args:
        members: the tile's splats. [I] int32
        begin, end: which of them, at most BATCH
        splats: [V,8] float64, see `projection`
        rgb: [V,4] float32
        x, y: the tile's first pixel in the full image
        bounds: left, top, right, bottom of what to look at, from (x, y). [4] int64
        cards: as from `new_cards`; out
    """
    low, high = np.float64(bounds[0]), np.float64(bounds[2])
    for place in range(begin, end):
        prefetch(splats, members[place])
        prefetch(rgb, members[place])
    for place in range(begin, end):
        at = np.uint64(place - begin) * CARD
        s = members[place]
        mx, my = splats[s, MX] - x - 0.5, splats[s, MY] - y - 0.5
        slope, l11 = splats[s, SLOPE], splats[s, L11]
        inv_l11, l22, r2 = splats[s, INV_L11], splats[s, L22], splats[s, R2]
        for row in range(np.uint64(TILE_H)):
            dy = np.float64(np.int32(row)) - my
            v = l22 * dy
            rest = r2 - v * v
            centre = mx - slope * dy
            half = np.sqrt(max(rest, 0.0)) * inv_l11
            start = max(np.ceil(centre - half), low)
            stop = min(np.floor(centre + half) + 1.0, high)
            # counting from the peak keeps u = l11·(column − centre) free of cancellation in float32; far
            # peaks (needles, giants) lie where l11 is small
            peak = min(max(np.floor(centre + 0.5), -65536.0), 65536.0)
            start, stop = min(start, high), max(stop, low) if rest >= 0.0 else low
            cards[at + BEGIN + row] = start
            cards[at + START + row] = start - peak
            cards[at + STOP + row] = stop - peak
            cards[at + U_PEAK + row] = l11 * (peak - centre)
            cards[at + V + row] = v
            cards[at + TOP + row] = rest + LOG2_ALPHA_MIN
        cards[at + FIRST] = max(np.ceil(my - splats[s, EXTENT_Y]), np.float64(bounds[1]))
        cards[at + END] = min(np.floor(my + splats[s, EXTENT_Y]) + 1.0, np.float64(bounds[3]))
        cards[at + STEP] = l11
        cards[at + RED], cards[at + GREEN], cards[at + BLUE] = rgb[s, 0], rgb[s, 1], rgb[s, 2]


@kernel(fast=True, inline=True)
def row_of(cards: Array, card: Number, row: Number) -> tuple[Number, Number, Number, Number, Number]:
    """Where a row of a splat begins and ends, from its peak; its place in a tile's state; u_peak and top."""
    begin = np.uint64(np.int32(cards[card + BEGIN + row]))
    return (
        cards[card + START + row], cards[card + STOP + row], row * np.uint64(TILE_W) + begin,
        cards[card + U_PEAK + row], cards[card + TOP + row],
    )  # fmt: skip


@kernel(inline=True)
def tile_bounds(x: int, y: int, window: Array, bounds: Array) -> None:
    """left, top, right, bottom of a tile's part in the window, from the tile's first pixel (x, y)."""
    bounds[0], bounds[1] = max(0, window[0] - x), max(0, window[1] - y)
    bounds[2], bounds[3] = min(TILE_W, window[2] - x), min(TILE_H, window[3] - y)
