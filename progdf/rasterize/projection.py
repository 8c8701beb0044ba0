"""Kernels: cull to the window, then project the survivors, in float64, in depth order.

A projected Gaussian ("splat") is eight float64, one cache line, in units in which alpha = 2^-(u² + v²) · opacity:
u = l11 · (dx + slope · dy) and v = l22 · dy for a pixel at offset (dx, dy) from the centre. l is the Cholesky factor
of the conic times sqrt(log2(e) / 2), so the exponent cannot become positive however thin the Gaussian is.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from progdf.rasterize.conventions import ALPHA_MIN, ANTIALIAS_FLOOR, DILATION, FRUSTUM_MARGIN
from progdf.rasterize.jit import kernel
from progdf.rasterize.shading import shade

Array = NDArray[Any]

MX, MY, SLOPE, L11, INV_L11, L22, R2, EXTENT_Y = range(8)
"""Columns of a splat: centre in pixels, the three shape numbers, u² + v² at alpha = 1/255, half height in pixels."""

HALF_LOG2E = 0.5 * math.log2(math.e)
UNIT = math.sqrt(HALF_LOG2E)
"""u and v per standard deviation."""

_MAX_REACH2 = 2.0 * math.log(1.0 / ALPHA_MIN)


@kernel(inline=True)
def rotation_entries(q: Array) -> tuple[float, ...]:
    """(unit w, x, y, z, 1/length); the length is 0 and the rotation the identity where q is zero or not finite."""
    largest = 0.0
    finite = True
    for k in range(4):
        value = abs(np.float64(q[k]))
        finite = finite and value < np.inf
        largest = max(largest, value)
    if not finite or largest == 0.0:
        return 1.0, 0.0, 0.0, 0.0, 0.0
    w, x, y, z = np.float64(q[0]), np.float64(q[1]), np.float64(q[2]), np.float64(q[3])
    inverse = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@kernel(inline=True)
def rotation_matrix(w: float, x: float, y: float, z: float) -> tuple[float, ...]:
    """Row-major entries of the rotation by a unit quaternion."""
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@kernel(inline=True)
def axes_2d(
    i: int,
    tan_x: float,
    tan_y: float,
    z: float,
    fx: float,
    fy: float,
    quats: Array,
    scales: Array,
    viewmat: Array,
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The Gaussian's three axes, seen in pixels: p0 their x components, p1 their y components."""
    w, qx, qy, qz, _ = rotation_entries(quats[i])
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_matrix(w, qx, qy, qz)
    s0, s1, s2 = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
    jx, jy = fx / z, fy / z
    a0 = jx * (viewmat[0, 0] - tan_x * viewmat[2, 0])
    a1 = jx * (viewmat[0, 1] - tan_x * viewmat[2, 1])
    a2 = jx * (viewmat[0, 2] - tan_x * viewmat[2, 2])
    b0 = jy * (viewmat[1, 0] - tan_y * viewmat[2, 0])
    b1 = jy * (viewmat[1, 1] - tan_y * viewmat[2, 1])
    b2 = jy * (viewmat[1, 2] - tan_y * viewmat[2, 2])
    p0 = (
        (a0 * r00 + a1 * r10 + a2 * r20) * s0,
        (a0 * r01 + a1 * r11 + a2 * r21) * s1,
        (a0 * r02 + a1 * r12 + a2 * r22) * s2,
    )
    p1 = (
        (b0 * r00 + b1 * r10 + b2 * r20) * s0,
        (b0 * r01 + b1 * r11 + b2 * r21) * s1,
        (b0 * r02 + b1 * r12 + b2 * r22) * s2,
    )
    return p0, p1


@kernel(inline=True)
def clamped_tangents(
    x: float, y: float, z: float, fx: float, fy: float, cx: float, cy: float, width: int, height: int
) -> tuple[float, float]:
    """x/z and y/z within the frustum plus its margin (Kerbl 2023, computeCov2D; limits as gsplat)."""
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * width / fx, FRUSTUM_MARGIN * 0.5 * height / fy
    tan_x = min(max(x / z, -(cx / fx + margin_x)), (width - cx) / fx + margin_x)
    tan_y = min(max(y / z, -(cy / fy + margin_y)), (height - cy) / fy + margin_y)
    return tan_x, tan_y


