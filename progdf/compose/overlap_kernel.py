"""Kernels of the order of painted layers: their coverage, and the steps of `arrange` in `overlap`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.cpu.jit import kernel

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Rows = NDArray[np.int64]

MIN_WEIGHT = 0.05
"""Opacity of a disc at a point; below it, the disc is beside the point."""
_MIN_OPACITY = 1e-30  # as in `overlap`
_MAX_WEIGHT = 0.999  # keeps the transmittance above 0

Cells = tuple[Rows, tuple[int, int, int], Doubles, float]
"""First disc of each cell of a grid, numbers of cells, lower corner, and side of a cell."""


@kernel(cache=True)
def copy_rows(values: Floats, rows: Rows, own: Floats, index: Rows) -> None:
    """Copy rows of paint from the scene.

    Args:
        values: an attribute of the scene. [N,c]
        rows: rows of the scene. [A]
        own: its values of the rows of paint; updated in place. [A,c]
        index: indices of those to copy. [K]
    """
    for i in index:
        for c in range(own.shape[1]):
            own[i, c] = values[rows[i], c]


@kernel(cache=True)
def copy_colors(values: Floats, rows: Rows, own: Floats, color: Doubles, index: Rows) -> None:
    """Copy colors of paint from the scene; the arguments are as in `copy_rows`.

    `color`: colors in the order of layers; updated in place to the same colors. [A,3]
    """
    for i in index:
        for c in range(3):
            own[i, c] = values[rows[i], c]
            color[i, c] = own[i, c]


@kernel(cache=True)
def restore_centers(means: Floats, rows: Rows, own: Floats, risen: Doubles, index: Rows) -> None:
    """Write the centers of risen rows of paint as they are without the order of layers.

    The arguments are as in `copy_rows`. `risen`: distance by which each row has risen. [A]
    """
    for i in index:
        if risen[i] > 0.0:
            for c in range(3):
                means[rows[i], c] = own[i, c]


@kernel(cache=True)
def add_tints(
    tints: Doubles, index: Rows, anchors: Rows, weights: Doubles, before: Floats, after: Floats
) -> None:
    """Write the color change of the surface beside rows of paint at a rim.

    Args:
        tints: change of each row of paint, updated in place. [A,3]
        index: indices of the rows to write. [F]
        anchors, weights: states of their anchors, and the weights of these. [F,4] each
        before, after: colors of the states in the original, and composed. [E,3] each
    """
    for f in range(len(index)):
        for c in range(3):
            change = 0.0
            for k in range(4):
                state = anchors[f, k]
                # in float32, like the difference of two composed scenes
                change += weights[f, k] * float(np.float32(after[state, c] - before[state, c]))
            tints[index[f], c] = change


@kernel(cache=True)
def raise_rows(risen: Doubles, over: Rows, under: Rows, rise: Doubles) -> None:
    """Raise the rows of an upper layer above those of a lower one.

    Args:
        risen: distance by which each row of paint rises; updated in place. [A]
        over, under, rise: see `Overlap`. [P] each
    """
    for p in range(len(over)):
        risen[over[p]] = max(risen[over[p]], rise[p] + risen[under[p]])


@kernel(cache=True)
def fade_rows(kept: Doubles, hidden: Rows, above: Rows, share: Doubles, opacity: Doubles) -> None:
    """Fade the rows of a lower layer that an upper one covers.

    Args:
        kept: factor of the opacity of each row of paint; updated in place. [A]
        hidden, above, share: see `Overlap`. [H] each
        opacity: see `opacities`. [A]
    """
    for h in range(len(hidden)):
        square = opacity[above[h]] * opacity[above[h]]
        fourth = square * square
        kept[hidden[h]] *= 1.0 - share[h] * (fourth * fourth)


@kernel(cache=True)
def rest_rims(color: Doubles, beside: Doubles, index: Rows, own: Floats, tints: Doubles) -> None:
    """Write the colors of rims without other paint.

    Args:
        color: color of each row of paint; updated in place. [A,3]
        beside: color of the surface beside it; updated in place. [A,3]
        index: indices of rims. [K]
        own: colors without the order of layers. [A,3]
        tints: see `add_tints`. [A,3]
    """
    for i in index:
        for c in range(3):
            color[i, c] = own[i, c]
            beside[i, c] = own[i, c] + tints[i, c]


@kernel(cache=True)
def cover_rims(
    beside: Doubles, over: Rows, under: Rows, cover: Doubles, opacity: Doubles, color: Doubles
) -> None:
    """Add the colors of lower paint to the surface beside rims.

    Args:
        beside: color of the surface beside each row of paint; updated in place. [A,3]
        over, under, cover: see `Overlap`. [P] each
        opacity: see `opacities`. [A]
        color: color of each row of paint. [A,3]
    """
    for p in range(len(over)):
        share = cover[p] * opacity[under[p]]
        for c in range(3):
            beside[over[p], c] += share * (color[under[p], c] - beside[over[p], c])


@kernel(cache=True)
def color_rims(color: Doubles, beside: Doubles, index: Rows, rim: Doubles, own: Floats) -> None:
    """Mix the colors of rims with those beside them; see `rest_rims` for the arguments. `rim`: [A]"""
    for i in index:
        for c in range(3):
            color[i, c] += rim[i] * (beside[i, c] - own[i, c])


@kernel(cache=True)
def write_colors(
    values: Floats, rows: Rows, index: Rows, own: Floats, color: Doubles, opacity: Doubles
) -> None:
    """Write colors in the order of layers.

    Args:
        values: colors of the scene; updated in place. [N,3]
        rows: rows of the scene. [A]
        index: indices of the rows to write. [K]
        own: colors without the order of layers. [A,3]
        color: colors in this order. [A,3]
        opacity: see `opacities`. [A]
    """
    for i in index:
        row = rows[i]
        for c in range(3):
            values[row, c] = own[i, c] if opacity[i] == 0.0 else np.float32(color[i, c])


@kernel(cache=True)
def write_centers(
    means: Floats,
    rows: Rows,
    index: Rows,
    own: Floats,
    heights: tuple[Doubles, Doubles],
    outward: Doubles,
    opacity: Doubles,
) -> float:
    """Write the centers of rows that rise or have risen; return the largest change of height.

    Args:
        means: centers of the scene; updated in place. [N,3]
        rows: rows of the scene. [A]
        index: indices of the rows that may change. [K]
        own: centers without the order of layers. [A,3]
        heights: distance by which each row rises; and that in the last picture, updated in place. [A] each
        outward: see `PaintRows`. [A,3]
        opacity: see `opacities`. [A]
    """
    risen, last = heights
    largest = 0.0
    for i in index:
        height = risen[i] if opacity[i] != 0.0 else 0.0
        if height == 0.0 and last[i] == 0.0:
            continue
        for c in range(3):
            means[rows[i], c] = own[i, c] + np.float32(height * outward[i, c])
        largest = max(largest, abs(height - last[i]))
        last[i] = height
    return largest


@kernel(cache=True)
def write_logits(
    logits: Floats,
    rows: Rows,
    index: Rows,
    own: Floats,
    factors: tuple[Doubles, Doubles],
    opacity: Doubles,
) -> None:
    """Write the opacity logits of rows that fade or have faded.

    Args:
        logits: opacity logits of the scene; updated in place. [N,1]
        rows: rows of the scene. [A]
        index: indices of the rows that may change. [K]
        own: logits without the order of layers. [A,1]
        factors: factor of the opacity of each row; and the last such factor, updated in place. [A] each
        opacity: see `opacities`. [A]
    """
    kept, last = factors
    for i in index:
        factor = kept[i] if opacity[i] != 0.0 else 1.0
        if factor == 1.0 and last[i] == 1.0:
            continue
        last[i] = factor
        logit = own[i, 0]
        if factor < 1.0:
            visible = max(factor / (1.0 + math.exp(-float(logit))), _MIN_OPACITY)
            logit = np.float32(math.log(visible / (1.0 - visible)))
        logits[rows[i], 0] = logit


@kernel(inline=True)
def _cell_range(value: float, low: float, cell: float, count: int) -> tuple[int, int]:
    """Return the first cell along an axis that can hold neighbors of a value, and the end of the range."""
    at = (value - low) / cell
    if not (-1.0 <= at <= count + 1.0):
        return 0, 0
    index = math.floor(at)
    return max(index - 1, 0), min(index + 2, count)


@kernel(cache=True)
def cover_points(
    sheet: tuple[Doubles, Rows],
    cells: Cells,
    points: Doubles,
    outward: Doubles,
    distance: float,
    enough: float,
    found: tuple[Doubles, Doubles, Doubles, Rows],
) -> None:
    """Add the coverage of points by discs, see `measure_cover`.

    Args:
        sheet: discs, sorted by their cells: center, normal, both wide axes over their standard deviations,
            outward direction, opacity [b,16]; and their indices [b]
        cells: the grid
        points, outward: points and directions away from their surface. [P,3] each
        distance: largest distance of a point from a disc's plane
        enough: coverage above which further discs are left out
        found: transmittance, greatest height, greatest weight and its disc; updated in place. [P] each
    """
    discs, ids = sheet
    starts, shape, low, cell = cells
    passing, height, most, under = found
    limit = -2.0 * math.log(MIN_WEIGHT)
    for p in range(len(points)):
        x = points[p, 0]
        y = points[p, 1]
        z = points[p, 2]
        first_x, end_x = _cell_range(x, low[0], cell, shape[0])
        first_y, end_y = _cell_range(y, low[1], cell, shape[1])
        first_z, end_z = _cell_range(z, low[2], cell, shape[2])
        if end_z <= first_z:
            continue
        for cx in range(first_x, end_x):
            for cy in range(first_y, end_y):
                if 1.0 - passing[p] >= enough:
                    break
                column = (cx * shape[1] + cy) * shape[2]
                for j in range(starts[column + first_z], starts[column + end_z]):
                    disc = discs[j]
                    ax = disc[0] - x
                    ay = disc[1] - y
                    az = disc[2] - z
                    if abs(disc[3] * ax + disc[4] * ay + disc[5] * az) > distance:
                        continue
                    u = disc[6] * ax + disc[7] * ay + disc[8] * az
                    v = disc[9] * ax + disc[10] * ay + disc[11] * az
                    squared = u * u + v * v
                    if squared >= limit:
                        continue
                    facing = disc[12] * outward[p, 0] + disc[13] * outward[p, 1] + disc[14] * outward[p, 2]
                    weight = disc[15] * math.exp(-0.5 * squared)
                    if facing <= 0.0 or weight <= MIN_WEIGHT:
                        continue
                    passing[p] *= 1.0 - min(weight, _MAX_WEIGHT)
                    above = ax * outward[p, 0] + ay * outward[p, 1] + az * outward[p, 2]
                    height[p] = max(height[p], above)
                    if weight > most[p] or (weight == most[p] and ids[j] > under[p]):
                        most[p] = weight
                        under[p] = ids[j]
