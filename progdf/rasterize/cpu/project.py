"""Kernel: cull Gaussians to the window, project and shade those that are left, in float64.

A projected Gaussian ("splat") is eight float64, one cache line, in units in which alpha = 2^-(u² + v²) ·
opacity: u = l11 · (dx + slope · dy) and v = l22 · dy for a pixel at offset (dx, dy) from the center. l is the
Cholesky factor of the conic times sqrt(log2(e) / 2), so the exponent cannot become positive however thin the
Gaussian is.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.conventions import ALPHA_MIN, ANTIALIAS_FLOOR, DILATION

from .jit import kernel
from .shading import Vec, dot, fill_basis, row_times, view_direction

Array = NDArray[Any]

MX, MY, SLOPE, L11, INV_L11, L22, R2, EXTENT_Y = range(8)
"""Columns of a splat: center in pixels, shape, u² + v² at alpha = 1/255, half height in pixels."""

UNIT = math.sqrt(0.5 * math.log2(math.e))
"""u and v per standard deviation."""

_PER_UNIT, _PER_ALPHA_MIN = 1.0 / UNIT, 1.0 / ALPHA_MIN
_CUT_RADIUS2 = 2.0 * math.log(1.0 / ALPHA_MIN)  # squared Mahalanobis distance where an opaque one ends


class Scene(NamedTuple):
    """Activated parameters of N Gaussians, or the gradients to them; C-contiguous float32.

    Args:
        means, quats, scales: [N,3], wxyz [N,4], [N,3]
        opacities: [N]
        colors: rgb [N,1,3] where the pinhole's degree is -1, else SH coefficients [N,K,3]
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    colors: Array


class Pinhole(NamedTuple):
    """A camera and what is drawn of its image, as kernels take them.

    Args:
        rows, shift: world → camera: rows of the rotation, translation
        fx, fy, cx, cy: intrinsics, pixels
        limits_x, limits_y: least and largest x/z and y/z in the Jacobian
        near: least camera z, world units
        window: x0, y0, x1, y1 of what is drawn, pixels
        grid: first tile column and row of the window, and how many there are
        degree: of spherical harmonics, -1 for rgb
        antialiased: see `progdf.rasterize.render`
    """

    rows: tuple[Vec, Vec, Vec]
    shift: Vec
    fx: float
    fy: float
    cx: float
    cy: float
    limits_x: tuple[float, float]
    limits_y: tuple[float, float]
    near: float
    window: tuple[int, int, int, int]
    grid: tuple[int, int, int, int]
    degree: int
    antialiased: bool


class Splats(NamedTuple):
    """What projection finds, by the Gaussians' rows.

    Args:
        means2d, depths: centers in pixels, camera z; 0 for what cannot be drawn. [N,2], [N] float32
        visible: whether one is a splat; where not, the next two are not set. [N] bool
        shapes: the columns above. [N,8] float64
        colors: rgb, opacity with antialias included. [N,4] float32
    """

    means2d: Array
    depths: Array
    visible: Array
    shapes: Array
    colors: Array


class Footprint(NamedTuple):
    """A Gaussian seen by a camera.

    Args:
        x, y: camera coordinates
        inv_z: 1/z
        tan_x, tan_y: x/z and y/z, clamped
        free_x, free_y: whether they were inside the limits
        quat: unit quaternion wxyz
        inv_length: 1 / length of the quaternion as given; 0 where it is replaced by the identity
        rotation: rows
        a0, a1: rows of Jacobian · world → camera
        turned0, turned1: a0 and a1 in the Gaussian's own axes
        p0, p1: x and y components of its three axes in pixels
        a, b, c: 2D covariance before the dilation: p0·p0, p0·p1, p1·p1
        normal: p0 × p1
        det0, det: determinant before and after the dilation
    """

    x: float
    y: float
    inv_z: float
    tan_x: float
    tan_y: float
    free_x: bool
    free_y: bool
    quat: tuple[float, float, float, float]
    inv_length: float
    rotation: tuple[Vec, Vec, Vec]
    a0: Vec
    a1: Vec
    turned0: Vec
    turned1: Vec
    p0: Vec
    p1: Vec
    a: float
    b: float
    c: float
    normal: Vec
    det0: float
    det: float


@kernel(contract=True, inline=True)
def cross(a: Vec, b: Vec) -> Vec:
    """a × b"""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel(contract=True, inline=True)
