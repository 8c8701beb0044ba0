"""Random numbers of a seed that have the same bits on every processor."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


class Draws:
    """Sequence of random numbers. The last bits of torch's normal numbers depend on the processor."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)

    def normal(self, *shape: int) -> Tensor:
        """Return numbers of mean 0 and standard deviation 1. float32"""
        return torch.from_numpy(self._random.standard_normal(shape).astype(np.float32))

    def uniform(self, *shape: int) -> Tensor:
        """Return numbers from 0 to 1. float32"""
        return torch.from_numpy(self._random.random(shape, np.float32))

    def order(self, count: int) -> Tensor:
        """Return the numbers below `count` in random order. [count] int64"""
        return torch.from_numpy(self._random.permutation(count))
