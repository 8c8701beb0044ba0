"""Fast version of `carry_rows` and `carry_pushed` in `progdf.compose.follow`, for dragging sliders.

The motion of a state is measured once, when it changes, and then applied to all rows that lie on it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.cpu.jit import kernel

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]
Quat = tuple[float, float, float, float]
Shapes = tuple[Floats, Floats, Floats, Floats]
"""Followed attributes of a scene: means, log-scales, quaternions and opacity logits. [N,3|3|4|1]"""
Doubles = NDArray[np.float64]
Motions = tuple[NDArray[np.bool_], Doubles, Doubles, Doubles, Doubles]
"""Change of each state from the original to the composed scene.

Geometry or opacity differs [E,2]; turn, a unit quaternion, and mean change of the log-scales [E,5]; center
before and after [E,2,3]; the turn as a matrix, times the scale [E,3,3]; opacity above the least that is
drawn, before and after [E,2].
"""

Blends = tuple[Doubles, NDArray[np.bool_], NDArray[np.bool_]]
"""Mean motion of the anchors of each added row, which is measured when one of them changes.

Matrix and shift of the affine map of the center, turn as a unit quaternion, mean change of the log-scales,
and factor of the opacity [F,18]; geometry or opacity of an anchor differs [F,2]; states whose motion has
changed in this update [E], or [0] without any.
"""

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
def release_rows(shapes: Shapes, index: Rows, rows: Rows, own: Floats) -> None:
    """Write following rows as they are before they follow their anchors.

    Args:
        shapes: followed attributes of the scene, updated in place. [N,c] each
        index: indices of the rows to write. [G]
        rows: rows of the scene that follow. [F]
        own: the rows before they follow, packed by `pack_shapes`. [F,11]
    """
    logits = shapes[3]
    for i in index:
        _write_geometry(shapes, rows[i], own, i)
        logits[rows[i], 0] = own[i, 10]


@kernel(cache=True)
def gather_shapes(own: Floats, index: Rows, shapes: Shapes, rows: Rows) -> None:
    """Copy following rows from a scene.

    Args:
        own: shapes of the following rows, packed by `pack_shapes`; updated in place. [F,11]
        index: indices of those to copy. [G]
        shapes: followed attributes of the scene. [N,c] each
        rows: rows of the scene that follow. [F]
    """
    for i in index:
        _copy_row(own, i, shapes, rows[i])


@kernel(inline=True)
def _copy_row(own: Floats, i: int, shapes: Shapes, row: int) -> None:
    """Copy one row of a scene to a table."""
    means, log_scales, quats, logits = shapes
    for c in range(3):
        own[i, c] = means[row, c]
        own[i, 3 + c] = log_scales[row, c]
    for c in range(4):
        own[i, 6 + c] = quats[row, c]
    own[i, 10] = logits[row, 0]


def rest_motions(before: Floats) -> Motions:
    """Return the motions of states that are as in the original. [E,11]"""
    count = len(before)
    moves = np.zeros((count, 2), np.bool_)
    turns = np.zeros((count, 5))
    turns[:, 0] = 1.0
    means = np.repeat(before[:, None, :3], 2, axis=1).astype(np.float64)
    opacities = 1.0 / (1.0 + np.exp(-before[:, 10].astype(np.float64)))
    visible = np.maximum(opacities - _MIN_DRAWN_OPACITY, 0.0)
    matrices = np.repeat(np.eye(3)[None], count, axis=0)
    return moves, turns, means, matrices, np.repeat(visible[:, None], 2, axis=1)


def rest_blends(count: int) -> tuple[Doubles, NDArray[np.bool_]]:
    """Return the blends of rows whose anchors are as in the original."""
    return np.zeros((count, 18)), np.zeros((count, 2), np.bool_)


@kernel(cache=True)
def measure_motions(motions: Motions, index: Rows, before: Floats, after: Shapes) -> None:
    """Update the motions of states that have changed.

    Args:
        motions: motions of all states, updated in place
        index: the changed states. [e]
        before: states in the original, packed by `pack_shapes`. [E,11]
        after: states under the other edits. [E,c] each
    """
    moves, turns, centers, matrices, visible = motions
    means, log_scales, quats, logits = after
    for state in index:
        differs = False
        for c in range(3):
            differs |= before[state, c] != means[state, c] or before[state, 3 + c] != log_scales[state, c]
        for c in range(4):
            differs |= before[state, 6 + c] != quats[state, c]
        moves[state, 0] = differs
        turn = (1.0, 0.0, 0.0, 0.0)
        growth = 0.0
        if differs:
            w, x, y, z = _normalize(
                float(before[state, 6]),
                float(before[state, 7]),
                float(before[state, 8]),
                float(before[state, 9]),
            )
            new = _normalize(
                float(quats[state, 0]), float(quats[state, 1]), float(quats[state, 2]), float(quats[state, 3])
            )
            turn = _multiply(new, (w, -x, -y, -z))
            for c in range(3):
                growth += (float(log_scales[state, c]) - float(before[state, 3 + c])) / 3.0
        turns[state, 0] = turn[0]
        turns[state, 1] = turn[1]
        turns[state, 2] = turn[2]
        turns[state, 3] = turn[3]
        turns[state, 4] = growth
        _write_matrix(matrices[state], turn, math.exp(growth))
        for c in range(3):
            centers[state, 1, c] = means[state, c]
        moves[state, 1] = before[state, 10] != logits[state, 0]
        visible[state, 1] = visible[state, 0]
        if moves[state, 1]:
            visible[state, 1] = max(_sigmoid(logits[state, 0]) - _MIN_DRAWN_OPACITY, 0.0)


@kernel(inline=True)
def _write_matrix(matrix: Doubles, q: Quat, scale: float) -> None:
    """Write the rotation matrix of a unit quaternion, times a scale. [3,3]"""
    w, x, y, z = q
    matrix[0, 0] = scale * (1.0 - 2.0 * (y * y + z * z))
    matrix[0, 1] = scale * 2.0 * (x * y - w * z)
    matrix[0, 2] = scale * 2.0 * (x * z + w * y)
    matrix[1, 0] = scale * 2.0 * (x * y + w * z)
    matrix[1, 1] = scale * (1.0 - 2.0 * (x * x + z * z))
    matrix[1, 2] = scale * 2.0 * (y * z - w * x)
    matrix[2, 0] = scale * 2.0 * (x * z - w * y)
    matrix[2, 1] = scale * 2.0 * (y * z + w * x)
    matrix[2, 2] = scale * (1.0 - 2.0 * (x * x + y * y))


@kernel(cache=True)
def carry_fast(
    shapes: Shapes,
    kept: tuple[Floats, Floats],
    index: Rows,
    table: tuple[Rows, Rows, Rows, Rows, Doubles],
    follows: NDArray[np.bool_],
    states: tuple[Floats, Shapes],
    motions: Motions,
    blends: Blends,
) -> float:
    """Write rows that follow their anchors; return the largest squared movement of a center.

    Args:
        shapes: followed attributes of the scene, updated in place. [N,c] each
        kept: following rows before they follow [F,11], of which pushed ones are updated in place; and their
            centers in the last picture, updated in place. [F,3]
        index: indices of the rows to write. [f]
        table: rows, edits, own states, anchors and weights, see `Followers`. [F], [F], [F], [F,4], [F,4]
        follows: by edit + 1: its rows follow; the first is for pushed rows
        states: states in the original [E,11], and composed. [E,c] each
        motions: motions of the states
        blends: mean motions of the anchors of added rows; updated in place
    """
    touched = blends[2]
    own, drawn = kept
    rows, edits, own_states, anchors, weights = table
    before, after = states
    moves, _, _, _, visible = motions
    means, log_scales, quats, logits = shapes
    largest = 0.0
    for i in index:
        first = anchors[i, 0]
        pushed = own_states[i] >= 0
        if pushed:
            _copy_row(own, i, after, own_states[i])
        elif len(touched):
            for k in range(4):
                if weights[i, k] > 0.0 and touched[anchors[i, k]]:
                    _blend(blends, i, anchors, weights, motions)
                    break
        is_moved = False
        fades = False
        if follows[edits[i] + 1]:
            is_moved = moves[first, 0] if pushed else blends[1][i, 0]
            fades = moves[first, 1] if pushed else blends[1][i, 1]
        row = rows[i]
        if not is_moved:
            _write_geometry(shapes, row, own, i)
        elif pushed and not _differs(own, i, before, first, 0, 10):
            for c in range(3):
                means[row, c] = after[0][first, c]
                log_scales[row, c] = after[1][first, c]
            for c in range(4):
                quats[row, c] = after[2][first, c]
        elif pushed:
            _carry_with(shapes, row, own, i, first, motions)
        else:
            _carry_geometry(shapes, row, own, i, blends[0])
        logit = own[i, 10]
        if fades and pushed and logit == before[first, 10]:
            logit = after[3][first, 0]
        elif fades:
            ratio = blends[0][i, 17]
            if pushed:
                ratio = _opacity_ratio(visible[first, 0], visible[first, 1])
            if ratio < 1.0:
                opacity = max(_sigmoid(logit) * ratio, _MIN_OPACITY)
                logit = np.float32(math.log(opacity) - math.log1p(-opacity))
        logits[row, 0] = logit
        step = 0.0
        for c in range(3):
            step += (means[row, c] - drawn[i, c]) ** 2
            drawn[i, c] = means[row, c]
        largest = max(largest, step)
    return largest


@kernel(inline=True)
def _write_geometry(shapes: Shapes, row: int, own: Floats, i: int) -> None:
    """Write the geometry of a row of the scene from a table."""
    means, log_scales, quats, _ = shapes
    for c in range(3):
        means[row, c] = own[i, c]
        log_scales[row, c] = own[i, 3 + c]
    for c in range(4):
        quats[row, c] = own[i, 6 + c]


@kernel(inline=True)
def _carry_with(shapes: Shapes, row: int, own: Floats, i: int, state: int, motions: Motions) -> None:
    """Write the geometry of row `i` of the table, which has a single anchor."""
    means, log_scales, quats, _ = shapes
    _, turns, centers, matrices, _ = motions
    x = own[i, 0] - centers[state, 0, 0]
    y = own[i, 1] - centers[state, 0, 1]
    z = own[i, 2] - centers[state, 0, 2]
    for c in range(3):
        arm = matrices[state, c, 0] * x + matrices[state, c, 1] * y + matrices[state, c, 2] * z
        means[row, c] = centers[state, 1, c] + arm
        log_scales[row, c] = own[i, 3 + c] + turns[state, 4]
    turn = (turns[state, 0], turns[state, 1], turns[state, 2], turns[state, 3])
    quat = _multiply(turn, (float(own[i, 6]), float(own[i, 7]), float(own[i, 8]), float(own[i, 9])))
    quats[row, 0] = quat[0]
    quats[row, 1] = quat[1]
    quats[row, 2] = quat[2]
    quats[row, 3] = quat[3]


@kernel(inline=True)
def _opacity_ratio(old: float, remaining: float) -> float:
    """Return the factor by which opacity above the least that is drawn falls; 1 if it does not."""
    if old > 0.0 and remaining < old:
        return remaining / old
    return 1.0


@kernel(inline=True)
def _carry_geometry(shapes: Shapes, row: int, own: Floats, i: int, blends: Doubles) -> None:
    """Write the geometry of row `i` of the table, moved by the blend of its anchors' motions."""
    means, log_scales, quats, _ = shapes
    x = float(own[i, 0])
    y = float(own[i, 1])
    z = float(own[i, 2])
    for c in range(3):
        moved = blends[i, 3 * c] * x + blends[i, 3 * c + 1] * y + blends[i, 3 * c + 2] * z
        means[row, c] = moved + blends[i, 9 + c]
        log_scales[row, c] = own[i, 3 + c] + blends[i, 16]
    turn = (blends[i, 12], blends[i, 13], blends[i, 14], blends[i, 15])
    quat = _multiply(turn, (float(own[i, 6]), float(own[i, 7]), float(own[i, 8]), float(own[i, 9])))
    quats[row, 0] = quat[0]
    quats[row, 1] = quat[1]
    quats[row, 2] = quat[2]
    quats[row, 3] = quat[3]


