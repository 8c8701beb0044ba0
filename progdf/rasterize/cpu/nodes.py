"""Nodes of the level-of-detail pyramid: their columns, and merging them from their children.

A node is one Gaussian with the moments of its children, weighted by opacity times area. Its colors are also
weighted by the visibility of the children, because hidden ones do not contribute to a picture.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from progdf.rasterize.engines import ALPHA_MIN

from .forward import Array, Quat, Scene, Vec, dot, quat_of, rotation_rows, times, unit_quat, vec
from .jit import Number, kernel, prefetch

LEAF = 4
"""Minimum number of Gaussians per leaf.

Fewer cost memory, more lose 0.7 dB (docs/lab/experiments.md, The viewer).
"""

LONGEST, DENSITY, WEIGHT, POINTS, LOSS = range(3, 8)
"""Columns of a node after its mean.

- LONGEST: largest scale, world units
- DENSITY: opacity, negative if a Gaussian below the node cannot be drawn
- WEIGHT: Σ opacity · area of the Gaussians below, world units², 0 if none can be drawn
- POINTS: Σ opacity of the Gaussians below
- LOSS: spread of the centers, world units, times (1 + summed variances of the colors, band-0 coefficients)
"""

SCALES = 4
"""First of the three scales in a node's 16-bit columns, each as a share of the largest times 65535.

Columns 0 to 3 are the rotation, wxyz times 32767.
"""

SPREAD = 7
"""Column of the centers' spread, the root of their variance, world units.

This column and all that follow are the upper halves of float32, with errors of 0.2 %.
"""

CONTRAST = 8
"""Column of the colors' spread, the root of their summed variances, in coefficients of band 0."""

VISIBILITY = 9
"""Column of the mean visibility of the Gaussians below, weighted by opacity times area."""

COLORS = 10
"""First column of the color coefficients, band by band."""

_OFF_DIAGONAL = 1e-9  # largest sum of squares off the diagonal, as a share of that on it; below 16-bit steps
PREFETCH_ROWS = 8  # rows to prefetch ahead, because they lie far apart in memory
MIN_WEIGHT = 1e-30
_MAX_WEIGHT = 1e30


class Nodes(NamedTuple):
    """Tree in arrays, level after level.

    Node i has the children 2i + 1 and 2i + 2. Leaf l of L = 2^levels holds the rows
    order[l·N // L : (l + 1)·N // L].
    """

    # means and the columns above: all that a cut reads. [2L-1,8] float32
    means: Array
    shapes: Array  # 16-bit columns. [2L-1,10+3K] uint16
    quats: Array  # first four 16-bit columns, signed. [2L-1,4] int16
    order: Array  # rows of the scene. [N] int32
    levels: int
    visibility: Array  # relative visibility of each row in the order, > 0. [N] float32


@kernel(contract=True, inline=True)
def two_largest(scale: Vec) -> tuple[float, float]:
    a = abs(scale[0])
    b = abs(scale[1])
    c = abs(scale[2])
    return max(a, max(b, c)), max(min(a, b), min(max(a, b), c))


@kernel(inline=True)
def roots(a: float, b: float, c: float) -> Vec:
    return math.sqrt(max(a, 0.0)), math.sqrt(max(b, 0.0)), math.sqrt(max(c, 0.0))


@kernel(contract=True, inline=True)
def _weight(scene: Scene, i: int) -> float:
    """Return opacity times area, or 0 if the Gaussian cannot be drawn."""
    mean = vec(scene.means, i)
    opacity = np.float64(scene.opacities[i])
    longest, middle = two_largest(vec(scene.scales, i))
    weight = opacity * longest * middle
    drawn = (
        opacity >= ALPHA_MIN and abs(mean[0]) + abs(mean[1]) + abs(mean[2]) < np.inf and weight < _MAX_WEIGHT
    )
    return max(weight, MIN_WEIGHT) if drawn else 0.0


