"""Depth order on the CPU: exact, ties by index, fast enough for every frame (1 ms at 100k, 12 ms at 1M).

No order is kept once a centre has moved, however little. Measured on the playbot with its 31k Gaussians at
640×480, the order of before against the exact one when 2931 centres have moved by a share of the scene's
radius in random directions: 1e-5 97 dB, 1e-4 65 dB with pixels off by 0.14, 1e-3 53 dB by 0.37, 1e-2 44 dB by
0.57. A threshold that shows no error would spare next to no sorts, and a sort is 0.8 ms of the 65 and more
that software OpenGL takes for this picture.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from progdf.camera import NEAR, Camera


def back_to_front(means: NDArray[np.float32], camera: Camera, near: float = NEAR) -> NDArray[np.uint32]:
    """Rows in front of the near plane, farthest first; the exact reverse of (float32 depth, index) ascending.

    Args:
        means: centres, world units; a row that is not finite is left out. [N,3]
        camera: only its `viewmat` counts
        near: least depth, world units

    Returns:
        [V] uint32, V ≤ N
    """
    row = camera.viewmat[2].double().numpy()
    # float64 as the CPU engine does: another rounding would swap neighbours
    with np.errstate(invalid="ignore", over="ignore"):
        depths = means.astype(np.float64) @ row[:3] + row[3]
        seen = np.flatnonzero((depths > near) & (depths < np.inf))
    # positive floats sort like their bits; below them the index makes every key unique
    bits = depths[seen].astype(np.float32).view(np.uint32)
    keys = bits.astype(np.uint64) << np.uint64(32) | seen.astype(np.uint64)
    keys.sort()
    return np.ascontiguousarray(keys[::-1]).astype(np.uint32)  # the low half is the index
