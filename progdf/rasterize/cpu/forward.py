"""Kernels: project and shade the Gaussians visible in the window, in float64, and sort them into its tiles.

A projected Gaussian ("splat") is eight float64, one cache line, in units in which
alpha = 2^-(u² + v²) · opacity. For a pixel at offset (dx, dy) from the center, u = l11 · (dx + slope · dy)
and v = l22 · dy. l is the Cholesky factor of the conic times sqrt(log2(e) / 2), so the exponent cannot become
positive however thin the Gaussian is. SH have the signs and the order of `progdf.sh`. The splats of a tile
are in depth order, whatever the number of threads.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.engines import ALPHA_MIN, ANTIALIAS_FLOOR
from progdf.sh import _C1, _C2, _C3, C0

from .jit import Number, kernel, prefetch

Array = NDArray[Any]
Vec = tuple[float, float, float]
Quat = tuple[float, float, float, float]

TILE_W = 64
"""Width of a tile, pixels. Wide, because the pixel loops are vectorized along a row of a tile."""

TILE_H = 8
"""Height of a tile, pixels."""

_DIGIT_BITS = 8  # bits per pass of the depth sort; eleven take as long
_PREFETCH_SPLATS = 8  # splats to prefetch ahead, because their tiles lie far apart in memory

MX, MY, SLOPE, L11, INV_L11, L22, R2, EXTENT_Y = range(8)
"""Columns of a splat: center in pixels, shape, u² + v² at alpha = 1/255, half height in pixels."""

UNIT = math.sqrt(0.5 * math.log2(math.e))
"""Value of u and v at one standard deviation."""

_PER_UNIT = 1.0 / UNIT
_PER_ALPHA_MIN = 1.0 / ALPHA_MIN
# squared Mahalanobis distance at which an opaque Gaussian ends
_CUT_RADIUS2 = 2.0 * math.log(1.0 / ALPHA_MIN)


class Scene(NamedTuple):
    """Activated parameters of N Gaussians, or the gradients to them. C-contiguous float32."""

    means: Array  # [N,3]
    quats: Array  # wxyz. [N,4]
    scales: Array  # [N,3]
    opacities: Array  # [N]
    colors: Array  # rgb [N,1,3] where the pinhole's degree is -1, else SH coefficients [N,K,3]


class Pinhole(NamedTuple):
    """Camera and window, in the kernels' form."""

    rows: tuple[Vec, Vec, Vec]  # rows of the rotation, world → camera
    shift: Vec  # translation, world → camera
    fx: float  # pixels, like the next three
    fy: float
    cx: float
    cy: float
    limits_x: tuple[float, float]  # smallest and largest x/z in the Jacobian
    limits_y: tuple[float, float]
    near: float  # smallest camera z, world units
    window: tuple[int, int, int, int]  # x0, y0, x1, y1 of the window, pixels
    grid: tuple[int, int, int, int]  # first tile column and row of the window, and their numbers
    degree: int  # SH degree, -1 for rgb
    antialiased: bool  # see `progdf.rasterize.render`
    dilation: float  # added to the diagonal of the 2D covariance, pixels²


class Splats(NamedTuple):
    """Results of the projection, by the Gaussians' rows."""

    means2d: Array  # centers in pixels; 0 if the Gaussian cannot be drawn. [N,2] float32
    depths: Array  # camera z; 0 likewise. [N] float32
    visible: Array  # true for a splat; elsewhere the next two are not set. [N] bool
    shapes: Array  # columns `MX` to `EXTENT_Y`. [N,8] float64
    colors: Array  # rgb, and opacity with antialiasing. [N,4] float32


