"""What an optimizer step is charged with, term by term: L1, perceptual, progressive, sharpness.

The sum is ProGDF's L_PGS = λ1 L_edit + λ2 L_prog + λ3 L_render (AAAI 2025), L_edit = L1 + LPIPS. Every term
has its own name, weight and switch: a run can tell what it paid for and an ablation can leave one out.
An objective keeps nothing that cannot be computed anew from the stage's pictures: a resumed run needs none
of its memory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from trainer.options import Norm, Progressive

from .losses import Perceptual, l1, progressive_change, sharpness

Sharpness = Literal["hinge", "paper", "off"]
Losses = Mapping[str, Sequence[float | None]]
"""Columns of equal length, a row per recording: "step", "left", and each term's mean; None where unpaid."""


@dataclass(frozen=True)
class LossWeights:
    """Which terms there are and what they weigh beside an L1 of 1.

    Args:
        perceptual: weight of the perceptual term; 0 leaves it out
        perceptual_every: it is paid for every so many steps, ≥ 1
        progressive: "decay" and "growth" charge for a step's length, see `losses.progressive_change`; the
            other two are no loss ("warmup" is a learning rate)
        progressive_weight: λ2
        sharpness: "hinge" or "paper", see `losses.sharpness`
        sharpness_weight: λ3
        progressive_norm: how a step's length is measured
    """

    perceptual: float = 0.1
    perceptual_every: int = 2
    progressive: Progressive = "off"
    progressive_weight: float = 5.0
    sharpness: Sharpness = "off"
    sharpness_weight: float = 1.0
    progressive_norm: Norm = "squares"

    def description(self, perceptual: str) -> str:
        """One line for log and report. `perceptual`: the name of the distance that is really used."""
        terms = ["L1"]
        if self.perceptual > 0:
            often = f" every {self.perceptual_every} steps" if self.perceptual_every > 1 else ""
            terms.append(f"{self.perceptual:g} {perceptual}{often}")
        if self.progressive in ("decay", "growth"):
            terms.append(
                f"{self.progressive_weight:g} progressive ({self.progressive}, {self.progressive_norm})"
            )
        if self.sharpness != "off":
            terms.append(f"{self.sharpness_weight:g} sharpness ({self.sharpness})")
        return " + ".join(terms)


@dataclass(frozen=True)
class Moment:
    """What one optimizer step looks at.

    Args:
        image: the render, differentiable. [h,w,3]
        target: what it should be. [h,w,3]
        view: index of the training view
        step: steps done before this one, over all stages
        local: steps done before this one in its stage
        arrived: the target is the stage's own picture, no longer on the way to it
        moved: offsets of the members, differentiable. [M,C]
        previous: the offsets one step earlier, or the same tensor at the first step. [M,C]
    """

    image: Tensor
    target: Tensor
    view: int
    step: int
    local: int
    arrived: bool
    moved: Tensor
    previous: Tensor


class Objective:
    """The weighted terms of a step; their sum is the loss.

    Args:
        perceptual: distance whose targets are kept until the stage ends
        weights: see `LossWeights`
        inside: where each training view's box shows the region without its rim; sharpness is measured
            there. Not needed where sharpness is off. [h,w] bool each
    """

    def __init__(
        self, perceptual: Perceptual, weights: LossWeights, inside: Sequence[Tensor] | None = None
    ) -> None:
        self.weights = weights
        self._perceptual = perceptual
        self._inside = inside

    def begin_stage(self) -> None:
        """The targets change now; what is kept of the old ones goes."""
        self._perceptual.forget()

    def terms(self, moment: Moment) -> dict[str, Tensor]:
        """The terms that this step pays for, weighted. [] each"""
        weights = self.weights
        terms = {"l1": l1(moment.image, moment.target)}
        if weights.perceptual > 0 and moment.arrived and moment.local % weights.perceptual_every == 0:
            distance = self._perceptual(moment.image, moment.target, moment.view)
            terms["perceptual"] = weights.perceptual * distance
        if weights.progressive in ("decay", "growth"):
            change = progressive_change(
                moment.moved,
                moment.previous,
                moment.step,
                weights.progressive == "growth",
                weights.progressive_norm,
            )
            terms["progressive"] = weights.progressive_weight * change
        if weights.sharpness != "off":
            inside = self._inside[moment.view] if self._inside is not None else None
            lost = sharpness(moment.image, moment.target, weights.sharpness, inside)
            terms["sharpness"] = weights.sharpness_weight * lost
        return terms


class TermMeans:
    """Mean of every term over the steps that paid for it, since the last reading."""

    def __init__(self) -> None:
        self.sums: dict[str, tuple[float, int]] = {}

    def add(self, terms: Mapping[str, float]) -> None:
        """One step."""
        for name, value in terms.items():
            total, count = self.sums.get(name, (0.0, 0))
            self.sums[name] = (total + value, count + 1)

    def read(self) -> dict[str, float]:
        """The means; what was added is forgotten."""
        means = {name: total / count for name, (total, count) in self.sums.items()}
        self.sums = {}
        return means


def loss_table(rows: Sequence[tuple[int, Mapping[str, float]]]) -> dict[str, list[float | None]]:
    """The recordings' means as columns, for report.json.

    Args:
        rows: (step, term → mean) of each recording
    """
    names = list(dict.fromkeys(name for _, means in rows for name in means))
    table: dict[str, list[float | None]] = {"step": [step for step, _ in rows]}
    for name in names:
        table[name] = [_five_digits(means.get(name)) for _, means in rows]
    return table


def total_loss(terms: Mapping[str, Tensor]) -> Tensor:
    """The loss. []"""
    return torch.stack(list(terms.values())).sum()


def _five_digits(value: float | None) -> float | None:
    """As report.json has it; what is not finite is no JSON."""
    return float(f"{value:.5g}") if value is not None and math.isfinite(value) else None
