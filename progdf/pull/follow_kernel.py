"""Kernels of Gaussians that follow nodes: eight Gaussians at once, in vectors of float32.

A node moves a point x to A x + t. A wide Gaussian has mean weights w of the nodes, slopes e of the weights
along its axes R S, in standard deviations, and differences d between their means on one axis and on all:

    mean Σ w (A x + t) + A R S e,    G R S = Σ w A R S + A R S diag(d) + (A x + t) eᵀ

These are the mean of the map, and its differences along the axes. A small Gaussian has weights only. The new
axes are the left singular vectors of G R S.
One-sided Jacobi rotations find them. They multiply columns, so a thin disc keeps its thickness in float32.
They start from the rotations of the last strength, so the axes keep their order.

The color of a band along 2l + 1 directions determines its coefficients. A rotation evaluates the band at the
directions rotated back.

Reference implementation: tests/helpers/plain_pull.py.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.cpu.jit import Number, Vector, broadcast, kernel, load, select, sqrt, store

from .node_kernel import NODE_QUAT, NODE_WIDTH

Singles = NDArray[np.float32]
Rows = NDArray[np.int32]
Weights = tuple[Rows, Rows, Singles]
"""First entry of each Gaussian [M+1], nodes and weights of the entries."""
Bends = tuple[Rows, Rows, Singles]
"""The same with slopes and differences, flattened [6 per entry]; small Gaussians have no entries."""
Bands = tuple[Singles, Singles]
"""Directions of a band [(2l+1)·3], and the matrix from colors along them to coefficients [(2l+1)²]."""

MAX_STRETCH = 3.0
"""Largest factor by which an axis of a Gaussian grows or shrinks; more shows as hairs."""
_LANES = 8
# numbers of eight Gaussians in the scratch memory of `follow_rows`
_QUAT = NODE_QUAT  # in the blended motion of nodes, which starts at 0
_SPARE = 32
_MATRIX = 36  # columns that are made orthogonal, then axes; later the rotation of the bands
_RIGHT = 45  # rotation of the columns
_HALF = 54
_LAST_RIGHT = 63
_LAST_QUAT = 72
_FLOOR = 76  # least squared scale
_SQUARES = 77
_NEW_QUAT = 80
_TANGENT = 84  # largest squared tangent of a rotation in a sweep
_COLORS = 90
_REST = _COLORS  # columns at rest, before the colors
_BASIS = 115
_BASIS_AT_REST = 125
_NODE = 210  # map of one node
_SLOPE = 222  # slopes of its weight, and differences
_FIRST = 228  # displacement by the first node
_BEND = 231  # Σ A R S diag(d) + (A x + t) eᵀ
_SHIFT = 240  # Σ A R S e
_SIZE = 243  # largest scale
_ROW = 244
_BAND_START = 14
_SWEEPS = 4  # of one-sided Jacobi rotations
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3 = (-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, 1.445305721320277)
_ORTHOGONAL_SQUARE = np.float32(4e-14)  # squared cosine of columns that are orthogonal up to rounding
_TINY = np.float32(1e-30)
# squared tangent; the columns are then orthogonal up to its square, as the rotations converge quadratically
_SETTLED_TANGENT_SQUARE = np.float32(1e-7)


@kernel(inline=True)
def _at(index: int) -> Number:
    """Return the index of the first lane of a number in the scratch memory."""
    return np.uint64(index * _LANES)


@kernel()
def _blend_node_motions(weights: Weights, table: Singles, member: int, lane: int, buffer: Singles) -> None:
    """Write the blended motion of a Gaussian into one lane of the buffer's numbers 0 to 19."""
    first, nodes, shares = weights
    a = broadcast(np.float32(0.0))
    b = a
    c = a
    start = first[member]
    base = nodes[start] * NODE_WIDTH + NODE_QUAT
    for k in range(start, first[member + 1]):
        at = nodes[k] * NODE_WIDTH
        share = shares[k]
        a = a + share * load(table, np.uint64(at))
        b = b + share * load(table, np.uint64(at + 8))
        cosine = np.float32(0.0)
        for i in range(4):
            cosine += table[at + NODE_QUAT + i] * table[base + i]
        if cosine < np.float32(0.0):
            share = -share
        c = c + share * load(table, np.uint64(at + NODE_QUAT))
    spare = _at(_SPARE)
    store(buffer, spare, a)
    store(buffer, spare + np.uint64(8), b)
    store(buffer, spare + np.uint64(16), c)
    for i in range(20):
        buffer[i * _LANES + lane] = buffer[_SPARE * _LANES + i]