class Footprint(NamedTuple):
    """Projection of one Gaussian."""

    x: float  # camera coordinates
    y: float
    inv_z: float
    tan_x: float  # x/z, clamped
    tan_y: float
    free_x: bool  # true if the ratio is inside the limits
    free_y: bool
    quat: Quat  # unit, wxyz
    inv_length: float  # 1 / length of the given quaternion; 0 if it is replaced by the identity
    rotation: tuple[Vec, Vec, Vec]  # rows
    a0: Vec  # rows of Jacobian times world → camera
    a1: Vec
    turned0: Vec  # a0 in the Gaussian's own axes
    turned1: Vec
    p0: Vec  # x components of its three axes in pixels
    p1: Vec  # y components
    a: float  # 2D covariance before dilation: p0·p0
    b: float  # p0·p1
    c: float  # p1·p1
    normal: Vec  # p0 × p1
    det0: float  # determinant before dilation
    det: float  # determinant after dilation


class TileLists(NamedTuple):
    """Splats of each tile, nearest first."""

    starts: Array  # first index of each tile's list. [tiles+1] int64
    members: Array  # rows of the splats, tile after tile. [I] int32
    # index of each member in an order by row, so that the sums of a Gaussian add up in a fixed order.
    # [I] int32, or [0] if not needed
    slots: Array
    offsets: Array  # first slot of each Gaussian. [N+1] int32


@kernel(contract=True, inline=True)
def dot(a: Vec, b: Vec) -> float:
    """Return a·b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel(contract=True, inline=True)
def row_times(a: Vec, rows: tuple[Vec, Vec, Vec]) -> Vec:
    """Return aᵀM for a matrix given by rows."""
    return (
        a[0] * rows[0][0] + a[1] * rows[1][0] + a[2] * rows[2][0],
        a[0] * rows[0][1] + a[1] * rows[1][1] + a[2] * rows[2][1],
        a[0] * rows[0][2] + a[1] * rows[1][2] + a[2] * rows[2][2],
    )


@kernel(inline=True)
def view_direction(point: Vec, eye: Vec) -> tuple[float, float, float, float]:
    """Return the unit vector from the eye to a point, world axes, and 1/distance; zeros at the eye itself."""
    x = point[0] - eye[0]
    y = point[1] - eye[1]
    z = point[2] - eye[2]
    squared = x * x + y * y + z * z
    inverse = 1.0 / math.sqrt(squared) if squared > 0.0 else 0.0
    return x * inverse, y * inverse, z * inverse, inverse


@kernel()
def fill_basis(degree: int, x: float, y: float, z: float, basis: Array) -> None:
    """Compute the (degree+1)² real basis functions in direction x, y, z. basis: out, [16] float64"""
    basis[0] = C0
    if degree >= 1:
        basis[1] = -_C1 * y
        basis[2] = _C1 * z
        basis[3] = -_C1 * x
    if degree >= 2:
        xx = x * x
        yy = y * y
        zz = z * z
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


@kernel(contract=True, inline=True)
def cross(a: Vec, b: Vec) -> Vec:
    """Return a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel(contract=True, inline=True)
def blend2(s: float, a: Vec, t: float, b: Vec) -> Vec:
    """Return s·a + t·b."""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@kernel(contract=True, inline=True)
