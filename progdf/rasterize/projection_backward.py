"""Kernel: from the sums of all intersections to gradients of the inputs, in float64, in one fixed order.

With σ = ½|Lᵀd|² and e = Lᵀd (that is u, v), a change δΣ of the 2D covariance changes σ by −½ eᵀ(Lᵀ δΣ L)e
and a move δm of the centre by −eᵀLᵀδm. So the moments Σg·e and Σg·eeᵀ are all that is needed, and Lᵀ meets
the 2D axes M = J·W·R·S in the product LᵀM, which does not cancel for needles when it is written with a cross
product.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .blend_backward import SUMS
from .conventions import ANTIALIAS_FLOOR, DILATION
from .gathers import first, gather, gather_vec, rows_at, scatter, scatter_vec
from .geometry import (  # fmt: skip
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
)
from .jit import kernel
from .lanes import WIDTH, Lanes, Mask, choose, load, prefetch, spread, store, total, widen
from .projection import R2, UNIT
from .shading import shade_backward
from .shares import pieces

Array = NDArray[Any]

_PER_UNIT, _PER_UNIT2 = 1.0 / UNIT, 1.0 / (UNIT * UNIT)

PARTS = 64
"""The camera's gradients are added up in this many parts, for any number of threads: so bits are the same."""

CAMERA = 16
"""Numbers of a part: viewmat rows 0..2 (12), then fx, fy, cx, cy."""


@kernel(contract=True, inline=True)
def _axes_gradient(seen: Footprint, g: tuple[Lanes, ...], antialiased: bool) -> tuple[Lanes, Lanes, Vec, Vec]:
    """Gradients to the centre in pixels (2) and to the 2D axes p0, p1, from Σg and its moments (6)."""
    # g = −dL/dσ; u and v are in units of their own
    e0, e1 = -g[1] * _PER_UNIT, -g[2] * _PER_UNIT
    h00, h01, h11 = -g[3] * _PER_UNIT2, -g[4] * _PER_UNIT2, -g[5] * _PER_UNIT2
    sigma_y = math.sqrt(seen.c + DILATION)
    inv_root = 1.0 / (math.sqrt(seen.det) * sigma_y)
    l11, l21, l22 = sigma_y * sigma_y * inv_root, -seen.b * inv_root, 1.0 / sigma_y
    # dL/dM = −L H (LᵀM); the first row of LᵀM is (p1 × (p0 × p1) + ε p0) / root
    along = blend2(inv_root, cross(seen.p1, seen.normal), DILATION * inv_root, seen.p0)
    d0 = blend2(-l11 * h00, along, -l11 * h01 * l22, seen.p1)
    d1 = blend2(-(l21 * h00 + l22 * h01), along, -(l21 * h01 + l22 * h11) * l22, seen.p1)
    if antialiased:
        # opacity · sqrt(det0 / det): d log = (ddet0 / det0 − ddet / det) / 2, det = det0 + ε (a + c) + ε²
        free = seen.det0 >= ANTIALIAS_FLOOR * seen.det
        by_det0 = choose(free, g[0] * (1.0 / seen.det0 - 1.0 / seen.det), 0.0)
        by_trace = choose(free, -g[0] * DILATION / seen.det, 0.0)
        d0 = blend2(1.0, d0, by_det0, cross(seen.p1, seen.normal))
        d0 = blend2(1.0, d0, by_trace, seen.p0)
        d1 = blend2(1.0, d1, by_det0, cross(seen.normal, seen.p0))
        d1 = blend2(1.0, d1, by_trace, seen.p1)
    return -l11 * e0, -(l21 * e0 + l22 * e1), d0, d1


@kernel(contract=True, inline=True)
def _quat_gradient(seen: Footprint, d0: Vec, d1: Vec) -> tuple[Lanes, Lanes, Lanes, Lanes]:
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
    lens: Lens, seen: Footprint, grad_px: Lanes, grad_py: Lanes, ga: Vec, gb: Vec
) -> tuple[Vec, tuple[Lanes, Lanes], tuple[Lanes, Lanes]]:
    """Gradients to the points in camera axes, to fx and fy, and to cx and cy. ga, gb: gradients to a0, a1.

    px = fx x/z + cx; a0 = fx/z (W0 − tan_x W2), where tan_x is x/z or a limit ((width − cx) + half)/fx,
    −(cx + half)/fx; the same for y.
    """
    inv_z = seen.inv_z
    down_a, down_b = dot(ga, lens.rows[2]), dot(gb, lens.rows[2])
    grad_jx = dot(ga, lens.rows[0]) - seen.tan_x * down_a
    grad_jy = dot(gb, lens.rows[1]) - seen.tan_y * down_b
    by_tan_x, by_tan_y = inv_z * down_a, inv_z * down_b  # over −fx, −fy
    slope_x = lens.fx * (grad_px - choose(seen.free_x, by_tan_x, 0.0))
    slope_y = lens.fy * (grad_py - choose(seen.free_y, by_tan_y, 0.0))
    by_limit_x, by_limit_y = choose(seen.free_x, 0.0, by_tan_x), choose(seen.free_y, 0.0, by_tan_y)
    towards = slope_x * seen.x + slope_y * seen.y + grad_jx * lens.fx + grad_jy * lens.fy
    by_focal = (
        (grad_px * seen.x + grad_jx) * inv_z + by_limit_x * seen.tan_x,
        (grad_py * seen.y + grad_jy) * inv_z + by_limit_y * seen.tan_y,
    )
    by_centre = (grad_px + by_limit_x, grad_py + by_limit_y)
    return (slope_x * inv_z, slope_y * inv_z, -towards * inv_z * inv_z), by_focal, by_centre