@kernel()
def _bend(bends: Bends, motions: tuple[Singles, Singles], start: int, lanes: int, buffer: Singles) -> None:
    """Write the terms of wide Gaussians, of eight: the columns `_BEND` and the displacements `_SHIFT`.

    The slopes of a Gaussian sum up to 0, and so do the differences. Displacements are taken relative to that
    by the first node, and maps less the identity, so that a translation adds nothing.
    """
    first, nodes, slopes = bends
    zero = broadcast(np.float32(0.0))
    for i in range(9):
        store(buffer, _at(_BEND + i), zero)
    for i in range(3):
        store(buffer, _at(_SHIFT + i), zero)
    count = 0
    for lane in range(lanes):
        count = max(count, first[start + lane + 1] - first[start + lane])
    for k in range(count):
        for lane in range(_LANES):
            member = start + min(lane, lanes - 1)
            entry = first[member] + k
            is_entry = entry < first[member + 1]
            at = nodes[entry] * NODE_WIDTH if is_entry else 0
            for i in range(12):
                buffer[(_NODE + i) * _LANES + lane] = motions[0][at + i]
            for i in range(6):
                buffer[(_SLOPE + i) * _LANES + lane] = slopes[6 * entry + i] if is_entry else np.float32(0.0)
        _add_bend(motions[1], k == 0, buffer)


@kernel()
def _add_bend(center: Singles, is_first: bool, buffer: Singles) -> None:
    """Add the terms of one node, whose map and slopes are in the buffer."""
    x = load(buffer, _at(_ROW)) - center[0]
    y = load(buffer, _at(_ROW + 1)) - center[1]
    z = load(buffer, _at(_ROW + 2)) - center[2]
    size = load(buffer, _at(_SIZE))
    for r in range(3):
        node = _NODE + 3 * r
        moved = load(buffer, _at(_NODE + 9 + r)) + _row_times(buffer, node, x, y, z)
        if is_first:
            store(buffer, _at(_FIRST + r), moved)
        moved = moved - load(buffer, _at(_FIRST + r))
        shift = load(buffer, _at(_SHIFT + r))
        for c in range(3):
            half_x = load(buffer, _at(_HALF + c))
            half_y = load(buffer, _at(_HALF + 3 + c))
            half_z = load(buffer, _at(_HALF + 6 + c))
            along = size * _row_times(buffer, node, half_x, half_y, half_z)
            slope = load(buffer, _at(_SLOPE + c))
            shift = shift + slope * along
            bend = load(buffer, _at(_BEND + 3 * r + c)) + slope * moved
            store(buffer, _at(_BEND + 3 * r + c), bend + load(buffer, _at(_SLOPE + 3 + c)) * along)
        store(buffer, _at(_SHIFT + r), shift)


@kernel()
def _row_times(buffer: Singles, row: int, x: Vector, y: Vector, z: Vector) -> Vector:
    """Return the product of a row of a matrix in the buffer, and a vector."""
    return load(buffer, _at(row)) * x + load(buffer, _at(row + 1)) * y + load(buffer, _at(row + 2)) * z


@kernel()
def _jacobi(buffer: Singles, first: int, second: int) -> None:
    """Make two columns of the matrix orthogonal; `_RIGHT` takes the same rotation."""
    x0 = load(buffer, _at(_MATRIX + first))
    x1 = load(buffer, _at(_MATRIX + 3 + first))
    x2 = load(buffer, _at(_MATRIX + 6 + first))
    y0 = load(buffer, _at(_MATRIX + second))
    y1 = load(buffer, _at(_MATRIX + 3 + second))
    y2 = load(buffer, _at(_MATRIX + 6 + second))
    mixed = x0 * y0 + x1 * y1 + x2 * y2
    first_square = x0 * x0 + x1 * x1 + x2 * x2
    second_square = y0 * y0 + y1 * y1 + y2 * y2
    difference = second_square - first_square
    size = select(difference < np.float32(0.0), np.float32(0.0) - difference, difference)
    twice = np.float32(2.0) * mixed
    divisor = size + sqrt(difference * difference + twice * twice) + _TINY
    tangent = twice / divisor
    tangent = select(difference < np.float32(0.0), np.float32(0.0) - tangent, tangent)
    is_orthogonal = mixed * mixed <= _ORTHOGONAL_SQUARE * first_square * second_square
    tangent = select(is_orthogonal, np.float32(0.0), tangent)
    cosine = np.float32(1.0) / sqrt(np.float32(1.0) + tangent * tangent)
    sine = tangent * cosine
    largest = load(buffer, _at(_TANGENT))
    square = tangent * tangent
    store(buffer, _at(_TANGENT), select(square > largest, square, largest))
    store(buffer, _at(_MATRIX + first), cosine * x0 - sine * y0)
    store(buffer, _at(_MATRIX + 3 + first), cosine * x1 - sine * y1)
    store(buffer, _at(_MATRIX + 6 + first), cosine * x2 - sine * y2)
    store(buffer, _at(_MATRIX + second), sine * x0 + cosine * y0)
    store(buffer, _at(_MATRIX + 3 + second), sine * x1 + cosine * y1)
    store(buffer, _at(_MATRIX + 6 + second), sine * x2 + cosine * y2)
    for r in range(3):
        x = load(buffer, _at(_RIGHT + 3 * r + first))
        y = load(buffer, _at(_RIGHT + 3 * r + second))
        store(buffer, _at(_RIGHT + 3 * r + first), cosine * x - sine * y)
        store(buffer, _at(_RIGHT + 3 * r + second), sine * x + cosine * y)