def times(a: Vec, b: Vec) -> Vec:
    """Return the product by components."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@kernel(inline=True)
def vec(rows: Array, i: int) -> Vec:
    """Return row i of an [N,3] array."""
    return np.float64(rows[i, 0]), np.float64(rows[i, 1]), np.float64(rows[i, 2])


@kernel(inline=True)
def quat_of(rows: Array, i: int) -> Quat:
    """Return row i of an [N,4] array."""
    return np.float64(rows[i, 0]), np.float64(rows[i, 1]), np.float64(rows[i, 2]), np.float64(rows[i, 3])


@kernel(inline=True)
def camera_center(camera: Pinhole) -> Vec:
    """Return −RᵀT."""
    turned = row_times(camera.shift, camera.rows)
    return -turned[0], -turned[1], -turned[2]


@kernel(contract=True, inline=True)
def unit_quat(w: float, x: float, y: float, z: float) -> tuple[float, float, float, float, float]:
    """Return the unit quaternion and 1/length, or the identity and 0 if it is zero or not finite."""
    total = abs(w) + abs(x) + abs(y) + abs(z)
    if not (total > 0.0 and total < np.inf):
        return 1.0, 0.0, 0.0, 0.0, 0.0
    inverse = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@kernel(contract=True, inline=True)
def rotation_rows(w: float, x: float, y: float, z: float) -> tuple[Vec, Vec, Vec]:
    """Return the rows of a unit quaternion's rotation matrix."""
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@kernel(contract=True, inline=True)
def footprint(camera: Pinhole, mean: Vec, scale: Vec, quat: Quat) -> Footprint:
    """Project a Gaussian in front of the camera."""
    x = dot(camera.rows[0], mean) + camera.shift[0]
    y = dot(camera.rows[1], mean) + camera.shift[1]
    inv_z = 1.0 / (dot(camera.rows[2], mean) + camera.shift[2])
    ratio_x = x * inv_z
    ratio_y = y * inv_z
    tan_x = min(max(ratio_x, camera.limits_x[0]), camera.limits_x[1])
    tan_y = min(max(ratio_y, camera.limits_y[0]), camera.limits_y[1])
    jx = camera.fx * inv_z
    jy = camera.fy * inv_z
    a0 = blend2(jx, camera.rows[0], -jx * tan_x, camera.rows[2])
    a1 = blend2(jy, camera.rows[1], -jy * tan_y, camera.rows[2])
    qw, qx, qy, qz, inv_length = unit_quat(quat[0], quat[1], quat[2], quat[3])
    rotation = rotation_rows(qw, qx, qy, qz)
    turned0 = row_times(a0, rotation)
    turned1 = row_times(a1, rotation)
    p0 = times(turned0, scale)
    p1 = times(turned1, scale)
    a = dot(p0, p0)
    b = dot(p0, p1)
    c = dot(p1, p1)
    # ac − b² cancels for needles (4 % wrong at 1000 px in float32); the cross product does not
    normal = cross(p0, p1)
    det0 = dot(normal, normal)
    return Footprint(
        x, y, inv_z, tan_x, tan_y, tan_x == ratio_x, tan_y == ratio_y, (qw, qx, qy, qz), inv_length, rotation,
        a0, a1, turned0, turned1, p0, p1, a, b, c, normal, det0,
        det0 + camera.dilation * (a + c) + camera.dilation * camera.dilation,
    )  # fmt: skip


@kernel(contract=True, inline=True)
def largest_extents(camera: Pinhole, scene: Scene, i: int) -> tuple[bool, float, float, float, float, float]:
    """Return a bound of a Gaussian's support that needs no covariance.

    Returns:
        True if it can be drawn at all; its center in pixels and camera z; the squares of half the sides of a
        box around it, in pixels
    """
    mean = vec(scene.means, i)
    scale = vec(scene.scales, i)
    opacity = np.float64(scene.opacities[i])
    z = dot(camera.rows[2], mean) + camera.shift[2]
    total = abs(mean[0]) + abs(mean[1]) + abs(mean[2]) + abs(scale[0]) + abs(scale[1]) + abs(scale[2])
    if not (z > camera.near and opacity >= ALPHA_MIN and total + opacity < np.inf):
        return False, 0.0, 0.0, 0.0, 0.0, 0.0
    largest = max(abs(scale[0]), max(abs(scale[1]), abs(scale[2])))
    x, y, wide2, high2 = extents(camera, mean, z, largest, opacity)
    return True, x, y, z, wide2, high2


@kernel(contract=True, inline=True)
def extents(
    camera: Pinhole, mean: Vec, z: float, largest: float, opacity: float
) -> tuple[float, float, float, float]:
    """Return the center and the squared half extents of a box around the support, in pixels.

    Args:
        largest: largest of the scales, world units
    """
    inv_z = 1.0 / z
    tan_x = (dot(camera.rows[0], mean) + camera.shift[0]) * inv_z
    tan_y = (dot(camera.rows[1], mean) + camera.shift[1]) * inv_z
    px = camera.fx * tan_x + camera.cx
    py = camera.fy * tan_y + camera.cy
    tan_x = min(max(tan_x, camera.limits_x[0]), camera.limits_x[1])
    tan_y = min(max(tan_y, camera.limits_y[0]), camera.limits_y[1])
    # ln x ≤ x − 1. The factor 1.001 is there because the viewmat's rotation is orthogonal only up to
    # rounding.
    radius2 = 1.001 * (_CUT_RADIUS2 + 2.0 * max(opacity - 1.0, 0.0))
    jx = camera.fx * largest * inv_z
    jy = camera.fy * largest * inv_z
    wide2 = radius2 * (jx * jx * (1.0 + tan_x * tan_x) + camera.dilation)
    high2 = radius2 * (jy * jy * (1.0 + tan_y * tan_y) + camera.dilation)
    return px, py, wide2, high2


