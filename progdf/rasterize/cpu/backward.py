"""Kernel: gradients of the inputs from the sums of all intersections, in float64 and in a fixed order.

With σ = ½|Lᵀd|² and e = Lᵀd (that is u, v), a change δΣ of the 2D covariance changes σ by −½ eᵀ(Lᵀ δΣ L)e,
and a move δm of the center by −eᵀLᵀδm. So the moments Σg·e and Σg·eeᵀ suffice. The 2D axes
M = J·W·R·S only enter as the product LᵀM, which does not cancel for needles if it is written with a cross
product.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.engines import ANTIALIAS_FLOOR
from progdf.sh import _C1, _C2, _C3

from .blend import SUMS
from .forward import (
    UNIT,
    Footprint,
    Pinhole,
    Scene,
    Vec,
    blend2,
    camera_center,
    cross,
    dot,
    fill_basis,
    footprint,
    quat_of,
    row_times,
    times,
    vec,
    view_direction,
)  # fmt: skip
from .jit import kernel

Array = NDArray[Any]

_PER_UNIT = 1.0 / UNIT
_PER_UNIT2 = 1.0 / (UNIT * UNIT)

CAMERA = 16
"""Length of the camera's gradient: viewmat rows 0..2 (12), then fx, fy, cx, cy."""

BLOCK = 1024
"""Number of Gaussians per partial sum of the camera's gradient.

A fixed size keeps the bits equal for every number of threads.
"""


