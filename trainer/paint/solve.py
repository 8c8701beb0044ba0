"""Solver for the colors of discs, and of the rows moved behind them, that reproduce painted pictures.

A view is linear in the colors that are drawn in it (`trainer.optimize.color_views`), so the colors are a
least-squares solution. Gaussians in front of a disc take light and those behind it add light. The weights
account for both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians, concatenate
from progdf.rasterize import render
from progdf.rasterize.engines import ColorMap, Crop, activate, color_map
from progdf.sh import C0
from progdf.system.equality import equal_fields
from progdf.threads import one_thread
from trainer.views.view import BACKGROUND, crop, seen_colors

_CG_STEPS = 40  # conjugate gradient steps per round
_SHARE_STEPS = 100  # gradient steps for shares
_CLAMP_ROUNDS = 3  # rounds; between them, colors below black are set to black
# Ridge of the least squares, in pixels: a weight of 1 counts as much as one fully covered pixel.
_SCENE_RIDGE = 0.05  # holds a row of the scene to its own color
_DISC_RIDGE = 0.1  # holds a disc to the painted color
_OWN_IMPORTANCE = 16.0  # importance of the painted pictures' errors, relative to those of other views
_BEHIND_IMPORTANCE = 4.0  # importance of views from behind, which stand for those of the sides
_MIN_MARGIN_PX = 32  # pixels; minimum margin around the paint in which colors are solved for


@dataclass(frozen=True)
class ExpectedView:
    """View of the paint, with its expected image and the pixels to compare."""

    __eq__ = equal_fields

    camera: Camera
    degrees: float  # rotation from the picture's camera; 0 is the picture itself
    expected: Tensor  # the view with the paint projected onto the surface. [H,W,3]
    covered: Tensor  # the painted pixels. [H,W] bool
    around: Tensor  # the ring around them. [H,W] bool


def box_of(painted: Tensor, camera: Camera) -> Crop:
    """Return the paint's window with half its size added on each side, where moved rows may be visible."""
    rows, columns = painted.nonzero().T
    top = int(rows.min())
    bottom = int(rows.max()) + 1
    left = int(columns.min())
    right = int(columns.max()) + 1
    margin = _MIN_MARGIN_PX + max(bottom - top, right - left) // 2
    return (
        max(0, left - margin),
        max(0, top - margin),
        min(camera.width, right + margin),
        min(camera.height, bottom + margin),
    )


def solve_colors(
    scene: Gaussians, rows: Tensor, added: Gaussians, views: Sequence[ExpectedView], behind: Tensor
) -> tuple[Gaussians, Gaussians]:
    """Return the scene and the added rows with the colors that reproduce all views of the paint best.

    Args:
        scene: with the moved rows at their new positions
        rows: rows of the scene that may change beside the added ones. [M] int64
        added: see `Discs`
        views: the painted pictures, and views from other sides
        behind: how visible the rows are from behind, pixels; it holds them to their own colors. [M]
    """
    joined = concatenate([scene, added])
    count = len(rows)
    free = torch.cat([rows, torch.arange(len(scene), len(joined))])
    activated = activate(joined)
    maps = list[ColorMap]()
    missing = list[Tensor]()
    importance = list[float]()
    lowest = torch.full((len(free), 3), -torch.inf)
    for view in views:
        if not bool(view.covered.any()):
            continue
        box = box_of(view.covered, view.camera)
        rendered = render(activated, view.camera, BACKGROUND, crop=box).image
        maps.append(color_map(activated, view.camera, box, free))
        importance.append(1.0 if view.degrees else _OWN_IMPORTANCE)
        missing.append(crop(view.expected, box) - rendered)
        lowest = torch.maximum(lowest, -seen_colors(joined[free], view.camera))
    ridge = torch.full((len(free), 1), _DISC_RIDGE)
    ridge[:count] = _SCENE_RIDGE + _BEHIND_IMPORTANCE * behind[:, None]
    change = _least_squares(maps, missing, importance, lowest, ridge) / C0
    return (
        replace(scene, sh0=scene.sh0.index_add(0, rows, change[:count])),
        replace(added, sh0=added.sh0 + change[count:]),
    )


