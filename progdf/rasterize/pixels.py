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


@kernel(inline=True)
def row_support(splat: Array, x: int, y: int, first: int, end: int) -> tuple[int, int, float, float, float]:
    """Where a splat is at least 1/255 in one pixel row, decided in float64.

    Args:
        splat: [8] float64, see `projection`
        x: column of the tile's first pixel in the full image
        y: row in the full image
        first, end: the columns of the tile to look at, from `x`

    Returns:
        first column of the support and one past its last, from `x` (equal: there is none);
        the column nearest to the row's peak, and u there: u = u_peak + l11 · (column − peak);
        v
    """
    dy = y + 0.5 - splat[MY]
    v = splat[L22] * dy
    rest = splat[R2] - v * v
    if not rest >= 0.0:
        return 0, 0, 0.0, 0.0, 0.0
    centre = splat[MX] - splat[SLOPE] * dy - x - 0.5
    half = math.sqrt(rest) * splat[INV_L11]
    start = max(np.ceil(centre - half), float(first))
    stop = min(np.floor(centre + half) + 1.0, float(end))
    if not start < stop:
        return 0, 0, 0.0, 0.0, 0.0
    # counting from the peak keeps u = l11·(column − centre) free of cancellation in float32; far peaks (needles,
    # giants) lie where l11 is small
    peak = min(max(np.floor(centre + 0.5), -65536.0), 65536.0)
    return int(start), int(stop), peak, splat[L11] * (peak - centre), v
