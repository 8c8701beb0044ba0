"""Kernels: colour of a Gaussian from spherical harmonics, and back. Signs and order as in `progdf.sh`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.jit import kernel
from progdf.sh import _C1, _C2, _C3, C0

Array = NDArray[Any]


@kernel(inline=True)
def view_direction(m0: float, m1: float, m2: float, viewmat: Array) -> tuple[float, float, float, float]:
    """Unit vector from the camera centre −RᵀT to a point, world axes, and 1/distance (0 at the centre itself)."""
    d0 = m0 + viewmat[0, 0] * viewmat[0, 3] + viewmat[1, 0] * viewmat[1, 3] + viewmat[2, 0] * viewmat[2, 3]
    d1 = m1 + viewmat[0, 1] * viewmat[0, 3] + viewmat[1, 1] * viewmat[1, 3] + viewmat[2, 1] * viewmat[2, 3]
    d2 = m2 + viewmat[0, 2] * viewmat[0, 3] + viewmat[1, 2] * viewmat[1, 3] + viewmat[2, 2] * viewmat[2, 3]
    squared = d0 * d0 + d1 * d1 + d2 * d2
    inverse = 1.0 / math.sqrt(squared) if squared > 0.0 else 0.0
    return d0 * inverse, d1 * inverse, d2 * inverse, inverse


@kernel()
def fill_basis(degree: int, x: float, y: float, z: float, basis: Array) -> None:
    """Values of the (degree+1)² real basis functions in direction x, y, z. basis: out, [16] float64"""
    basis[0] = C0
    if degree >= 1:
        basis[1] = -_C1 * y
        basis[2] = _C1 * z
        basis[3] = -_C1 * x
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis[4] = _C2[0] * x * y
        basis[5] = _C2[1] * y * z
        basis[6] = _C2[2] * (2 * zz - xx - yy)
        basis[7] = _C2[3] * x * z
        basis[8] = _C2[4] * (xx - yy)
        if degree >= 3:
            basis[9] = _C3[0] * y * (3 * xx - yy)
            basis[10] = _C3[1] * x * y * z
            basis[11] = _C3[2] * y * (4 * zz - xx - yy)
            basis[12] = _C3[3] * z * (2 * zz - 3 * xx - 3 * yy)
            basis[13] = _C3[4] * x * (4 * zz - xx - yy)
            basis[14] = _C3[5] * z * (xx - yy)
            basis[15] = _C3[6] * x * (xx - 3 * yy)


@kernel()
def fill_basis_gradient(degree: int, x: float, y: float, z: float, slopes: Array) -> None:
    """Derivatives of the basis functions by x, y and z. slopes: out, [16,3] float64, zero on entry"""
    if degree >= 1:
        slopes[1, 1] = -_C1
        slopes[2, 2] = _C1
        slopes[3, 0] = -_C1
    if degree >= 2:
        slopes[4, 0], slopes[4, 1] = _C2[0] * y, _C2[0] * x
        slopes[5, 1], slopes[5, 2] = _C2[1] * z, _C2[1] * y
        slopes[6, 0], slopes[6, 1], slopes[6, 2] = -2 * _C2[2] * x, -2 * _C2[2] * y, 4 * _C2[2] * z
        slopes[7, 0], slopes[7, 2] = _C2[3] * z, _C2[3] * x
        slopes[8, 0], slopes[8, 1] = 2 * _C2[4] * x, -2 * _C2[4] * y
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        slopes[9, 0], slopes[9, 1] = 6 * _C3[0] * x * y, 3 * _C3[0] * (xx - yy)
        slopes[10, 0], slopes[10, 1], slopes[10, 2] = _C3[1] * y * z, _C3[1] * x * z, _C3[1] * x * y
        slopes[11, 0] = -2 * _C3[2] * x * y
        slopes[11, 1] = _C3[2] * (4 * zz - xx - 3 * yy)
        slopes[11, 2] = 8 * _C3[2] * y * z
        slopes[12, 0], slopes[12, 1] = -6 * _C3[3] * x * z, -6 * _C3[3] * y * z
        slopes[12, 2] = _C3[3] * (6 * zz - 3 * xx - 3 * yy)
        slopes[13, 0] = _C3[4] * (4 * zz - 3 * xx - yy)
        slopes[13, 1] = -2 * _C3[4] * x * y
        slopes[13, 2] = 8 * _C3[4] * x * z
        slopes[14, 0], slopes[14, 1], slopes[14, 2] = (
            2 * _C3[5] * x * z,
            -2 * _C3[5] * y * z,
            _C3[5] * (xx - yy),
        )
        slopes[15, 0], slopes[15, 1] = 3 * _C3[6] * (xx - yy), -6 * _C3[6] * x * y


@kernel()
def shade(
    sh: Array, degree: int, m0: float, m1: float, m2: float, viewmat: Array
) -> tuple[float, float, float]:
    """Colour Σ basis·sh + 0.5 seen from the camera, before the clamp at 0. sh: [K,3]"""
    x, y, z, _ = view_direction(m0, m1, m2, viewmat)
    basis = np.empty(16)
    fill_basis(degree, x, y, z, basis)
    red = green = blue = 0.5
    for k in range((degree + 1) ** 2):
        red += basis[k] * sh[k, 0]
        green += basis[k] * sh[k, 1]
        blue += basis[k] * sh[k, 2]
    return red, green, blue


@kernel()
def shade_backward(
    sh: Array, degree: int, m0: float, m1: float, m2: float, viewmat: Array, grad_rgb: Array, grad_sh: Array
) -> tuple[float, float, float]:
    """Gradients of `shade` clamped at 0: fills grad_sh [K,3], returns the gradient to (point − camera centre).

    Args:
        grad_rgb: gradient to the clamped colour. [3] float64
        grad_sh: out, [K,3] float32
    """
    x, y, z, inverse = view_direction(m0, m1, m2, viewmat)
    basis = np.empty(16)
    slopes = np.zeros((16, 3))
    fill_basis(degree, x, y, z, basis)
    fill_basis_gradient(degree, x, y, z, slopes)
    red, green, blue = shade(sh, degree, m0, m1, m2, viewmat)
    g0 = grad_rgb[0] if red >= 0.0 else 0.0
    g1 = grad_rgb[1] if green >= 0.0 else 0.0
    g2 = grad_rgb[2] if blue >= 0.0 else 0.0
    dx = dy = dz = 0.0
    for k in range((degree + 1) ** 2):
        grad_sh[k, 0] = basis[k] * g0
        grad_sh[k, 1] = basis[k] * g1
        grad_sh[k, 2] = basis[k] * g2
        along = g0 * sh[k, 0] + g1 * sh[k, 1] + g2 * sh[k, 2]
        dx += slopes[k, 0] * along
        dy += slopes[k, 1] * along
        dz += slopes[k, 2] * along
    radial = dx * x + dy * y + dz * z
    return (dx - radial * x) * inverse, (dy - radial * y) * inverse, (dz - radial * z) * inverse
