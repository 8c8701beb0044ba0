"""Kernels of the deformation graph: links between Gaussians, occupied cells, groups, and bindings to nodes.

Reference implementations: tests/helpers/plain_graph.py.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.cpu.jit import Number, kernel

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]
Shapes = tuple[Floats, Floats, Floats, Floats]
"""Means [M,3], unit quaternions wxyz [M,4], scales [M,3] and OKLab colors [M,3]."""

_TINY = 1e-30
_SIGMA_DISTANCE = math.sqrt(3.0)  # standard deviations; six points at this distance average cubics exactly


@kernel(inline=True)
def _axis(quats: Floats, row: int, axis: int) -> tuple[float, float, float]:
    """Return a column of the rotation matrix of a quaternion."""
    w = quats[row, 0]
    x = quats[row, 1]
    y = quats[row, 2]
    z = quats[row, 3]
    if axis == 0:
        return 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)
    if axis == 1:
        return 2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)
    return 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)


@kernel()
def _reach(quats: Floats, scales: Floats, row: int, x: float, y: float, z: float) -> float:
    """Return the standard deviation of a Gaussian in a direction."""
    square = 0.0
    for axis in range(3):
        a, b, c = _axis(quats, row, axis)
        along = (a * x + b * y + c * z) * scales[row, axis]
        square += along * along
    return math.sqrt(square)


@kernel()
def _normal(quats: Floats, scales: Floats, row: int) -> tuple[float, float, float]:
    """Return the axis along which a Gaussian is thinnest."""
    thin = 0
    for axis in range(1, 3):
        if scales[row, axis] < scales[row, thin]:
            thin = axis
    return _axis(quats, row, thin)


@kernel(cache=True)
def measure_pairs(
    shapes: Shapes,
    near: Rows,
    distances: Floats,
    limits: tuple[float, int, int],
    gaps: Floats,
    color_distances: Floats,
    bent: Mask,
) -> None:
    """Write the measures of Gaussians and their neighbors, for a range of rows.

    Args:
        shapes: the Gaussians. [M]
        near: neighbors of each. [M,K]
        distances: their distances. [M,K]
        limits: cosine of the angle between normals below which a pair is bent; first row, and end
        gaps: distance per sum of both standard deviations in its direction; written. [M,K]
        color_distances: distance of the colors; written. [M,K]
        bent: True if the normals differ; written. [M,K]
    """
    means, quats, scales, colors = shapes
    min_cosine, first, end = limits
    for i in range(first, end):
        a, b, c = _normal(quats, scales, i)
        for k in range(near.shape[1]):
            j = near[i, k]
            length = max(distances[i, k], _TINY)
            x = (means[j, 0] - means[i, 0]) / length
            y = (means[j, 1] - means[i, 1]) / length
            z = (means[j, 2] - means[i, 2]) / length
            reach = _reach(quats, scales, i, x, y, z) + _reach(quats, scales, j, x, y, z)
            gaps[i, k] = distances[i, k] / max(reach, _TINY)
            d, e, f = _normal(quats, scales, j)
            bent[i, k] = abs(a * d + b * e + c * f) < min_cosine
            square = 0.0
            for channel in range(3):
                square += (colors[i, channel] - colors[j, channel]) ** 2
            color_distances[i, k] = math.sqrt(square)


@kernel(inline=True)
def _slot(table: Rows, key: Number) -> Number:
    """Return the place of a key in a hash table, or a free place for it. Free places hold −1."""
    mask = np.uint64(len(table) - 1)
    place = (np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(20)
    place &= mask
    while table[place] >= 0 and table[place] != key:
        place = (place + np.uint64(1)) & mask
    return place


@kernel(cache=True, allocates=True)
def exceeds_cells(points: Floats, low: Floats, size: float, limit: int) -> bool:
    """Return whether points are in more than `limit` grid cells.

    Args:
        points: positions. [M,3]
        low: lower corner of the grid. [3]
        size: size of a cell; at most 2²¹ cells lie along an axis
        limit: number of cells
    """
    width = 4
    while width < 4 * limit:
        width *= 2
    table = np.full(width, -1, np.int64)
    count = 0
    for i in range(len(points)):
        key = np.int64(0)
        for axis in range(3):
            key = (key << 21) + np.int64((points[i, axis] - low[axis]) / size)
        place = _slot(table, key)
        if table[place] < 0:
            table[place] = key
            count += 1
            if count > limit:
                return True
    return False


@kernel(inline=True)
def _root(parents: Rows, row: int) -> int:
    """Return the root of a row's group, and shorten the way to it."""
    while parents[row] != row:
        parents[row] = parents[parents[row]]
        row = parents[row]
    return row


