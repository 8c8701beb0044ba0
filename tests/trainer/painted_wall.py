"""Test wall of large, soft, thick Gaussians, and paint on it that is finer than they are."""

from __future__ import annotations

import math

import torch

from progdf.camera import Camera, intrinsics, look_at
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.rasterize import render
from progdf.surface.find import find_surface
from trainer.paint.discs import PaintedView, composite_over
from trainer.run.paint import DiscLayout, lay_discs, make_goal, paint_gdf
from trainer.views.view import BACKGROUND

SIDE = 128
CAMERA = Camera(
    look_at(torch.tensor([0.0, 0.0, -3.0]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0])),
    intrinsics(math.radians(45), SIDE, SIDE),
    SIDE,
    SIDE,
    near=0.01,
)


def wall(seed: int = 0, count: int = 2500, size: float = 0.09, rough: float = 0.05) -> Gaussians:
    """Return a wall across the picture; its Gaussians are 5 pixels wide and up to 6 pixels off its plane."""
    random = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=random) * torch.tensor([3.2, 3.2, 0.0]) - torch.tensor(
        [1.6, 1.6, 0.0]
    )
    means[:, 2] = rough * torch.randn(count, generator=random).clamp(-2, 2)
    scales = torch.tensor([size, size, 0.2 * size]) * (0.7 + 0.6 * torch.rand(count, 3, generator=random))
    colors = 0.6 + 0.05 * torch.randn(count, 3, generator=random)
    return Gaussians(
        means,
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        scales.log(),
        torch.full((count,), 0.5),
        colors,
        torch.zeros(count, 3, 3),
    )


def picture(scene: Gaussians) -> torch.Tensor:
    return render(scene, CAMERA, BACKGROUND).image.clamp(0.0, 1.0)


def letters(scene: Gaussians) -> PaintedView:
    """Return the wall with dark blue bars, 5 pixels wide with gaps of 5, in its middle."""
    painted = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    for left in range(45, 85, 10):
        painted[50:78, left : left + 5] = True
    return paint_on(scene, painted)


def paint_on(scene: Gaussians, painted: torch.Tensor) -> PaintedView:
    """Return the wall with the pixels of `painted` in dark blue. [H,W] bool"""
    drawn = painted[..., None] * torch.tensor([0.1, 0.15, 0.5, 1.0])
    surface = find_surface(scene, CAMERA, painted.numpy())
    return PaintedView(CAMERA, composite_over(picture(scene), drawn), drawn, surface)


def edit_of(scene: Gaussians, paint: PaintedView) -> tuple[Gdf, DiscLayout]:
    laid = lay_discs(make_goal(scene, [paint]), 4.0)
    return paint_gdf(laid, scene, [paint], "letters", None), laid
