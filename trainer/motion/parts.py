"""The connected parts of a region: which of its Gaussians hang together and can move as one.

Nobody says how many hands a region holds. Gaussians that lie within a few spacings of each other are
neighbors, and whatever a chain of neighbors joins is one part.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from progdf.scene.neighbors import nearest_rows

_NEIGHBOR = 8  # a Gaussian's spacing is the distance to its eighth neighbor: the first can be a twin
_SAMPLES = 512  # Gaussians whose spacing is measured
_REACH = 2.5  # spacings that a gap must have to part what it parts
_CELLS = 2.0  # cells per reach; then any two Gaussians of a cell are neighbors (√3 / 2 < 1)


def connected_parts(means: Tensor, least: float = 0.02) -> Tensor:
    """Which part each Gaussian belongs to.

    Time and memory grow with the number of Gaussians: they are gathered in cells first, and cells are
    neighbors where their centroids are within reach, so a gap counts exactly to within half its width.

    Args:
        means: centers of the region's members. [M,3]
        least: a part with a smaller share of the members, or fewer than 8, is not a part of its own: stray
            Gaussians go with the nearest part that is

    Returns:
        Part of each, 0 the one with most members. [M] int64; the same for the same means
    """
    if len(means) == 0:
        return torch.zeros(0, dtype=torch.int64)
    points = means.detach().double()
    reach = _REACH * _spacing(points)
    if reach <= 0:
        return torch.zeros(len(points), dtype=torch.int64)
    cells = ((points - points.amin(dim=0)) / (reach / _CELLS)).floor().long()
    occupied, cell_of = torch.unique(cells, dim=0, return_inverse=True)
    counts = torch.bincount(cell_of, minlength=len(occupied))
    sums = torch.zeros(len(occupied), 3, dtype=torch.float64)
    centroids = sums.index_add(0, cell_of, points) / counts[:, None]
    return _join_strays(_join_cells(centroids, reach), centroids, counts, max(8.0, least * len(points)))[
        cell_of
    ]


def _spacing(points: Tensor) -> float:
    """Median distance to the eighth neighbor (of few points a nearer one), of up to 512 of the points."""
    rows = torch.arange(len(points))[:: max(1, len(points) // _SAMPLES)][:_SAMPLES]
    nearest = min(_NEIGHBOR, max(2, len(points) // 8), len(points) - 1)
    if not nearest:
        return 0.0
    return float(nearest_rows(points, rows, nearest)[1][:, -1].median())


def _join_cells(centroids: Tensor, reach: float) -> Tensor:
    """Which cells are joined, by however long a chain of cells within reach of each other. [C,3] -> [C]"""
    count = len(centroids)
    first, second = cKDTree(centroids.numpy()).query_pairs(reach, output_type="ndarray").T
    links = coo_matrix((np.ones(len(first), np.bool_), (first, second)), (count, count))
    return torch.from_numpy(connected_components(links, directed=False)[1]).long()


def _join_strays(labels: Tensor, centroids: Tensor, counts: Tensor, least: float) -> Tensor:
    """Parts numbered by size, the largest 0; cells of those below `least` go with the nearest other cell."""
    roots, part = torch.unique(labels, return_inverse=True)
    sizes = torch.zeros(len(roots), dtype=torch.int64).index_add(0, part, counts)
    order = sizes.argsort(descending=True, stable=True)
    kept = max(1, int((sizes >= least).sum()))
    number = torch.empty_like(order)
    number[order] = torch.arange(len(order))
    part = number[part]
    stray, firm = (part >= kept).nonzero()[:, 0], (part < kept).nonzero()[:, 0]
    if len(stray):
        part[stray] = part[firm[torch.from_numpy(cKDTree(centroids[firm]).query(centroids[stray])[1])]]
    return part