@kernel(cache=True, allocates=True)
def join_links(start: Rows, end: Rows, cell: Rows) -> Rows:
    """Return the group of each row: rows of one cell that are joined by pairs. [P], [P], [M] -> [M]

    Groups are numbered by their first rows.
    """
    count = len(cell)
    parents = np.arange(count)
    for k in range(len(start)):
        if cell[start[k]] != cell[end[k]]:
            continue
        a = _root(parents, start[k])
        b = _root(parents, end[k])
        if a < b:
            parents[b] = a
        else:
            parents[a] = b
    groups = np.empty(count, np.int64)
    found = 0
    for row in range(count):
        root = _root(parents, row)
        if root == row:
            groups[row] = found
            found += 1
        else:
            groups[row] = groups[root]
    return groups


@kernel()
def _choose_nodes(
    positions: Floats, spacing: float, place: Floats, candidates: Rows, near: Floats, slots: Rows
) -> int:
    """Write the weights that the nearest candidates have at a place, and their indices; return their number.

    Args:
        positions: the nodes. [n,3]
        spacing: typical length of their edges
        place: [3]
        candidates: nodes, filled up with −1. [K]
        near: weights, which sum to 1, nearest first; written. [B]
        slots: index of each among the candidates; written. [B]
    """
    kept = len(near)
    count = 0
    for k in range(len(candidates)):
        node = candidates[k]
        if node < 0:
            continue
        square = 0.0
        for axis in range(3):
            square += (positions[node, axis] - place[axis]) ** 2
        distance = math.sqrt(square)
        if count == kept and distance >= near[kept - 1]:
            continue
        at = min(count, kept - 1)
        while at > 0 and near[at - 1] > distance:
            near[at] = near[at - 1]
            slots[at] = slots[at - 1]
            at -= 1
        near[at] = distance
        slots[at] = k
        count = min(count + 1, kept)
    # the weights fall to 0 at the farthest candidate if there are more than enough
    reach = 1.001 * near[count - 1] + 1e-9 * spacing
    total = 0.0
    for k in range(count):
        near[k] = max(1.0 - near[k] / reach, 0.0) ** 2
        total += near[k]
    for k in range(count):
        near[k] = near[k] / total if total > 0.0 else 1.0 / count
    return count


@kernel(cache=True, allocates=True)
def bind_points(
    positions: Floats, spacing: float, points: Floats, candidates: Rows, nodes: Rows, part: tuple[int, int],
    found: Number, weights: Floats,
) -> None:  # fmt: skip
    """Write the nodes that points follow and their weights, for a range of points.

    Args:
        positions: the nodes. [n,3]
        spacing: typical length of their edges
        points: the points. [P,3]
        candidates: each node and those connected with it, filled up with −1. [n,K]
        nodes: the node that each point belongs to. [P]
        part: first point, and end
        found: nodes, nearest first, filled up with the first; written. [P,B] int32
        weights: their weights, which sum to 1; 0 for those filled up; written. [P,B]
    """
    kept = found.shape[1]
    near = np.empty(kept)
    slots = np.empty(kept, np.int64)
    for p in range(part[0], part[1]):
        own = candidates[nodes[p]]
        count = _choose_nodes(positions, spacing, points[p], own, near, slots)
        for k in range(kept):
            found[p, k] = own[slots[k]] if k < count else own[slots[0]]
            weights[p, k] = near[k] if k < count else 0.0


@kernel(cache=True, allocates=True)
def average_weights(
    graph: tuple[Floats, float, Rows],
    gaussians: tuple[Floats, Floats, Rows],
    kept: int,
    part: tuple[int, int],
    weights: Floats,
    slopes: Floats,
) -> None:
    """Write the weights of nodes along the principal axes of Gaussians, for a range of these.

    Along each axis, two points are compared. Their six weights have the moments of the Gaussian.

    Args:
        graph: the nodes [n,3]; the typical length of their edges; and each node and those connected with it,
            filled up with −1. [n,K]
        gaussians: their centers [M,3]; principal axes times standard deviations, as columns [M,3,3]; and the
            node that each belongs to. [M]
        kept: number of nodes that each point follows
        part: first Gaussian, and end
        weights: mean weights of the candidates, which sum to 1; written. [M,K]
        slopes: their change per standard deviation along each axis, and their mean on the axis less the mean
            on all axes; written. [M,K,6]
    """
    positions, spacing, candidates = graph
    points, halves, nodes = gaussians
    near = np.empty(kept)
    slots = np.empty(kept, np.int64)
    place = np.empty(3)
    for m in range(part[0], part[1]):
        own = candidates[nodes[m]]
        weights[m] = 0.0
        slopes[m] = 0.0
        for axis in range(3):
            for sign in (1.0, -1.0):
                for c in range(3):
                    place[c] = points[m, c] + sign * _SIGMA_DISTANCE * halves[m, c, axis]
                count = _choose_nodes(positions, spacing, place, own, near, slots)
                for k in range(count):
                    weights[m, slots[k]] += near[k] / 6.0
                    slopes[m, slots[k], axis] += sign * near[k] / (2.0 * _SIGMA_DISTANCE)
                    slopes[m, slots[k], 3 + axis] += 0.5 * near[k]
        for k in range(len(own)):
            for axis in range(3):
                slopes[m, k, 3 + axis] -= weights[m, k]
