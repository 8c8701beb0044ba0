"""Stored bases of a field as numpy arrays, for kernels."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from .baked import AttributeBases, Segment

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]


class StoredBases(NamedTuple):
    """Bases of one attribute of an edit, see `AttributeBases`."""

    end: NDArray[Any]  # int8 or float32. [M,c]
    residual: NDArray[Any]  # int8 or float32. [R,M,c]
    scale: Floats  # [1+R,c]
    coefficients: Floats  # [S,1+R]

    @staticmethod
    def of(bases: AttributeBases) -> StoredBases:
        stored = (bases.end_offset, bases.residual_basis)
        levels = [part if part.dtype == torch.int8 else part.float() for part in stored]
        tensors = (*levels, bases.scale, bases.coefficients)
        return StoredBases(*(tensor.contiguous().numpy() for tensor in tensors))

    def factors(self, at: Segment) -> tuple[Rows, Floats]:
        """Return the residual bases used in a segment of the knots, and the factors of all used bases.

        Returns:
            Indices of the residual bases with nonzero coefficients [U], and factors of basis 0 and of each of
            them [1+U,c]. There are no factors if the attribute is unchanged.
        """
        right, share = at
        row = self.coefficients[right]
        if share != 1.0:
            low = self.coefficients[right - 1]
            row = low + np.float32(share) * (row - low)
        used = np.flatnonzero(row[1:])
        if not len(used) and row[0] == 0.0:
            return used, np.zeros((0, self.end.shape[1]), np.float32)
        bases = np.concatenate([[0], 1 + used])
        return used, row[bases, None] * self.scale[bases]
