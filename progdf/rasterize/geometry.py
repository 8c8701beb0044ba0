"""Kernels: Gaussians seen by one camera, in float64; what projection and its gradient have in common.

A `Real` is one float64 or eight (`lanes`): the same lines project one Gaussian or eight.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .conventions import DILATION, FRUSTUM_MARGIN
from .jit import kernel
from .lanes import choose

Array = NDArray[Any]
Real = Any
Vec = tuple[Real, Real, Real]


@kernel(contract=True, inline=True)
def dot(a: Vec, b: Vec) -> Real:
    """a·b"""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel(contract=True, inline=True)
def cross(a: Vec, b: Vec) -> Vec:
    """a × b"""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel(contract=True, inline=True)
def blend2(s: Real, a: Vec, t: Real, b: Vec) -> Vec:
    """s·a + t·b"""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@kernel(contract=True, inline=True)
def times(a: Vec, b: Vec) -> Vec:
    """Product by components."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@kernel(contract=True, inline=True)
def row_times(a: Vec, rows: tuple[Vec, Vec, Vec]) -> Vec:
    """aᵀM for a matrix given by rows."""
    return (
        a[0] * rows[0][0] + a[1] * rows[1][0] + a[2] * rows[2][0],
        a[0] * rows[0][1] + a[1] * rows[1][1] + a[2] * rows[2][1],
        a[0] * rows[0][2] + a[1] * rows[1][2] + a[2] * rows[2][2],
    )


@kernel(inline=True)
def vec(rows: Array, i: int) -> Vec:
    """Row i of an [N,3] array."""
    return np.float64(rows[i, 0]), np.float64(rows[i, 1]), np.float64(rows[i, 2])


class Lens(NamedTuple):
    """A camera.

    Args:
        rows: of the world → camera rotation
        shift: of world → camera
        eye: the camera's centre −RᵀT
        fx, fy, cx, cy: intrinsics, pixels
        low_x, high_x, low_y, high_y: limits of x/z and y/z in the Jacobian
    """

    rows: tuple[Vec, Vec, Vec]
    shift: Vec
    eye: Vec
    fx: float
    fy: float
    cx: float
    cy: float
    low_x: float
    high_x: float
    low_y: float
    high_y: float


@kernel()
def make_lens(viewmat: Array, intrinsics: Array, size: Array) -> Lens:
    """A camera; world → camera [4,4] and fx, fy, cx, cy [4] in float64, width, height [2] in int64."""
    rows = (vec(viewmat, 0), vec(viewmat, 1), vec(viewmat, 2))
    shift = (viewmat[0, 3], viewmat[1, 3], viewmat[2, 3])
    turned = row_times(shift, rows)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    width, height = np.float64(size[0]), np.float64(size[1])
    # clamp as the original does (Kerbl 2023, computeCov2D): off-screen Gaussians would blow up the Jacobian;
    # limits as in gsplat
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * width / fx, FRUSTUM_MARGIN * 0.5 * height / fy
    return Lens(
        rows, shift, (-turned[0], -turned[1], -turned[2]), fx, fy, cx, cy,
        -(cx / fx + margin_x), (width - cx) / fx + margin_x, -(cy / fy + margin_y),
        (height - cy) / fy + margin_y,
    )  # fmt: skip


class Footprint(NamedTuple):
    """A Gaussian seen by a camera, or eight.

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

    x: Real
    y: Real
    inv_z: Real
    tan_x: Real
    tan_y: Real
    free_x: Real
    free_y: Real
    quat: tuple[Real, Real, Real, Real]
    inv_length: Real
    rotation: tuple[Vec, Vec, Vec]
    a0: Vec
    a1: Vec
    turned0: Vec
    turned1: Vec
    p0: Vec
    p1: Vec
    a: Real
    b: Real
    c: Real
    normal: Vec
    det0: Real
    det: Real


@kernel(contract=True, inline=True)
def unit_quat(w: Real, x: Real, y: Real, z: Real) -> tuple[Real, Real, Real, Real, Real]:
    """Unit quaternion and 1/length; the identity and 0 where it is zero or not finite."""
    total = abs(w) + abs(x) + abs(y) + abs(z)
    usable = (total > 0.0) & (total < np.inf)
    w, x = choose(usable, w, 1.0), choose(usable, x, 0.0)
    y, z = choose(usable, y, 0.0), choose(usable, z, 0.0)
    inverse = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, choose(usable, inverse, 0.0)


@kernel(contract=True, inline=True)
def rotation_rows(w: Real, x: Real, y: Real, z: Real) -> tuple[Vec, Vec, Vec]:
    """Rows of the rotation by a unit quaternion."""
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@kernel(contract=True, inline=True)
def footprint(lens: Lens, mean: Vec, q0: Real, q1: Real, q2: Real, q3: Real, scale: Vec) -> Footprint:
    """Project a Gaussian (or eight) in front of the camera; quaternion wxyz of any length."""
    x, y = dot(lens.rows[0], mean) + lens.shift[0], dot(lens.rows[1], mean) + lens.shift[1]
    inv_z = 1.0 / (dot(lens.rows[2], mean) + lens.shift[2])
    ratio_x, ratio_y = x * inv_z, y * inv_z
    tan_x = min(max(ratio_x, lens.low_x), lens.high_x)
    tan_y = min(max(ratio_y, lens.low_y), lens.high_y)
    jx, jy = lens.fx * inv_z, lens.fy * inv_z
    a0 = blend2(jx, lens.rows[0], -jx * tan_x, lens.rows[2])
    a1 = blend2(jy, lens.rows[1], -jy * tan_y, lens.rows[2])
    qw, qx, qy, qz, inv_length = unit_quat(q0, q1, q2, q3)
    rotation = rotation_rows(qw, qx, qy, qz)
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