@one_thread()
def solve_shares(
    scene: Gaussians, rows: Tensor, changes: Tensor, views: Sequence[ExpectedView], behind: Tensor
) -> Tensor:
    """Return the shares of given color changes, 0 to 1, that reproduce all views of the paint best.

    Args:
        scene: the scene
        rows: rows that may change. [M] int64
        changes: full change of each row's color. [M,3]
        views: the painted pictures, and views from other sides
        behind: how visible the rows are from behind, pixels; it holds them to their own colors. [M]

    Returns:
        [M]
    """
    activated = activate(scene)
    maps = list[ColorMap]()
    missing = list[Tensor]()
    importance = list[float]()
    for view in views:
        if not bool(view.covered.any()):
            continue
        box = box_of(view.covered, view.camera)
        rendered = render(activated, view.camera, BACKGROUND, crop=box)
        maps.append(color_map(activated, view.camera, box, rows))
        importance.append(1.0 if view.degrees else _OWN_IMPORTANCE)
        missing.append(crop(view.expected, box) - rendered.image)
    ridge = (_SCENE_RIDGE + _BEHIND_IMPORTANCE * behind) * changes.square().sum(dim=1)

    def gradient(images: Sequence[Tensor], along: Tensor) -> Tensor:
        total = torch.zeros(len(rows))
        for weights, image, share in zip(maps, images, importance, strict=True):
            total += share * (along * weights.gradient(image)).sum(dim=1)
        return total

    # the sums of the rows of the normal matrix bound its eigenvalues
    sizes = changes.abs()
    bound = gradient([weights.picture(sizes) for weights in maps], sizes) + ridge
    step = 1.0 / bound.clamp_min(1e-12)
    shares = torch.zeros(len(rows))
    ahead = shares
    momentum = 1.0
    for _ in range(_SHARE_STEPS):  # projected gradients with Nesterov's momentum
        colors = ahead[:, None] * changes
        residuals = [goal - weights.picture(colors) for weights, goal in zip(maps, missing, strict=True)]
        new = (ahead + step * (gradient(residuals, changes) - ridge * ahead)).clamp(0.0, 1.0)
        next_momentum = 0.5 * (1.0 + (1.0 + 4.0 * momentum**2) ** 0.5)
        ahead = new + (momentum - 1.0) / next_momentum * (new - shares)
        shares = new
        momentum = next_momentum
    return shares


@one_thread()
def _least_squares(
    maps: Sequence[ColorMap],
    targets: Sequence[Tensor],
    importance: Sequence[float],
    lowest: Tensor,
    held: Tensor,
) -> Tensor:
    """Solve for color changes, at least `lowest`, by conjugate gradients; `held` is the ridge.

    targets [h,w,3] with their importance each, lowest [M,3], held [M,1] -> [M,3]
    """

    def gradient(images: Sequence[Tensor]) -> Tensor:
        parts = (
            share * weights.gradient(image)
            for weights, image, share in zip(maps, images, importance, strict=True)
        )
        return torch.stack(list(parts)).sum(dim=0)

    def normal(colors: Tensor) -> Tensor:
        return gradient([weights.picture(colors) for weights in maps]) + held * colors

    gradient_of_targets = gradient(targets)
    diagonal = normal(torch.ones_like(lowest))
    colors = torch.zeros_like(lowest)
    for _ in range(_CLAMP_ROUNDS):
        residual = gradient_of_targets - normal(colors)
        free = ~((colors <= lowest) & (residual < 0))
        residual = residual * free
        direction = residual / diagonal
        power = (residual * direction).sum(dim=0)
        for _ in range(_CG_STEPS):
            image = normal(direction) * free
            step_length = power / (direction * image).sum(dim=0).clamp_min(1e-20)
            colors = colors + step_length * direction
            residual = residual - step_length * image
            scaled = residual / diagonal
            next_power = (residual * scaled).sum(dim=0)
            direction = scaled + next_power / power.clamp_min(1e-30) * direction
            power = next_power
        colors = colors.maximum(lowest)
    return colors
