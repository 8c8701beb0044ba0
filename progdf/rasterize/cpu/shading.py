"""Kernels: color of a Gaussian from spherical harmonics, and back. Signs and order as in `progdf.sh`."""

from __future__ import annotations

import math
from typing import Any

from numpy.typing import NDArray

from progdf.sh import _C1, _C2, _C3, C0

from .jit import kernel

Array = NDArray[Any]
Vec = tuple[float, float, float]


@kernel(contract=True, inline=True)
def dot(a: Vec, b: Vec) -> float:
    """a·b"""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel(contract=True, inline=True)
def row_times(a: Vec, rows: tuple[Vec, Vec, Vec]) -> Vec:
    """aᵀM for a matrix given by rows."""
    return (
        a[0] * rows[0][0] + a[1] * rows[1][0] + a[2] * rows[2][0],
        a[0] * rows[0][1] + a[1] * rows[1][1] + a[2] * rows[2][1],
        a[0] * rows[0][2] + a[1] * rows[1][2] + a[2] * rows[2][2],
    )


@kernel(inline=True)
def view_direction(point: Vec, eye: Vec) -> tuple[float, float, float, float]:
    """Unit vector from the eye to a point, world axes, and 1/distance (zeros at the eye itself)."""
    x, y, z = point[0] - eye[0], point[1] - eye[1], point[2] - eye[2]
    squared = x * x + y * y + z * z
    inverse = 1.0 / math.sqrt(squared) if squared > 0.0 else 0.0
    return x * inverse, y * inverse, z * inverse, inverse


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
        slopes[14, 0], slopes[14, 1] = 2 * _C3[5] * x * z, -2 * _C3[5] * y * z
        slopes[14, 2] = _C3[5] * (xx - yy)
        slopes[15, 0], slopes[15, 1] = 3 * _C3[6] * (xx - yy), -6 * _C3[6] * x * y


@kernel(contract=True)
def shade_backward(
    i: int, colors: Array, degree: int, point: Vec, eye: Vec, gradient: Vec, basis: Array, slopes: Array,
    out: Array,
) -> Vec:  # fmt: skip
    """Gradients of Gaussian i's color max(0, Σ basis·sh + 0.5).

    Args:
        i: row of `colors` and `out`
        colors: SH coefficients. [N,K,3] float32
        degree: 0..3
        point, eye: its center and the camera's, world axes
        gradient: to the clamped color
        basis, slopes: scratch. [16], [16,3] float64, `slopes` zero where no derivative is ever written
        out: gradient to the coefficients. [N,K,3] float32

    Returns:
        The gradient to point − eye.
    """
    x, y, z, inverse = view_direction(point, eye)
    fill_basis(degree, x, y, z, basis)
    fill_basis_gradient(degree, x, y, z, slopes)
    bands = (degree + 1) ** 2
    red = green = blue = 0.5
    for k in range(bands):
        red += basis[k] * colors[i, k, 0]
        green += basis[k] * colors[i, k, 1]
        blue += basis[k] * colors[i, k, 2]
    g0 = gradient[0] if red >= 0.0 else 0.0
    g1 = gradient[1] if green >= 0.0 else 0.0
    g2 = gradient[2] if blue >= 0.0 else 0.0
    dx = dy = dz = 0.0
    for k in range(bands):
        out[i, k, 0], out[i, k, 1], out[i, k, 2] = basis[k] * g0, basis[k] * g1, basis[k] * g2
        along = g0 * colors[i, k, 0] + g1 * colors[i, k, 1] + g2 * colors[i, k, 2]
        dx += slopes[k, 0] * along
        dy += slopes[k, 1] * along
        dz += slopes[k, 2] * along
    radial = dx * x + dy * y + dz * z
    return (dx - radial * x) * inverse, (dy - radial * y) * inverse, (dz - radial * z) * inverse