def blend2(s: float, a: Vec, t: float, b: Vec) -> Vec:
    """s·a + t·b"""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@kernel(contract=True, inline=True)
def times(a: Vec, b: Vec) -> Vec:
    """Product by components."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@kernel(inline=True)
def vec(rows: Array, i: int) -> Vec:
    """Row i of an [N,3] array."""
    return np.float64(rows[i, 0]), np.float64(rows[i, 1]), np.float64(rows[i, 2])


@kernel(inline=True)
def camera_center(camera: Pinhole) -> Vec:
    """−RᵀT"""
    turned = row_times(camera.shift, camera.rows)
    return -turned[0], -turned[1], -turned[2]


@kernel(contract=True, inline=True)
def _unit_quat(w: float, x: float, y: float, z: float) -> tuple[float, float, float, float, float]:
    """Unit quaternion and 1/length; the identity and 0 where it is zero or not finite."""
    total = abs(w) + abs(x) + abs(y) + abs(z)
    if not (total > 0.0 and total < np.inf):
        return 1.0, 0.0, 0.0, 0.0, 0.0
    inverse = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@kernel(contract=True, inline=True)
def _rotation_rows(w: float, x: float, y: float, z: float) -> tuple[Vec, Vec, Vec]:
    """Rows of the rotation by a unit quaternion."""
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@kernel(contract=True, inline=True)
def footprint(camera: Pinhole, scene: Scene, i: int) -> Footprint:
    """Project Gaussian i, which is in front of the camera."""
    mean, scale = vec(scene.means, i), vec(scene.scales, i)
    x, y = dot(camera.rows[0], mean) + camera.shift[0], dot(camera.rows[1], mean) + camera.shift[1]
    inv_z = 1.0 / (dot(camera.rows[2], mean) + camera.shift[2])
    ratio_x, ratio_y = x * inv_z, y * inv_z
    tan_x = min(max(ratio_x, camera.limits_x[0]), camera.limits_x[1])
    tan_y = min(max(ratio_y, camera.limits_y[0]), camera.limits_y[1])
    jx, jy = camera.fx * inv_z, camera.fy * inv_z
    a0 = blend2(jx, camera.rows[0], -jx * tan_x, camera.rows[2])
    a1 = blend2(jy, camera.rows[1], -jy * tan_y, camera.rows[2])
    qw, qx, qy, qz, inv_length = _unit_quat(
        np.float64(scene.quats[i, 0]), np.float64(scene.quats[i, 1]),
        np.float64(scene.quats[i, 2]), np.float64(scene.quats[i, 3]),
    )  # fmt: skip
    rotation = _rotation_rows(qw, qx, qy, qz)
    turned0, turned1 = row_times(a0, rotation), row_times(a1, rotation)
    p0, p1 = times(turned0, scale), times(turned1, scale)
    a, b, c = dot(p0, p0), dot(p0, p1), dot(p1, p1)
    # ac − b² cancels for needles (4 % wrong at 1000 px in float32); the cross product does not
    normal = cross(p0, p1)
    det0 = dot(normal, normal)
    return Footprint(
        x, y, inv_z, tan_x, tan_y, tan_x == ratio_x, tan_y == ratio_y, (qw, qx, qy, qz), inv_length, rotation,
        a0, a1, turned0, turned1, p0, p1, a, b, c, normal, det0,
        det0 + DILATION * (a + c) + DILATION * DILATION,
    )  # fmt: skip


@kernel(contract=True, inline=True)
def largest_extents(camera: Pinhole, scene: Scene, i: int) -> tuple[bool, float, float, float, float, float]:
    """A bound of a Gaussian's support that needs no covariance.

    Returns:
        whether it can be drawn at all; its center in pixels and camera z; the squares of half the sides of a
        box around it in pixels
    """
    mean, scale, opacity = vec(scene.means, i), vec(scene.scales, i), np.float64(scene.opacities[i])
    z = dot(camera.rows[2], mean) + camera.shift[2]
    total = abs(mean[0]) + abs(mean[1]) + abs(mean[2]) + abs(scale[0]) + abs(scale[1]) + abs(scale[2])
    if not (z > camera.near and opacity >= ALPHA_MIN and total + opacity < np.inf):
        return False, 0.0, 0.0, 0.0, 0.0, 0.0
    inv_z = 1.0 / z
    tan_x = (dot(camera.rows[0], mean) + camera.shift[0]) * inv_z
    tan_y = (dot(camera.rows[1], mean) + camera.shift[1]) * inv_z
    px, py = camera.fx * tan_x + camera.cx, camera.fy * tan_y + camera.cy
    tan_x = min(max(tan_x, camera.limits_x[0]), camera.limits_x[1])
    tan_y = min(max(tan_y, camera.limits_y[0]), camera.limits_y[1])
    # ln x ≤ x − 1; 1.001: the viewmat's rotation is one only within rounding
    radius2 = 1.001 * (_CUT_RADIUS2 + 2.0 * max(opacity - 1.0, 0.0))
    largest = max(abs(scale[0]), max(abs(scale[1]), abs(scale[2]))) * inv_z
    jx, jy = camera.fx * largest, camera.fy * largest
    wide2 = radius2 * (jx * jx * (1.0 + tan_x * tan_x) + DILATION)
    high2 = radius2 * (jy * jy * (1.0 + tan_y * tan_y) + DILATION)
    return True, px, py, z, wide2, high2


@kernel(contract=True, inline=True)
def shade_splat(scene: Scene, i: int, degree: int, eye: Vec, basis: Array) -> Vec:
    """The color of a Gaussian; basis: scratch, [16] float64"""
    if degree < 0:
        return vec(scene.colors[i], 0)
    dx, dy, dz, _ = view_direction(vec(scene.means, i), eye)
    fill_basis(degree, dx, dy, dz, basis)
    red = green = blue = 0.5
    for band in range((degree + 1) ** 2):
        red += basis[band] * scene.colors[i, band, 0]
        green += basis[band] * scene.colors[i, band, 1]
        blue += basis[band] * scene.colors[i, band, 2]
    return red, green, blue


@kernel(contract=True, cache=True)
def project(begin: int, end: int, scene: Scene, camera: Pinhole, splats: Splats, basis: Array) -> None:
    """Project Gaussians begin … end − 1.

    Args:
        splats: out, rows begin … end − 1
        basis: scratch. [16] float64
    """
    eye = camera_center(camera)
    window = camera.window
    x0, y0, x1, y1 = float(window[0]), float(window[1]), float(window[2]), float(window[3])
    for i in range(begin, end):
        usable, px, py, z, wide2, high2 = largest_extents(camera, scene, i)
        splats.means2d[i, 0], splats.means2d[i, 1], splats.depths[i] = px, py, z
        splats.visible[i] = False
        out_x, out_y = max(max(x0 - px, px - x1), 0.0), max(max(y0 - py, py - y1), 0.0)
        if not (usable and out_x * out_x <= wide2 and out_y * out_y <= high2):
            continue
        seen = footprint(camera, scene, i)
        opacity = np.float64(scene.opacities[i])
        if camera.antialiased:
            opacity = opacity * math.sqrt(max(ANTIALIAS_FLOOR, seen.det0 / seen.det))
        sigma_x, sigma_y = math.sqrt(seen.a + DILATION), math.sqrt(seen.c + DILATION)
        px, py = camera.fx * seen.x * seen.inv_z + camera.cx, camera.fy * seen.y * seen.inv_z + camera.cy
        r2 = max(0.0, math.log2(opacity * _PER_ALPHA_MIN))
        radius = math.sqrt(r2) * _PER_UNIT
        extent_x, extent_y = radius * sigma_x, radius * sigma_y
        in_x = px + extent_x >= x0 and px - extent_x <= x1
        if not (opacity >= ALPHA_MIN and in_x and py + extent_y >= y0 and py - extent_y <= y1):
            continue
        red, green, blue = shade_splat(scene, i, camera.degree, eye, basis)
        if not abs(red) + abs(green) + abs(blue) < np.inf:
            continue
        if camera.degree >= 0:
            red, green, blue = max(0.0, red), max(0.0, green), max(0.0, blue)
        splats.visible[i] = True
        root, inv_sigma_y = math.sqrt(seen.det), 1.0 / sigma_y
        shape, color = splats.shapes[i], splats.colors[i]
        shape[MX], shape[MY] = px, py
        shape[SLOPE] = -(seen.b * inv_sigma_y * inv_sigma_y)
        shape[L11], shape[INV_L11] = UNIT * sigma_y / root, root * inv_sigma_y * _PER_UNIT
        shape[L22], shape[R2], shape[EXTENT_Y] = UNIT * inv_sigma_y, r2, extent_y
        color[0], color[1], color[2], color[3] = red, green, blue, opacity
