"""Membrane: values continued smoothly from known pixels into unknown ones."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu
from torch import Tensor


def membrane(values: Tensor, unknown: Tensor) -> Tensor:
    """Continue values into unknown pixels smoothly: each becomes the mean of its four neighbors.

    Args:
        values: [H,W,C]
        unknown: [H,W] bool; values are constant across the picture's edge

    Returns:
        [H,W,C]; known values are unchanged
    """
    mask = unknown.numpy()
    known = values.double().numpy()
    index = np.full(mask.shape, -1)
    index[mask] = np.arange(mask.sum())
    count = int(mask.sum())
    # pixels without a connection to known ones become 0, as no view shows their surface
    diagonal = np.full(count, 1e-9)
    right = np.zeros((count, known.shape[2]))
    rows = []
    columns = []
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        neighbor = np.roll(index, step, axis)
        inside = np.ones(mask.shape, bool)
        inside[(0 if step > 0 else -1,) if axis == 0 else (slice(None), 0 if step > 0 else -1)] = False
        pixels = mask & inside
        diagonal[index[pixels]] += 1
        right[index[pixels & (neighbor < 0)]] += np.roll(known, step, axis)[pixels & (neighbor < 0)]
        rows.append(index[pixels & (neighbor >= 0)])
        columns.append(neighbor[pixels & (neighbor >= 0)])
    i = np.concatenate([*rows, np.arange(count)])
    j = np.concatenate([*columns, np.arange(count)])
    entries = np.concatenate([-np.ones(len(i) - count), diagonal])
    result = known.copy()
    result[mask] = splu(coo_matrix((entries, (i, j)), (count, count)).tocsc()).solve(right)
    return torch.from_numpy(result).to(values.dtype)