@kernel(contract=True, inline=True)
def shade_splat(mean: Vec, colors: Array, degree: int, eye: Vec, basis: Array) -> Vec:
    """Return the color of a Gaussian.

    Args:
        colors: its coefficients, as in `Scene`
        basis: scratch. [16] float64
    """
    if degree < 0:
        return vec(colors, 0)
    dx, dy, dz, _ = view_direction(mean, eye)
    fill_basis(degree, dx, dy, dz, basis)
    red = green = blue = 0.5
    for band in range((degree + 1) ** 2):
        red += basis[band] * colors[band, 0]
        green += basis[band] * colors[band, 1]
        blue += basis[band] * colors[band, 2]
    return red, green, blue


@kernel(contract=True, cache=True)
def shade_rows(
    begin: int, end: int, means: Array, sh0: Array, shN: Array, camera: Pinhole, basis: Array, colors: Array
) -> None:
    """Compute the colors of Gaussians begin … end − 1 as `project` does, at least 0; NaN remains.

    Args:
        means, sh0, shN: of all Gaussians. [N,3], [N,3], [N,K,3]
        camera: its SH degree is 0 to 3
        basis: scratch. [16] float64
        colors: out, rows begin … end − 1. [N,3]
    """
    eye = camera_center(camera)
    for i in range(begin, end):
        dx, dy, dz, _ = view_direction(vec(means, i), eye)
        fill_basis(camera.degree, dx, dy, dz, basis)
        red = 0.5 + basis[0] * sh0[i, 0]
        green = 0.5 + basis[0] * sh0[i, 1]
        blue = 0.5 + basis[0] * sh0[i, 2]
        for band in range(1, (camera.degree + 1) ** 2):
            red += basis[band] * shN[i, band - 1, 0]
            green += basis[band] * shN[i, band - 1, 1]
            blue += basis[band] * shN[i, band - 1, 2]
        colors[i, 0] = 0.0 if red < 0.0 else red
        colors[i, 1] = 0.0 if green < 0.0 else green
        colors[i, 2] = 0.0 if blue < 0.0 else blue


