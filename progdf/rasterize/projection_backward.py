"""Kernel: from the sums of all intersections to gradients of the inputs, in float64, in one fixed order.

With σ = ½|Lᵀd|² and e = Lᵀd (that is u, v), a change δΣ of the 2D covariance changes σ by −½ eᵀ(Lᵀ δΣ L)e
and a move δm of the centre by −eᵀLᵀδm. So the moments Σg·e and Σg·eeᵀ are all that is needed, and Lᵀ meets
the 2D axes M = J·W·R·S in the product LᵀM, which does not cancel for needles when it is written with a cross
product.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.blend_backward import SUMS
from progdf.rasterize.conventions import ANTIALIAS_FLOOR, DILATION
from progdf.rasterize.geometry import (
    Footprint,
    Lens,
    Vec,
    blend2,
    cross,
    dot,
    footprint,
    make_lens,
    row_times,
    times,
    vec,
)  # fmt: skip
from progdf.rasterize.jit import kernel
from progdf.rasterize.projection import R2, UNIT
from progdf.rasterize.shading import shade_backward
from progdf.rasterize.shares import claim

Array = NDArray[Any]

PARTS = 64
"""The camera's gradients are added up in this many parts, for any number of threads: so bits are the same."""

CAMERA = 16
"""Numbers of a part: viewmat rows 0..2 (12), then fx, fy, cx, cy."""


@kernel(contract=True, inline=True)
def _axes_gradient(seen: Footprint, total: Array, antialiased: bool) -> tuple[float, float, Vec, Vec]:
    """Gradients to the centre in pixels (2) and to the 2D axes p0, p1, from a splat's sums [9]."""
    # the sums are of g = −dL/dσ, in units of u and v
    e0, e1 = -total[4] / UNIT, -total[5] / UNIT
    h00, h01, h11 = -total[6] / (UNIT * UNIT), -total[7] / (UNIT * UNIT), -total[8] / (UNIT * UNIT)
    sigma_y = math.sqrt(seen.c + DILATION)
    inv_root = 1.0 / (math.sqrt(seen.det) * sigma_y)
    l11, l21, l22 = sigma_y * sigma_y * inv_root, -seen.b * inv_root, 1.0 / sigma_y
    # dL/dM = −L H (LᵀM); the first row of LᵀM is (p1 × (p0 × p1) + ε p0) / root
    along = blend2(inv_root, cross(seen.p1, seen.normal), DILATION * inv_root, seen.p0)
    d0 = blend2(-l11 * h00, along, -l11 * h01 * l22, seen.p1)
    d1 = blend2(-(l21 * h00 + l22 * h01), along, -(l21 * h01 + l22 * h11) * l22, seen.p1)
    if antialiased and seen.det0 >= ANTIALIAS_FLOOR * seen.det:
        # opacity · sqrt(det0 / det): d log = (ddet0 / det0 − ddet / det) / 2, det = det0 + ε (a + c) + ε²
        by_det0 = total[3] * (1.0 / seen.det0 - 1.0 / seen.det)
        by_trace = -total[3] * DILATION / seen.det
        d0 = blend2(1.0, d0, by_det0, cross(seen.p1, seen.normal))
        d0 = blend2(1.0, d0, by_trace, seen.p0)
        d1 = blend2(1.0, d1, by_det0, cross(seen.normal, seen.p0))
        d1 = blend2(1.0, d1, by_trace, seen.p1)
    return -l11 * e0, -(l21 * e0 + l22 * e1), d0, d1


