"""Kernels of the color solver: passes over the members that need no temporary arrays.

The same sums in torch make arrays of the size of all SH coefficients, whose memory the system takes and gives
back at every step. SH functions are computed from the camera where they are needed, for eight members at
once: reading them from memory takes longer, and storing them takes 36 bytes per member and view.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from progdf.rasterize.cpu.engine import Array
from progdf.rasterize.cpu.jit import WIDTH, Number, Vector, kernel, load, select, sqrt, store
from progdf.sh import _C1, _C2, _C3, C0
from progdf.threads import run_chunks

_CHUNK = 8192  # members that a thread processes at once; a multiple of `WIDTH`
_MAX_BANDS = 16  # SH functions up to degree 3
_VIEWS = 8  # views that are processed at once, see `view_blocks`
_LANES = np.uint64(WIDTH)
_SUMS = 4  # partial sums of `_sum_products`, because one sum waits for each addition
_ZERO: Number = np.float32(0.0)
_B0: Number = np.float32(C0)
_B1: Number = np.float32(_C1)
_B20, _B21, _B22, _B23, _B24 = (np.float32(c) for c in _C2)
_B30, _B31, _B32, _B33, _B34, _B35, _B36 = (np.float32(c) for c in _C3)
_TWO: Number = np.float32(2.0)
_THREE: Number = np.float32(3.0)
_FOUR: Number = np.float32(4.0)


def shade_views(means: Array, positions: Array, sh: Array, bias: float, lowest: float) -> Array:
    """Return max(lowest, bias + Σ basis · sh) of all members from some cameras.

    Args:
        means: centers of the members. [M,3] float32
        positions: centers of the cameras, at most 8. [V,3] float32
        sh: coefficients of the lowest b = 1, 4, 9 or 16 functions. [M,b,3] float32
        bias: constant, 0.5 for colors and 0 for changes
        lowest: lower limit, 0 for drawn colors

    Returns:
        colors. [V,M,3] float32
    """
    colors = np.empty((len(positions), len(means), 3), np.float32)
    limits = np.float32(bias), np.float32(lowest)

    def work(chunk: int) -> None:
        begin = chunk * _CHUNK
        end = min(begin + _CHUNK, len(means))
        scratch = _new_scratch(len(positions))
        _shade(begin, end, means, positions, sh, limits, scratch, colors)

    run_chunks(work, -(-len(means) // _CHUNK))
    return colors


def add_gradients(means: Array, positions: Array, by_color: Array, gradient: Array) -> None:
    """Add Σ basis · by_color over some views to the gradient by SH, the transpose of `shade_views`.

    Args:
        means, positions: see `shade_views`
        by_color: gradient by the members' colors in each view. [V,M,3] float32
        gradient: changed in place. [M,b,3] float32
    """

    def work(chunk: int) -> None:
        begin = chunk * _CHUNK
        end = min(begin + _CHUNK, len(means))
        _add_gradients(begin, end, means, positions, by_color, _new_scratch(len(positions)), gradient)

    run_chunks(work, -(-len(means) // _CHUNK))


def _new_scratch(views: int) -> Array:
    """Return memory for eight members: SH functions, coefficients, offsets to a camera, and colors."""
    return np.zeros((4 * _MAX_BANDS + 3 + 3 * views) * WIDTH, np.float32)


@kernel(contract=True, inline=True)
def _fill_bases(count: int, x: Vector, y: Vector, z: Vector, bases: Array) -> None:
    """Compute the first 4, 9 or 16 functions except the constant one along any direction. See `sh.basis`."""
    inverse = np.float32(1.0) / sqrt(x * x + y * y + z * z + np.float32(1e-24))
    x = x * inverse
    y = y * inverse
    z = z * inverse
    store(bases, _LANES, y * -_B1)
    store(bases, np.uint64(2) * _LANES, z * _B1)
    store(bases, np.uint64(3) * _LANES, x * -_B1)
    if count > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        store(bases, np.uint64(4) * _LANES, x * y * _B20)
        store(bases, np.uint64(5) * _LANES, y * z * _B21)
        store(bases, np.uint64(6) * _LANES, (zz * _TWO - xx - yy) * _B22)
        store(bases, np.uint64(7) * _LANES, x * z * _B23)
        store(bases, np.uint64(8) * _LANES, (xx - yy) * _B24)
        if count > 9:
            store(bases, np.uint64(9) * _LANES, y * (xx * _THREE - yy) * _B30)
            store(bases, np.uint64(10) * _LANES, x * y * z * _B31)
            store(bases, np.uint64(11) * _LANES, y * (zz * _FOUR - xx - yy) * _B32)
            store(bases, np.uint64(12) * _LANES, z * (zz * _TWO - xx * _THREE - yy * _THREE) * _B33)
            store(bases, np.uint64(13) * _LANES, x * (zz * _FOUR - xx - yy) * _B34)
            store(bases, np.uint64(14) * _LANES, z * (xx - yy) * _B35)
            store(bases, np.uint64(15) * _LANES, x * (xx - yy * _THREE) * _B36)


@kernel(contract=True, cache=True)
def _shade(
    begin: int, end: int, means: Array, positions: Array, sh: Array, limits: tuple[Number, Number],
    scratch: Array, colors: Array,
) -> None:  # fmt: skip
    """Compute `shade_views` for members begin … end − 1. limits: bias and lowest; scratch: `_new_scratch`"""
    bias, lowest = limits
    count = sh.shape[1]
    bases = scratch[: _MAX_BANDS * WIDTH]
    rows = scratch[_MAX_BANDS * WIDTH : 4 * _MAX_BANDS * WIDTH]  # [b,3,8]
    centers = scratch[4 * _MAX_BANDS * WIDTH : (4 * _MAX_BANDS + 3) * WIDTH]  # [3,8]
    shaded = scratch[(4 * _MAX_BANDS + 3) * WIDTH : (4 * _MAX_BANDS + 6) * WIDTH]  # [3,8]
    bases[:WIDTH] = _B0
    for first in range(begin, end, WIDTH):
        lanes = min(WIDTH, end - first)
        for lane in range(lanes):
            for b in range(count):
                for c in range(3):
                    rows[(3 * b + c) * WIDTH + lane] = sh[first + lane, b, c]
            for c in range(3):
                centers[c * WIDTH + lane] = means[first + lane, c]
        for v in range(len(positions)):
            if count > 1:
                x = load(centers, np.uint64(0)) - positions[v, 0]
                y = load(centers, _LANES) - positions[v, 1]
                z = load(centers, np.uint64(2) * _LANES) - positions[v, 2]
                _fill_bases(count, x, y, z, bases)
            weight = load(bases, np.uint64(0))
            red = load(rows, np.uint64(0)) * weight + bias
            green = load(rows, _LANES) * weight + bias
            blue = load(rows, np.uint64(2) * _LANES) * weight + bias
            for b in range(np.uint64(1), np.uint64(count)):
                weight = load(bases, b * _LANES)
                at = np.uint64(3) * b * _LANES
                red = red + load(rows, at) * weight
                green = green + load(rows, at + _LANES) * weight
                blue = blue + load(rows, at + np.uint64(2) * _LANES) * weight
            store(shaded, np.uint64(0), select(red > lowest, red, lowest))
            store(shaded, _LANES, select(green > lowest, green, lowest))
            store(shaded, np.uint64(2) * _LANES, select(blue > lowest, blue, lowest))
            for lane in range(lanes):
                for c in range(3):
                    colors[v, first + lane, c] = shaded[c * WIDTH + lane]


@kernel(contract=True, cache=True)
def _add_gradients(
    begin: int, end: int, means: Array, positions: Array, by_color: Array, scratch: Array, gradient: Array
) -> None:
    """Compute `add_gradients` for members begin … end − 1. scratch: see `_new_scratch`"""
    count = gradient.shape[1]
    bases = scratch[: _MAX_BANDS * WIDTH]
    sums = scratch[_MAX_BANDS * WIDTH : 4 * _MAX_BANDS * WIDTH]  # [b,3,8]
    centers = scratch[4 * _MAX_BANDS * WIDTH : (4 * _MAX_BANDS + 3) * WIDTH]  # [3,8]
    pulls = scratch[(4 * _MAX_BANDS + 3) * WIDTH :]  # [V,3,8]
    bases[:WIDTH] = _B0
    for first in range(begin, end, WIDTH):
        lanes = min(WIDTH, end - first)
        sums[: 3 * count * WIDTH] = _ZERO
        for lane in range(lanes):
            for c in range(3):
                centers[c * WIDTH + lane] = means[first + lane, c]
        # all views first: a vector cannot be read from numbers that were written just before
        for v in range(len(positions)):
            for lane in range(lanes):
                for c in range(3):
                    pulls[(3 * v + c) * WIDTH + lane] = by_color[v, first + lane, c]
        for v in range(len(positions)):
            if count > 1:
                x = load(centers, np.uint64(0)) - positions[v, 0]
                y = load(centers, _LANES) - positions[v, 1]
                z = load(centers, np.uint64(2) * _LANES) - positions[v, 2]
                _fill_bases(count, x, y, z, bases)
            begun = np.uint64(3 * v) * _LANES
            red = load(pulls, begun)
            green = load(pulls, begun + _LANES)
            blue = load(pulls, begun + np.uint64(2) * _LANES)
            for b in range(np.uint64(count)):
                weight = load(bases, b * _LANES)
                at = np.uint64(3) * b * _LANES
                store(sums, at, load(sums, at) + red * weight)
                at += _LANES
                store(sums, at, load(sums, at) + green * weight)
                at += _LANES
                store(sums, at, load(sums, at) + blue * weight)
        for lane in range(lanes):
            for b in range(count):
                for c in range(3):
                    gradient[first + lane, b, c] += sums[(3 * b + c) * WIDTH + lane]


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


def invert_blocks(curvature: Array, free: Array, diagonal: Array) -> Array:
    """Return the inverse of each member's block, with 0 where a function is not solved for.

    Args:
        curvature: positive semidefinite. [M,B,B] float32
        free: functions to solve for, the lowest b. [M,b] bool
        diagonal: positive numbers added to the diagonals. [M] float32

    Returns:
        [M,b,b] float32, computed in float64
    """
    count = free.shape[1]
    inverse = np.empty((len(free), count, count), np.float32)

    def work(chunk: int) -> None:
        begin = chunk * _CHUNK
        _invert_blocks(begin, min(begin + _CHUNK, len(free)), curvature, free, diagonal, inverse)

    run_chunks(work, -(-len(free) // _CHUNK))
    return inverse


@kernel(contract=True, cache=True, allocates=True)
def _invert_blocks(
    begin: int, end: int, curvature: Array, free: Array, diagonal: Array, inverse: Array
) -> None:
    """Compute `invert_blocks` of members begin … end − 1 by Gauss–Jordan elimination."""
    count = free.shape[1]
    block = np.empty((count, count))
    for m in range(begin, end):
        for i in range(count):
            for j in range(count):
                block[i, j] = curvature[m, i, j] if free[m, i] and free[m, j] else 0.0
            block[i, i] += np.float64(diagonal[m])
        for k in range(count):
            pivot = 1.0 / block[k, k]
            block[k, k] = 1.0
            for j in range(count):
                block[k, j] *= pivot
            for i in range(count):
                factor = block[i, k]
                if i == k or factor == 0.0:
                    continue
                block[i, k] = 0.0
                for j in range(count):
                    block[i, j] -= factor * block[k, j]
        for i in range(count):
            for j in range(count):
                inverse[m, i, j] = block[i, j] if free[m, i] and free[m, j] else 0.0


@kernel(contract=True, cache=True)
def apply_blocks(inverse: Array, descent: Array, out: Array) -> None:
    """Compute the product of each member's block and descent. [M,b,b], [M,b,3] -> out [M,b,3] float32"""
    count = inverse.shape[1]
    for m in range(len(inverse)):
        for i in range(count):
            red = green = blue = _ZERO
            for j in range(count):
                weight = inverse[m, i, j]
                red += weight * descent[m, j, 0]
                green += weight * descent[m, j, 1]
                blue += weight * descent[m, j, 2]
            out[m, i, 0] = red
            out[m, i, 1] = green
            out[m, i, 2] = blue