class _Scratch(NamedTuple):
    """What a thread works in.

    Args:
        rows, places: in the scene and in the order of depth, of the Gaussians that get gradients. [≥ a part]
        sums: of eight Gaussians, each followed by the gradient to the ray from the eye. [8,SUMS+3] float64
        order: 0..7. int64
        basis, slopes: see `shading.shade_backward`
        camera: the gradients to the camera, lane by lane. [CAMERA·8] float64
    """

    rows: Array
    places: Array
    sums: Array
    order: Array
    basis: Array
    slopes: Array
    camera: Array


@kernel(contract=True, inline=True)
def _add_up(begin: int, end: int, sums: Array, out: Array, row: int) -> None:
    """The sum of some intersections, as a row of `out`."""
    eight, ninth = spread(0.0), 0.0
    for slot in range(begin, end):
        eight += widen(load(sums, np.uint64(slot * SUMS)))
        ninth += sums[slot, WIDTH]
    store(out, np.uint64(row * out.shape[1]), eight)
    out[row, WIDTH] = ninth


@kernel(contract=True, inline=True)
def _add_four(camera: Array, row: int, a: Vec, b: Lanes, used: Mask) -> None:
    """Add to four numbers of the camera's gradients."""
    at = np.uint64(4 * row * WIDTH)
    for k in range(3):
        store(camera, at, load(camera, at) + choose(used, a[k], 0.0))
        at += np.uint64(WIDTH)
    store(camera, at, load(camera, at) + choose(used, b, 0.0))


