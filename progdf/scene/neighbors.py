"""Nearest neighbors of points: the one k-nearest-neighbors, through scipy's k-d tree."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor


def nearest_rows(points: Tensor, rows: Tensor, k: int, workers: int = 1) -> tuple[Tensor, Tensor]:
    """The k nearest other points of some of the points, exactly.

    Args:
        points: all points, finite. [N,3]
        rows: those whose neighbors are wanted. [Q] int64
        k: how many, 1..N−1; fewer where there are not as many points
        workers: threads; the result does not depend on them

    Returns:
        Their rows, nearest first, [Q,k] int64; their distances [Q,k] float64.
    """
    k = min(k, len(points) - 1)
    places = points.double().numpy()
    distances, found = cKDTree(places).query(places[rows.numpy()], k + 1, workers=workers)
    distances, found = distances.reshape(len(rows), k + 1), found.reshape(len(rows), k + 1)
    dropped = found == rows.numpy()[:, None]
    dropped[~dropped.any(axis=1), -1] = True  # more points than k in its own place, and it is not among them
    others = ~dropped
    return (
        torch.from_numpy(found[others].reshape(len(rows), k)),
        torch.from_numpy(distances[others].reshape(len(rows), k)),
    )