@kernel()
def _is_small(buffer: Singles) -> Number:
    """Return whether all lanes turned so little in a sweep that the next one would change only rounding."""
    largest = np.float32(0.0)
    for lane in range(_LANES):
        largest = max(largest, buffer[_TANGENT * _LANES + lane])
    return largest <= _SETTLED_TANGENT_SQUARE


@kernel()
def _product(buffer: Singles, left: int, right: int, result: int) -> None:
    """Set a matrix in the buffer to the product of two others, all [3,3]."""
    for r in range(3):
        a = load(buffer, _at(left + 3 * r))
        b = load(buffer, _at(left + 3 * r + 1))
        c = load(buffer, _at(left + 3 * r + 2))
        for k in range(3):
            total = a * load(buffer, _at(right + k))
            total = total + b * load(buffer, _at(right + 3 + k))
            total = total + c * load(buffer, _at(right + 6 + k))
            store(buffer, _at(result + 3 * r + k), total)


@kernel()
def _stretch_axes(buffer: Singles) -> None:
    """Compute the axes and squared relative scales of G R S, from the last rotation of its columns."""
    _product(buffer, 0, _HALF, _RIGHT)
    inverse_size = np.float32(1.0) / load(buffer, _at(_SIZE))
    for k in range(9):
        half = load(buffer, _at(_HALF + k)) + inverse_size * load(buffer, _at(_BEND + k))
        store(buffer, _at(_RIGHT + k), load(buffer, _at(_RIGHT + k)) + half)
    _product(buffer, _RIGHT, _LAST_RIGHT, _MATRIX)
    for k in range(9):
        store(buffer, _at(_RIGHT + k), load(buffer, _at(_LAST_RIGHT + k)))
    for _ in range(_SWEEPS):
        store(buffer, _at(_TANGENT), broadcast(np.float32(0.0)))
        _jacobi(buffer, 0, 1)
        _jacobi(buffer, 0, 2)
        _jacobi(buffer, 1, 2)
        if _is_small(buffer):
            break
    _product(buffer, _HALF, _RIGHT, _REST)
    floor = load(buffer, _at(_FLOOR))
    for k in range(3):
        x = load(buffer, _at(_REST + k))
        y = load(buffer, _at(_REST + 3 + k))
        z = load(buffer, _at(_REST + 6 + k))
        at_rest = x * x + y * y + z * z
        x = load(buffer, _at(_MATRIX + k))
        y = load(buffer, _at(_MATRIX + 3 + k))
        z = load(buffer, _at(_MATRIX + 6 + k))
        square = x * x + y * y + z * z
        most = np.float32(MAX_STRETCH**2) * at_rest
        least = np.float32(MAX_STRETCH**-2) * at_rest
        limited = select(square > most, most, square)
        limited = select(limited < least, least, limited)
        store(buffer, _at(_SQUARES + k), select(limited < floor, floor, limited))
        factor = np.float32(1.0) / sqrt(square + _TINY)
        store(buffer, _at(_MATRIX + k), factor * x)
        store(buffer, _at(_MATRIX + 3 + k), factor * y)
        store(buffer, _at(_MATRIX + 6 + k), factor * z)
    _write_axes_quat(buffer)


