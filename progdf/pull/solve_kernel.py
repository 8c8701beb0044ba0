"""Kernels of the solver: rotations, sums over edges, the factorized system, and Anderson acceleration.

A round computes the rotations for given positions and then the positions for given rotations. It is a
fixed-point map of the positions, and its differences x ↦ g(x) − x of earlier rounds predict where it settles
(Anderson acceleration, Peng and others 2018). A round whose difference has grown starts the history anew.

Reference implementation: tests/helpers/plain_pull.py, which repeats the rounds without acceleration.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.cpu.jit import kernel

Floats = NDArray[np.float64]
Rows = NDArray[np.int32]
Sparse = tuple[Rows, Rows, Floats]
"""Matrix by rows, or by columns: first entry of each row [n+1], columns of the entries, their values."""
Graph = tuple[Rows, Rows, Floats, Floats]
"""First edge of each node [n+1], ends [E] and arms [E,3] of the edges, stiffness of the springs [n]."""
Factor = tuple[Sparse, Sparse, Rows, Rows]
"""Lower factor by columns, diagonal first; upper factor by columns, diagonal last; both permutations.

Row i of the system is row `rows[i]` of the factors, and its solution is entry `columns[i]` of theirs.
"""
Handles = tuple[Sparse, Sparse, Floats, float]
"""Weights of the nodes [H,n] and of the columns of their rotations [H,3n], targets [H,3], and stiffness."""
Memory = tuple[Floats, Floats, Floats]
"""Steps of the rounds' results [h,3f] and of their differences [h,3f], products of the latter [h,h]."""

HISTORY = 6
"""Rounds that predict the next one."""
_ROTATION_STEPS = 40  # largest number of Newton steps of a rotation
_ROTATION_TOLERANCE = 1e-10  # squared angle, radians²; the error after such a step is its square
_GROWTH_LIMIT = 2.0  # factor by which the difference may grow before the history starts anew
_RIDGE = 1e-10  # share of the squared differences that keeps the prediction's system regular


@kernel(inline=True)
def _rotate(rotation: Floats, x: float, y: float, z: float) -> None:
    """Multiply a rotation [3,3] in place by a small rotation vector, exact to second order, from the left."""
    w = 1.0 / math.sqrt(1.0 + 0.25 * (x * x + y * y + z * z))
    x *= 0.5 * w
    y *= 0.5 * w
    z *= 0.5 * w
    for c in range(3):
        a = rotation[0, c]
        b = rotation[1, c]
        d = rotation[2, c]
        rotation[0, c] = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * d
        rotation[1, c] = 2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * d
        rotation[2, c] = 2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * d


@kernel(inline=True)
def _newton_step(
    trace: float, skew: tuple[float, float, float], diagonal: tuple[float, float, float],
    mixed: tuple[float, float, float],
) -> tuple[float, float, float]:  # fmt: skip
    """Return the rotation vector by which the trace of H grows, for a matrix H [3,3].

    It is a Newton step where the trace is concave, otherwise one of Müller and others (2016).

    Args:
        trace: Σ |H_ii|
        skew: H_zy − H_yz and so on
        diagonal: H_xx, H_yy, H_zz
        mixed: H_xy + H_yx, H_xz + H_zx, H_yz + H_zy
    """
    tx, ty, tz = skew
    # the Hessian tr(H) I − H with the symmetric part H, and a ridge for free directions
    ridge = 1e-9 * trace + 1e-12
    h00 = diagonal[1] + diagonal[2] + ridge
    h11 = diagonal[0] + diagonal[2] + ridge
    h22 = diagonal[0] + diagonal[1] + ridge
    h01 = -0.5 * mixed[0]
    h02 = -0.5 * mixed[1]
    h12 = -0.5 * mixed[2]
    c00 = h11 * h22 - h12 * h12
    c01 = h02 * h12 - h01 * h22
    c02 = h01 * h12 - h02 * h11
    determinant = h00 * c00 + h01 * c01 + h02 * c02
    if h00 > 0.0 and h00 * h11 - h01 * h01 > 0.0 and determinant > 0.0:
        c11 = h00 * h22 - h02 * h02
        c12 = h01 * h02 - h00 * h12
        c22 = h00 * h11 - h01 * h01
        x = (c00 * tx + c01 * ty + c02 * tz) / determinant
        y = (c01 * tx + c11 * ty + c12 * tz) / determinant
        z = (c02 * tx + c12 * ty + c22 * tz) / determinant
        if x * x + y * y + z * z < 1.0:
            return x, y, z
    return tx / (trace + 1e-9), ty / (trace + 1e-9), tz / (trace + 1e-9)


