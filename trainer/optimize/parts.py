"""The connected parts of a region: which of its Gaussians hang together and can move as one.

Nobody says how many hands a region holds. Gaussians that lie within a few spacings of each other are
neighbours, and whatever a chain of neighbours joins is one part.
"""

from __future__ import annotations

import torch
from torch import Tensor

_NEIGHBOUR = 8  # a Gaussian's spacing is the distance to its eighth neighbour: the first can be a twin
_SAMPLES = 512  # Gaussians whose spacing is measured
_REACH = 2.5  # spacings that a gap must have to part what it parts
_CELLS = 2.0  # cells per reach; then any two Gaussians of a cell are neighbours (√3 / 2 < 1)


def connected_parts(means: Tensor, least: float = 0.02) -> Tensor:
    """Which part each Gaussian belongs to.

    Time and memory grow with the number of Gaussians: they are gathered in cells first, and cells are
    neighbours where their centroids are within reach, so a gap counts exactly to within half its width.

    Args:
        means: centres of the region's members. [M,3]
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
    labels = _joined(len(occupied), _neighbours(occupied, centroids, reach))
    return _strays_joined(labels, centroids, counts, max(8.0, least * len(points)))[cell_of]


def _spacing(points: Tensor) -> float:
    """Median distance to the eighth neighbour (of few points a nearer one), of up to 512 of the points."""
    sample = points[:: max(1, len(points) // _SAMPLES)][:_SAMPLES]
    nearest = min(_NEIGHBOUR, max(2, len(points) // 8)) + 1  # each is its own nearest
    nearest = min(nearest, len(points))
    return float(torch.cdist(sample, points).kthvalue(nearest, dim=1).values.median())


def _neighbours(occupied: Tensor, centroids: Tensor, reach: float) -> Tensor:
    """Pairs of cells whose centroids are within reach. [C,3] sorted, [C,3] -> [E,2]"""
    extent = occupied.amax(dim=0) + 7  # room for three cells beyond either side
    stride = torch.stack([extent[1] * extent[2], extent[2], extent.new_ones(())])
    keys = ((occupied + 3) * stride).sum(dim=1)  # ascending, as `unique` sorts
    around = range(-3, 4)
    pairs = []
    for offset in ((x, y, z) for x in around for y in around for z in around):
        if offset <= (0, 0, 0):  # the other half is met from the other side
            continue
        wanted = keys + int((torch.tensor(offset) * stride).sum())
        found = torch.searchsorted(keys, wanted).clamp_max(len(keys) - 1)
        here = (keys[found] == wanted).nonzero()[:, 0]
        there = found[here]
        near = (centroids[here] - centroids[there]).norm(dim=1) <= reach
        pairs.append(torch.stack([here[near], there[near]], dim=1))
    return torch.cat(pairs)


def _joined(count: int, pairs: Tensor) -> Tensor:
    """Smallest index that each node is joined with, by however long a chain. [E,2] -> [count]"""
    labels = torch.arange(count)
    while True:
        lowest = torch.minimum(labels[pairs[:, 0]], labels[pairs[:, 1]])
        better = labels.clone()
        for end in (0, 1):
            better.scatter_reduce_(0, labels[pairs[:, end]], lowest, "amin")
        while not torch.equal(better[better], better):
            better = better[better]
        better = better[labels]
        if torch.equal(better, labels):
            return labels
        labels = better


def _strays_joined(labels: Tensor, centroids: Tensor, counts: Tensor, least: float) -> Tensor:
    """Parts numbered by size, the largest 0; cells of those below `least` go with the nearest other cell."""
    roots, part = torch.unique(labels, return_inverse=True)
    sizes = torch.zeros(len(roots), dtype=torch.int64).index_add(0, part, counts)
    order = sizes.argsort(descending=True, stable=True)
    kept = max(1, int((sizes >= least).sum()))
    number = torch.empty_like(order)
    number[order] = torch.arange(len(order))
    part = number[part]
    stray, firm = (part >= kept).nonzero()[:, 0], (part < kept).nonzero()[:, 0]
    for first in range(0, len(stray), 1024):
        some = stray[first : first + 1024]
        part[some] = part[firm[torch.cdist(centroids[some], centroids[firm]).argmin(dim=1)]]
    return part
