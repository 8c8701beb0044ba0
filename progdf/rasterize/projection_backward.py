"""Kernel: from the sums of all intersections to gradients of the inputs, in float64, in one fixed order.

With σ = ½|Lᵀd|² and e = Lᵀd (that is u, v), a change δΣ of the 2D covariance changes σ by −½ eᵀ(Lᵀ δΣ L)e and a move
δm of the centre by −eᵀLᵀδm. So the moments Σg·e and Σg·eeᵀ are all that is needed, and Lᵀ meets the 2D axes
M = J·W·R·S in the product LᵀM, which does not cancel for needles when it is written with a cross product.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from progdf.rasterize.blend_backward import SUMS
from progdf.rasterize.conventions import ANTIALIAS_FLOOR, DILATION, FRUSTUM_MARGIN
from progdf.rasterize.jit import kernel
from progdf.rasterize.projection import R2, UNIT, axes_2d, clamped_tangents, rotation_entries, rotation_matrix
from progdf.rasterize.shading import shade_backward

Array = NDArray[Any]

PARTS = 64
"""The camera's gradients are added up in this many parts, whatever the number of threads: the sum's bits depend on it."""

CAMERA = 16
"""Numbers of a part: viewmat rows 0..2 (12), then fx, fy, cx, cy."""


@kernel(parallel=True, cache=True)
def project_backward(
    ids: Array, means: Array, quats: Array, scales: Array, opacities: Array, colors: Array, degree: int,
    viewmat: Array, intrinsics: Array, size: Array, antialiased: bool,
    splats: Array, per_splat: Array, sums: Array,
    grad_means: Array, grad_quats: Array, grad_scales: Array, grad_opacities: Array, grad_colors: Array,
    grad_camera: Array,
) -> None:  # fmt: skip
    """Gradients of `projection.project`, which has the same first arguments.

    Args:
        splats: nearest first. [V,8] float64
        per_splat: first row of `sums` of each splat. [V+1] int64
        sums: see `blend_backward`. [I,9] float32
        grad_means, grad_quats, grad_scales, grad_opacities, grad_colors: out, float32, zero on entry; shapes of inputs
        grad_camera: out, [PARTS, CAMERA] float64
    """
    count = ids.size
    fx, fy, cx, cy = intrinsics
    width, height = size
    step = (count + PARTS - 1) // PARTS
    for part in prange(PARTS):
        grad_camera[part] = 0.0
        total = np.empty(SUMS)
        camera = grad_camera[part]
        for s in range(part * step, min(count, (part + 1) * step)):
            if splats[s, R2] < 0.0 or per_splat[s] == per_splat[s + 1]:
                continue
            total[:] = 0.0
            for slot in range(per_splat[s], per_splat[s + 1]):
                for k in range(SUMS):
                    total[k] += sums[slot, k]
            i = ids[s]
            m0, m1, m2 = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
            x = viewmat[0, 0] * m0 + viewmat[0, 1] * m1 + viewmat[0, 2] * m2 + viewmat[0, 3]
            y = viewmat[1, 0] * m0 + viewmat[1, 1] * m1 + viewmat[1, 2] * m2 + viewmat[1, 3]
            z = viewmat[2, 0] * m0 + viewmat[2, 1] * m1 + viewmat[2, 2] * m2 + viewmat[2, 3]
            tan_x, tan_y = clamped_tangents(x, y, z, fx, fy, cx, cy, width, height)
            p0, p1 = axes_2d(i, tan_x, tan_y, z, fx, fy, quats, scales, viewmat)
            a = p0[0] * p0[0] + p0[1] * p0[1] + p0[2] * p0[2]
            b = p0[0] * p1[0] + p0[1] * p1[1] + p0[2] * p1[2]
            c = p1[0] * p1[0] + p1[1] * p1[1] + p1[2] * p1[2]
            n0, n1, n2 = (
                p0[1] * p1[2] - p0[2] * p1[1],
                p0[2] * p1[0] - p0[0] * p1[2],
                p0[0] * p1[1] - p0[1] * p1[0],
            )
            det0 = n0 * n0 + n1 * n1 + n2 * n2
            det = det0 + DILATION * (a + c) + DILATION * DILATION
            root_c = math.sqrt(c + DILATION)
            root = math.sqrt(det) * root_c

            # dL/dσ-moments: alpha = opacity · exp(−σ), so dL/dσ = −g; the sums are in units of u, v
            e0, e1 = -total[4] / UNIT, -total[5] / UNIT
            h00, h01, h11 = -total[6] / (UNIT * UNIT), -total[7] / (UNIT * UNIT), -total[8] / (UNIT * UNIT)
            l11, l21, l22 = root_c * root_c / root, -b / root, 1.0 / root_c
            grad_px = -l11 * e0
            grad_py = -(l21 * e0 + l22 * e1)

            # dL/dM = −L H (LᵀM); the first row of LᵀM is (p1 × (p0 × p1) + ε p0) / root
            w0 = (p1[1] * n2 - p1[2] * n1 + DILATION * p0[0]) / root
            w1 = (p1[2] * n0 - p1[0] * n2 + DILATION * p0[1]) / root
            w2 = (p1[0] * n1 - p1[1] * n0 + DILATION * p0[2]) / root
            f00, f01, f10, f11 = -l11 * h00, -l11 * h01, -(l21 * h00 + l22 * h01), -(l21 * h01 + l22 * h11)
            d00, d01, d02 = (
                f00 * w0 + f01 * l22 * p1[0],
                f00 * w1 + f01 * l22 * p1[1],
                f00 * w2 + f01 * l22 * p1[2],
            )
            d10, d11, d12 = (
                f10 * w0 + f11 * l22 * p1[0],
                f10 * w1 + f11 * l22 * p1[1],
                f10 * w2 + f11 * l22 * p1[2],
            )

            opacity = np.float64(opacities[i])
            grad_opacities[i] = total[3] / opacity
            ratio = det0 / det
            if antialiased and ratio >= ANTIALIAS_FLOOR:
                # opacity · sqrt(ratio): dL/dratio = Σg / (2 ratio)
                by_det0 = total[3] / (2.0 * ratio) * (det - det0) / (det * det)
                by_trace = -total[3] / 2.0 * DILATION / det
                d00 += 2.0 * (by_det0 * (p1[1] * n2 - p1[2] * n1) + by_trace * p0[0])
                d01 += 2.0 * (by_det0 * (p1[2] * n0 - p1[0] * n2) + by_trace * p0[1])
                d02 += 2.0 * (by_det0 * (p1[0] * n1 - p1[1] * n0) + by_trace * p0[2])
                d10 += 2.0 * (by_det0 * (n1 * p0[2] - n2 * p0[1]) + by_trace * p1[0])
                d11 += 2.0 * (by_det0 * (n2 * p0[0] - n0 * p0[2]) + by_trace * p1[1])
                d12 += 2.0 * (by_det0 * (n0 * p0[1] - n1 * p0[0]) + by_trace * p1[2])

            # M = [A0; A1] R S with A0 = fx/z (W0 − tan_x W2), A1 = fy/z (W1 − tan_y W2)
            q0, q1, q2, q3, inverse_length = rotation_entries(quats[i])
            r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_matrix(q0, q1, q2, q3)
            s0, s1, s2 = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
            jx, jy = fx / z, fy / z
            a0, a1, a2 = (
                jx * (viewmat[0, 0] - tan_x * viewmat[2, 0]),
                jx * (viewmat[0, 1] - tan_x * viewmat[2, 1]),
                jx * (viewmat[0, 2] - tan_x * viewmat[2, 2]),
            )
            b0, b1, b2 = (
                jy * (viewmat[1, 0] - tan_y * viewmat[2, 0]),
                jy * (viewmat[1, 1] - tan_y * viewmat[2, 1]),
                jy * (viewmat[1, 2] - tan_y * viewmat[2, 2]),
            )
            grad_scales[i, 0] = d00 * (a0 * r00 + a1 * r10 + a2 * r20) + d10 * (
                b0 * r00 + b1 * r10 + b2 * r20
            )
            grad_scales[i, 1] = d01 * (a0 * r01 + a1 * r11 + a2 * r21) + d11 * (
                b0 * r01 + b1 * r11 + b2 * r21
            )
            grad_scales[i, 2] = d02 * (a0 * r02 + a1 * r12 + a2 * r22) + d12 * (
                b0 * r02 + b1 * r12 + b2 * r22
            )
            d00, d01, d02, d10, d11, d12 = d00 * s0, d01 * s1, d02 * s2, d10 * s0, d11 * s1, d12 * s2
            if inverse_length > 0.0:
                v00, v01, v02 = a0 * d00 + b0 * d10, a0 * d01 + b0 * d11, a0 * d02 + b0 * d12
                v10, v11, v12 = a1 * d00 + b1 * d10, a1 * d01 + b1 * d11, a1 * d02 + b1 * d12
                v20, v21, v22 = a2 * d00 + b2 * d10, a2 * d01 + b2 * d11, a2 * d02 + b2 * d12
                gw = 2.0 * (q1 * (v21 - v12) + q2 * (v02 - v20) + q3 * (v10 - v01))
                gx = 2.0 * (q2 * (v01 + v10) + q3 * (v02 + v20) + q0 * (v21 - v12) - 2.0 * q1 * (v11 + v22))
                gy = 2.0 * (q1 * (v01 + v10) + q3 * (v12 + v21) + q0 * (v02 - v20) - 2.0 * q2 * (v00 + v22))
                gz = 2.0 * (q1 * (v02 + v20) + q2 * (v12 + v21) + q0 * (v10 - v01) - 2.0 * q3 * (v00 + v11))
                along = gw * q0 + gx * q1 + gy * q2 + gz * q3
                grad_quats[i, 0] = (gw - along * q0) * inverse_length
                grad_quats[i, 1] = (gx - along * q1) * inverse_length
                grad_quats[i, 2] = (gy - along * q2) * inverse_length
                grad_quats[i, 3] = (gz - along * q3) * inverse_length
            ga0, ga1, ga2 = (
                d00 * r00 + d01 * r01 + d02 * r02,
                d00 * r10 + d01 * r11 + d02 * r12,
                d00 * r20 + d01 * r21 + d02 * r22,
            )
            gb0, gb1, gb2 = (
                d10 * r00 + d11 * r01 + d12 * r02,
                d10 * r10 + d11 * r11 + d12 * r12,
                d10 * r20 + d11 * r21 + d12 * r22,
            )
            ga_w2 = ga0 * viewmat[2, 0] + ga1 * viewmat[2, 1] + ga2 * viewmat[2, 2]
            gb_w2 = gb0 * viewmat[2, 0] + gb1 * viewmat[2, 1] + gb2 * viewmat[2, 2]
            grad_jx = ga0 * viewmat[0, 0] + ga1 * viewmat[0, 1] + ga2 * viewmat[0, 2] - tan_x * ga_w2
            grad_jy = gb0 * viewmat[1, 0] + gb1 * viewmat[1, 1] + gb2 * viewmat[1, 2] - tan_y * gb_w2
            grad_tan_x, grad_tan_y = -jx * ga_w2, -jy * gb_w2

            # px = fx x/z + cx, jx = fx/z, and tan_x = x/z unless it is clamped
            camera[12] += grad_px * x / z + grad_jx / z
            camera[13] += grad_py * y / z + grad_jy / z
            camera[14] += grad_px
            camera[15] += grad_py
            half_x, half_y = FRUSTUM_MARGIN * 0.5 * width, FRUSTUM_MARGIN * 0.5 * height
            slope_x, slope_y = fx * grad_px, fy * grad_py
            if tan_x == x / z:
                slope_x += grad_tan_x
            else:  # clamped at (width − cx + half) / fx or −(cx + half) / fx
                camera[12] -= grad_tan_x * tan_x / fx
                camera[14] -= grad_tan_x / fx
            if tan_y == y / z:
                slope_y += grad_tan_y
            else:
                camera[13] -= grad_tan_y * tan_y / fy
                camera[15] -= grad_tan_y / fy
            gx, gy = slope_x / z, slope_y / z
            gz = -(slope_x * x + slope_y * y) / (z * z) - (grad_jx * fx + grad_jy * fy) / (z * z)
            gm0 = gx * viewmat[0, 0] + gy * viewmat[1, 0] + gz * viewmat[2, 0]
            gm1 = gx * viewmat[0, 1] + gy * viewmat[1, 1] + gz * viewmat[2, 1]
            gm2 = gx * viewmat[0, 2] + gy * viewmat[1, 2] + gz * viewmat[2, 2]
            camera[0] += gx * m0 + jx * ga0
            camera[1] += gx * m1 + jx * ga1
            camera[2] += gx * m2 + jx * ga2
            camera[3] += gx
            camera[4] += gy * m0 + jy * gb0
            camera[5] += gy * m1 + jy * gb1
            camera[6] += gy * m2 + jy * gb2
            camera[7] += gy
            camera[8] += gz * m0 - jx * tan_x * ga0 - jy * tan_y * gb0
            camera[9] += gz * m1 - jx * tan_x * ga1 - jy * tan_y * gb1
            camera[10] += gz * m2 - jx * tan_x * ga2 - jy * tan_y * gb2
            camera[11] += gz

            if degree < 0:
                grad_colors[i, 0, 0], grad_colors[i, 0, 1], grad_colors[i, 0, 2] = (
                    total[0],
                    total[1],
                    total[2],
                )
            else:
                t0, t1, t2 = shade_backward(colors[i], degree, m0, m1, m2, viewmat, total, grad_colors[i])
                gm0 += t0
                gm1 += t1
                gm2 += t2
                for row in range(3):  # the camera centre is −RᵀT
                    along = t0 * viewmat[row, 0] + t1 * viewmat[row, 1] + t2 * viewmat[row, 2]
                    camera[4 * row + 3] += along
                    camera[4 * row] += t0 * viewmat[row, 3]
                    camera[4 * row + 1] += t1 * viewmat[row, 3]
                    camera[4 * row + 2] += t2 * viewmat[row, 3]
            grad_means[i, 0], grad_means[i, 1], grad_means[i, 2] = gm0, gm1, gm2
