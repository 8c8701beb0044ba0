"""The colors by which discs, and the rows that made way for them, show a painted picture.

Least squares: a view is linear in the colors that are drawn in it (`trainer.optimize.color_views`). What lies
before a disc takes light, what shines through it adds some; both are in the weights.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.rasterize import render
from progdf.rasterize.engines import ColorMap, Crop, activate, color_map
from progdf.sh import C0
from progdf.threads import one_thread
from trainer.views.view import BACKGROUND, crop, seen_colors

_STEPS, _ROUNDS = 40, 3  # of conjugate gradients; between them, colors below black are set to it
_HELD = 0.05  # of a pixel: how much a moved row holds on to its own color
_RIDGE = 1e-3  # the same of a disc


def join(scene: Gaussians, added: Gaussians) -> Gaussians:
    """A scene and rows after its own."""
    rows: dict[str, Any] = {
        name: torch.cat([getattr(scene, name), getattr(added, name)]) for name in ATTRIBUTES
    }
    return replace(scene, **rows)


def solve_colors(
    scene: Gaussians, moved: Tensor, added: Gaussians, camera: Camera, target: Tensor, box: Crop
) -> tuple[Gaussians, Gaussians]:
    """Scene and added rows with the colors whose picture comes closest to `target`.

    Args:
        scene: with the moved rows where they go
        moved: the rows that may change beside the added ones. [M] int64
        added: see `Discs`
        camera: of the painted view
        target: what it shall show. [H,W,3]
        box: the window that counts
    """
    joined, count = join(scene, added), len(moved)
    rows = torch.cat([moved, torch.arange(len(scene), len(joined))])
    colors = seen_colors(joined, camera)
    own = colors[rows]
    weights = color_map(activate(joined), camera, box, rows)
    others = colors.index_fill(0, rows, 0.0)
    rest = render(joined, camera, BACKGROUND, colors=others, crop=box).image
    held = torch.full((len(rows), 1), _RIDGE)
    held[:count] = _HELD
    change = (_least_squares(weights, crop(target, box) - rest, own, held) - own) / C0
    return (
        replace(scene, sh0=scene.sh0.index_add(0, moved, change[:count])),
        replace(added, sh0=added.sh0 + change[count:]),
    )


@one_thread()
def _least_squares(weights: ColorMap, target: Tensor, start: Tensor, held: Tensor) -> Tensor:
    """Colors, not below black, by conjugate gradients. [h,w,3], [M,3], [M,1] -> [M,3]"""
    diagonal = weights.gradient(weights.picture(torch.ones_like(start))) + held
    colors = start
    for _ in range(_ROUNDS):
        residual = weights.gradient(target - weights.picture(colors)) + held * (start - colors)
        free = ~((colors <= 0) & (residual < 0))
        residual = residual * free
        direction = residual / diagonal
        power = (residual * direction).sum(dim=0)
        for _ in range(_STEPS):
            image = weights.gradient(weights.picture(direction)) * free + held * direction
            length = power / (direction * image).sum(dim=0).clamp_min(1e-20)
            colors, residual = colors + length * direction, residual - length * image
            scaled = residual / diagonal
            now = (residual * scaled).sum(dim=0)
            direction = scaled + now / power.clamp_min(1e-30) * direction
            power = now
        colors = colors.clamp_min(0.0)
    return colors
