"""Loss terms of the descent view by view: L1 and a perceptual term.

L_edit of ProGDF (AAAI 2025, eq. 4) is L1 + LPIPS between render and edited view (weights: docs/method.md 3).
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from progdf.errors import ProgdfError
from progdf.metrics.lpips import Features, Lpips
from progdf.system.equality import equal_fields
from trainer.options import OptimizeOptions


def l1(image: Tensor, target: Tensor) -> Tensor:
    """Return the mean absolute difference. [h,w,3], [h,w,3] -> []"""
    return (image - target).abs().mean()


class Perceptual(Protocol):
    """Perceptual distance of images of range 0..1 with at least 31 pixels on each side."""

    @property
    def name(self) -> str:
        """Name in report.json."""
        ...

    def __call__(self, image: Tensor, target: Tensor, key: Hashable = None) -> Tensor:
        """Return the distance. [h,w,3], [h,w,3] -> []

        Features of the target are cached under `key`; None caches nothing.
        """
        ...

    def forget(self) -> None:
        """Clear the cache of targets."""
        ...


class LpipsLoss:
    """LPIPS (Zhang et al. 2018). Features of targets are cached per key while they fit in memory.

    Args:
        network: see `Lpips.load`
        name: name in report.json
        room: size of the cache in bytes; a target of 256 pixels takes 2.5 MB
    """

    def __init__(self, network: Lpips, name: str = "lpips-alex", room: int = 1 << 30) -> None:
        self.name = name
        self._network = network
        self._room = room
        self._free = room
        self._kept: dict[Hashable, Features] = {}

    def __call__(self, image: Tensor, target: Tensor, key: Hashable = None) -> Tensor:
        """See `Perceptual.__call__`."""
        self._network = self._network.to(image.device)
        features = self._kept.get(key) if key is not None else None
        if features is None:
            with torch.no_grad():
                features = self._network.features(target)
            size = sum(layer.numel() * layer.element_size() for layer in features)
            if key is not None and size <= self._free:
                self._kept[key] = features
                self._free -= size
        return self._network.distance(self._network.features(image), features)

    def forget(self) -> None:
        """See `Perceptual.forget`."""
        self._kept.clear()
        self._free = self._room


class GradientL1:
    """Substitute for missing LPIPS weights: L1 of the image gradients at full and half resolution."""

    name = "gradient-l1"

    def __call__(self, image: Tensor, target: Tensor, key: Hashable = None) -> Tensor:
        """See `Perceptual.__call__`."""
        a = image.permute(2, 0, 1)[None]
        b = target.permute(2, 0, 1)[None]
        total = image.new_zeros(())
        for _ in range(2):
            for axis in (2, 3):
                total = total + (a.diff(dim=axis) - b.diff(dim=axis)).abs().mean()
            a = avg_pool2d(a, 2)
            b = avg_pool2d(b, 2)
        return total

    def forget(self) -> None:
        """Do nothing; there is no cache."""


def perceptual_loss() -> tuple[Perceptual, str]:
    """Return LPIPS and "", or its substitute and one line with the reason and the remedy."""
    try:
        return LpipsLoss(Lpips.load()), ""
    except ProgdfError as error:
        return GradientL1(), f"training with gradient L1 in place of LPIPS: {error}"


Losses = Mapping[str, Sequence[float | None]]
"""Columns of equal length with one row per recording: "step", "left" and the mean of each term, or None.

A term is None in recordings whose steps did not compute it.
"""


PERCEPTUAL_EVERY = 2
"""Interval between evaluations of LPIPS, in steps."""


def describe_loss(options: OptimizeOptions, perceptual: str) -> str:
    """Return a one-line description of the loss for log and report.

    Args:
        options: fully resolved, see `trainer.resolve.resolve_kind`
        perceptual: name of the distance in use
    """
    if options.solver == "colors":
        return "squared error, all views at once"
    terms = ["L1"]
    if options.perceptual_weight:
        terms.append(f"{options.perceptual_weight:g} {perceptual} every {PERCEPTUAL_EVERY} steps")
    return " + ".join(terms)


@dataclass(frozen=True)
class Moment:
    """Inputs of the loss at one optimizer step."""

    __eq__ = equal_fields

    image: Tensor  # render, differentiable. [h,w,3]
    target: Tensor  # target picture. [h,w,3]
    view: int  # index of the training view
    step: int  # steps done before this one, over all stages
    local: int  # steps done before this one in its stage
    arrived: bool  # True once the target is the stage's own picture, no longer a blend
    moved: Tensor  # member offsets, differentiable. [M,C]
    previous: Tensor  # member offsets one step earlier, or the same tensor at the first step. [M,C]


class Objective:
    """Weighted terms of a step. Their sum is the loss.

    Args:
        perceptual: distance whose targets are cached until the stage ends
        options: terms and their weights relative to an L1 of 1, fully resolved
    """

    def __init__(self, perceptual: Perceptual, options: OptimizeOptions) -> None:
        self._options = options
        self._perceptual = perceptual

    def begin_stage(self) -> None:
        """Clear the cache, because the targets change."""
        self._perceptual.forget()

    def terms(self, moment: Moment) -> dict[str, Tensor]:
        """Return the weighted terms of this step. [] each"""
        options = self._options
        terms = {"l1": l1(moment.image, moment.target)}
        if options.perceptual_weight and moment.arrived and moment.local % PERCEPTUAL_EVERY == 0:
            distance = self._perceptual(moment.image, moment.target, moment.view)
            terms["perceptual"] = options.perceptual_weight * distance
        return terms


class TermMeans:
    """Mean of every term over the steps that computed it, since the last read."""

    def __init__(self) -> None:
        self.sums: dict[str, tuple[float, int]] = {}

    def add(self, terms: Mapping[str, float]) -> None:
        """Add the terms of one step."""
        for name, value in terms.items():
            total, count = self.sums.get(name, (0.0, 0))
            self.sums[name] = (total + value, count + 1)

    def read(self) -> dict[str, float]:
        """Return the means and reset."""
        means = {name: total / count for name, (total, count) in self.sums.items()}
        self.sums = {}
        return means


def loss_table(rows: Sequence[tuple[int, Mapping[str, float]]]) -> dict[str, list[float | None]]:
    """Return the recordings' means as columns, for report.json.

    Args:
        rows: (step, term → mean) of each recording
    """
    names = list(dict.fromkeys(name for _, means in rows for name in means))
    table: dict[str, list[float | None]] = {"step": [step for step, _ in rows]}
    for name in names:
        table[name] = [_five_digits(means.get(name)) for _, means in rows]
    return table


def total_loss(terms: Mapping[str, Tensor]) -> Tensor:
    """Return the sum of the terms. []"""
    return torch.stack(list(terms.values())).sum()


def _five_digits(value: float | None) -> float | None:
    """Round to five digits for report.json; None if not finite, as JSON has no such number."""
    return float(f"{value:.5g}") if value is not None and math.isfinite(value) else None
