"""Plain twins of the kernels that make a palette of SH rows, see `progdf.formats.packed.palette_kernel`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]


def plain_split_groups(rows: Floats, max_groups: int) -> list[list[int]]:
    """Split the group with the largest squared deviation at the mean of its widest column, repeatedly."""
    groups = [np.arange(len(rows))]
    unsplit: list[list[int]] = []
    while groups and len(groups) + len(unsplit) < max_groups:
        deviations = [_deviations(rows[group]) for group in groups]
        largest = int(np.argmax([each.sum() for each in deviations]))
        group = groups.pop(largest)
        values = rows[group, deviations[largest].argmax()].astype(np.float64)
        is_low = values <= values.mean()
        if is_low.all():
            unsplit.append(group.tolist())
        else:
            groups += [group[is_low], group[~is_low]]
    return [*(group.tolist() for group in groups), *unsplit]


def _deviations(rows: Floats) -> NDArray[np.float64]:
    """Return the squared deviations of each column from its mean. [M,C] -> [C]"""
    values = rows.astype(np.float64)
    squares: NDArray[np.float64] = ((values - values.mean(axis=0)) ** 2).sum(axis=0)
    return squares


def plain_reassign(rows: Floats, centers: Floats, labels: Rows, reach: int) -> Rows:
    """Return the nearest of the centers around each row's own. [N,C], [G,C], [N] -> [N]"""
    result = labels.copy()
    for i, own in enumerate(labels):
        first = max(own - reach, 0)
        near = centers[first : own + reach + 1]
        result[i] = first + ((near - rows[i]) ** 2).sum(axis=1).argmin()
    return result
