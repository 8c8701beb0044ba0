"""The order of depth. The Gaussians are sorted: there are far fewer of them than of their tiles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def depth_order(depths: NDArray[np.float32], visible: NDArray[np.bool_]) -> NDArray[Any]:
    """The rows of visible Gaussians, nearest first, ties by row. depths: > 0. [N], [N] -> [V] int32"""
    rows = np.flatnonzero(visible)
    bits = depths[rows].view(np.uint32)  # positive floats sort as their bits
    keys = (bits.astype(np.uint64) << np.uint64(32)) | rows.astype(np.uint64)
    keys.sort()  # all different, so any sort is stable
    return (keys & np.uint64(0xFFFF_FFFF)).astype(np.int32)
