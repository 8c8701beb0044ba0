"""Kernel: the backward pass in one launch."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from .blend_backward import unblend
from .jit import kernel
from .projection_backward import project_backward
from .shares import enter, leave

Array = NDArray[Any]


@kernel(cache=True, allocates=True)
def backpropagate(
    splats: Array, rgb: Array, window: Array, grid: Array, tile_starts: Array, members: Array, slots: Array,
    background: Array, transmittance: Array, last: Array, grad_image: Array, grad_transmittance: Array,
    sums: Array, wanted: Array,
    ids: Array, ranks: Array, means: Array, quats: Array, scales: Array, opacities: Array, colors: Array,
    degree: int, viewmat: Array, intrinsics: Array, size: Array, antialiased: bool, per_splat: Array,
    grad_means: Array, grad_quats: Array, grad_scales: Array, grad_opacities: Array, grad_colors: Array,
    grad_camera: Array, claims: Array,
) -> None:  # fmt: skip
    """`unblend`, then `project_backward`, whose arguments these are; claims: as `shares.Team` gives them."""
    seat = enter(claims)
    unblend(
        splats, rgb, window, grid, tile_starts, members, slots, background, transmittance, last, grad_image,
        grad_transmittance, sums, wanted, seat, claims, 0,
    )  # fmt: skip
    project_backward(
        ids, ranks, means, quats, scales, opacities, colors, degree, viewmat, intrinsics, size, antialiased,
        splats, per_splat, sums, wanted, grad_means, grad_quats, grad_scales, grad_opacities, grad_colors,
        grad_camera, seat, claims, 1,
    )  # fmt: skip
    leave(seat, claims)