@kernel(contract=True, cache=True)
def project(begin: int, end: int, scene: Scene, camera: Pinhole, splats: Splats, basis: Array) -> None:
    """Project Gaussians begin … end − 1.

    Args:
        splats: out, rows begin … end − 1
        basis: scratch. [16] float64
    """
    eye = camera_center(camera)
    window = camera.window
    x0 = float(window[0])
    y0 = float(window[1])
    x1 = float(window[2])
    y1 = float(window[3])
    for i in range(begin, end):
        usable, px, py, z, wide2, high2 = largest_extents(camera, scene, i)
        splats.means2d[i, 0] = px
        splats.means2d[i, 1] = py
        splats.depths[i] = z
        splats.visible[i] = False
        out_x = max(max(x0 - px, px - x1), 0.0)
        out_y = max(max(y0 - py, py - y1), 0.0)
        if not (usable and out_x * out_x <= wide2 and out_y * out_y <= high2):
            continue
        seen = footprint(camera, vec(scene.means, i), vec(scene.scales, i), quat_of(scene.quats, i))
        opacity = np.float64(scene.opacities[i])
        if camera.antialiased:
            opacity = opacity * math.sqrt(max(ANTIALIAS_FLOOR, seen.det0 / seen.det))
        sigma_x = math.sqrt(seen.a + camera.dilation)
        sigma_y = math.sqrt(seen.c + camera.dilation)
        px = camera.fx * seen.x * seen.inv_z + camera.cx
        py = camera.fy * seen.y * seen.inv_z + camera.cy
        r2 = max(0.0, math.log2(opacity * _PER_ALPHA_MIN))
        radius = math.sqrt(r2) * _PER_UNIT
        extent_x = radius * sigma_x
        extent_y = radius * sigma_y
        in_x = px + extent_x >= x0 and px - extent_x <= x1
        if not (opacity >= ALPHA_MIN and in_x and py + extent_y >= y0 and py - extent_y <= y1):
            continue
        red, green, blue = shade_splat(vec(scene.means, i), scene.colors[i], camera.degree, eye, basis)
        if not abs(red) + abs(green) + abs(blue) < np.inf:
            continue
        if camera.degree >= 0:
            red = max(0.0, red)
            green = max(0.0, green)
            blue = max(0.0, blue)
        splats.visible[i] = True
        root = math.sqrt(seen.det)
        inv_sigma_y = 1.0 / sigma_y
        shape = splats.shapes[i]
        color = splats.colors[i]
        shape[MX] = px
        shape[MY] = py
        shape[SLOPE] = -(seen.b * inv_sigma_y * inv_sigma_y)
        shape[L11] = UNIT * sigma_y / root
        shape[INV_L11] = root * inv_sigma_y * _PER_UNIT
        shape[L22] = UNIT * inv_sigma_y
        shape[R2] = r2
        shape[EXTENT_Y] = extent_y
        color[0] = red
        color[1] = green
        color[2] = blue
        color[3] = opacity


@kernel(contract=True, inline=True)
def _tile_columns(
    shape: Array, side: float, top: float, bottom: float, left: float, right: float
) -> tuple[int, int]:
    """Return the first tile column, and one past the last, that a splat may touch in pixel rows top..bottom.

    Columns count from the left edge of the full image. left and right are the window's. The bound is exact up
    to 1e-6 px: within a band of rows the left edge of the support is farthest out at its leftmost point, or
    at the row of the band nearest to it. side is dy of that point.
    """
    low = top + 0.5 - shape[MY]
    high = bottom + 0.5 - shape[MY]
    left_at = min(max(side, low), high)
    right_at = min(max(-side, low), high)
    v = shape[L22] * left_at
    w = shape[L22] * right_at
    outermost = shape[MX] - shape[SLOPE] * left_at - math.sqrt(max(0.0, shape[R2] - v * v)) * shape[INV_L11]
    first = max(np.ceil(outermost - 0.5 - 1e-6), left)
    outermost = shape[MX] - shape[SLOPE] * right_at + math.sqrt(max(0.0, shape[R2] - w * w)) * shape[INV_L11]
    last = min(np.floor(outermost - 0.5 + 1e-6), right - 1.0)
    if not first <= last:
        return 0, 0
    return int(first) // TILE_W, int(last) // TILE_W + 1