@kernel(contract=True, cache=True)
def merge_nodes(
    begin: int, end: int, indices: Array, level: int, scene: Scene, colors: Array, nodes: Nodes,
    colors_only: bool, weights: Array, merged: Array, matrix: Array, quat: Array,
) -> None:  # fmt: skip
    """Merge nodes indices[begin … end − 1] of a level from the level below.

    Args:
        colors: the scene's colors, a row per Gaussian. [N,3K] float32
        weights: scratch, at least 2 · `LEAF` values, float64
        merged: scratch [3K] float32
        matrix: scratch [3,3]
        quat: scratch [4]
    """
    count = nodes.order.shape[0]
    for at in range(begin, end):
        me = (1 << level) - 1 + indices[at]
        if level == nodes.levels:
            first = (indices[at] * count) >> level
            last = ((indices[at] + 1) * count) >> level
            for k in range(first, last):  # rows of neighbors lie far apart; adjacent leaves do not
                prefetch_pick(~nodes.order[min(k + PREFETCH_ROWS, count - 1)], scene, nodes, not colors_only)
                weights[k - first] = _weight(scene, nodes.order[k])
            _merge_rows(me, first, last, scene, colors, nodes, colors_only, weights, merged, matrix, quat)
        else:
            _merge_pair(me, scene, nodes, colors_only, merged, matrix, quat)


@kernel(contract=True)
def _merge_rows(
    me: int, first: int, last: int, scene: Scene, colors: Array, nodes: Nodes, colors_only: bool,
    weights: Array, merged: Array, matrix: Array, quat: Array,
) -> None:  # fmt: skip
    """Merge the Gaussians order[first … last − 1] into leaf `me`. See `merge_nodes`."""
    total = points = 0.0
    sound = True
    for k in range(last - first):
        weight = weights[k]
        total += weight
        points += np.float64(scene.opacities[nodes.order[first + k]]) if weight > 0.0 else 0.0
        sound = sound and weight > 0.0
    share = 1.0 / max(total, MIN_WEIGHT)
    visible = 0.0
    for k in range(last - first):
        visible += weights[k] * share * nodes.visibility[first + k]
    seen_share = 1.0 / max(visible, MIN_WEIGHT)
    merged[:] = 0.0
    square = red = green = blue = 0.0
    x = y = z = 0.0
    for k in range(last - first):
        weight = weights[k] * share
        if weight > 0.0:
            i = nodes.order[first + k]
            seen = weight * nodes.visibility[first + k] * seen_share
            _add_scaled(np.float32(seen), colors[i], merged)
            color = vec(colors, i)
            red += seen * color[0]
            green += seen * color[1]
            blue += seen * color[2]
            square += seen * dot(color, color)
            mean = vec(scene.means, i)
            x += weight * mean[0]
            y += weight * mean[1]
            z += weight * mean[2]
    base = red, green, blue
    nodes.shapes[me, VISIBILITY] = _pack(visible)
    _write_colors(me, merged, square - dot(base, base), nodes)
    if not colors_only:
        matrix[:] = 0.0
        between = 0.0
        for k in range(last - first):
            weight = weights[k] * share
            if weight > 0.0:
                mean, scale, turn = part_of(nodes.order[first + k], True, scene, nodes)
                off = mean[0] - x, mean[1] - y, mean[2] - z
                _add_moments(off, scale, turn, weight, matrix)
                between += weight * dot(off, off)
        center = x, y, z
        _write_shape(me, center, total, points, sound, between, matrix, quat, nodes)
    _write_loss(me, nodes)