def drop_held(colors: Array, gradient: Array, drawn: Array) -> None:
    """Set the gradient of channels to 0 that stay black, and mark the others.

    colors: at least 0, [M,3] float32; gradient: negative, in place, [M,3] float32; drawn: out, [M,3] bool
    """
    _drop_held(colors.reshape(-1), gradient.reshape(-1), drawn.reshape(-1))


@kernel(cache=True)
def _drop_held(colors: Array, gradient: Array, drawn: Array) -> None:
    """Compute `drop_held` without branches. [n] each"""
    for k in range(len(colors)):
        is_drawn = (colors[k] > _ZERO) | (gradient[k] > _ZERO)
        drawn[k] = is_drawn
        gradient[k] = gradient[k] if is_drawn else _ZERO


def keep_drawn(colors: Array, drawn: Array) -> None:
    """Set channels to 0 that are not drawn. [M,3] float32, [M,3] bool"""
    _keep_drawn(colors.reshape(-1), drawn.reshape(-1))


@kernel(cache=True)
def _keep_drawn(colors: Array, drawn: Array) -> None:
    """Compute `keep_drawn` without branches. [n] each"""
    for k in range(len(colors)):
        colors[k] = colors[k] if drawn[k] else _ZERO


def inner_product(a: Tensor, b: Tensor) -> float:
    """Return Σ a · b of two float32 tensors of one shape, summed in float64."""
    return float(_sum_products(a.reshape(-1).numpy(), b.reshape(-1).numpy()))


@kernel(cache=True)
def _sum_products(a: Array, b: Array) -> Number:
    """Return the sum of `inner_product`. [n], [n]"""
    first = second = third = fourth = 0.0
    even = len(a) - len(a) % _SUMS
    for i in range(0, even, _SUMS):
        first += np.float64(a[i] * b[i])
        second += np.float64(a[i + 1] * b[i + 1])
        third += np.float64(a[i + 2] * b[i + 2])
        fourth += np.float64(a[i + 3] * b[i + 3])
    for i in range(even, len(a)):
        first += np.float64(a[i] * b[i])
    return (first + second) + (third + fourth)