@kernel(contract=True, inline=True)
def _quat_gradient(seen: Footprint, d0: Vec, d1: Vec) -> tuple[float, float, float, float]:
    """Gradient to the quaternion as given; d0, d1: gradients to the rows a0ᵀR, a1ᵀR."""
    q0, q1, q2, q3 = seen.quat
    v0, v1, v2 = (
        blend2(seen.a0[0], d0, seen.a1[0], d1),
        blend2(seen.a0[1], d0, seen.a1[1], d1),
        blend2(seen.a0[2], d0, seen.a1[2], d1),
    )
    sym01, sym02, sym12 = v0[1] + v1[0], v0[2] + v2[0], v1[2] + v2[1]
    skew01, skew02, skew12 = v1[0] - v0[1], v0[2] - v2[0], v2[1] - v1[2]
    gw = 2.0 * (q1 * skew12 + q2 * skew02 + q3 * skew01)
    gx = 2.0 * (q2 * sym01 + q3 * sym02 + q0 * skew12 - 2.0 * q1 * (v1[1] + v2[2]))
    gy = 2.0 * (q1 * sym01 + q3 * sym12 + q0 * skew02 - 2.0 * q2 * (v0[0] + v2[2]))
    gz = 2.0 * (q1 * sym02 + q2 * sym12 + q0 * skew01 - 2.0 * q3 * (v0[0] + v1[1]))
    radial = gw * q0 + gx * q1 + gy * q2 + gz * q3
    k = seen.inv_length
    return (gw - radial * q0) * k, (gx - radial * q1) * k, (gy - radial * q2) * k, (gz - radial * q3) * k


@kernel(contract=True, inline=True)
def _point_gradient(
    lens: Lens, seen: Footprint, grad_px: float, grad_py: float, ga: Vec, gb: Vec, camera: Array
) -> Vec:
    """Gradient to the point in camera axes; adds the intrinsics' to `camera`. ga, gb: gradients to a0, a1.

    px = fx x/z + cx; a0 = fx/z (W0 − tan_x W2), where tan_x is x/z or a limit ((width − cx) + half)/fx,
    −(cx + half)/fx; the same for y.
    """
    inv_z = seen.inv_z
    jx, jy = lens.fx * inv_z, lens.fy * inv_z
    down_a, down_b = dot(ga, lens.rows[2]), dot(gb, lens.rows[2])
    grad_jx = dot(ga, lens.rows[0]) - seen.tan_x * down_a
    grad_jy = dot(gb, lens.rows[1]) - seen.tan_y * down_b
    slope_x, slope_y = lens.fx * grad_px, lens.fy * grad_py
    camera[12] += grad_px * seen.x * inv_z + grad_jx * inv_z
    camera[13] += grad_py * seen.y * inv_z + grad_jy * inv_z
    camera[14] += grad_px
    camera[15] += grad_py
    if seen.free_x:
        slope_x -= jx * down_a
    else:
        camera[12] += jx * down_a * seen.tan_x / lens.fx
        camera[14] += jx * down_a / lens.fx
    if seen.free_y:
        slope_y -= jy * down_b
    else:
        camera[13] += jy * down_b * seen.tan_y / lens.fy
        camera[15] += jy * down_b / lens.fy
    towards = slope_x * seen.x + slope_y * seen.y + grad_jx * lens.fx + grad_jy * lens.fy
    return slope_x * inv_z, slope_y * inv_z, -towards * inv_z * inv_z