@kernel(inline=True)
def _all_finite(row: Array) -> bool:
    finite = True
    for k in range(row.size):
        finite = finite and abs(row[k]) < np.inf
    return finite


@kernel(parallel=True, cache=True)
def cull(
    means: Array, scales: Array, opacities: Array, viewmat: Array, intrinsics: Array, size: Array, window: Array,
    near: float, centres: Array, depths: Array, candidates: Array,
) -> None:  # fmt: skip
    """Mark the Gaussians that may touch the window, by a bound that needs no covariance.

    Args:
        means, scales, opacities: activated. [N,3], [N,3], [N] float32
        viewmat: [4,4] float64
        intrinsics: fx, fy, cx, cy. [4] float64
        size: width, height of the full image. [2] int64
        window: x0, y0, x1, y1. [4] int64
        near: least camera z
        centres: out, [N,2] float32
        depths: out, [N] float32
        candidates: out, [N] bool
    """
    n = means.shape[0]
    fx, fy, cx, cy = intrinsics
    width, height = size
    x0, y0, x1, y1 = window
    chunk = 2048
    for c in prange((n + chunk - 1) // chunk):
        for i in range(c * chunk, min(n, (c + 1) * chunk)):
            candidates[i] = False
            centres[i, 0] = centres[i, 1] = depths[i] = 0.0
            opacity = np.float64(opacities[i])
            if not (opacity >= ALPHA_MIN and opacity < np.inf):
                continue
            m0, m1, m2 = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
            z = viewmat[2, 0] * m0 + viewmat[2, 1] * m1 + viewmat[2, 2] * m2 + viewmat[2, 3]
            s0, s1, s2 = (
                abs(np.float64(scales[i, 0])),
                abs(np.float64(scales[i, 1])),
                abs(np.float64(scales[i, 2])),
            )
            if not (z > near and abs(m0) + abs(m1) + abs(m2) + s0 + s1 + s2 < np.inf):
                continue
            x = viewmat[0, 0] * m0 + viewmat[0, 1] * m1 + viewmat[0, 2] * m2 + viewmat[0, 3]
            y = viewmat[1, 0] * m0 + viewmat[1, 1] * m1 + viewmat[1, 2] * m2 + viewmat[1, 3]
            px, py = fx * x / z + cx, fy * y / z + cy
            centres[i, 0], centres[i, 1], depths[i] = px, py, z
            tan_x, tan_y = clamped_tangents(x, y, z, fx, fy, cx, cy, width, height)
            reach2 = _MAX_REACH2 if opacity <= 1.0 else 2.0 * math.log(opacity / ALPHA_MIN)
            largest = max(s0, s1, s2)
            jx, jy = largest * fx / z, largest * fy / z
            out_x, out_y = max(x0 - px, px - x1, 0.0), max(y0 - py, py - y1, 0.0)
            # 1.001: the viewmat's rotation is only a rotation within rounding
            candidates[i] = (
                out_x * out_x <= 1.001 * reach2 * (jx * jx * (1.0 + tan_x * tan_x) + DILATION)
                and out_y * out_y <= 1.001 * reach2 * (jy * jy * (1.0 + tan_y * tan_y) + DILATION)
            )  # fmt: skip


@kernel(parallel=True, cache=True)
def project(
    ids: Array, means: Array, quats: Array, scales: Array, opacities: Array, colors: Array, degree: int,
    viewmat: Array, intrinsics: Array, size: Array, window: Array, antialiased: bool,
    splats: Array, rgb: Array, visible: Array,
) -> None:  # fmt: skip
    """Project and shade the candidates.

    Args:
        ids: candidates, nearest first. [V] int64
        means, quats, scales, opacities: activated. [N,3], [N,4], [N,3], [N] float32
        colors: rgb [N,1,3] with degree -1, else SH coefficients [N,K,3]. float32
        viewmat, intrinsics, size, window: as in `cull`
        splats: out, the columns named above; R2 is -1 where the splat is not shown. [V,8] float64
        rgb: out, [V,4] opacity last, antialias included. float32
        visible: out, set to True for what is shown. [N] bool
    """
    count = ids.size
    fx, fy, cx, cy = intrinsics
    width, height = size
    x0, y0, x1, y1 = window
    chunk = 256
    for part in prange((count + chunk - 1) // chunk):
        for s in range(part * chunk, min(count, (part + 1) * chunk)):
            i = ids[s]
            splats[s, R2] = -1.0
            splats[s, EXTENT_Y] = -1.0
            if degree < 0:
                if not _all_finite(colors[i, 0]):
                    continue
            else:
                finite = True
                for k in range((degree + 1) ** 2):
                    finite = finite and _all_finite(colors[i, k])
                if not finite:
                    continue
            m0, m1, m2 = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
            x = viewmat[0, 0] * m0 + viewmat[0, 1] * m1 + viewmat[0, 2] * m2 + viewmat[0, 3]
            y = viewmat[1, 0] * m0 + viewmat[1, 1] * m1 + viewmat[1, 2] * m2 + viewmat[1, 3]
            z = viewmat[2, 0] * m0 + viewmat[2, 1] * m1 + viewmat[2, 2] * m2 + viewmat[2, 3]
            px, py = fx * x / z + cx, fy * y / z + cy
            tan_x, tan_y = clamped_tangents(x, y, z, fx, fy, cx, cy, width, height)
            p0, p1 = axes_2d(i, tan_x, tan_y, z, fx, fy, quats, scales, viewmat)
            a = p0[0] * p0[0] + p0[1] * p0[1] + p0[2] * p0[2]
            b = p0[0] * p1[0] + p0[1] * p1[1] + p0[2] * p1[2]
            c = p1[0] * p1[0] + p1[1] * p1[1] + p1[2] * p1[2]
            # ac − b² cancels for needles (4 % wrong at 1000 px in float32); the cross product does not
            n0, n1, n2 = (
                p0[1] * p1[2] - p0[2] * p1[1],
                p0[2] * p1[0] - p0[0] * p1[2],
                p0[0] * p1[1] - p0[1] * p1[0],
            )
            det0 = n0 * n0 + n1 * n1 + n2 * n2
            det = det0 + DILATION * (a + c) + DILATION * DILATION
            opacity = np.float64(opacities[i])
            if antialiased:
                opacity *= math.sqrt(max(ANTIALIAS_FLOOR, det0 / det))
                if opacity < ALPHA_MIN:
                    continue
            r2 = max(0.0, math.log2(opacity / ALPHA_MIN))
            extent_x = math.sqrt(r2 * (a + DILATION)) / UNIT
            extent_y = math.sqrt(r2 * (c + DILATION)) / UNIT
            if px + extent_x < x0 or px - extent_x > x1 or py + extent_y < y0 or py - extent_y > y1:
                continue
            visible[i] = True
            splats[s, MX] = px
            splats[s, MY] = py
            splats[s, SLOPE] = -b / (c + DILATION)
            splats[s, L11] = UNIT * math.sqrt((c + DILATION) / det)
            splats[s, INV_L11] = math.sqrt(det / (c + DILATION)) / UNIT
            splats[s, L22] = UNIT / math.sqrt(c + DILATION)
            splats[s, R2] = r2
            splats[s, EXTENT_Y] = extent_y
            rgb[s, 3] = opacity
            if degree < 0:
                rgb[s, 0], rgb[s, 1], rgb[s, 2] = colors[i, 0, 0], colors[i, 0, 1], colors[i, 0, 2]
            else:
                red, green, blue = shade(colors[i], degree, m0, m1, m2, viewmat)
                rgb[s, 0], rgb[s, 1], rgb[s, 2] = max(0.0, red), max(0.0, green), max(0.0, blue)
