"""Fast version of `carry_rows` and `carry_pushed` in `progdf.compose.follow`, for dragging sliders."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.cpu.jit import kernel

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]
Quat = tuple[float, float, float, float]

_MIN_DRAWN_OPACITY = 1 / 255  # as in `follow`
_MIN_OPACITY = 1e-30


@kernel(inline=True)
def _multiply(a: Quat, b: Quat) -> Quat:
    """Return the Hamilton product of quaternions wxyz."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@kernel(inline=True)
def _normalize(w: float, x: float, y: float, z: float) -> Quat:
    """Return a unit quaternion; the identity for zero."""
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not length > 0.0:
        return 1.0, 0.0, 0.0, 0.0
    return w / length, x / length, y / length, z / length


@kernel(inline=True)
def _sigmoid(logit: float) -> float:
    """Return the opacity of a logit."""
    return 1.0 / (1.0 + math.exp(-logit))


@kernel(inline=True)
def _differs(a: Floats, i: int, b: Floats, j: int, first: int, last: int) -> bool:
    """Return whether two rows differ in some columns."""
    differs = False
    for c in range(first, last):
        differs |= a[i, c] != b[j, c]
    return differs


@kernel(cache=True)
def carry_fast(
    shapes: Floats,
    own: Floats,
    states: tuple[Floats, Floats],
    anchors: Rows,
    weights: NDArray[np.float64],
    pushed: bool,
) -> None:
    """Write rows that follow their anchors.

    Args:
        shapes: the rows under all edits, as of `pack_shapes`; updated in place. [F,11]
        own: the rows under their own edit, or under paint alone. [F,11]
        states: all states in the original and under the other edits. [E,11] each
        anchors: states of the anchors. [F,4]
        weights: their weights, sum 1. [F,4]
        pushed: the rows are pushed ones, whose anchor is their own row
    """
    before, after = states
    for i in range(len(shapes)):
        moves = False
        fades = False
        for k in range(4):
            if weights[i, k] > 0.0:
                state = anchors[i, k]
                moves |= _differs(before, state, after, state, 0, 10)
                fades |= before[state, 10] != after[state, 10]
        first = anchors[i, 0]
        if moves and pushed and not _differs(own, i, before, first, 0, 10):
            for c in range(10):
                shapes[i, c] = after[first, c]
        elif moves:
            _carry_geometry(shapes, own, before, after, anchors, weights, i)
        if fades and pushed and own[i, 10] == before[first, 10]:
            shapes[i, 10] = after[first, 10]
        elif fades:
            visible = 0.0
            remaining = 0.0
            for k in range(4):
                state = anchors[i, k]
                visible += weights[i, k] * max(_sigmoid(before[state, 10]) - _MIN_DRAWN_OPACITY, 0.0)
                remaining += weights[i, k] * max(_sigmoid(after[state, 10]) - _MIN_DRAWN_OPACITY, 0.0)
            shapes[i, 10] = own[i, 10]
            if visible > 0.0 and remaining < visible:
                opacity = max(_sigmoid(own[i, 10]) * (remaining / visible), _MIN_OPACITY)
                shapes[i, 10] = math.log(opacity) - math.log1p(-opacity)


@kernel()
def _carry_geometry(
    shapes: Floats,
    own: Floats,
    before: Floats,
    after: Floats,
    anchors: Rows,
    weights: NDArray[np.float64],
    i: int,
) -> None:
    """Write the geometry of row `i`; arguments as of `carry_fast`."""
    tw = tx = ty = tz = 0.0
    px = py = pz = 0.0
    nx = ny = nz = 0.0
    growth = 0.0
    base = (1.0, 0.0, 0.0, 0.0)
    for k in range(4):
        state = anchors[i, k]
        weight = weights[i, k]
        old = _normalize(
            float(before[state, 6]), float(before[state, 7]), float(before[state, 8]), float(before[state, 9])
        )
        new = _normalize(
            float(after[state, 6]), float(after[state, 7]), float(after[state, 8]), float(after[state, 9])
        )
        turn = _multiply(new, (old[0], -old[1], -old[2], -old[3]))
        if k == 0:
            base = turn
        sign = weight
        if turn[0] * base[0] + turn[1] * base[1] + turn[2] * base[2] + turn[3] * base[3] < 0.0:
            sign = -weight
        tw += sign * turn[0]
        tx += sign * turn[1]
        ty += sign * turn[2]
        tz += sign * turn[3]
        px += weight * before[state, 0]
        py += weight * before[state, 1]
        pz += weight * before[state, 2]
        nx += weight * after[state, 0]
        ny += weight * after[state, 1]
        nz += weight * after[state, 2]
        for c in range(3, 6):
            growth += weight * (float(after[state, c]) - float(before[state, c])) / 3.0
    q = _normalize(tw, tx, ty, tz)
    arm = (0.0, float(own[i, 0]) - px, float(own[i, 1]) - py, float(own[i, 2]) - pz)
    turned = _multiply(_multiply(q, arm), (q[0], -q[1], -q[2], -q[3]))
    scale = math.exp(growth)
    quat = _multiply(q, (float(own[i, 6]), float(own[i, 7]), float(own[i, 8]), float(own[i, 9])))
    shapes[i, 0] = nx + scale * turned[1]
    shapes[i, 1] = ny + scale * turned[2]
    shapes[i, 2] = nz + scale * turned[3]
    for c in range(3, 6):
        shapes[i, c] = own[i, c] + growth
    shapes[i, 6] = quat[0]
    shapes[i, 7] = quat[1]
    shapes[i, 8] = quat[2]
    shapes[i, 9] = quat[3]
