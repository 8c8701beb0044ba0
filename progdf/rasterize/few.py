"""Kernels: cull, sort, project and bin a small scene in one call on one thread.

The steps are those of `projection`, `order` and `binning`, compiled from the same functions without threads:
for a few thousand Gaussians, nine launches take longer than the work. The result is the same bits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.binning import fill_tiles, find_tiles, place_tiles
from progdf.rasterize.jit import kernel
from progdf.rasterize.order import (
    BUCKETS,
    DIGITS,
    count_digits,
    gather_keys,
    move_digits,
    place_digits,
    rank_items,
)
from progdf.rasterize.projection import cull, project
from progdf.rasterize.shares import CLAIMS

Array = NDArray[Any]


@kernel(cache=True)
def _depth_order(depths: Array, candidates: Array) -> tuple[Array, Array]:
    ids, keys, items = gather_keys(depths, candidates)
    new_keys, new_items = np.empty_like(keys), np.empty_like(items)
    places = np.empty((1, BUCKETS), np.int64)
    for digit in range(DIGITS):
        count_digits(keys, digit, places, np.zeros(CLAIMS, np.int64))
        place_digits(places)
        move_digits(keys, items, digit, places, new_keys, new_items, np.zeros(CLAIMS, np.int64))
        keys, new_keys, items, new_items = new_keys, keys, new_items, items
    return ids, rank_items(items)


@kernel(cache=True)
def list_few(
    means: Array, quats: Array, scales: Array, opacities: Array, colors: Array, degree: int, viewmat: Array,
    intrinsics: Array, size: Array, window: Array, near: float, antialiased: bool, grid: Array, most: int,
    for_gradients: bool, centres: Array, depths: Array, candidates: Array, visible: Array, tile_starts: Array,
) -> tuple[Array, Array, Array, Array, Array, Array, Array, int]:  # fmt: skip
    """From Gaussians to lists of tiles; arguments as in `projection.project` and `binning.find_tiles`.

    Args:
        for_gradients: whether slots are wanted

    Returns:
        ids, ranks, splats, rgb, per_splat, members, slots, and the number of (splat, tile) intersections;
        where that is more than `most`, members and slots are empty
    """
    claims = np.zeros((2, CLAIMS), np.int64)
    cull(
        means, scales, opacities, viewmat, intrinsics, size, window, near, centres, depths, candidates,
        claims[0],
    )  # fmt: skip
    ids, ranks = _depth_order(depths, candidates)
    splats, rgb = np.empty((ids.size, 8)), np.empty((ids.size, 4), np.float32)
    project(
        ids, ranks, means, quats, scales, opacities, colors, degree, viewmat, intrinsics, size, window,
        antialiased, splats, rgb, visible, claims[1],
    )  # fmt: skip
    counts, per_splat = np.empty((1, grid[2] * grid[3]), np.int64), np.empty(ids.size + 1, np.int64)
    tiles = find_tiles(splats, 0, window, grid, most, counts, per_splat)
    total = place_tiles(counts, tile_starts, per_splat)
    listed = total if total <= most else 0
    members, slots = np.empty(listed, np.int32), np.empty(listed if for_gradients else 0, np.int64)
    if listed:
        fill_tiles(tiles, 0, counts, per_splat, members, slots)
    return ids, ranks, splats, rgb, per_splat, members, slots, total
