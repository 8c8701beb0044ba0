"""Kernels: the forward pass in two launches; between them, memory for what the first has counted."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from .binning import fill_tiles, find_tiles
from .blend import blend
from .jit import kernel
from .order import STEPS, Sorting, depth_order
from .projection import cull, project
from .shares import enter, leave

Array = NDArray[Any]


@kernel(cache=True, allocates=True)
def list_splats(
    means: Array, quats: Array, scales: Array, opacities: Array, colors: Array, degree: int, viewmat: Array,
    intrinsics: Array, size: Array, window: Array, near: float, antialiased: bool, grid: Array, most: int,
    centres: Array, depths: Array, candidates: Array, visible: Array, sorting: Sorting, ids: Array,
    ranks: Array, splats: Array, rgb: Array, counts: Array, per_splat: Array, tiles: Array,
    tile_starts: Array, found: Array, claims: Array,
) -> None:  # fmt: skip
    """`cull`, `depth_order`, `project` and `find_tiles`, whose arguments these are.

    Args:
        ids, ranks, splats, rgb: filled up to V. [N,…]
        per_splat: filled up to V. [N+1] int64
        found: out, V and the number of intersections. [2] int64
        claims: as `shares.Team` gives them
    """
    seat = enter(claims)
    cull(
        means, scales, opacities, viewmat, intrinsics, size, window, near, centres, depths, candidates, seat,
        claims, 0,
    )  # fmt: skip
    step = 1
    count = depth_order(depths, candidates, sorting, ids, ranks, found, seat, claims, step)
    step += STEPS
    project(
        ids[:count], ranks[:count], means, quats, scales, opacities, colors, degree, viewmat, intrinsics,
        size, window, antialiased, splats, rgb, visible, seat, claims, step,
    )  # fmt: skip
    step += 1
    find_tiles(
        splats[:count], window, grid, most, counts, per_splat[: count + 1], tiles, tile_starts, found, seat,
        claims, step,
    )  # fmt: skip
    leave(seat, claims)


@kernel(cache=True, allocates=True)
def list_tiles(
    splats: Array, window: Array, grid: Array, places: Array, per_splat: Array, tiles: Array, members: Array,
    slots: Array, claims: Array,
) -> None:  # fmt: skip
    """`fill_tiles` by itself; claims: as `shares.Team` gives them."""
    seat = enter(claims)
    fill_tiles(splats, window, grid, places, per_splat, tiles, members, slots, seat, claims, 0)
    leave(seat, claims)


@kernel(cache=True, allocates=True)
def draw(
    splats: Array, rgb: Array, window: Array, grid: Array, places: Array, per_splat: Array, tiles: Array,
    tile_starts: Array, members: Array, slots: Array, background: Array, image: Array, transmittance: Array,
    last: Array, claims: Array,
) -> None:  # fmt: skip
    """`fill_tiles`, then `blend`, whose arguments these are; claims: as `shares.Team` gives them."""
    seat = enter(claims)
    fill_tiles(splats, window, grid, places, per_splat, tiles, members, slots, seat, claims, 0)
    blend(
        splats, rgb, window, grid, tile_starts, members, background, image, transmittance, last, seat, claims,
        1,
    )  # fmt: skip
    leave(seat, claims)