@kernel(contract=True)
def _merge_pair(
    me: int, scene: Scene, nodes: Nodes, colors_only: bool, merged: Array, matrix: Array, quat: Array
) -> None:
    """Merge the two children of node `me`. See `merge_nodes`."""
    means = nodes.means
    shapes = nodes.shapes
    children = 2 * me + 1, 2 * me + 2
    total = np.float64(means[children[0], WEIGHT]) + np.float64(means[children[1], WEIGHT])
    share = 1.0 / max(total, MIN_WEIGHT)
    visible = 0.0
    for i in children:
        visible += np.float64(means[i, WEIGHT]) * share * np.float64(_unpack(shapes[i, VISIBILITY]))
    seen_share = 1.0 / max(visible, MIN_WEIGHT)
    merged[:] = 0.0
    square = red = green = blue = 0.0
    x = y = z = points = 0.0
    sound = True
    for i in children:
        weight = np.float64(means[i, WEIGHT]) * share
        sound = sound and means[i, DENSITY] > 0.0
        if weight > 0.0:
            seen = weight * np.float64(_unpack(shapes[i, VISIBILITY])) * seen_share
            for c in range(merged.shape[0]):
                merged[c] += np.float32(seen) * _unpack(shapes[i, COLORS + c])
            color = (
                np.float64(_unpack(shapes[i, COLORS])),
                np.float64(_unpack(shapes[i, COLORS + 1])),
                np.float64(_unpack(shapes[i, COLORS + 2])),
            )
            red += seen * color[0]
            green += seen * color[1]
            blue += seen * color[2]
            square += seen * (dot(color, color) + np.float64(_unpack(shapes[i, CONTRAST])) ** 2)
            mean = vec(means, i)
            x += weight * mean[0]
            y += weight * mean[1]
            z += weight * mean[2]
            points += np.float64(means[i, POINTS])
    base = red, green, blue
    nodes.shapes[me, VISIBILITY] = _pack(visible)
    _write_colors(me, merged, square - dot(base, base), nodes)
    if not colors_only:
        matrix[:] = 0.0
        between = 0.0
        for i in children:
            weight = np.float64(means[i, WEIGHT]) * share
            if weight > 0.0:
                mean, scale, turn = part_of(i, False, scene, nodes)
                off = mean[0] - x, mean[1] - y, mean[2] - z
                _add_moments(off, scale, turn, weight, matrix)
                between += weight * (dot(off, off) + np.float64(_unpack(shapes[i, SPREAD])) ** 2)
        center = x, y, z
        _write_shape(me, center, total, points, sound, between, matrix, quat, nodes)
    _write_loss(me, nodes)


@kernel(contract=True, inline=True)
def _add_scaled(weight: Number, values: Array, sums: Array) -> None:
    """Add weight · values to the sums. A loop that the compiler vectorizes."""
    for c in range(sums.shape[0]):
        sums[c] += weight * values[c]


@kernel(contract=True, inline=True)
def _write_colors(me: int, colors: Array, variance: float, nodes: Nodes) -> None:
    """Write a node's colors [3K], and the summed variances of those of band 0."""
    for c in range(colors.shape[0]):
        nodes.shapes[me, COLORS + c] = _pack(colors[c])
    nodes.shapes[me, CONTRAST] = _pack(math.sqrt(max(variance, 0.0)))


@kernel(contract=True, inline=True)
def _write_shape(
    me: int, center: Vec, total: float, points: float, sound: bool, between: float, matrix: Array,
    quat: Array, nodes: Nodes,
) -> None:  # fmt: skip
    """Write a node's mean, shape and density.

    Args:
        total: column `WEIGHT`
        points: column `POINTS`
        sound: whether all Gaussians below the node can be drawn
        between: variance of the centers, world units²
        matrix: covariance [3,3]; overwritten
        quat: scratch [4]
    """
    mine = nodes.means[me]
    shapes = nodes.shapes
    shapes[me, SPREAD] = _pack(math.sqrt(between))
    _diagonalize(matrix, quat)
    mine[0], mine[1], mine[2] = center
    mine[WEIGHT] = total
    mine[POINTS] = points
    for k in range(4):
        nodes.quats[me, k] = np.rint(32767.0 * quat[k])
    sizes = roots(matrix[0, 0], matrix[1, 1], matrix[2, 2])
    mine[LONGEST], middle = two_largest(sizes)
    unit = 65535.0 / max(mine[LONGEST], MIN_WEIGHT)
    for k in range(3):
        shapes[me, SCALES + k] = np.uint16(np.rint(unit * sizes[k]))
    density = total / max(mine[LONGEST] * middle, MIN_WEIGHT)
    mine[DENSITY] = density if sound else -density


@kernel(contract=True, inline=True)
def _write_loss(me: int, nodes: Nodes) -> None:
    spread = np.float64(_unpack(nodes.shapes[me, SPREAD]))
    contrast = np.float64(_unpack(nodes.shapes[me, CONTRAST]))
    nodes.means[me, LOSS] = spread * (1.0 + contrast**2)


@kernel(inline=True)
def _pack(value: float) -> Number:
    """Return the upper half of a float32, rounded to nearest."""
    return np.uint16((np.float32(value).view(np.uint32) + np.uint32(0x8000)) >> np.uint32(16))


@kernel(inline=True)
def _unpack(half: Number) -> Number:
    return np.uint32(np.uint32(half) << np.uint32(16)).view(np.float32)


