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

import torch
from torch import Tensor

from trainer.options import OptimizeOptions, Sharpness

from .losses import Perceptual, l1, progressive_change, sharpness

Losses = Mapping[str, Sequence[float | None]]
"""Columns of equal length, a row per recording: "step", "left", and each term's mean; None where unpaid."""


PROGRESSIVE_WEIGHT = 5.0
"""λ2 of the paper."""
SHARPNESS_WEIGHT: Mapping[Sharpness, float] = {"hinge": 0.1, "paper": 1.0}
"""λ3."""


def describe_loss(options: OptimizeOptions, perceptual: str) -> str:
    """What is minimized, in one line for log and report.

    Args:
        options: with nothing left open, see `trainer.resolve.resolve_kind`
        perceptual: the name of the distance that is really used
    """
    if options.solver == "pictures":
        return "squared error, all pictures at once, neighbors tied"
    if options.solver == "colors":
        return "squared error, all views at once"
    terms = ["L1"]
    if options.perceptual_weight:
        often = f" every {options.perceptual_every} steps" if options.perceptual_every > 1 else ""
        terms.append(f"{options.perceptual_weight:g} {perceptual}{often}")
    if options.progressive in ("decay", "growth"):
        terms.append(
            f"{PROGRESSIVE_WEIGHT:g} progressive ({options.progressive}, {options.progressive_norm})"
        )
    if options.sharpness in SHARPNESS_WEIGHT:
        terms.append(f"{SHARPNESS_WEIGHT[options.sharpness]:g} sharpness ({options.sharpness})")
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
        options: which terms there are, and what they weigh beside an L1 of 1; nothing is left open
        inside: where each training view's box shows the region without its rim; sharpness is measured
            there. Not needed where sharpness is off. [h,w] bool each
    """

    def __init__(
        self, perceptual: Perceptual, options: OptimizeOptions, inside: Sequence[Tensor] | None = None
    ) -> None:
        self._options = options
        self._perceptual = perceptual
        self._inside = inside

    def begin_stage(self) -> None:
        """The targets change now; what is kept of the old ones goes."""
        self._perceptual.forget()

    def terms(self, moment: Moment) -> dict[str, Tensor]:
        """The terms that this step pays for, weighted. [] each"""
        options = self._options
        terms = {"l1": l1(moment.image, moment.target)}
        if options.perceptual_weight and moment.arrived and moment.local % options.perceptual_every == 0:
            distance = self._perceptual(moment.image, moment.target, moment.view)
            terms["perceptual"] = options.perceptual_weight * distance
        if options.progressive in ("decay", "growth"):
            grows = options.progressive == "growth"
            change = progressive_change(
                moment.moved, moment.previous, moment.step, grows, options.progressive_norm
            )
            terms["progressive"] = PROGRESSIVE_WEIGHT * change
        if options.sharpness == "hinge" or options.sharpness == "paper":
            inside = self._inside[moment.view] if self._inside is not None else None
            lost = sharpness(moment.image, moment.target, options.sharpness, inside)
            terms["sharpness"] = SHARPNESS_WEIGHT[options.sharpness] * lost
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
