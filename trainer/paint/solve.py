"""The colors by which discs, and the rows that made way for them, show painted pictures.

Least squares: a view is linear in the colors that are drawn in it (`trainer.optimize.color_views`). What lies
before a disc takes light, what shines through it adds some; both are in the weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians, concatenate
from progdf.rasterize import render
from progdf.rasterize.engines import ColorMap, Crop, activate, color_map
from progdf.sh import C0
from progdf.threads import one_thread
from trainer.views.view import BACKGROUND, crop, seen_colors

from .discs import PaintedView

_STEPS = 40  # of conjugate gradients
_ROUNDS = 3  # between them, colors below black are set to it
_HELD = 0.05  # of a pixel: how much a row of the scene holds on to its own color
_RIDGE = 0.02  # the same of a disc, on what was painted there
_MIN_BOX = 32  # pixels around the paint in which its colors are solved for


def box_of(painted: Tensor, camera: Camera) -> Crop:
    """The window around the paint in which moved rows may show: half as large again on each side."""
    rows, columns = painted.nonzero().T
    (top, bottom), (left, right) = ((int(axis.min()), int(axis.max()) + 1) for axis in (rows, columns))
    margin = _MIN_BOX + max(bottom - top, right - left) // 2
    return (
        max(0, left - margin),
        max(0, top - margin),
        min(camera.width, right + margin),
        min(camera.height, bottom + margin),
    )


def solve_colors(
    scene: Gaussians, rows: Tensor, added: Gaussians, paints: Sequence[PaintedView]
) -> tuple[Gaussians, Gaussians]:
    """Scene and added rows with the colors whose pictures come closest to what was painted, all together.

    Args:
        scene: with the moved rows where they go
        rows: of the scene, which may change beside the added ones. [M] int64
        added: see `Discs`
        paints: of one thing
    """
    joined = concatenate([scene, added])
    count = len(rows)
    free = torch.cat([rows, torch.arange(len(scene), len(joined))])
    activated = activate(joined)
    maps = list[ColorMap]()
    missing = list[Tensor]()
    lowest = torch.full((len(free), 3), -torch.inf)
    for paint in paints:
        box = box_of(paint.mask, paint.camera)
        colors = seen_colors(joined, paint.camera)
        shown = render(joined, paint.camera, BACKGROUND, colors=colors, crop=box).image
        maps.append(color_map(activated, paint.camera, box, free))
        missing.append(crop(paint.picture, box) - shown)
        lowest = torch.maximum(lowest, -colors[free])
    held = torch.full((len(free), 1), _RIDGE)
    held[:count] = _HELD
    change = _least_squares(maps, missing, lowest, held) / C0
    return (
        replace(scene, sh0=scene.sh0.index_add(0, rows, change[:count])),
        replace(added, sh0=added.sh0 + change[count:]),
    )


@one_thread()
def _least_squares(
    maps: Sequence[ColorMap], targets: Sequence[Tensor], lowest: Tensor, held: Tensor
) -> Tensor:
    """Changes of color, not below `lowest`, by conjugate gradients. [h,w,3] each, [M,3], [M,1] -> [M,3]"""

    def gradient(images: Sequence[Tensor]) -> Tensor:
        parts = (weights.gradient(image) for weights, image in zip(maps, images, strict=True))
        return torch.stack(list(parts)).sum(dim=0)

    def normal(colors: Tensor) -> Tensor:
        return gradient([weights.picture(colors) for weights in maps]) + held * colors

    right = gradient(targets)
    diagonal = normal(torch.ones_like(lowest))
    colors = torch.zeros_like(lowest)
    for _ in range(_ROUNDS):
        residual = right - normal(colors)
        free = ~((colors <= lowest) & (residual < 0))
        residual = residual * free
        direction = residual / diagonal
        power = (residual * direction).sum(dim=0)
        for _ in range(_STEPS):
            image = normal(direction) * free
            length = power / (direction * image).sum(dim=0).clamp_min(1e-20)
            colors = colors + length * direction
            residual = residual - length * image
            scaled = residual / diagonal
            now = (residual * scaled).sum(dim=0)
            direction = scaled + now / power.clamp_min(1e-30) * direction
            power = now
        colors = colors.maximum(lowest)
    return colors
