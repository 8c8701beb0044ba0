"""Losses of the paper: L_PGS of the optimization and L_GDF of the network (docs/paper.md)."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from progdf.system.equality import equal_fields
from trainer.optimize.losses import Moment, Perceptual, l1
from trainer.options import OptimizeOptions
from trainer.views.crops import CropScene

Exponent = Literal["decay", "growth"]
Over = Literal["mean", "sum"]

PROGRESSIVE_WEIGHT = 5.0
"""λ2: weight of the progressive constraint."""
SHARPNESS_WEIGHT = 1.0
"""λ3: weight of L_render in L_PGS."""
FIELD_SHARPNESS_WEIGHT = 1.0
"""Weight of L_render in L_GDF."""

EXPONENT: Exponent = "decay"
"""Reading of the exponent: −t/s, as the text says (decay), or +t/s, as printed (growth)."""
OVER: Over = "mean"
"""Reading of the norm: the mean of the members' squared steps, or their sum."""
# α, β and the period of the progressive constraint (eq. 5)
_ALPHA = 0.05
_BETA = 1.1
_PERIOD_STEPS = 50.0


def progressive_change(moved: Tensor, previous: Tensor, step: int, exponent: Exponent, over: Over) -> Tensor:
    """Return the progressive constraint (eq. 5): L_prog = α·β^(±t/50)·Σ‖ΔΘ‖², without its λ2. []

    ΔΘ is the change of a member's raw parameters by the last step. The paper does not state the norm or the
    number of members: docs/lab/experiments.md, The progressive constraint.

    Args:
        moved: offsets of the members. [M,C]
        previous: one step earlier. [M,C]
        step: t
        exponent: growth is +t/50, which forces shorter and shorter steps; decay is −t/50, which relaxes the
            constraint
        over: mean or sum over the members
    """
    signed_step = step if exponent == "growth" else -step
    factor: float = _ALPHA * _BETA ** (signed_step / _PERIOD_STEPS)
    change = (moved - previous.detach()).square().sum()
    return factor * (change / len(moved) if over == "mean" else change)


def laplacian(luma: Tensor) -> Tensor:
    """Return the 4-neighbor Laplacian without the border pixels. [h,w] -> [h-2,w-2]"""
    around = luma[:-2, 1:-1] + luma[2:, 1:-1] + luma[1:-1, :-2] + luma[1:-1, 2:]
    return around - 4.0 * luma[1:-1, 1:-1]


def sharpness(image: Tensor) -> Tensor:
    """Return L_render = −(∇²R)², the mean over the picture. [h,w,3] -> []

    The printed −∇²R is signed, and its sum cancels except at the border of the picture.
    """
    return -laplacian(image.mean(dim=2)).square().mean()


def describe_loss(options: OptimizeOptions, perceptual: str) -> str:
    """Return a one-line description of L_PGS for log and report.

    Args:
        options: fully resolved, see `trainer.resolve.resolve_kind`
        perceptual: name of the distance in use
    """
    terms = ["L1"]
    if options.perceptual_weight:
        terms.append(f"{options.perceptual_weight:g} {perceptual}")
    terms.append(f"{PROGRESSIVE_WEIGHT:g} progressive ({EXPONENT}, {OVER})")
    terms.append(f"{SHARPNESS_WEIGHT:g} sharpness (paper)")
    return " + ".join(terms)


class PaperObjective:
    """Objective over whole pictures: L_PGS = L_edit + 5 L_prog + L_render, with L_edit = L1 + LPIPS.

    Args:
        perceptual: distance whose targets are cached until the stage ends
        weight: weight of the perceptual distance; 0 leaves it out
    """

    def __init__(self, perceptual: Perceptual, weight: float) -> None:
        self._perceptual = perceptual
        self._weight = weight

    def begin_stage(self) -> None:
        """Clear the cache, because the targets change."""
        self._perceptual.forget()

    def terms(self, moment: Moment) -> dict[str, Tensor]:
        """Return the weighted terms of this step. [] each"""
        terms = {"l1": l1(moment.image, moment.target)}
        if self._weight:
            distance = self._perceptual(moment.image, moment.target, moment.view)
            terms["perceptual"] = self._weight * distance
        change = progressive_change(moment.moved, moment.previous, moment.step, EXPONENT, OVER)
        terms["progressive"] = PROGRESSIVE_WEIGHT * change
        terms["sharpness"] = SHARPNESS_WEIGHT * sharpness(moment.image)
        return terms


@dataclass(frozen=True)
class RenderedLoss:
    """Loss of the network: L_GDF = L_pred + L_render. It implements `PictureLoss`.

    L_pred is L1 + LPIPS between the renders of Θ0 + GDF(s) and of the snapshot at s. L_render is −(∇²R)² of
    the former render.
    """

    __eq__ = equal_fields

    crops: Sequence[CropScene]  # the training views
    rows: Tensor  # raw values of the members before the edit, packed. [M,C]
    moving: Collection[str]  # attributes that the edit changes
    perceptual: Perceptual  # LPIPS or its substitute

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.crops)

    def __call__(self, found: Tensor, recorded: Tensor, view: int) -> Tensor:
        """See `PictureLoss`. [M,C], [M,C] -> []"""
        crop = self.crops[view]
        with torch.no_grad():
            expected = crop.render(self.rows + recorded, self.moving)
        image = crop.render(self.rows + found, self.moving)
        predicted = l1(image, expected) + self.perceptual(image, expected)
        return predicted + FIELD_SHARPNESS_WEIGHT * sharpness(image)
