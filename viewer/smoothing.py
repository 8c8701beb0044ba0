"""The mean of what lies around each point: what smoothing and feathering move weights towards."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

_LEAST = float(np.finfo(np.float64).tiny)  # a corner without a share has no mean, and gives none
_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])


def near_mean(points: Floats, values: Floats, width: float) -> Floats:
    """Mean of the values around each point: continuous, and its cost grows with the points alone.

    Each point gives its value to the eight corners of its cell and takes their means, by its place among
    them: a kernel of about 0.6 `width` standard deviation.

    Args:
        points: finite, in any unit. [M,3]
        values: at the points. [M]
        width: side of a cell, in the unit of the points, > 0

    Returns:
        Within the range of the values. [M]
    """
    if not len(points):
        return values.copy()
    places = points / np.float32(width)
    low = np.floor(places)
    ends = np.stack([1.0 - (places - low), places - low], 2)  # to the lower corner and to the upper one
    shares = (ends[:, 0, :, None, None] * ends[:, 1, None, :, None] * ends[:, 2, None, None, :]).reshape(
        -1, 8
    )
    low -= low.min(0)
    _, y_side, z_side = (low.max(0) + 2).tolist()
    steps = np.array([y_side * z_side, z_side, 1.0])
    cells = (low @ steps)[:, None] + _CORNERS @ steps  # whole numbers, exact in float64 up to 2⁵³
    corners = np.unique(cells, return_inverse=True)[1].reshape(cells.shape)
    given = np.bincount(corners.ravel(), shares.ravel())[corners]
    total = np.bincount(corners.ravel(), (shares * values[:, None]).ravel())[corners]
    found: Floats = (shares * (total / np.maximum(given, _LEAST))).sum(1).astype(np.float32)
    return np.clip(found, values.min(), values.max())