@kernel()
def _write_axes_quat(buffer: Singles) -> None:
    """Write the quaternion of the axes with the sign and length of the last one.

    The third axis completes a rotation, also of a reflected gradient.
    """
    a = load(buffer, _at(_MATRIX))
    b = load(buffer, _at(_MATRIX + 3))
    c = load(buffer, _at(_MATRIX + 6))
    d = load(buffer, _at(_MATRIX + 1))
    e = load(buffer, _at(_MATRIX + 4))
    f = load(buffer, _at(_MATRIX + 7))
    g = b * f - c * e
    h = c * d - a * f
    i = a * e - b * d
    one = np.float32(1.0)
    w = one + a + e + i
    x = one + a - e - i
    y = one - a + e - i
    z = one - a - e + i
    qw = w
    qx = f - h
    qy = g - c
    qz = b - d
    best = w
    larger = x > best
    best = select(larger, x, best)
    nw = select(larger, f - h, qw)
    nx = select(larger, x, qx)
    ny = select(larger, b + d, qy)
    nz = select(larger, g + c, qz)
    larger = y > best
    best = select(larger, y, best)
    nw = select(larger, g - c, nw)
    nx = select(larger, b + d, nx)
    ny = select(larger, y, ny)
    nz = select(larger, f + h, nz)
    larger = z > best
    nw = select(larger, b - d, nw)
    nx = select(larger, g + c, nx)
    ny = select(larger, f + h, ny)
    nz = select(larger, z, nz)
    lw = load(buffer, _at(_LAST_QUAT))
    lx = load(buffer, _at(_LAST_QUAT + 1))
    ly = load(buffer, _at(_LAST_QUAT + 2))
    lz = load(buffer, _at(_LAST_QUAT + 3))
    square = lw * lw + lx * lx + ly * ly + lz * lz
    length = select(square > np.float32(0.0), sqrt(square), broadcast(one))
    factor = length / sqrt(nw * nw + nx * nx + ny * ny + nz * nz + _TINY)
    cosine = nw * lw + nx * lx + ny * ly + nz * lz
    factor = select(cosine < np.float32(0.0), np.float32(0.0) - factor, factor)
    store(buffer, _at(_NEW_QUAT), factor * nw)
    store(buffer, _at(_NEW_QUAT + 1), factor * nx)
    store(buffer, _at(_NEW_QUAT + 2), factor * ny)
    store(buffer, _at(_NEW_QUAT + 3), factor * nz)


@kernel()
def _band(degree: int, x: Vector, y: Vector, z: Vector, buffer: Singles, at: int) -> None:
    """Write the basis functions of one band along a direction, see `progdf.sh.basis`."""
    xx = x * x
    yy = y * y
    zz = z * z
    if degree == 1:
        store(buffer, _at(at), np.float32(-0.4886025119029199) * y)
        store(buffer, _at(at + 1), np.float32(0.4886025119029199) * z)
        store(buffer, _at(at + 2), np.float32(-0.4886025119029199) * x)
    elif degree == 2:
        store(buffer, _at(at), np.float32(_C2[0]) * x * y)
        store(buffer, _at(at + 1), np.float32(_C2[1]) * y * z)
        store(buffer, _at(at + 2), np.float32(_C2[2]) * (np.float32(2.0) * zz - xx - yy))
        store(buffer, _at(at + 3), np.float32(_C2[3]) * x * z)
        store(buffer, _at(at + 4), np.float32(_C2[4]) * (xx - yy))
    else:
        store(buffer, _at(at), np.float32(_C3[0]) * y * (np.float32(3.0) * xx - yy))
        store(buffer, _at(at + 1), np.float32(_C3[1]) * x * y * z)
        store(buffer, _at(at + 2), np.float32(_C3[2]) * y * (np.float32(4.0) * zz - xx - yy))
        polar = np.float32(2.0) * zz - np.float32(3.0) * (xx + yy)
        store(buffer, _at(at + 3), np.float32(_C3[3]) * z * polar)
        store(buffer, _at(at + 4), np.float32(_C3[2]) * x * (np.float32(4.0) * zz - xx - yy))
        store(buffer, _at(at + 5), np.float32(_C3[4]) * z * (xx - yy))
        store(buffer, _at(at + 6), np.float32(_C3[0]) * x * (xx - np.float32(3.0) * yy))