@kernel()
def nearest_rotation(matrix: Floats, rotation: Floats) -> None:
    """Turn a rotation into the one nearest to a matrix. Both [3,3]; the rotation is updated in place.

    The trace of Rᵀ M grows by steps, see `_newton_step`.
    Directions in which the matrix is zero keep the rotation.
    """
    size = 0.0
    for i in range(3):
        for j in range(3):
            size = max(size, abs(matrix[i, j]))
    if not size > 1e-150:
        return
    for _ in range(_ROTATION_STEPS):
        m00 = m11 = m22 = 0.0
        xy = yx = xz = zx = yz = zy = 0.0
        for c in range(3):
            a = matrix[0, c] / size
            b = matrix[1, c] / size
            d = matrix[2, c] / size
            m00 += a * rotation[0, c]
            m11 += b * rotation[1, c]
            m22 += d * rotation[2, c]
            xy += a * rotation[1, c]
            yx += b * rotation[0, c]
            xz += a * rotation[2, c]
            zx += d * rotation[0, c]
            yz += b * rotation[2, c]
            zy += d * rotation[1, c]
        trace = abs(m00) + abs(m11) + abs(m22)
        x, y, z = _newton_step(
            trace, (zy - yz, xz - zx, yx - xy), (m00, m11, m22), (xy + yx, xz + zx, yz + zy)
        )
        _rotate(rotation, x, y, z)
        if x * x + y * y + z * z < _ROTATION_TOLERANCE:
            break


@kernel()
def _edge_product(graph: Graph, positions: Floats, i: int, product: Floats) -> None:
    """Set a product [3,3] to Σ (x_j − x_i) (p_j − p_i)ᵀ over the edges of node i. positions: [n,3]"""
    first, ends, arms, _ = graph
    product[:] = 0.0
    for e in range(first[i], first[i + 1]):
        j = ends[e]
        for r in range(3):
            length = positions[j, r] - positions[i, r]
            for c in range(3):
                product[r, c] += length * arms[e, c]


@kernel(cache=True, allocates=True)
def edge_products(graph: Graph, positions: Floats) -> Floats:
    """Return the products of all nodes, see `_edge_product`. [n,3] -> [n,3,3]"""
    count = len(positions)
    products = np.empty((count, 3, 3))
    for i in range(count):
        _edge_product(graph, positions, i, products[i])
    return products


@kernel(allocates=True)
def _fit_rotations(graph: Graph, rest: Floats, positions: Floats, rotations: Floats) -> float:
    """Update the rotations for the positions; return the energy of the edges and springs."""
    product = np.empty((3, 3))
    first, ends, arms, springs = graph
    energy = 0.0
    for i in range(len(rest)):
        _edge_product(graph, positions, i, product)
        nearest_rotation(product, rotations[i])
        for r in range(3):
            energy += 0.5 * springs[i] * (positions[i, r] - rest[i, r]) ** 2
            for c in range(3):
                energy -= 0.5 * rotations[i, r, c] * product[r, c]
            for e in range(first[i], first[i + 1]):
                step = positions[ends[e], r] - positions[i, r]
                energy += 0.25 * (step * step + arms[e, r] * arms[e, r])
    return energy


@kernel(cache=True)
def nearest_rotations_fast(matrices: Floats, rotations: Floats) -> None:
    """Turn rotations into those nearest to matrices, in place. Both [n,3,3]"""
    for i in range(len(matrices)):
        nearest_rotation(matrices[i], rotations[i])