@kernel()
def _blend(blends: Blends, i: int, anchors: Rows, weights: Doubles, motions: Motions) -> None:
    """Measure the mean motion of the anchors of row `i` of the table; arguments as in `carry_fast`."""
    blend = blends[0][i]
    moves, turns, centers, _, visible = motions
    tw = tx = ty = tz = 0.0
    px = py = pz = 0.0
    nx = ny = nz = 0.0
    growth = 0.0
    old = 0.0
    remaining = 0.0
    is_moved = False
    fades = False
    base = turns[anchors[i, 0]]
    for k in range(4):
        weight = weights[i, k]
        if weight > 0.0:
            state = anchors[i, k]
            is_moved |= moves[state, 0]
            fades |= moves[state, 1]
            turn = turns[state]
            sign = weight
            if turn[0] * base[0] + turn[1] * base[1] + turn[2] * base[2] + turn[3] * base[3] < 0.0:
                sign = -weight
            tw += sign * turn[0]
            tx += sign * turn[1]
            ty += sign * turn[2]
            tz += sign * turn[3]
            growth += weight * turn[4]
            center = centers[state]
            px += weight * center[0, 0]
            py += weight * center[0, 1]
            pz += weight * center[0, 2]
            nx += weight * center[1, 0]
            ny += weight * center[1, 1]
            nz += weight * center[1, 2]
            old += weight * visible[state, 0]
            remaining += weight * visible[state, 1]
    q = _normalize(tw, tx, ty, tz)
    matrix = blend[:9].reshape(3, 3)
    _write_matrix(matrix, q, math.exp(growth))
    blend[9] = nx - (matrix[0, 0] * px + matrix[0, 1] * py + matrix[0, 2] * pz)
    blend[10] = ny - (matrix[1, 0] * px + matrix[1, 1] * py + matrix[1, 2] * pz)
    blend[11] = nz - (matrix[2, 0] * px + matrix[2, 1] * py + matrix[2, 2] * pz)
    blend[12] = q[0]
    blend[13] = q[1]
    blend[14] = q[2]
    blend[15] = q[3]
    blend[16] = growth
    blend[17] = _opacity_ratio(old, remaining)
    blends[1][i, 0] = is_moved
    blends[1][i, 1] = fades
