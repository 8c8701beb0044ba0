"""What the pixel kernels share: exp2, the support of a splat in one row of a tile, the layout of a tile's state."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from progdf.rasterize.binning import TILE_H, TILE_W
from progdf.rasterize.conventions import ALPHA_MIN
from progdf.rasterize.jit import kernel
from progdf.rasterize.projection import INV_L11, L11, L22, MX, MY, R2, SLOPE

Array = NDArray[Any]

LANES = np.uint64(8)
"""Pixels are worked on in aligned groups of this many."""

PLANE = np.uint64(TILE_W * TILE_H)
"""A tile's state is planes of this many float32 in one buffer, so that LLVM can tell that they do not overlap."""

LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)

# 2^x on [-1, 0], exact at 0, largest relative error 2.0e-9 before rounding (fitted by reweighted least squares)
_E1, _E2, _E3 = np.float32(0.6931470643273044), np.float32(0.240224367820186), np.float32(0.05549075707783424)
_E4, _E5, _E6 = (
    np.float32(0.009579179674631904),
    np.float32(0.0012747482964304813),
    np.float32(0.00010902322854050052),
)
_ONE = np.float32(1.0)


@intrinsic
def _as_float(typingctx: Any, bits: Any) -> Any:
    """Bits of an int32 as a float32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


@intrinsic
def _as_int(typingctx: Any, number: Any) -> Any:
    """Bits of a float32 as an int32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(32))

    return types.int32(types.float32), generate


@kernel(fast=True, inline=True)
def exp2(x: float) -> float:
    """2^x for x ≤ 0, below -126 as at -126; branch-free, so that loops around it vectorise. float32"""
    x = max(x, np.float32(-126.0))
    whole = np.int32(x)
    f = x - np.float32(whole)
    p = _ONE + f * (_E1 + f * (_E2 + f * (_E3 + f * (_E4 + f * (_E5 + f * _E6)))))
    return _as_float(_as_int(p) + (whole << np.int32(23)))


START, STOP, PEAK, U_PEAK, V, TOP = (np.uint64(TILE_H * plane) for plane in range(6))
"""Planes of `find_rows`' result."""

ROW_NUMBERS = 6 * TILE_H
"""Length of `find_rows`' result."""


@kernel(fast=True, inline=True)
def find_rows(splat: Array, x: int, y: int, left: int, right: int, rows: Array) -> None:
    """Where a splat is at least 1/255 in each pixel row of a tile, decided in float64.

    Args:
        splat: [8] float64, see `projection`
        x, y: the tile's first pixel in the full image
        left, right: the columns of the tile to look at, from `x`
        rows: out, six planes of one number per row. START, STOP: first column of the support and one past its last,
            from `x`; none where STOP is not the greater. PEAK: the column nearest to the row's peak; U_PEAK: u
            there, so that u = u_peak + l11 · (column − peak). V: v. TOP: log2 of alpha where u is 0. [48] float32
    """
    low, high = np.float64(left), np.float64(right)
    mx, my, slope, l11 = splat[MX] - x - 0.5, splat[MY] - y - 0.5, splat[SLOPE], splat[L11]
    inv_l11, l22, r2 = splat[INV_L11], splat[L22], splat[R2]
    for row in range(np.uint64(TILE_H)):
        dy = np.float64(np.int32(row)) - my
        v = l22 * dy
        rest = r2 - v * v
        centre = mx - slope * dy
        half = np.sqrt(max(rest, 0.0)) * inv_l11
        start = max(np.ceil(centre - half), low)
        stop = min(np.floor(centre + half) + 1.0, high)
        # counting from the peak keeps u = l11·(column − centre) free of cancellation in float32; far peaks
        # (needles, giants) lie where l11 is small
        peak = min(max(np.floor(centre + 0.5), -65536.0), 65536.0)
        rows[START + row] = min(start, high)
        rows[STOP + row] = max(stop, low) if rest >= 0.0 else low
        rows[PEAK + row] = peak
        rows[U_PEAK + row] = l11 * (peak - centre)
        rows[V + row] = v
        rows[TOP + row] = rest + LOG2_ALPHA_MIN
