"""Kernels of the color solver: passes over the members that need no temporary arrays.

The same sums in torch make arrays of the size of all SH coefficients, whose memory the system takes and gives
back at every step.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from progdf.rasterize.cpu.engine import Array
from progdf.rasterize.cpu.jit import Number, kernel


@kernel(cache=True)
def add_colors(basis: Array, offsets: Array, colors: Array) -> None:
    """Add Σ basis · offset to the colors. [M,B], [M,b,3], [M,3] float32

    It replaces sums of torch, which fragment the heap by 0.2 GB for 200 000 members: glibc before 2.38 does
    not reuse holes of the exact size for aligned memory.
    """
    for m in range(len(colors)):
        red = colors[m, 0]
        green = colors[m, 1]
        blue = colors[m, 2]
        for b in range(offsets.shape[1]):
            weight = basis[m, b]
            red += weight * offsets[m, b, 0]
            green += weight * offsets[m, b, 1]
            blue += weight * offsets[m, b, 2]
        colors[m, 0] = red
        colors[m, 1] = green
        colors[m, 2] = blue


@kernel(contract=True, cache=True)
def add_gradients(basis: Array, pull: Array, offsets: Array) -> None:
    """Add Σ basis · pull to the offsets, the transpose of `add_colors`. [M,B], [M,3], [M,b,3] float32"""
    for m in range(len(pull)):
        red = pull[m, 0]
        green = pull[m, 1]
        blue = pull[m, 2]
        if red == 0.0 and green == 0.0 and blue == 0.0:
            continue
        for b in range(offsets.shape[1]):
            weight = basis[m, b]
            offsets[m, b, 0] += weight * red
            offsets[m, b, 1] += weight * green
            offsets[m, b, 2] += weight * blue


@kernel(cache=True)
def add_curvature(basis: Array, weights: Array, curvature: Array) -> None:
    """Add weight · basis · basisᵀ of each member. [M,B], [M], [M,b,b] float32"""
    for m in range(len(weights)):
        weight = weights[m]
        if weight == 0.0:
            continue
        for i in range(curvature.shape[1]):
            scaled = weight * basis[m, i]
            for j in range(curvature.shape[2]):
                curvature[m, i, j] += scaled * basis[m, j]


@kernel(cache=True)
def drop_held(colors: Array, gradient: Array, drawn: Array) -> None:
    """Set the gradient of channels to 0 that stay black, and mark the others.

    colors: at least 0, [M,3] float32; gradient: negative, in place, [M,3] float32; drawn: out, [M,3] bool
    """
    for m in range(len(colors)):
        for c in range(3):
            is_drawn = colors[m, c] > 0.0 or gradient[m, c] > 0.0
            drawn[m, c] = is_drawn
            if not is_drawn:
                gradient[m, c] = np.float32(0.0)


@kernel(cache=True)
def keep_drawn(colors: Array, drawn: Array) -> None:
    """Set channels to 0 that are not drawn. [M,3] float32, [M,3] bool"""
    for m in range(len(colors)):
        for c in range(3):
            if not drawn[m, c]:
                colors[m, c] = np.float32(0.0)


def inner_product(a: Tensor, b: Tensor) -> float:
    """Return Σ a · b of two float32 tensors of one shape, summed in float64."""
    return float(_sum_products(a.reshape(-1).numpy(), b.reshape(-1).numpy()))


@kernel(cache=True)
def _sum_products(a: Array, b: Array) -> Number:
    """Return the sum of `inner_product`. [n], [n]"""
    total = 0.0
    for i in range(len(a)):
        total += np.float64(a[i] * b[i])
    return total