@kernel(contract=True, cache=True)
def find_tiles(begin: int, end: int, splats: Splats, camera: Pinhole, tiles: Array, counts: Array) -> int:
    """List the tiles that the splats of rows begin … end − 1 touch.

    Args:
        tiles: out, splat after splat, as far as there is room. int32
        counts: out, number of tiles of each row. [N] int32

    Returns:
        Number of tiles, including those without room.
    """
    window = camera.window
    x0 = float(window[0])
    y0 = float(window[1])
    x1 = float(window[2])
    y1 = float(window[3])
    at = 0
    for i in range(begin, end):
        counts[i] = 0
        if not splats.visible[i]:
            continue
        shape = splats.shapes[i]
        mx = shape[MX]
        my = shape[MY]
        high = shape[EXTENT_Y]
        slope = shape[SLOPE]
        inclined = slope / (shape[L22] * shape[L22])
        variance = shape[INV_L11] * shape[INV_L11] + slope * inclined
        wide = math.sqrt(shape[R2] * variance)
        # pixel rows and columns whose centers the splat may touch
        top = max(np.ceil(my - high - 0.5 - 1e-6), y0)
        bottom = min(np.floor(my + high - 0.5 + 1e-6), y1 - 1.0)
        first = max(np.ceil(mx - wide - 0.5 - 1e-6), x0)
        last = min(np.floor(mx + wide - 0.5 + 1e-6), x1 - 1.0)
        if not (top <= bottom and first <= last):
            continue
        left = int(first) // TILE_W
        right = int(last) // TILE_W + 1
        narrow = right == left + 1
        side = inclined * wide / variance
        before = at
        for row in range(int(top) // TILE_H, int(bottom) // TILE_H + 1):
            if not narrow:
                edge = float(row * TILE_H)
                upper = max(top, edge)
                lower = min(bottom, edge + (TILE_H - 1.0))
                left, right = _tile_columns(shape, side, upper, lower, x0, x1)
            base = (row - camera.grid[1]) * camera.grid[2] - camera.grid[0]
            for column in range(left, right):
                if at < tiles.size:
                    tiles[at] = base + column
                at += 1
        counts[i] = at - before
    return at


def bin_splats(order: Array, tiles: Array, counts: Array, tile_count: int, with_slots: bool) -> TileLists:
    """List the splats of each tile. It runs on one thread, because two take as long.

    Args:
        order: rows of the splats, nearest first. [V] int32
        tiles, counts: tiles of all rows and their numbers, see `find_tiles`. [I], [N]
        tile_count: number of tiles in the window
        with_slots: fill `TileLists.slots`
    """
    offsets = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=offsets[1:])
    starts = np.zeros(tile_count + 1, np.int64)
    np.cumsum(np.bincount(tiles, minlength=tile_count), out=starts[1:])
    members = np.empty(len(tiles), np.int32)
    slots = np.empty(len(tiles) if with_slots else 0, np.int32)
    _fill(order, tiles, offsets, starts[:-1].copy(), members, slots)
    return TileLists(starts, members, slots, offsets)


@kernel(cache=True)
def _fill(order: Array, tiles: Array, offsets: Array, cursors: Array, members: Array, slots: Array) -> None:
    """Write the splats into the lists of their tiles. cursors: next position of each tile, modified"""
    last = order.size - 1
    for k in range(order.size):
        prefetch(offsets, order[min(k + 2 * _PREFETCH_SPLATS, last)])
        prefetch(tiles, offsets[order[min(k + _PREFETCH_SPLATS, last)]])
        i = order[k]
        for slot in range(offsets[i], offsets[i + 1]):
            at = cursors[tiles[slot]]
            cursors[tiles[slot]] = at + 1
            members[at] = i
            if slots.size > 0:
                slots[at] = slot


def depth_order(depths: NDArray[np.float32], visible: NDArray[np.bool_]) -> NDArray[Any]:
    """Return the rows of visible Gaussians, nearest first, ties by row. depths: > 0. [N], [N] -> [V] int32"""
    rows = np.flatnonzero(visible).astype(np.int32)
    keys = depths[rows].view(np.uint32)  # positive floats sort as their bits
    for shift in range(0, 32, _DIGIT_BITS):
        sorted_arrays = np.empty_like(keys), np.empty_like(rows)
        _sort_digit(keys, rows, np.uint32(shift), np.zeros(1 << _DIGIT_BITS, np.int64), *sorted_arrays)
        keys, rows = sorted_arrays
    return rows


@kernel(cache=True)
def _sort_digit(
    keys: Array, rows: Array, shift: Number, cursors: Array, sorted_keys: Array, sorted_rows: Array
) -> None:
    """Sort stably by the bits from `shift` on. Four times faster than numpy's sort.

    Args:
        cursors: scratch, zero on entry
        sorted_keys, sorted_rows: out
    """
    mask = np.uint32(cursors.size - 1)
    for k in range(keys.size):
        cursors[(keys[k] >> shift) & mask] += 1
    total = 0
    for digit in range(cursors.size):
        total, cursors[digit] = total + cursors[digit], total
    for k in range(keys.size):
        digit = (keys[k] >> shift) & mask
        at = cursors[digit]
        cursors[digit] = at + 1
        sorted_keys[at], sorted_rows[at] = keys[k], rows[k]
