"""Kernels of the composer: sums of offsets, and writing of rows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.cpu.jit import kernel

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]

_BLOCK_MEMBERS = 512  # members whose offsets are summed at once


@kernel(cache=True)
def keep_larger(largest: Floats, push: Floats) -> None:
    """Replace rows by those of `push` that are at least as long. [U,c] each"""
    for i in range(len(largest)):
        old = np.float32(0.0)
        new = np.float32(0.0)
        for c in range(largest.shape[1]):
            old += largest[i, c] * largest[i, c]
            new += push[i, c] * push[i, c]
        if new >= old:
            for c in range(largest.shape[1]):
                largest[i, c] = push[i, c]


@kernel(cache=True, allocates=True)
def add_offsets(
    total: Floats,
    part: tuple[Rows, Rows, Floats],
    stored: tuple[NDArray[Any], NDArray[Any]],
    used: Rows,
    factors: Floats,
    gain: np.float32,
    hidden: np.float32,
    covered: Floats,
) -> None:
    """Compute total ← total · (1 − m hidden c) + m gain Δ for one layer and attribute, see `compose_layers`.

    Args:
        total: sums so far, updated in place. [U,c]
        part: positions of the layer's members in `total` [m], their member indices [m], and the weights of
            all members [M], or [0] if all are 1
        stored: end and residual bases. [M,c], [R,M,c]
        used, factors: see `StoredBases.factors`. [U], [1+U,c] or none
        hidden, covered: share of lower layers that is hidden at coverage 1, and the coverage c [M], or [0] if
            it is 0 everywhere
    """
    (at, members, weights), (end, residual_levels) = part, stored
    one = np.float32(1.0)
    width = total.shape[1]
    offsets = np.zeros(
        _BLOCK_MEMBERS * width, np.float32
    )  # of a block of members, which stay in the L1 cache
    tiles = np.empty((len(factors), _BLOCK_MEMBERS * width), np.float32)
    for k in range(len(factors)):
        for i in range(min(_BLOCK_MEMBERS, len(at))):
            for c in range(width):
                tiles[k, i * width + c] = factors[k, c]
    ends = end.reshape(-1)
    sums = total.reshape(-1)
    for first in range(0, len(at), _BLOCK_MEMBERS):
        count = min(_BLOCK_MEMBERS, len(at) - first)
        low = members[first]
        row = at[first]
        if members[first + count - 1] - low == count - 1:  # consecutive members: contiguous in memory
            for k in range(len(factors)):
                tile = tiles[k]
                if k == 0:
                    run = ends[low * width : (low + count) * width]
                    for j in range(count * width):
                        offsets[j] = tile[j] * np.float32(run[j])
                else:
                    levels = residual_levels[used[k - 1]].reshape(-1)[low * width : (low + count) * width]
                    for j in range(count * width):
                        offsets[j] += tile[j] * np.float32(levels[j])
        else:
            for k in range(len(factors)):
                for i in range(count):
                    for c in range(width):
                        j = i * width + c
                        if k == 0:
                            offsets[j] = factors[0, c] * np.float32(end[members[first + i], c])
                        else:
                            level = residual_levels[used[k - 1], members[first + i], c]
                            offsets[j] += factors[k, c] * np.float32(level)
        if len(weights) == 0 and len(covered) == 0 and at[first + count - 1] - row == count - 1:
            run = sums[row * width : (row + count) * width]
            for j in range(count * width):
                run[j] += gain * offsets[j]
            continue
        for i in range(count):
            row = at[first + i]
            member = members[first + i]
            weight = one
            if len(weights):
                weight = weights[member]
                if weight == 0.0:
                    continue
            for c in range(width):
                if len(covered):
                    total[row, c] *= one - (weight * hidden) * covered[member]
                total[row, c] += (weight * gain) * offsets[i * width + c]


@kernel(cache=True, allocates=True)
def write_rows(
    after: Floats, before: Floats, rows: Rows, total: Floats, weight_sum: Floats, measure: bool
) -> float:
    """Compute after ← before + total / weight_sum in some rows; return the largest squared movement.

    Args:
        after, before: attribute values, `after` is updated in place. [N,c]
        rows: rows to write. [U]
        total: sums, overwritten. [U,c]
        weight_sum: at least 1; [0] if all are 1. [U]
        measure: compute the movement of a center; otherwise the result is 0
    """
    largest = np.float32(0.0)
    width = total.shape[1]
    for first in range(0, len(rows), _BLOCK_MEMBERS):
        count = min(_BLOCK_MEMBERS, len(rows) - first)
        if len(weight_sum):
            for i in range(first, first + count):
                for c in range(width):
                    total[i, c] /= weight_sum[i]
        if measure:
            for i in range(first, first + count):
                row = rows[i]
                step = np.float32(0.0)
                for c in range(3):
                    moved = before[row, c] + total[i, c] - after[row, c]
                    step += moved * moved
                largest = max(largest, step)
        row = rows[first]
        if rows[first + count - 1] - row == count - 1:
            new_run = after[row : row + count].reshape(-1)
            old_run = before[row : row + count].reshape(-1)
            own_run = total[first : first + count].reshape(-1)
            for j in range(count * width):
                new_run[j] = old_run[j] + own_run[j]
            continue
        for i in range(first, first + count):
            for c in range(width):
                after[rows[i], c] = before[rows[i], c] + total[i, c]
    return float(largest)


@kernel(cache=True)
def mark_differing(marks: NDArray[np.bool_], now: Floats, original: Floats, rows: Rows) -> None:
    """Mark the rows that differ from the original. [m], [N,c], [N,c], [m]"""
    for i in range(len(rows)):
        row = rows[i]
        for c in range(now.shape[1]):
            if now[row, c] != original[row, c]:
                marks[i] = True
                break