@kernel()
def fill_basis_gradient(degree: int, x: float, y: float, z: float, slopes: Array) -> None:
    """Compute the derivatives of the basis functions with respect to x, y and z.

    slopes: out, [16,3] float64, zero on entry
    """
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
        xx = x * x
        yy = y * y
        zz = z * z
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
    """Compute the gradients of Gaussian i's color max(0, Σ basis·sh + 0.5).

    Args:
        i: row of `colors` and `out`
        colors: SH coefficients. [N,K,3] float32
        degree: 0..3
        point, eye: centers of the Gaussian and of the camera, world axes
        gradient: to the clamped color
        basis: scratch. [16] float64
        slopes: scratch, zero where no derivative is ever written. [16,3] float64
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


@kernel(contract=True, inline=True)
def _axes_gradient(seen: Footprint, g: tuple[float, ...], camera: Pinhole) -> tuple[float, float, Vec, Vec]:
    """Return the gradients to the center in pixels (2) and to the 2D axes p0, p1.

    g: Σg and its moments (6)
    """
    # g = −dL/dσ; u and v are in units of `UNIT`
    e0 = -g[1] * _PER_UNIT
    e1 = -g[2] * _PER_UNIT
    h00 = -g[3] * _PER_UNIT2
    h01 = -g[4] * _PER_UNIT2
    h11 = -g[5] * _PER_UNIT2
    sigma_y = math.sqrt(seen.c + camera.dilation)
    inv_root = 1.0 / (math.sqrt(seen.det) * sigma_y)
    l11 = sigma_y * sigma_y * inv_root
    l21 = -seen.b * inv_root
    l22 = 1.0 / sigma_y
    # dL/dM = −L H (LᵀM); the first row of LᵀM is (p1 × (p0 × p1) + ε p0) / root
    along = blend2(inv_root, cross(seen.p1, seen.normal), camera.dilation * inv_root, seen.p0)
    d0 = blend2(-l11 * h00, along, -l11 * h01 * l22, seen.p1)
    d1 = blend2(-(l21 * h00 + l22 * h01), along, -(l21 * h01 + l22 * h11) * l22, seen.p1)
    if camera.antialiased:
        # opacity · sqrt(det0 / det): d log = (ddet0 / det0 − ddet / det) / 2, det = det0 + ε (a + c) + ε²
        by_det0 = by_trace = 0.0
        if seen.det0 >= ANTIALIAS_FLOOR * seen.det:
            by_det0 = g[0] * (1.0 / seen.det0 - 1.0 / seen.det)
            by_trace = -g[0] * camera.dilation / seen.det
        d0 = blend2(1.0, d0, by_det0, cross(seen.p1, seen.normal))
        d0 = blend2(1.0, d0, by_trace, seen.p0)
        d1 = blend2(1.0, d1, by_det0, cross(seen.normal, seen.p0))
        d1 = blend2(1.0, d1, by_trace, seen.p1)
    return -l11 * e0, -(l21 * e0 + l22 * e1), d0, d1


@kernel(contract=True, inline=True)
def _quat_gradient(seen: Footprint, d0: Vec, d1: Vec) -> tuple[float, float, float, float]:
    """Return the gradient to the unnormalized quaternion. d0, d1: gradients to the rows a0ᵀR, a1ᵀR"""
    q0, q1, q2, q3 = seen.quat
    v0 = blend2(seen.a0[0], d0, seen.a1[0], d1)
    v1 = blend2(seen.a0[1], d0, seen.a1[1], d1)
    v2 = blend2(seen.a0[2], d0, seen.a1[2], d1)
    sym01 = v0[1] + v1[0]
    sym02 = v0[2] + v2[0]
    sym12 = v1[2] + v2[1]
    skew01 = v1[0] - v0[1]
    skew02 = v0[2] - v2[0]
    skew12 = v2[1] - v1[2]
    gw = 2.0 * (q1 * skew12 + q2 * skew02 + q3 * skew01)
    gx = 2.0 * (q2 * sym01 + q3 * sym02 + q0 * skew12 - 2.0 * q1 * (v1[1] + v2[2]))
    gy = 2.0 * (q1 * sym01 + q3 * sym12 + q0 * skew02 - 2.0 * q2 * (v0[0] + v2[2]))
    gz = 2.0 * (q1 * sym02 + q2 * sym12 + q0 * skew01 - 2.0 * q3 * (v0[0] + v1[1]))
    radial = gw * q0 + gx * q1 + gy * q2 + gz * q3
    k = seen.inv_length
    return (gw - radial * q0) * k, (gx - radial * q1) * k, (gy - radial * q2) * k, (gz - radial * q3) * k


@kernel(contract=True, inline=True)
def _point_gradient(
    camera: Pinhole, seen: Footprint, grad_px: float, grad_py: float, ga: Vec, gb: Vec
) -> tuple[Vec, tuple[float, float], tuple[float, float]]:
    """Return the gradients to the points in camera axes, to fx and fy, and to cx and cy.

    ga, gb are the gradients to a0, a1. px = fx x/z + cx and a0 = fx/z (W0 − tan_x W2). tan_x is x/z or a
    limit: ((width − cx) + half)/fx or −(cx + half)/fx. The same holds for y.
    """
    inv_z = seen.inv_z
    down_a = dot(ga, camera.rows[2])
    down_b = dot(gb, camera.rows[2])
    grad_jx = dot(ga, camera.rows[0]) - seen.tan_x * down_a
    grad_jy = dot(gb, camera.rows[1]) - seen.tan_y * down_b
    # divided by −fx, −fy
    by_tan_x = inv_z * down_a
    by_tan_y = inv_z * down_b
    slope_x = camera.fx * (grad_px - (by_tan_x if seen.free_x else 0.0))
    slope_y = camera.fy * (grad_py - (by_tan_y if seen.free_y else 0.0))
    by_limit_x = 0.0 if seen.free_x else by_tan_x
    by_limit_y = 0.0 if seen.free_y else by_tan_y
    towards = slope_x * seen.x + slope_y * seen.y + grad_jx * camera.fx + grad_jy * camera.fy
    by_focal = (
        (grad_px * seen.x + grad_jx) * inv_z + by_limit_x * seen.tan_x,
        (grad_py * seen.y + grad_jy) * inv_z + by_limit_y * seen.tan_y,
    )
    by_center = (grad_px + by_limit_x, grad_py + by_limit_y)
    return (slope_x * inv_z, slope_y * inv_z, -towards * inv_z * inv_z), by_focal, by_center


@kernel(contract=True, inline=True)
def _set(rows: Array, i: int, value: Vec) -> None:
    """Set row i of an [N,3] array."""
    rows[i, 0], rows[i, 1], rows[i, 2] = value


class GradientScratch(NamedTuple):
    """Scratch arrays of one thread: see `shade_backward`; total: sums of a Gaussian's intersections. [9]"""

    basis: Array
    slopes: Array
    total: Array


