"""Kernels: cull to the window, then project the survivors, in float64.

A projected Gaussian ("splat") is eight float64, one cache line, in units in which alpha = 2^-(u² + v²) ·
opacity: u = l11 · (dx + slope · dy) and v = l22 · dy for a pixel at offset (dx, dy) from the centre. l is
    the Cholesky factor
of the conic times sqrt(log2(e) / 2), so the exponent cannot become positive however thin the Gaussian is.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .conventions import ALPHA_MIN, ANTIALIAS_FLOOR, DILATION
from .gathers import gather, gather_vec, rows_at, rows_from, scatter
from .geometry import Vec, dot, footprint, make_lens, vec
from .jit import kernel
from .lanes import WIDTH, choose, prefetch_to_write
from .shading import fill_basis, view_direction
from .shares import pieces

Array = NDArray[Any]

MX, MY, SLOPE, L11, INV_L11, L22, R2, EXTENT_Y = range(8)
"""Columns of a splat: centre in pixels, shape, u² + v² at alpha = 1/255, half height in pixels."""

UNIT = math.sqrt(0.5 * math.log2(math.e))
"""u and v per standard deviation."""

_PER_UNIT, _PER_ALPHA_MIN = 1.0 / UNIT, 1.0 / ALPHA_MIN
_REACH2 = 2.0 * math.log(1.0 / ALPHA_MIN)
_CHUNK = 512  # Gaussians that a thread takes at once


@kernel(contract=True)
def _cull_range(
    begin: int, end: int, means: Array, scales: Array, opacities: Array, viewmat: Array, intrinsics: Array,
    size: Array, window: Array, near: float, centres: Array, depths: Array, candidates: Array,
) -> None:  # fmt: skip
    lens = make_lens(viewmat, intrinsics, size)
    x0, y0 = np.float64(window[0]), np.float64(window[1])
    x1, y1 = np.float64(window[2]), np.float64(window[3])
    for k in range(begin, end, WIDTH):
        i = rows_from(k, end)
        mean, scale, opacity = gather_vec(means, i), gather_vec(scales, i), gather(opacities, i, 0)
        x, y = dot(lens.rows[0], mean) + lens.shift[0], dot(lens.rows[1], mean) + lens.shift[1]
        z = dot(lens.rows[2], mean) + lens.shift[2]
        total = abs(mean[0]) + abs(mean[1]) + abs(mean[2]) + abs(scale[0]) + abs(scale[1]) + abs(scale[2])
        usable = (z > near) & (opacity >= ALPHA_MIN) & (total + opacity < np.inf)
        inv_z = 1.0 / z
        tan_x, tan_y = x * inv_z, y * inv_z
        px, py = lens.fx * tan_x + lens.cx, lens.fy * tan_y + lens.cy
        tan_x = min(max(tan_x, lens.low_x), lens.high_x)
        tan_y = min(max(tan_y, lens.low_y), lens.high_y)
        # ln x ≤ x − 1; 1.001: the viewmat's rotation is one only within rounding
        reach2 = 1.001 * (_REACH2 + 2.0 * max(opacity - 1.0, 0.0))
        largest = max(abs(scale[0]), max(abs(scale[1]), abs(scale[2]))) * inv_z
        jx, jy = lens.fx * largest, lens.fy * largest
        out_x, out_y = max(max(x0 - px, px - x1), 0.0), max(max(y0 - py, py - y1), 0.0)
        near_x = out_x * out_x <= reach2 * (jx * jx * (1.0 + tan_x * tan_x) + DILATION)
        near_y = out_y * out_y <= reach2 * (jy * jy * (1.0 + tan_y * tan_y) + DILATION)
        scatter(centres, i, 0, choose(usable, px, 0.0))
        scatter(centres, i, 1, choose(usable, py, 0.0))
        scatter(depths, i, 0, choose(usable, z, 0.0))
        scatter(candidates, i, 0, usable & near_x & near_y)


@kernel()
def cull(
    means: Array, scales: Array, opacities: Array, viewmat: Array, intrinsics: Array, size: Array,
    window: Array, near: float, centres: Array, depths: Array, candidates: Array, seat: int,
    claims: Array, step: int,
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
        seat, claims, step: see `shares.pieces`
    """
    n = means.shape[0]
    parts = (n + _CHUNK - 1) // _CHUNK
    for part in pieces(claims, step, seat, parts):
        _cull_range(
            part * _CHUNK, min(n, (part + 1) * _CHUNK), means, scales, opacities, viewmat, intrinsics, size,
            window, near, centres, depths, candidates,
        )  # fmt: skip