@kernel(inline=True)
def _rest_basis_start(degree: int) -> int:
    """Return the number of the basis functions of a band along its directions at rest."""
    if degree == 1:
        return _BASIS_AT_REST
    if degree == 2:
        return _BASIS_AT_REST + 9
    return _BASIS_AT_REST + 34


@kernel()
def _write_basis_at_rest(degree: int, bands: Bands, buffer: Singles) -> None:
    """Write the basis functions of a band along its directions at rest."""
    directions = bands[0]
    count = 2 * degree + 1
    at_rest = _rest_basis_start(degree)
    for j in range(count):
        x = broadcast(directions[3 * j])
        y = broadcast(directions[3 * j + 1])
        z = broadcast(directions[3 * j + 2])
        _band(degree, x, y, z, buffer, at_rest + j * count)


@kernel()
def _turn_band(degree: int, bands: Bands, buffer: Singles) -> None:
    """Rotate one band of the packed rows; the identity changes no bit."""
    directions, inverse = bands
    count = 2 * degree + 1
    at_rest = _rest_basis_start(degree)
    offset = _ROW + _BAND_START + 3 * (degree * degree - 1)
    for j in range(count):
        dx = directions[3 * j]
        dy = directions[3 * j + 1]
        dz = directions[3 * j + 2]
        x = (
            load(buffer, _at(_MATRIX)) * dx
            + load(buffer, _at(_MATRIX + 3)) * dy
            + load(buffer, _at(_MATRIX + 6)) * dz
        )
        y = (
            load(buffer, _at(_MATRIX + 1)) * dx
            + load(buffer, _at(_MATRIX + 4)) * dy
            + load(buffer, _at(_MATRIX + 7)) * dz
        )
        z = (
            load(buffer, _at(_MATRIX + 2)) * dx
            + load(buffer, _at(_MATRIX + 5)) * dy
            + load(buffer, _at(_MATRIX + 8)) * dz
        )
        _band(degree, x, y, z, buffer, _BASIS)
        for color in range(3):
            total = broadcast(np.float32(0.0))
            for k in range(count):
                change = load(buffer, _at(_BASIS + k)) - load(buffer, _at(at_rest + j * count + k))
                total = total + change * load(buffer, _at(offset + 3 * k + color))
            store(buffer, _at(_COLORS + 3 * j + color), total)
    for k in range(count):
        for color in range(3):
            total = load(buffer, _at(offset + 3 * k + color))
            for j in range(count):
                total = total + inverse[k * count + j] * load(buffer, _at(_COLORS + 3 * j + color))
            store(buffer, _at(offset + 3 * k + color), total)


@kernel()
def _write_rotation(buffer: Singles) -> None:
    """Write the rotation matrix of the blended quaternion, which need not be normalized."""
    w = load(buffer, _at(_QUAT))
    x = load(buffer, _at(_QUAT + 1))
    y = load(buffer, _at(_QUAT + 2))
    z = load(buffer, _at(_QUAT + 3))
    two = np.float32(2.0) / (w * w + x * x + y * y + z * z + _TINY)
    one = np.float32(1.0)
    store(buffer, _at(_MATRIX), one - two * (y * y + z * z))
    store(buffer, _at(_MATRIX + 1), two * (x * y - w * z))
    store(buffer, _at(_MATRIX + 2), two * (x * z + w * y))
    store(buffer, _at(_MATRIX + 3), two * (x * y + w * z))
    store(buffer, _at(_MATRIX + 4), one - two * (x * x + z * z))
    store(buffer, _at(_MATRIX + 5), two * (y * z - w * x))
    store(buffer, _at(_MATRIX + 6), two * (x * z - w * y))
    store(buffer, _at(_MATRIX + 7), two * (y * z + w * x))
    store(buffer, _at(_MATRIX + 8), one - two * (x * x + y * y))


@kernel()
def _read_lane(
    rows: Singles, last: tuple[Singles, Singles, Singles], member: int, lane: int, buffer: Singles
) -> None:
    """Read a Gaussian's row and its axes at a similar pose into one lane."""
    halves, last_turns, last_quats = last
    for k in range(9):
        buffer[(_HALF + k) * _LANES + lane] = halves[member, k]
        buffer[(_LAST_RIGHT + k) * _LANES + lane] = last_turns[member, k]
    for k in range(4):
        buffer[(_LAST_QUAT + k) * _LANES + lane] = last_quats[member, k]
    buffer[_FLOOR * _LANES + lane] = halves[member, 9]
    buffer[_SIZE * _LANES + lane] = halves[member, 11]
    for c in range(rows.shape[1]):
        buffer[(_ROW + c) * _LANES + lane] = rows[member, c]


