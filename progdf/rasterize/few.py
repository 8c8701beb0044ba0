"""Kernels: cull, sort, project and bin a small scene in one call on one thread.

The steps are those of `projection` and `binning`, compiled from the same functions without threads: for a few
thousand Gaussians, nine launches take longer than the work between them. The result is the same bits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize import binning, projection
from progdf.rasterize.jit import kernel, without_threads

Array = NDArray[Any]

_cull = without_threads(projection.cull)
_project = without_threads(projection.project)
_depth_order = without_threads(binning.depth_order)
_count_tiles = without_threads(binning.count_tiles)
_place_tiles = without_threads(binning.place_tiles)
_fill_tiles = without_threads(binning.fill_tiles)


@kernel(cache=True)
def list_few(
    means: Array, quats: Array, scales: Array, opacities: Array, colors: Array, degree: int, viewmat: Array,
    intrinsics: Array, size: Array, window: Array, near: float, antialiased: bool, grid: Array,
    centres: Array, depths: Array, candidates: Array, visible: Array, tile_starts: Array,
) -> tuple[Array, Array, Array, Array, Array, Array, int]:  # fmt: skip
    """From Gaussians to counted tiles; arguments as in `projection.project` and `binning.count_tiles`.

    Returns:
        ids, ranks, splats, rgb, counts, per_splat, and the number of (splat, tile) intersections
    """
    _cull(
        means, scales, opacities, viewmat, intrinsics, size, window, near, centres, depths, candidates
    )  # fmt: skip
    ids, ranks = _depth_order(depths, candidates, 1)
    splats, rgb = np.empty((ids.size, 8)), np.empty((ids.size, 4), np.float32)
    _project(
        ids, ranks, means, quats, scales, opacities, colors, degree, viewmat, intrinsics, size, window,
        antialiased, splats, rgb, visible,
    )  # fmt: skip
    counts, per_splat = np.empty((1, grid[2] * grid[3]), np.int64), np.empty(ids.size + 1, np.int64)
    _count_tiles(splats, window, grid, counts, per_splat)
    total = _place_tiles(counts, tile_starts, per_splat)
    return ids, ranks, splats, rgb, counts, per_splat, total


@kernel(cache=True)
def fill_few(
    splats: Array, window: Array, grid: Array, places: Array, per_splat: Array, members: Array, slots: Array
) -> None:
    """As `binning.fill_tiles`."""
    _fill_tiles(splats, window, grid, places, per_splat, members, slots)
