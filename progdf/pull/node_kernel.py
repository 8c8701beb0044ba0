"""Kernels of nodes: the affine motion and the rotation that Gaussians blend.

Reference implementation: tests/helpers/plain_pull.py.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.cpu.jit import kernel

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

NODE_WIDTH = 24
"""Numbers per node: G − I [9], shift [3], nothing [4], quaternion [4], nothing [4]."""
NODE_QUAT = 16
"""First number of the quaternion."""
_NODE_SWEEPS = 8  # sweeps of one-sided Jacobi rotations


@kernel()
def _orthogonalize(columns: Floats, right: Floats, i: int, j: int) -> None:
    """Make two columns [3,3] orthogonal; `right` [3,3] takes the same rotation."""
    first = columns[0, i] ** 2 + columns[1, i] ** 2 + columns[2, i] ** 2
    second = columns[0, j] ** 2 + columns[1, j] ** 2 + columns[2, j] ** 2
    mixed = columns[0, i] * columns[0, j] + columns[1, i] * columns[1, j] + columns[2, i] * columns[2, j]
    difference = second - first
    divisor = abs(difference) + math.sqrt(difference * difference + 4.0 * mixed * mixed)
    if divisor > 0.0:
        tangent = 2.0 * mixed / divisor
        if difference < 0.0:
            tangent = -tangent
        cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
        sine = tangent * cosine
        for r in range(3):
            x = columns[r, i]
            y = columns[r, j]
            columns[r, i] = cosine * x - sine * y
            columns[r, j] = sine * x + cosine * y
            x = right[r, i]
            y = right[r, j]
            right[r, i] = cosine * x - sine * y
            right[r, j] = sine * x + cosine * y


@kernel(allocates=True)
def _decompose(gradient: Floats, columns: Floats, right: Floats, lengths: Floats) -> None:
    """Write the singular vectors and values of a gradient [3,3]: both sides [3,3], and the lengths [3].

    Both sides are rotations, also if the gradient is reflected or flat.
    """
    columns[:] = gradient
    right[:] = 0.0
    for r in range(3):
        right[r, r] = 1.0
    for _ in range(_NODE_SWEEPS):
        for i in range(2):
            for j in range(i + 1, 3):
                _orthogonalize(columns, right, i, j)
    for c in range(3):
        lengths[c] = math.sqrt(columns[0, c] ** 2 + columns[1, c] ** 2 + columns[2, c] ** 2)
    least = 0
    if lengths[1] < lengths[least]:
        least = 1
    if lengths[2] < lengths[least]:
        least = 2
    a = (least + 1) % 3
    b = (least + 2) % 3
    for c in (a, b):
        scale = 1.0 / max(lengths[c], 1e-150)
        for r in range(3):
            columns[r, c] *= scale
    # the least direction completes a rotation
    for r in range(3):
        s = (r + 1) % 3
        t = (r + 2) % 3
        columns[r, least] = columns[s, a] * columns[t, b] - columns[t, a] * columns[s, b]


@kernel()
def _write_map(gradient: Floats, rest: Floats, moved: Floats, center: Floats, entry: Singles) -> None:
    """Write a node's affine map, less the identity, into its entry, for points relative to a center."""
    for r in range(3):
        for c in range(3):
            entry[3 * r + c] = gradient[r, c] - (1.0 if r == c else 0.0)
        shift = moved[r] - rest[r]
        for c in range(3):
            arm = rest[c] - center[c]
            shift -= gradient[r, c] * arm
            if r == c:
                shift += arm
        entry[9 + r] = shift


@kernel(allocates=True)
def _write_quat(columns: Floats, right: Floats, entry: Singles) -> None:
    """Write the quaternion wxyz of a node's rotation, from its singular vectors, into its entry."""
    m = np.zeros((3, 3))
    for r in range(3):
        for c in range(3):
            for k in range(3):
                m[r, c] += columns[r, k] * right[c, k]
    w = 1.0 + m[0, 0] + m[1, 1] + m[2, 2]
    x = 1.0 + m[0, 0] - m[1, 1] - m[2, 2]
    y = 1.0 - m[0, 0] + m[1, 1] - m[2, 2]
    z = 1.0 - m[0, 0] - m[1, 1] + m[2, 2]
    if w >= max(x, y, z):
        x = m[2, 1] - m[1, 2]
        y = m[0, 2] - m[2, 0]
        z = m[1, 0] - m[0, 1]
    elif x >= max(y, z):
        w = m[2, 1] - m[1, 2]
        y = m[0, 1] + m[1, 0]
        z = m[0, 2] + m[2, 0]
    elif y >= z:
        w = m[0, 2] - m[2, 0]
        x = m[0, 1] + m[1, 0]
        z = m[1, 2] + m[2, 1]
    else:
        w = m[1, 0] - m[0, 1]
        x = m[0, 2] + m[2, 0]
        y = m[1, 2] + m[2, 1]
    length = math.sqrt(w * w + x * x + y * y + z * z)
    entry[NODE_QUAT] = w / length
    entry[NODE_QUAT + 1] = x / length
    entry[NODE_QUAT + 2] = y / length
    entry[NODE_QUAT + 3] = z / length


@kernel(cache=True, allocates=True)
def write_nodes(gradients: Floats, rest: Floats, moved: Floats, center: Floats, table: Singles) -> None:
    """Write the motions of nodes, from which those of Gaussians are blended.

    Args:
        gradients: deformation gradients. [n,3,3]
        rest, moved: positions. [n,3] each
        center: the shifts are for points relative to it. [3]
        table: motions, see `NODE_WIDTH`. [n,24]
    """
    columns = np.empty((3, 3))
    right = np.empty((3, 3))
    lengths = np.empty(3)
    for node in range(len(gradients)):
        entry = table[node]
        _decompose(gradients[node], columns, right, lengths)
        _write_map(gradients[node], rest[node], moved[node], center, entry)
        _write_quat(columns, right, entry)
