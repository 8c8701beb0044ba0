"""Kernels of the palette of SH rows: a tree of splits, and a reassignment between neighboring leaves."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.cpu.jit import kernel

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Rows = NDArray[np.int64]


@kernel()
def measure(rows: Floats, order: Rows, start: int, end: int, total: Doubles, squares: Doubles) -> float:
    """Compute the sum of each column over a group and its squared deviations; return the sum of the latter.

    Args:
        rows: all rows. [N,C]
        order: rows by group. [N]
        start, end: range of the group in `order`
        total, squares: results. [C] each
    """
    count = end - start
    total[:] = 0.0
    squares[:] = 0.0
    for i in range(start, end):
        row = order[i]
        for c in range(rows.shape[1]):
            total[c] += rows[row, c]
    for i in range(start, end):
        row = order[i]
        for c in range(rows.shape[1]):
            off = rows[row, c] - total[c] / count
            squares[c] += off * off
    error = 0.0
    for c in range(rows.shape[1]):
        error += squares[c]
    return error


@kernel()
def partition(rows: Floats, order: Rows, start: int, end: int, column: int, edge: float) -> int:
    """Move the rows of a group that are at most `edge` in a column before the others; return their end."""
    low = start
    high = end - 1
    while low <= high:
        if rows[order[low], column] <= edge:
            low += 1
        else:
            kept = order[low]
            order[low] = order[high]
            order[high] = kept
            high -= 1
    return low


@kernel(cache=True, allocates=True)
def split_groups(rows: Floats, max_groups: int) -> tuple[Rows, Rows]:
    """Split rows into groups; the next split is that of the group with the largest squared deviation.

    A group is split at the mean of its column with the largest deviation. Groups of equal rows are not split.

    Args:
        rows: [N,C], N ≥ 1
        max_groups: largest number of groups, ≥ 1

    Returns:
        Rows by group [N], and the start of each group, ascending, then N [G+1].
    """
    count, columns = rows.shape
    order = np.arange(count)
    ends = np.zeros(count, np.int64)  # end of the group that starts at each position
    edges = np.zeros(count, np.float64)  # mean of the column at which the group is split
    split_columns = np.zeros(count, np.int64)
    total = np.zeros(columns, np.float64)
    squares = np.zeros(columns, np.float64)
    error = measure(rows, order, 0, count, total, squares)
    ends[0] = count
    split_columns[0] = squares.argmax()
    edges[0] = total[split_columns[0]] / count
    heap = [(-error, 0)]
    groups = 1
    while groups < max_groups and len(heap):
        error, start = heapq.heappop(heap)
        if error >= 0.0:
            break
        end = ends[start]
        middle = partition(rows, order, start, end, split_columns[start], edges[start])
        if middle in (start, end):
            continue  # equal up to rounding
        groups += 1
        for low, high in ((start, middle), (middle, end)):
            ends[low] = high
            error = measure(rows, order, low, high, total, squares)
            split_columns[low] = squares.argmax()
            edges[low] = total[split_columns[low]] / (high - low)
            heapq.heappush(heap, (-error, low))
    starts = np.zeros(groups + 1, np.int64)
    at = 0
    for group in range(groups):
        starts[group] = at
        at = ends[at]
    starts[groups] = at
    return order, starts


@kernel(cache=True, allocates=True)
def reassign(rows: Floats, centers: Floats, labels: Rows, reach: int) -> None:
    """Move each row to the nearest of the centers around its own, in the order of the tree.

    Args:
        rows: [N,C]
        centers: [G,C]
        labels: center of each row, updated in place. [N]
        reach: centers before and after a row's own that are compared
    """
    for i in range(len(rows)):
        own = labels[i]
        best = np.float32(np.inf)
        for center in range(max(own - reach, 0), min(own + reach + 1, len(centers))):
            distance = np.float32(0.0)
            for c in range(rows.shape[1]):
                off = rows[i, c] - centers[center, c]
                distance += off * off
            if distance < best:
                best = distance
                labels[i] = center
