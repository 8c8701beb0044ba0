"""What the optimizer minimizes: L1, a perceptual term, and the clamp whose gradient is not lost.

L_edit of ProGDF (AAAI 2025, eq. 4) is L1 + LPIPS between render and edited view (weights: docs/method.md 3).
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from progdf.errors import ProgdfError
from progdf.metrics.lpips import Features, Lpips
from trainer.options import OptimizeOptions, Over, Sharpness

_LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601


def l1(image: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference. [h,w,3], [h,w,3] -> []"""
    return (image - target).abs().mean()


class Perceptual(Protocol):
    """A perceptual distance of images of range 0..1 that are at least 31 pixels each way."""

    @property
    def name(self) -> str:
        """As report.json names it."""
        ...

    def __call__(self, image: Tensor, target: Tensor, key: Hashable = None) -> Tensor:
        """[h,w,3], [h,w,3] -> []; what is computed of the target is kept under `key`, None keeps nothing."""
        ...

    def forget(self) -> None:
        """Drop what is kept of targets."""
        ...


class LpipsLoss:
    """LPIPS (Zhang et al. 2018); the targets' features are computed once per key, while they fit in memory.

    Args:
        network: see `Lpips.load`
        name: as report.json names it
        room: bytes that may be kept; a target of 256 pixels takes 2.5 MB
    """

    def __init__(self, network: Lpips, name: str = "lpips-alex", room: int = 1 << 30) -> None:
        self.name = name
        self._network = network
        self._room = room
        self._free = room
        self._kept: dict[Hashable, Features] = {}

    def __call__(self, image: Tensor, target: Tensor, key: Hashable = None) -> Tensor:
        """See `Perceptual`."""
        self._network = self._network.to(image.device)
        seen = self._kept.get(key) if key is not None else None
        if seen is None:
            with torch.no_grad():
                seen = self._network.features(target)
            size = sum(layer.numel() * layer.element_size() for layer in seen)
            if key is not None and size <= self._free:
                self._kept[key] = seen
                self._free -= size
        return self._network.distance(self._network.features(image), seen)

    def forget(self) -> None:
        """See `Perceptual`."""
        self._kept.clear()
        self._free = self._room


class GradientL1:
    """The stand-in where LPIPS weights are absent: L1 of the image gradients at full and half resolution."""

    name = "gradient-l1"

    def __call__(self, image: Tensor, target: Tensor, key: Hashable = None) -> Tensor:
        """See `Perceptual`."""
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
        """Nothing is kept."""


def perceptual_loss() -> tuple[Perceptual, str]:
    """LPIPS, or its stand-in and one line that says why and how to get the real one; "" where all is well."""
    try:
        return LpipsLoss(Lpips.load()), ""
    except ProgdfError as error:
        return GradientL1(), f"training with gradient L1 in place of LPIPS: {error}"


def progressive_change(
    moved: Tensor,
    previous: Tensor,
    step: int,
    grows: bool,
    over: Over = "mean",
    alpha: float = 0.05,
    beta: float = 1.1,
) -> Tensor:
    """The paper's progressive constraint (eq. 5): L_prog = α·β^(±t/50)·Σ‖ΔΘ‖², without its λ2. []

    ΔΘ is what the last step changed of a member's raw parameters. The paper does not say of which norm and of
    how many members: docs/experiments.md, The progressive constraint.

    Args:
        moved: offsets of the members. [M,C]
        previous: one step earlier. [M,C]
        step: t
        grows: the printed exponent +t/50, which allows ever shorter steps; else −t/50, which lets go of them
        over: the members: their mean, or their sum
        alpha, beta: of the paper
    """
    period = 50.0
    factor: float = alpha * beta ** ((step if grows else -step) / period)
    change = (moved - previous.detach()).square().sum()
    return factor * (change / len(moved) if over == "mean" else change)


def sharpness(
    image: Tensor, target: Tensor, form: Literal["hinge", "paper"], inside: Tensor | None = None
) -> Tensor:
    """The paper's L_render. []

    "paper" is −(∇²R)², the mean over the whole picture; of the printed −∇²R, signed, nothing is left but the
    rim. "hinge" asks for no more than the target has: max(0, S(target) − S(image)), S the mean of |∇²Y|
    inside the region, Y the luma.

    Args:
        image: the render. [h,w,3]
        target: what it should be. [h,w,3]
        form: see above
        inside: the pixels that count under "hinge"; None: all. [h,w] bool
    """
    if form == "paper":
        return -laplacian(image.mean(dim=2)).square().mean()
    weights = torch.ones_like(image[1:-1, 1:-1, 0]) if inside is None else inside[1:-1, 1:-1].to(image.dtype)
    count = weights.sum().clamp_min(1.0)

    def edges(picture: Tensor) -> Tensor:
        return (laplacian(picture @ picture.new_tensor(_LUMA)).abs() * weights).sum() / count

    return (edges(target) - edges(image)).clamp_min(0.0)


def laplacian(luma: Tensor) -> Tensor:
    """Sum of the four neighbors minus four times the pixel, where all four exist. [h,w] -> [h-2,w-2]"""
    around = luma[:-2, 1:-1] + luma[2:, 1:-1] + luma[1:-1, :-2] + luma[1:-1, 2:]
    return around - 4.0 * luma[1:-1, 1:-1]


def erode(mask: Tensor, by: int = 2) -> Tensor:
    """The mask without its rim of `by` pixels, beyond the picture counting as inside. [h,w] -> [h,w] bool"""
    outside = (mask <= 0.5).float()
    return max_pool2d(outside[None, None], 2 * by + 1, 1, by)[0, 0] < 0.5


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
    if options.solver == "colors":
        return "squared error, all views at once"
    terms = ["L1"]
    if options.perceptual_weight:
        often = f" every {options.perceptual_every} steps" if options.perceptual_every > 1 else ""
        terms.append(f"{options.perceptual_weight:g} {perceptual}{often}")
    if options.progressive in ("decay", "growth"):
        terms.append(
            f"{PROGRESSIVE_WEIGHT:g} progressive ({options.progressive}, {options.progressive_over})"
        )
    if options.sharpness in SHARPNESS_WEIGHT:
        terms.append(f"{SHARPNESS_WEIGHT[options.sharpness]:g} sharpness ({options.sharpness})")
    return " + ".join(terms)


@dataclass(frozen=True)
class Moment:
    """What one optimizer step looks at."""

    image: Tensor  # the render, differentiable. [h,w,3]
    target: Tensor  # what it should be. [h,w,3]
    view: int  # index of the training view
    step: int  # steps done before this one, over all stages
    local: int  # steps done before this one in its stage
    arrived: bool  # the target is the stage's own picture, no longer on the way to it
    moved: Tensor  # offsets of the members, differentiable. [M,C]
    previous: Tensor  # the offsets one step earlier, or the same tensor at the first step. [M,C]


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
                moment.moved, moment.previous, moment.step, grows, options.progressive_over
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