@kernel()
def _right_side(graph: Graph, handles: Handles, rest: Floats, rotations: Floats, right: Floats) -> None:
    """Set the right side of the linear system from the rotations, springs and handles. right: [n,3]"""
    first, ends, arms, springs = graph
    handle_nodes, steering, targets, stiffness = handles
    for i in range(len(rest)):
        for r in range(3):
            total = springs[i] * rest[i, r]
            for e in range(first[i], first[i + 1]):
                j = ends[e]
                for c in range(3):
                    total -= 0.5 * (rotations[i, r, c] + rotations[j, r, c]) * arms[e, c]
            right[i, r] = total
    for h in range(len(targets)):
        for r in range(3):
            missing = targets[h, r]
            for k in range(steering[0][h], steering[0][h + 1]):
                column = steering[1][k]
                missing -= steering[2][k] * rotations[column // 3, r, column % 3]
            for k in range(handle_nodes[0][h], handle_nodes[0][h + 1]):
                right[handle_nodes[1][k], r] += stiffness * handle_nodes[2][k] * missing


@kernel()
def _solve_factored(factor: Factor, vectors: Floats) -> None:
    """Solve the factorized system for four right sides, in the order of its factors, in place. [f,4]"""
    lower, upper, _, _ = factor
    first, rows, values = lower
    for j in range(len(vectors)):
        for k in range(first[j] + 1, first[j + 1]):
            i = rows[k]
            for c in range(4):
                vectors[i, c] -= values[k] * vectors[j, c]
    first, rows, values = upper
    for j in range(len(vectors) - 1, -1, -1):
        last = first[j + 1] - 1
        for c in range(4):
            vectors[j, c] /= values[last]
        for k in range(first[j], last):
            i = rows[k]
            for c in range(4):
                vectors[i, c] -= values[k] * vectors[j, c]


@kernel()
def _predict(gram: Floats, weights: Floats, count: int) -> None:
    """Set the weights [count] with the least squares Σ weights · columns = newest difference.

    The Gram matrix [count,count+1] holds the products of the columns, and with the newest difference last.
    """
    for k in range(count):
        gram[k, k] += _RIDGE * gram[k, k] + 1e-300
    for k in range(count):
        for i in range(k + 1, count):
            factor = gram[i, k] / gram[k, k]
            for j in range(k, count + 1):
                gram[i, j] -= factor * gram[k, j]
    for k in range(count - 1, -1, -1):
        total = gram[k, count]
        for j in range(k + 1, count):
            total -= gram[k, j] * weights[j]
        weights[k] = total / gram[k, k]


@kernel(inline=True)
def _dot(a: Floats, b: Floats) -> float:
    """Return the product of two vectors of equal length."""
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@kernel(allocates=True)
def _extrapolate(memory: Memory, slot: int, used: int, last: Floats, now: Floats) -> None:
    """Add the newest round to the history, and move its result to where the rounds settle.

    Args:
        memory: steps of the rounds' results and of their differences, products of the latter, see `settle`
        slot: place of the newest steps in the history
        used: number of steps in the history with it
        last: result of the last round and its difference. [2,3f]
        now: the same of the newest round, of which the result is updated in place. [2,3f]
    """
    steps, difference_steps, products = memory
    gram = np.empty((HISTORY, HISTORY + 1))
    weights = np.empty(HISTORY)
    for k in range(now.shape[1]):
        steps[slot, k] = now[0, k] - last[0, k]
        difference_steps[slot, k] = now[1, k] - last[1, k]
    for j in range(used):
        products[slot, j] = _dot(difference_steps[slot], difference_steps[j])
        products[j, slot] = products[slot, j]
    for j in range(used):
        gram[j, used] = _dot(difference_steps[j], now[1])
        for k in range(used):
            gram[j, k] = products[j, k]
    _predict(gram, weights, used)
    last[:] = now
    for j in range(used):
        for k in range(now.shape[1]):
            now[0, k] -= weights[j] * steps[j, k]


@kernel()
def _move_free(positions: Floats, free: Rows, values: Floats) -> None:
    """Set the positions [n,3] of the free nodes [f] to values [3f]."""
    for f in range(len(free)):
        for c in range(3):
            positions[free[f], c] = values[3 * f + c]


@kernel()
def _solve_positions(
    factor: Factor, free: Rows, right: Floats, packed: Floats, positions: Floats, now: Floats
) -> float:
    """Solve for the positions of the free nodes; return the largest movement of a coordinate.

    Args:
        factor: factors of the system
        free: the free nodes. [f]
        right: right side. [f,3]
        packed: memory. [f,4]
        positions: current positions. [n,3]
        now: new positions of the free nodes, and the difference from the current ones; written. [2,3f]
    """
    largest = 0.0
    for f in range(len(free)):
        for c in range(3):
            packed[factor[2][f], c] = right[f, c]
    _solve_factored(factor, packed)
    for f in range(len(free)):
        for c in range(3):
            value = packed[factor[3][f], c]
            step = value - positions[free[f], c]
            now[0, 3 * f + c] = value
            now[1, 3 * f + c] = step
            largest = max(largest, abs(step))
    return largest


@kernel(cache=True, allocates=True)
def settle(
    graph: Graph,
    factor: Factor,
    nodes: tuple[Rows, Sparse],
    handles: Handles,
    rest: Floats,
    pose: tuple[Floats, Floats],
    limits: tuple[int, float],
) -> tuple[int, float]:
    """Repeat rounds until the nodes settle; return their number and the movement in the last one.

    Args:
        graph: edges and springs of the n nodes
        factor: factors of the system of the f free nodes
        nodes: the free nodes [f], and the columns of the system that belong to held nodes. [f,n]
        handles: handles and their targets
        rest: positions at rest. [n,3]
        pose: positions [n,3] and rotations [n,3,3] to start from; updated in place
        limits: largest number of rounds, and movement of a coordinate in a round that counts as settled
    """
    positions, rotations = pose
    free, to_held = nodes
    max_rounds, tolerance = limits
    count = len(free)
    right = np.empty((len(rest), 3))
    free_right = np.empty((count, 3))
    packed = np.zeros((count, 4))
    now = np.empty((2, 3 * count))
    last = np.empty((2, 3 * count))
    memory = (
        np.empty((HISTORY, 3 * count)),
        np.empty((HISTORY, 3 * count)),
        np.zeros((HISTORY, HISTORY)),
    )
    last_rotations = rotations.copy()
    last_energy = 0.0
    last_length = 0.0
    largest = 0.0
    history = -1  # steps in the history; −1 before the first round
    for i in range(max_rounds):
        energy = _fit_rotations(graph, rest, positions, rotations)
        if history > 0 and energy > last_energy:  # predicted badly; continue from the last round's result
            _move_free(positions, free, last[0])
            rotations[:] = last_rotations
            history = -1
            energy = _fit_rotations(graph, rest, positions, rotations)
        last_energy = energy
        last_rotations[:] = rotations
        _right_side(graph, handles, rest, rotations, right)
        for f in range(count):
            for c in range(3):
                free_right[f, c] = right[free[f], c]
                for k in range(to_held[0][f], to_held[0][f + 1]):
                    free_right[f, c] -= to_held[2][k] * rest[to_held[1][k], c]
        largest = _solve_positions(factor, free, free_right, packed, positions, now)
        if largest <= tolerance:
            _move_free(positions, free, now[0])
            return i + 1, largest
        length = _dot(now[1], now[1])
        if history >= 0 and length > _GROWTH_LIMIT * _GROWTH_LIMIT * last_length:
            history = -1
        last_length = length
        history += 1
        if history > 0 and i < max_rounds - 1:
            _extrapolate(memory, (history - 1) % HISTORY, min(history, HISTORY), last, now)
        else:
            last[:] = now
        _move_free(positions, free, now[0])
    return max_rounds, largest