def new_scratch() -> GradientScratch:
    """Allocate the scratch of one thread."""
    return GradientScratch(np.empty(16), np.zeros((16, 3)), np.empty(SUMS))


@kernel(contract=True, cache=True)
def project_backward(
    begin: int, end: int, scene: Scene, camera: Pinhole, offsets: Array, sums: Array, grad_mask: Array,
    gradients: Scene, by_camera: Array, scratch: GradientScratch,
) -> None:  # fmt: skip
    """Compute the gradients of `project`, which has the same first arguments.

    Args:
        offsets: first row of `sums` of each Gaussian. [N+1] int32
        sums: see `blend_backward`. [I,9] float32
        grad_mask: rows whose gradients are computed, all others are zero; [0] selects all. [N] bool
        gradients: out
        by_camera: out, each block's share of the camera's gradient, zero on entry. [blocks,CAMERA] float64
    """
    gradients.means[begin:end] = 0.0
    gradients.quats[begin:end] = 0.0
    gradients.scales[begin:end] = 0.0
    gradients.opacities[begin:end] = 0.0
    gradients.colors[begin:end] = 0.0
    eye = camera_center(camera)
    total = scratch.total
    for i in range(begin, end):
        if offsets[i] == offsets[i + 1] or (grad_mask.size > 0 and not grad_mask[i]):
            continue
        total[:] = 0.0
        for slot in range(offsets[i], offsets[i + 1]):
            for k in range(SUMS):
                total[k] += sums[slot, k]
        by_rgb = (total[0], total[1], total[2])
        by_ray = (0.0, 0.0, 0.0)
        mean = vec(scene.means, i)
        scale = vec(scene.scales, i)
        if camera.degree < 0:
            _set(gradients.colors[i], 0, by_rgb)
        else:
            by_ray = shade_backward(
                i, scene.colors, camera.degree, mean, eye, by_rgb, scratch.basis, scratch.slopes,
                gradients.colors,
            )  # fmt: skip
        g = (total[3], total[4], total[5], total[6], total[7], total[8])
        gradients.opacities[i] = g[0] / np.float64(scene.opacities[i])
        seen = footprint(camera, mean, scale, quat_of(scene.quats, i))
        grad_px, grad_py, d0, d1 = _axes_gradient(seen, g, camera)
        _set(gradients.scales, i, blend2(1.0, times(d0, seen.turned0), 1.0, times(d1, seen.turned1)))
        d0 = times(d0, scale)
        d1 = times(d1, scale)
        by_quat = _quat_gradient(seen, d0, d1)
        for k in range(4):
            gradients.quats[i, k] = by_quat[k]
        r0, r1, r2 = seen.rotation
        ga = (dot(r0, d0), dot(r1, d0), dot(r2, d0))
        gb = (dot(r0, d1), dot(r1, d1), dot(r2, d1))
        point, by_focal, by_center = _point_gradient(camera, seen, grad_px, grad_py, ga, gb)
        _set(gradients.means, i, blend2(1.0, row_times(point, camera.rows), 1.0, by_ray))
        jx = camera.fx * seen.inv_z
        jy = camera.fy * seen.inv_z
        row0 = blend2(point[0], mean, jx, ga)
        row1 = blend2(point[1], mean, jy, gb)
        row2 = blend2(point[2], mean, -1.0, blend2(jx * seen.tan_x, ga, jy * seen.tan_y, gb))
        # add the gradient through the colors, which depend on the camera center −RᵀT
        row0 = blend2(1.0, row0, camera.shift[0], by_ray)
        row1 = blend2(1.0, row1, camera.shift[1], by_ray)
        row2 = blend2(1.0, row2, camera.shift[2], by_ray)
        shift0 = point[0] + dot(by_ray, camera.rows[0])
        shift1 = point[1] + dot(by_ray, camera.rows[1])
        shift2 = point[2] + dot(by_ray, camera.rows[2])
        viewmat = row0 + (shift0,) + row1 + (shift1,) + row2 + (shift2,)  # noqa: RUF005  for numba
        parts = viewmat + by_focal + by_center
        for k in range(CAMERA):
            by_camera[i // BLOCK, k] += parts[k]