@kernel(contract=True)
def _project_backward_range(
    begin: int, end: int, ids: Array, ranks: Array, means: Array, quats: Array, scales: Array,
    opacities: Array, colors: Array, degree: int, viewmat: Array, intrinsics: Array, size: Array,
    antialiased: bool, splats: Array, per_splat: Array, sums: Array, wanted: Array,
    grad_means: Array, grad_quats: Array, grad_scales: Array, grad_opacities: Array, grad_colors: Array,
    scratch: _Scratch, camera: Array,
) -> None:  # fmt: skip
    lens = make_lens(viewmat, intrinsics, size)
    scratch.camera[:] = 0.0
    # up to the next part's first, with what is not among the candidates
    first_row = ids[begin] if begin > 0 else 0
    end_row = ids[end] if end < ids.size else means.shape[0]
    grad_means[first_row:end_row] = 0.0
    grad_quats[first_row:end_row] = 0.0
    grad_scales[first_row:end_row] = 0.0
    grad_opacities[first_row:end_row] = 0.0
    grad_colors[first_row:end_row] = 0.0
    count = 0
    for n in range(begin, end):
        s = ranks[n]
        if (wanted.size == 0 or wanted[s]) and splats[s, R2] >= 0.0 and per_splat[s] < per_splat[s + 1]:
            scratch.rows[count], scratch.places[count] = ids[n], s
            count += 1
    for k in range(0, count, WIDTH):
        for lane in range(WIDTH):
            ahead = per_splat[scratch.places[min(k + WIDTH + lane, count - 1)]]
            prefetch(sums, ahead)
            prefetch(sums, ahead + 2)
            at = min(k + lane, count - 1)
            n, s = scratch.rows[at], scratch.places[at]
            _add_up(per_splat[s], per_splat[s + 1], sums, scratch.sums, lane)
            by_rgb = vec(scratch.sums, lane)
            if degree < 0:
                grad_colors[n, 0, 0], grad_colors[n, 0, 1], grad_colors[n, 0, 2] = by_rgb
            else:
                by_ray = shade_backward(
                    n, colors, degree, vec(means, n), lens.eye, by_rgb, scratch.basis, scratch.slopes,
                    grad_colors,
                )  # fmt: skip
                for axis in range(3):
                    scratch.sums[lane, SUMS + axis] = by_ray[axis]
        i, used = rows_at(scratch.rows, k, count), first(count - k)
        e = rows_at(scratch.order, 0, WIDTH)
        g = (
            gather(scratch.sums, e, 3), gather(scratch.sums, e, 4), gather(scratch.sums, e, 5),
            gather(scratch.sums, e, 6), gather(scratch.sums, e, 7), gather(scratch.sums, e, 8),
        )  # fmt: skip
        by_rays = (
            gather(scratch.sums, e, SUMS),
            gather(scratch.sums, e, SUMS + 1),
            gather(scratch.sums, e, SUMS + 2),
        )
        mean, scale = gather_vec(means, i), gather_vec(scales, i)
        seen = footprint(
            lens, mean, gather(quats, i, 0), gather(quats, i, 1), gather(quats, i, 2), gather(quats, i, 3),
            scale,
        )  # fmt: skip
        scatter(grad_opacities, i, 0, g[0] / gather(opacities, i, 0))
        grad_px, grad_py, d0, d1 = _axes_gradient(seen, g, antialiased)
        scatter_vec(grad_scales, i, blend2(1.0, times(d0, seen.turned0), 1.0, times(d1, seen.turned1)))
        d0, d1 = times(d0, scale), times(d1, scale)
        by_quat = _quat_gradient(seen, d0, d1)
        scatter(grad_quats, i, 0, by_quat[0])
        scatter(grad_quats, i, 1, by_quat[1])
        scatter(grad_quats, i, 2, by_quat[2])
        scatter(grad_quats, i, 3, by_quat[3])
        r0, r1, r2 = seen.rotation
        ga, gb = (dot(r0, d0), dot(r1, d0), dot(r2, d0)), (dot(r0, d1), dot(r1, d1), dot(r2, d1))
        point, by_focal, by_centre = _point_gradient(lens, seen, grad_px, grad_py, ga, gb)
        scatter_vec(grad_means, i, blend2(1.0, row_times(point, lens.rows), 1.0, by_rays))
        jx, jy = lens.fx * seen.inv_z, lens.fy * seen.inv_z
        row0, row1 = blend2(point[0], mean, jx, ga), blend2(point[1], mean, jy, gb)
        row2 = blend2(point[2], mean, -1.0, blend2(jx * seen.tan_x, ga, jy * seen.tan_y, gb))
        # and the colours' by the eye, −RᵀT
        row0 = blend2(1.0, row0, lens.shift[0], by_rays)
        row1 = blend2(1.0, row1, lens.shift[1], by_rays)
        row2 = blend2(1.0, row2, lens.shift[2], by_rays)
        _add_four(scratch.camera, 0, row0, point[0] + dot(by_rays, lens.rows[0]), used)
        _add_four(scratch.camera, 1, row1, point[1] + dot(by_rays, lens.rows[1]), used)
        _add_four(scratch.camera, 2, row2, point[2] + dot(by_rays, lens.rows[2]), used)
        _add_four(scratch.camera, 3, (by_focal[0], by_focal[1], by_centre[0]), by_centre[1], used)
    for k in range(CAMERA):
        camera[k] = total(load(scratch.camera, np.uint64(k * WIDTH)))


@kernel(allocates=True)
def project_backward(
    ids: Array, ranks: Array, means: Array, quats: Array, scales: Array, opacities: Array, colors: Array,
    degree: int, viewmat: Array, intrinsics: Array, size: Array, antialiased: bool,
    splats: Array, per_splat: Array, sums: Array, wanted: Array,
    grad_means: Array, grad_quats: Array, grad_scales: Array, grad_opacities: Array, grad_colors: Array,
    grad_camera: Array, seat: int, claims: Array, step: int,
) -> None:  # fmt: skip
    """Gradients of `projection.project`, which has the same first arguments.

    Args:
        splats: nearest first. [V,8] float64
        per_splat: first row of `sums` of each splat. [V+1] int64
        sums: see `blend_backward`. [I,9] float32
        wanted: splats whose gradients are filled in; [0]: all. [V] bool
        grad_means, grad_quats, grad_scales, grad_opacities, grad_colors: out, float32; shapes of inputs
        grad_camera: out, zero on entry. [PARTS, CAMERA] float64
        seat, claims, step: see `shares.pieces`
    """
    most = max(1, (ids.size + PARTS - 1) // PARTS)
    scratch = _Scratch(
        np.empty(most, np.int64), np.empty(most, np.int64), np.zeros((WIDTH, SUMS + 3)), np.arange(WIDTH),
        np.empty(16), np.zeros((16, 3)), np.empty(CAMERA * WIDTH),
    )  # fmt: skip
    for part in pieces(claims, step, seat, max(1, (ids.size + most - 1) // most)):
        _project_backward_range(
            part * most, min(ids.size, (part + 1) * most), ids, ranks, means, quats, scales, opacities,
            colors, degree, viewmat, intrinsics, size, antialiased, splats, per_splat, sums, wanted,
            grad_means, grad_quats, grad_scales, grad_opacities, grad_colors, scratch,
            grad_camera[part],
        )  # fmt: skip