@kernel()
def _move_means(center: Singles, buffer: Singles) -> None:
    """Move the means by the blended affine maps, whose shifts refer to a center [3], and by `_SHIFT`."""
    x = load(buffer, _at(_ROW)) - center[0]
    y = load(buffer, _at(_ROW + 1)) - center[1]
    z = load(buffer, _at(_ROW + 2)) - center[2]
    for r in range(3):
        step = load(buffer, _at(9 + r)) + load(buffer, _at(_SHIFT + r))
        step = step + load(buffer, _at(3 * r)) * x
        step = step + load(buffer, _at(3 * r + 1)) * y
        step = step + load(buffer, _at(3 * r + 2)) * z
        store(buffer, _at(_ROW + r), load(buffer, _at(_ROW + r)) + step)


@kernel()
def _write_frame(frames: tuple[Singles, Singles], member: int, lane: int, buffer: Singles) -> None:
    """Write the rotation of the columns and the quaternion of one lane."""
    for k in range(9):
        frames[0][member, k] = buffer[(_RIGHT + k) * _LANES + lane]
    for k in range(4):
        frames[1][member, k] = buffer[(_NEW_QUAT + k) * _LANES + lane]


@kernel()
def _write_row(halves: Singles, member: int, lane: int, buffer: Singles, result: Singles) -> None:
    """Write the packed raw row of one lane."""
    for c in range(result.shape[1]):
        result[member, c] = buffer[(_ROW + c) * _LANES + lane]
    for k in range(3):
        square = buffer[(_SQUARES + k) * _LANES + lane]
        result[member, 3 + k] = halves[member, 10] + np.float32(0.5) * math.log(square)
    for k in range(4):
        result[member, 6 + k] = buffer[(_NEW_QUAT + k) * _LANES + lane]


@kernel(cache=True, allocates=True)
def follow_rows(
    rows: Singles,
    nodes: tuple[Weights, Bends],
    motions: tuple[Singles, Singles],
    last: tuple[Singles, Singles, Singles],
    frames: tuple[Singles, Singles],
    bands: tuple[Bands, Bands, Bands],
    result: Singles,
    part: tuple[int, int, int, bool],
) -> None:
    """Write the packed raw rows that follow the nodes, for a part of the M Gaussians.

    Args:
        rows: raw rows at rest. [M,C]
        nodes: nodes that each Gaussian follows with their weights, and those that wide Gaussians follow with
            slopes and differences
        motions: motions of the nodes, see `write_nodes`, flattened [24n], and the point to which their
            shifts refer. [3]
        last: axes times scales at rest with three more numbers, see `progdf.pull.follow.Frames` [M,12];
            rotations of the columns [M,9] and quaternions [M,4] at a similar pose
        frames: rotations of the columns and quaternions at this pose; written, may be those of `last`
        bands: directions and matrices of bands 1, 2 and 3
        result: raw rows; written. [M,C]
        part: first Gaussian, end, SH degree that rotates, 0 to 3, and True to write the offsets from rest
    """
    begin, end, degree, is_offset = part
    weights, bends = nodes
    table, center = motions
    width = rows.shape[1]
    buffer = np.zeros((_ROW + width) * _LANES, np.float32)
    if degree > 0:
        _write_basis_at_rest(1, bands[0], buffer)
    if degree > 1:
        _write_basis_at_rest(2, bands[1], buffer)
    if degree > 2:
        _write_basis_at_rest(3, bands[2], buffer)
    for start in range(begin, end, _LANES):
        lanes = min(_LANES, end - start)
        for lane in range(_LANES):
            member = start + min(lane, lanes - 1)
            _blend_node_motions(weights, table, member, lane, buffer)
            _read_lane(rows, last, member, lane, buffer)
        _bend(bends, motions, start, lanes, buffer)
        _move_means(center, buffer)
        _stretch_axes(buffer)
        for lane in range(lanes):
            _write_frame(frames, start + lane, lane, buffer)
        if degree > 0:
            _write_rotation(buffer)
            _turn_band(1, bands[0], buffer)
        if degree > 1:
            _turn_band(2, bands[1], buffer)
        if degree > 2:
            _turn_band(3, bands[2], buffer)
        for lane in range(lanes):
            member = start + lane
            _write_row(last[0], member, lane, buffer, result)
            if is_offset:
                for c in range(width):
                    result[member, c] -= rows[member, c]