@kernel(inline=True)
def prefetch_pick(pick: int, scene: Scene, nodes: Nodes, turned: bool) -> None:
    """Prefetch the data of a pick; its rotation only if `turned`."""
    if pick >= 0:
        prefetch(nodes.means, pick)
        prefetch(nodes.shapes, pick)
    else:
        prefetch(scene.means, ~pick)
        prefetch(scene.quats if turned else scene.means, ~pick)
        prefetch(scene.scales, ~pick)
        prefetch(scene.opacities, ~pick)
        prefetch(scene.colors, ~pick)


@kernel(inline=True)
def part_of(i: int, is_row: bool, scene: Scene, nodes: Nodes) -> tuple[Vec, Vec, Quat]:
    """Return the mean, scales and rotation of a row or a node."""
    if is_row:
        return vec(scene.means, i), vec(scene.scales, i), quat_of(scene.quats, i)
    shape = nodes.shapes[i]
    unit = nodes.means[i, LONGEST] / 65535.0
    scale = unit * shape[SCALES], unit * shape[SCALES + 1], unit * shape[SCALES + 2]
    return vec(nodes.means, i), scale, quat_of(nodes.quats, i)


@kernel(inline=True)
def color_of(i: int, is_row: bool, band: int, k: int, scene: Scene, nodes: Nodes) -> Number:
    return scene.colors[i, band, k] if is_row else _unpack(nodes.shapes[i, COLORS + 3 * band + k])


@kernel(contract=True, inline=True)
def _add_moments(off: Vec, scale: Vec, quat: Quat, weight: float, matrix: Array) -> None:
    """Add a Gaussian's second moments about a point to the upper half of a symmetric matrix."""
    qw, qx, qy, qz, _ = unit_quat(quat[0], quat[1], quat[2], quat[3])
    rotation = rotation_rows(qw, qx, qy, qz)
    turned = times(rotation[0], scale), times(rotation[1], scale), times(rotation[2], scale)
    for row in range(3):
        for column in range(row, 3):
            matrix[row, column] += weight * (dot(turned[row], turned[column]) + off[row] * off[column])


@kernel(contract=True)
def _diagonalize(matrix: Array, quat: Array) -> None:
    """Diagonalize a symmetric matrix [3,3] in place by Jacobi rotations.

    Args:
        matrix: in, its upper half; out, the eigenvalues on the diagonal
        quat: out, wxyz of the rotation whose columns are the eigenvectors. [4]
    """
    quat[0] = 1.0
    quat[1] = 0.0
    quat[2] = 0.0
    quat[3] = 0.0
    matrix[1, 0] = matrix[0, 1]
    matrix[2, 0] = matrix[0, 2]
    matrix[2, 1] = matrix[1, 2]
    for _ in range(8):
        off = matrix[0, 1] ** 2 + matrix[0, 2] ** 2 + matrix[1, 2] ** 2
        if off <= _OFF_DIAGONAL * (matrix[0, 0] ** 2 + matrix[1, 1] ** 2 + matrix[2, 2] ** 2):
            return
        for axis in range(3):
            p = (axis + 1) % 3
            q = (axis + 2) % 3
            if matrix[p, q] == 0.0:
                continue
            half = (matrix[q, q] - matrix[p, p]) / (2.0 * matrix[p, q])
            tangent = math.copysign(1.0, half) / (abs(half) + math.sqrt(half * half + 1.0))
            cosine = 1.0 / math.sqrt(tangent * tangent + 1.0)
            sine = tangent * cosine
            matrix[p, p] -= tangent * matrix[p, q]
            matrix[q, q] += tangent * matrix[p, q]
            to_p = matrix[axis, p]
            to_q = matrix[axis, q]
            matrix[p, q] = matrix[q, p] = 0.0
            matrix[axis, p] = matrix[p, axis] = cosine * to_p - sine * to_q
            matrix[axis, q] = matrix[q, axis] = sine * to_p + cosine * to_q
            turn = math.sqrt(0.5 * (1.0 + cosine))  # cosine of half the angle, about −axis
            lean = -0.5 * sine / turn
            w = quat[0]
            along = quat[1 + axis]
            at_p = quat[1 + p]
            at_q = quat[1 + q]
            quat[0] = w * turn - along * lean
            quat[1 + axis] = along * turn + w * lean
            quat[1 + p] = at_p * turn + at_q * lean
            quat[1 + q] = at_q * turn - at_p * lean
