"""Color map as sparse weights in torch, on any device: the plain twin of the CPU's lists of weights.

The weights are stored twice, sorted by pixel and sorted by Gaussian. Both products are then sums of
consecutive entries in a fixed order, so the bits are the same in every run on the same device.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.system.equality import equal_fields


@dataclass(frozen=True)
class SparseWeights:
    """Color map as sparse weights of M Gaussians in P pixels. All tensors are on one device."""

    size: tuple[int, ...]  # height and width of the window, or its number of selected pixels
    by_pixel: SortedEntries  # entries of each pixel: index of the Gaussian and weight
    by_row: SortedEntries  # entries of each Gaussian: index of the pixel and weight

    def picture(self, colors: Tensor) -> Tensor:
        """Draw an image, see `ColorMap`."""
        return self.by_pixel.product(colors).view(*self.size, -1)

    def gradient(self, image: Tensor) -> Tensor:
        """Return the gradient of the colors, see `ColorMap`."""
        return self.by_row.product(image.reshape(-1, image.shape[-1]))

    def to(self, device: torch.device) -> SparseWeights:
        """Return the weights on a device."""
        return SparseWeights(self.size, self.by_pixel.to(device), self.by_row.to(device))


@dataclass(frozen=True)
class SortedEntries:
    """Entries of a sparse matrix, sorted by row (compressed sparse rows)."""

    __eq__ = equal_fields

    counts: Tensor  # number of entries of each row. [R] int64
    columns: Tensor  # column of each entry. [E] int32
    weights: Tensor  # weight of each entry. [E] float32

    def product(self, values: Tensor) -> Tensor:
        """Return the product with a dense matrix. [C,k] -> [R,k]"""
        products = values.float()[self.columns] * self.weights[:, None]
        return torch.segment_reduce(products, "sum", lengths=self.counts, unsafe=True, initial=0.0)

    def transpose(self, column_count: int) -> SortedEntries:
        """Return the entries sorted by column, and by row within a column."""
        row_count = len(self.counts)
        indices = torch.arange(row_count, dtype=torch.int32, device=self.counts.device)
        rows = indices.repeat_interleave(self.counts, output_size=len(self.columns))
        columns, order = self.columns.sort(stable=True)
        counts = torch.bincount(columns, minlength=column_count)
        return SortedEntries(counts, rows[order], self.weights[order])

    def to(self, device: torch.device) -> SortedEntries:
        """Return the entries on a device."""
        return SortedEntries(self.counts.to(device), self.columns.to(device), self.weights.to(device))


def sparse_weights(size: tuple[int, ...], count: int, by_pixel: SortedEntries) -> SparseWeights:
    """Return a color map from entries that are sorted by pixel.

    Args:
        size: height and width of the window, or its number of selected pixels
        count: number of colored Gaussians M
        by_pixel: entries of each pixel
    """
    return SparseWeights(size, by_pixel, by_pixel.transpose(count))


def weights_of_entries(
    size: tuple[int, ...], count: int, rows: Tensor, pixels: Tensor, weights: Tensor
) -> SparseWeights:
    """Return a color map from a list of weights in any order.

    Args:
        size: height and width of the window, or its number of selected pixels
        count: number of colored Gaussians M
        rows: Gaussian of each weight, 0..M−1. [E] int32
        pixels: pixel of each weight. [E] int32
        weights: αT. [E] float32
    """
    ordered, order = pixels.sort(stable=True)
    counts = torch.bincount(ordered, minlength=math.prod(size))
    return sparse_weights(size, count, SortedEntries(counts, rows[order], weights[order]))