@kernel(contract=True)
def _shape_range(
    begin: int, end: int, ids: Array, ranks: Array, means: Array, quats: Array, scales: Array,
    opacities: Array, viewmat: Array, intrinsics: Array, size: Array, window: Array, antialiased: bool,
    splats: Array, rgb: Array,
) -> None:  # fmt: skip
    """Everything but the colours, eight candidates at a time."""
    lens = make_lens(viewmat, intrinsics, size)
    x0, y0 = np.float64(window[0]), np.float64(window[1])
    x1, y1 = np.float64(window[2]), np.float64(window[3])
    for k in range(begin, end, WIDTH):
        i, s = rows_at(ids, k, end), rows_at(ranks, k, end)
        for ahead in range(min(k + WIDTH, end), min(k + 2 * WIDTH, end)):
            prefetch_to_write(splats, ranks[ahead])
            prefetch_to_write(rgb, ranks[ahead])
        seen = footprint(
            lens, gather_vec(means, i), gather(quats, i, 0), gather(quats, i, 1), gather(quats, i, 2),
            gather(quats, i, 3), gather_vec(scales, i),
        )  # fmt: skip
        opacity = gather(opacities, i, 0)
        if antialiased:
            opacity = opacity * math.sqrt(max(ANTIALIAS_FLOOR, seen.det0 / seen.det))
        var_x, var_y = seen.a + DILATION, seen.c + DILATION
        sigma_x, sigma_y, root = math.sqrt(var_x), math.sqrt(var_y), math.sqrt(seen.det)
        px, py = lens.fx * seen.x * seen.inv_z + lens.cx, lens.fy * seen.y * seen.inv_z + lens.cy
        r2 = max(0.0, math.log2(opacity * _PER_ALPHA_MIN))
        reach = math.sqrt(r2) * _PER_UNIT
        extent_x, extent_y = reach * sigma_x, reach * sigma_y
        shown = (
            (opacity >= ALPHA_MIN)
            & (px + extent_x >= x0) & (px - extent_x <= x1)
            & (py + extent_y >= y0) & (py - extent_y <= y1)
        )  # fmt: skip
        inv_sigma_y = 1.0 / sigma_y
        scatter(splats, s, MX, px)
        scatter(splats, s, MY, py)
        scatter(splats, s, SLOPE, -(seen.b * inv_sigma_y * inv_sigma_y))
        scatter(splats, s, L11, UNIT * sigma_y / root)
        scatter(splats, s, INV_L11, root * inv_sigma_y * _PER_UNIT)
        scatter(splats, s, L22, UNIT * inv_sigma_y)
        scatter(splats, s, R2, choose(shown, r2, -1.0))
        scatter(splats, s, EXTENT_Y, choose(shown, extent_y, -1.0))
        scatter(rgb, s, 3, opacity)


@kernel(contract=True, allocates=True)
def _shade_range(
    begin: int, end: int, ids: Array, ranks: Array, means: Array, colors: Array, degree: int, eye: Vec,
    splats: Array, rgb: Array, visible: Array,
) -> None:  # fmt: skip
    """The colours of what is shown; what has none is not."""
    basis = np.empty(16)
    bands = max(1, (degree + 1) ** 2)
    for k in range(begin, end):
        i, s = ids[k], ranks[k]
        if splats[s, R2] < 0.0:
            continue
        red = green = blue = 0.0
        if degree < 0:
            red, green, blue = colors[i, 0, 0], colors[i, 0, 1], colors[i, 0, 2]
        else:
            dx, dy, dz, _ = view_direction(vec(means, i), eye)
            fill_basis(degree, dx, dy, dz, basis)
            red = green = blue = 0.5
            for band in range(bands):
                red += basis[band] * colors[i, band, 0]
                green += basis[band] * colors[i, band, 1]
                blue += basis[band] * colors[i, band, 2]
        if not abs(red) + abs(green) + abs(blue) < np.inf:
            splats[s, R2] = splats[s, EXTENT_Y] = -1.0
            continue
        if degree >= 0:
            red, green, blue = max(0.0, red), max(0.0, green), max(0.0, blue)
        visible[i] = True
        rgb[s, 0], rgb[s, 1], rgb[s, 2] = red, green, blue


@kernel(allocates=True)
def project(
    ids: Array, ranks: Array, means: Array, quats: Array, scales: Array, opacities: Array, colors: Array,
    degree: int, viewmat: Array, intrinsics: Array, size: Array, window: Array, antialiased: bool,
    splats: Array, rgb: Array, visible: Array, seat: int, claims: Array, step: int,
) -> None:  # fmt: skip
    """Project and shade the candidates; read in the order of the scene, written in the order of depth.

    Args:
        ids: candidates, ascending. [V] int64
        ranks: place of each in the order of depth. [V] int64
        means, quats, scales, opacities: activated. [N,3], [N,4], [N,3], [N] float32
        colors: rgb [N,1,3] with degree -1, else SH coefficients [N,K,3]. float32
        viewmat, intrinsics, size, window: as in `cull`
        splats: out, the columns named above; R2 is -1 where the splat is not shown. [V,8] float64
        rgb: out, [V,4] opacity last, antialias included. float32
        visible: out, set to True for what is shown. [N] bool
        seat, claims, step: see `shares.pieces`
    """
    count, eye = ids.size, make_lens(viewmat, intrinsics, size).eye
    parts = (count + _CHUNK - 1) // _CHUNK
    for part in pieces(claims, step, seat, parts):
        begin, end = part * _CHUNK, min(count, (part + 1) * _CHUNK)
        _shape_range(
            begin, end, ids, ranks, means, quats, scales, opacities, viewmat, intrinsics, size, window,
            antialiased, splats, rgb,
        )  # fmt: skip
        _shade_range(begin, end, ids, ranks, means, colors, degree, eye, splats, rgb, visible)