@kernel(contract=True)
def _project_backward_range(
    begin: int, end: int, ids: Array, ranks: Array, means: Array, quats: Array, scales: Array,
    opacities: Array, colors: Array, degree: int, viewmat: Array, intrinsics: Array, size: Array,
    antialiased: bool, splats: Array, per_splat: Array, sums: Array, wanted: Array,
    grad_means: Array, grad_quats: Array, grad_scales: Array, grad_opacities: Array, grad_colors: Array,
    camera: Array,
) -> None:  # fmt: skip
    lens = make_lens(viewmat, intrinsics, size)
    total, basis, slopes = np.empty(SUMS), np.empty(16), np.zeros((16, 3))
    for n in range(begin, end):
        i, s = ids[n], ranks[n]
        if not wanted[s] or splats[s, R2] < 0.0 or per_splat[s] == per_splat[s + 1]:
            continue
        for k in range(SUMS):
            total[k] = 0.0
        for slot in range(per_splat[s], per_splat[s + 1]):
            for k in range(SUMS):
                total[k] += sums[slot, k]
        mean, scale = vec(means, i), vec(scales, i)
        seen = footprint(
            lens, mean, np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]),
            np.float64(quats[i, 3]), scale,
        )  # fmt: skip
        grad_opacities[i] = total[3] / np.float64(opacities[i])
        grad_px, grad_py, d0, d1 = _axes_gradient(seen, total, antialiased)
        by_scale0, by_scale1 = times(d0, seen.turned0), times(d1, seen.turned1)
        for k in range(3):
            grad_scales[i, k] = by_scale0[k] + by_scale1[k]
        d0, d1 = times(d0, scale), times(d1, scale)
        by_quat = _quat_gradient(seen, d0, d1)
        for k in range(4):
            grad_quats[i, k] = by_quat[k]
        r0, r1, r2 = seen.rotation
        ga, gb = (dot(r0, d0), dot(r1, d0), dot(r2, d0)), (dot(r0, d1), dot(r1, d1), dot(r2, d1))
        point = _point_gradient(lens, seen, grad_px, grad_py, ga, gb, camera)
        by_mean = row_times(point, lens.rows)
        jx, jy = lens.fx * seen.inv_z, lens.fy * seen.inv_z
        for k in range(3):
            camera[k] += point[0] * mean[k] + jx * ga[k]
            camera[4 + k] += point[1] * mean[k] + jy * gb[k]
            camera[8 + k] += point[2] * mean[k] - jx * seen.tan_x * ga[k] - jy * seen.tan_y * gb[k]
            camera[4 * k + 3] += point[k]
        if degree < 0:
            for k in range(3):
                grad_colors[i, 0, k] = total[k]
        else:
            by_rgb = (total[0], total[1], total[2])
            by_ray = shade_backward(i, colors, degree, mean, lens.eye, by_rgb, basis, slopes, grad_colors)
            by_mean = blend2(1.0, by_mean, 1.0, by_ray)
            for row in range(3):  # the eye is −RᵀT
                camera[4 * row + 3] += dot(by_ray, lens.rows[row])
                for k in range(3):
                    camera[4 * row + k] += by_ray[k] * lens.shift[row]
        for k in range(3):
            grad_means[i, k] = by_mean[k]


@kernel(cache=True)
def project_backward(
    ids: Array, ranks: Array, means: Array, quats: Array, scales: Array, opacities: Array, colors: Array,
    degree: int, viewmat: Array, intrinsics: Array, size: Array, antialiased: bool,
    splats: Array, per_splat: Array, sums: Array, wanted: Array,
    grad_means: Array, grad_quats: Array, grad_scales: Array, grad_opacities: Array, grad_colors: Array,
    grad_camera: Array, claims: Array,
) -> None:  # fmt: skip
    """Gradients of `projection.project`, which has the same first arguments.

    Args:
        splats: nearest first. [V,8] float64
        per_splat: first row of `sums` of each splat. [V+1] int64
        sums: see `blend_backward`. [I,9] float32
        wanted: splats whose gradients are filled in. [V] bool
        grad_means, grad_quats, grad_scales, grad_opacities, grad_colors: out, float32, zero on entry; shapes
            of inputs
        grad_camera: out, zero on entry. [PARTS, CAMERA] float64
        claims: as `shares.claim` wants it
    """
    step = (ids.size + PARTS - 1) // PARTS
    part = claim(claims)
    while part < PARTS:
        _project_backward_range(
            part * step, min(ids.size, (part + 1) * step), ids, ranks, means, quats, scales, opacities,
            colors, degree, viewmat, intrinsics, size, antialiased, splats, per_splat, sums, wanted,
            grad_means, grad_quats, grad_scales, grad_opacities, grad_colors, grad_camera[part],
        )  # fmt: skip
        part = claim(claims)
