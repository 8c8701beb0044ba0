"""Which field to ship: ranks by rendered error per byte, the fewest bytes that meet the target.

The trajectory is rendered once (docs/method.md 5). Numbers of different attributes cannot be compared, and an
error that no picture shows is none: so every attribute is straightened (its offset replaced by a_0(s) times
the full one), one at a time, at every snapshot, and the change in the pictures is one row of pixels per
attribute and snapshot. The inner products of these rows predict the error of any ranks; errors of several
attributes may add up or cancel. Ranks are grown on that prediction, and the pictures have the last word.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, Protocol

import torch
from torch import Tensor

from progdf.metrics.image import decibels

from .baked import BakedField, interpolate_at
from .keyframes import fit_keyframes, fit_lossless
from .separable import (
    AttributeTrajectory,
    channel_weights,
    check_trajectory,
    fit_amplitude,
    moving_attributes,
    principal_modes,
    store_attribute,
)

Kind = Literal["auto", "separable", "keyframes", "lossless"]

MOST_BYTES = 400.0
"""Bytes a member beyond which a separable field is not grown; nine keyframes of 14 numbers take 448."""

CLOSE = 0.02
"""Share of its bytes that may be saved in vain before the search for ranks goes on."""

SPARE = 1.0
"""Decibels above the target at which the search goes on all the same."""

KEYFRAMES = (2, 3, 4, 5, 6, 9, 12, 17)

SAMPLES = 13
"""Strengths at which errors are taken."""

Render = Callable[[Tensor], Tensor]
"""Offsets of the members -> the pixels that count, of some views side by side. [M,C] -> [P,3]"""

MOST_PIXELS = 40_000
"""Pixels kept of each render; of more, evenly spread ones."""

MOST_SNAPSHOTS = 40
"""Snapshots that are rendered; between two of them changes are taken to go straight."""

UNSEEN = 0.1
"""Say of the bare numbers beside the pictures, for members that these views do not show."""

Modes = Mapping[str, tuple[Tensor, Tensor]]
"""By attribute, as `separable.principal_modes` gives them."""


class Field(Protocol):
    """Anything that gives the offsets of its members at any strength, baked or not."""

    @property
    def attributes(self) -> Collection[str]:
        """Names of the attributes that move."""
        ...

    def offsets(self, s: float) -> Tensor:
        """Packed raw-space offsets. [M,C] float32"""
        ...


@dataclass(frozen=True)
class Candidate:
    """A field and its error against the trajectory."""

    field: BakedField  # the field
    curve: tuple[float, ...]  # PSNR at `sample_strengths()`, dB
    label: str  # what it is, e.g. "separable (means 2, sh0 3)"

    @property
    def worst(self) -> float:
        """Least PSNR over the slider, dB."""
        return min(self.curve)

    @property
    def mean(self) -> float:
        """Mean PSNR over the slider, dB."""
        return sum(self.curve) / len(self.curve)


def sample_strengths() -> tuple[float, ...]:
    """Strengths at which errors are taken: even, the ends left out where the error is 0 by construction."""
    return tuple((i + 1) / (SAMPLES + 1) for i in range(SAMPLES))


class FieldEvaluator:
    """Renders fields and compares them with the trajectory, whose pictures are made once.

    Args:
        strengths: of the snapshots. [T]
        offsets: [T,M,C]
        render: the pixels that count; held-out views are the honest choice
        truth: the offsets at any strength, [M,C]; None is straight from snapshot to snapshot
    """

    def __init__(
        self,
        strengths: Tensor,
        offsets: Tensor,
        render: Render,
        truth: Callable[[float], Tensor] | None = None,
    ) -> None:
        course = truth or (lambda s: interpolate_at(strengths, offsets, s))
        self._render = render
        self._nothing = torch.zeros_like(offsets[0])
        with torch.no_grad():
            self._expected = [render(course(s)) for s in sample_strengths()]

    def curve(self, field: Field) -> tuple[float, ...]:
        """PSNR at `sample_strengths()`, dB."""
        with torch.no_grad():
            return tuple(
                decibels(float((self._render(self._offsets(field, s)) - expected).double().square().mean()))
                for s, expected in zip(sample_strengths(), self._expected, strict=True)
            )

    def _offsets(self, field: Field, s: float) -> Tensor:
        # a field that moves nothing does not know how many members it has
        return field.offsets(s) if field.attributes else self._nothing

    def candidate(self, field: BakedField, label: str) -> Candidate:
        """The field with its error."""
        return Candidate(field, self.curve(field), label)


@dataclass(frozen=True)
class FieldChoice:
    """What was chosen and why."""

    best: Candidate  # the field
    met: bool  # whether it reaches what was asked of it: the target, or the budget where there is no target
    tried: tuple[Candidate, ...]  # everything that was looked at
    why: str = ""  # in words, as "the smallest of 6 that reach 40 dB"


def choose_field(
    strengths: Tensor,
    offsets: Tensor,
    render: Render,
    weights: Tensor | None = None,
    kind: Kind = "auto",
    target: float = 40.0,
    budget: float | None = None,
    evaluator: FieldEvaluator | None = None,
    recorded: Sequence[float] | None = None,
) -> FieldChoice:
    """The smallest field whose worst PSNR against the trajectory reaches the target, or the best in a budget.

    Args:
        strengths: of the snapshots, ascending from 0 to 1. [T]
        offsets: raw offsets of the members; the first row is 0, the last the recorded end. [T,M,C] float32
        render: of a few views and their interesting pixels; the ranks are chosen on it
        weights: how much an error of each number shows: visibility [M] or [M,C]; None is evenly
        kind: "auto" tries separable fields and the straight line; "keyframes" is the baseline, "lossless"
            every snapshot, whatever it takes
        target: least PSNR over the slider, dB; infinite asks for the best in the budget
        budget: most bytes a member; None is as many as it takes
        evaluator: decides in the end, best on views that `render` does not show; None decides by `render`
        recorded: strengths for the slider's ticks; `strengths` when None

    Returns:
        The choice; where nothing reaches the target within the budget, the best there is, with `met` false.

    Raises:
        ValueError: no trajectory, or weights that do not fit.
    """
    check_trajectory(strengths, offsets)
    evaluator = evaluator or FieldEvaluator(strengths, offsets, render)
    if kind == "lossless":
        everything = fit_lossless(strengths, offsets, recorded)
        candidate = evaluator.candidate(everything, f"all {len(strengths)} snapshots")
        fits = budget is None or everything.bytes_per_member <= budget
        met = fits and (not math.isfinite(target) or candidate.worst >= target)
        return FieldChoice(candidate, met, (candidate,), "nothing is left out")
    if kind == "keyframes":
        tried = _even_keyframes(strengths, offsets, target, budget, evaluator, recorded)
    else:
        spread = channel_weights(weights, offsets.shape[1], offsets.shape[2])
        seen = render_trajectories(offsets, spread, render)
        tried = _grow_fields(seen, strengths, target, budget, evaluator, recorded)
    if kind == "auto":  # the straight line takes fewest bytes, and may be all that the edit needs
        tried += _even_keyframes(strengths, offsets, -math.inf, budget, evaluator, recorded)
    return pick_candidate(tuple(tried), target, budget)


def pick_candidate(tried: tuple[Candidate, ...], target: float, budget: float | None) -> FieldChoice:
    """The smallest that reaches the target, else the best; of those that the budget allows, if any."""
    looked = f"{len(tried)} fields"
    allowed = [c for c in tried if budget is None or c.field.bytes_per_member <= budget]
    if not allowed:
        least = min(tried, key=lambda c: (c.field.bytes_per_member, -c.worst))
        return FieldChoice(least, False, tried, f"the smallest of {looked}; none fits into {budget:g} bytes")
    good = [c for c in allowed if c.worst >= target]
    within = "" if budget is None else f" within {budget:g} bytes"
    if good:
        best = min(good, key=lambda c: (c.field.bytes_per_member, -c.worst))
        return FieldChoice(best, True, tried, f"the smallest of {looked}{within} that reaches {target:g} dB")
    best = max(allowed, key=lambda c: (c.worst, -c.field.bytes_per_member))
    if math.isfinite(target):
        return FieldChoice(best, False, tried, f"the best of {looked}{within}; none reaches {target:g} dB")
    return FieldChoice(best, True, tried, f"the best of {looked}{within}")


def separable_within(
    seen: RenderedTrajectories,
    strengths: Tensor,
    budget: float,
    evaluator: FieldEvaluator,
    recorded: Sequence[float] | None = None,
) -> Candidate:
    """The separable field with the ranks expected to be best within `budget` bytes a member."""
    return _separable(seen, strengths, grow_ranks(seen, budget)[-1], evaluator, recorded)


def _grow_fields(
    seen: RenderedTrajectories,
    strengths: Tensor,
    target: float,
    budget: float | None,
    evaluator: FieldEvaluator,
    recorded: Sequence[float] | None,
) -> list[Candidate]:
    """Separable fields along the path of growing ranks, until one just meets the target."""
    path = grow_ranks(seen, budget or MOST_BYTES)
    expected = expected_worst(seen, path)
    widths = {name: trajectory.offsets.shape[2] for name, trajectory in seen.trajectories.items()}
    stored = [sum((4 + ranks[name]) * width for name, width in widths.items()) for ranks in path]
    tried: dict[int, Candidate] = {}

    def evaluate(i: int) -> Candidate:
        if i not in tried:
            tried[i] = _separable(seen, strengths, path[i], evaluator, recorded, target)
        return tried[i]

    # the prediction leads to the place, each look corrects it, until the smallest that holds is cornered
    low, high = -1, len(path)
    correction = 0.0
    while high - low > 1:
        likely = [i for i in range(low + 1, high) if expected[i] + correction >= target]
        i = likely[0] if likely else high - 1
        if high < len(path) and stored[high] - stored[i] <= CLOSE * stored[high]:
            if evaluate(high).worst < target + SPARE:
                break
            i = (low + high) // 2  # the prediction asks for too much
        candidate = evaluate(i)
        correction = candidate.worst - expected[i]
        low, high = (low, i) if candidate.worst >= target else (i, high)
    return list(tried.values())


def _separable(
    seen: RenderedTrajectories,
    strengths: Tensor,
    ranks: Mapping[str, int],
    evaluator: FieldEvaluator,
    recorded: Sequence[float] | None,
    enough: float = math.inf,
) -> Candidate:
    """The field of these ranks: pictures choose the bases or, short of `enough` dB, numbers if better.

    Pictures are the better guide but for parts that move far, where straightening an attribute changes more
    than a sum of effects can say.
    """
    ticks = tuple(strengths.tolist() if recorded is None else recorded)
    label = ", ".join(f"{name} {rank}" for name, rank in ranks.items() if rank) or "rank 0"
    candidates = []
    for modes in (
        emphasize_modes(seen, ranks),
        {n: principal_modes(c.gram) for n, c in seen.trajectories.items()},
    ):
        attributes = {
            name: store_attribute(trajectory, modes[name][0][:, : ranks[name]])
            for name, trajectory in seen.trajectories.items()
        }
        field = BakedField("separable", strengths.float(), attributes, seen.channels, ticks)
        candidates.append(evaluator.candidate(field, f"separable ({label})"))
        if candidates[-1].worst >= enough or not any(ranks.values()):
            break
    return max(candidates, key=lambda candidate: candidate.worst)


def _even_keyframes(
    strengths: Tensor,
    offsets: Tensor,
    target: float,
    budget: float | None,
    evaluator: FieldEvaluator,
    recorded: Sequence[float] | None,
) -> list[Candidate]:
    """Ever more keyframes at even strengths, until the target is met or the budget spent."""
    tried: list[Candidate] = []
    for count in (count for count in KEYFRAMES if count <= len(strengths)):
        field = fit_keyframes(strengths, offsets, count, recorded, torch.int8)
        if tried and (tried[-1].worst >= target or field.bytes_per_member > (budget or math.inf)):
            break
        tried.append(evaluator.candidate(field, f"{count} keyframes"))
    return tried


def grow_ranks(seen: RenderedTrajectories, most_bytes: float) -> list[dict[str, int]]:
    """Ranks from none upwards; each step adds the basis that takes most rendered error per byte."""
    widths = {name: trajectory.offsets.shape[2] for name, trajectory in seen.trajectories.items()}
    evenly = torch.ones(seen.gram.shape[1], dtype=torch.float64)
    modes = seen.modes(evenly)
    ranks = dict.fromkeys(seen.trajectories, 0)
    stored = 4.0 * sum(widths.values())
    path = [dict(ranks)]
    now = _hardness(seen.mse(modes, ranks))
    while now > 0:
        best: tuple[float, str, float] | None = None
        for name, width in widths.items():
            if ranks[name] >= modes[name][0].shape[1] or stored + width > most_bytes:
                continue
            then = _hardness(seen.mse(modes, {**ranks, name: ranks[name] + 1}))
            gain = math.log(now / max(then, 1e-30)) / width
            if best is None or gain > best[0]:
                best = (gain, name, then)
        if best is None or now < 1e-10:  # 100 dB
            break
        _, name, now = best
        ranks[name] += 1
        stored += widths[name]
        path.append(dict(ranks))
    return path


def _hardness(mse: Tensor) -> float:
    """Between mean and worst over the snapshots: the fourth-power mean, so that no step is in vain."""
    return float(mse.pow(4).mean().pow(0.25))


def emphasize_modes(seen: RenderedTrajectories, ranks: Mapping[str, int]) -> Modes:
    """Bases for these ranks, with snapshots of large error made to count more until the worst is least."""
    emphasis = torch.ones(seen.gram.shape[1], dtype=torch.float64)
    best = modes = seen.modes(emphasis)
    least = mse = seen.mse(modes, ranks)
    for _ in range(8):
        inner = mse[1:-1]
        if not bool((inner > 0).any()):
            break
        emphasis[1:-1] *= (inner / inner.mean()).clamp(min=1e-3).pow(0.5)
        emphasis = emphasis.clamp(1e-3, 1e3)
        modes = seen.modes(emphasis)
        mse = seen.mse(modes, ranks)
        if float(mse.max()) < float(least.max()):
            best, least = modes, mse
    return best


def expected_worst(seen: RenderedTrajectories, path: Sequence[Mapping[str, int]]) -> list[float]:
    """Least PSNR over the slider that each of these ranks should give at least, dB."""
    modes = seen.modes(torch.ones(seen.gram.shape[1], dtype=torch.float64))
    return [decibels(float(seen.mse(modes, ranks).max())) for ranks in path]


@dataclass(frozen=True)
class RenderedTrajectories:
    """What straightening each attribute changes in the pictures."""

    trajectories: Mapping[str, AttributeTrajectory]  # by attribute
    gram: Tensor  # inner products of these changes over pixels and colors. [A,T,A,T] float64
    values: int  # numbers that each inner product sums over
    channels: int  # width of a packed row

    def modes(self, emphasis: Tensor) -> Modes:
        """Each attribute's best bases, when the snapshots count as `emphasis` says. [T] float64, > 0"""
        modes = {}
        for i, (name, trajectory) in enumerate(self.trajectories.items()):
            seen = self.gram[i, :, i]
            parameters = float(trajectory.gram.diagonal().sum())
            share = UNSEEN * float(seen.diagonal().sum()) / parameters if parameters > 0 else 0.0
            modes[name] = principal_modes(seen + share * trajectory.gram, emphasis)
        return modes

    def mse(self, modes: Modes, ranks: Mapping[str, int]) -> Tensor:
        """Expected mean squared error of the pictures at each snapshot. [T] float64"""
        snapshots = self.gram.shape[1]
        remaining = torch.eye(snapshots, dtype=torch.float64).repeat(len(self.trajectories), 1, 1)
        for i, name in enumerate(self.trajectories):
            mix, table = (part[:, : ranks.get(name, 0)] for part in modes[name])
            remaining[i] -= table @ mix.T  # row t: what remains there, as a sum of the rows of pixels
        half = torch.einsum("ats,asbu->atbu", remaining, self.gram)
        return torch.einsum("atbu,btu->t", half, remaining).clamp(min=0) / self.values


def render_trajectories(offsets: Tensor, weights: Tensor, render: Render) -> RenderedTrajectories:
    """Straighten every attribute at every snapshot, and look.

    Args:
        offsets: [T,M,C] float32, the first row 0
        weights: how much an error of each number shows, ≥ 0. [M,C]
        render: called (1 + A)·(T − 2) times at most, where T counts no more than `MOST_SNAPSHOTS`
    """
    attributes = moving_attributes(offsets)
    trajectories = {
        name: fit_amplitude(offsets[:, :, columns], weights[:, columns])
        for name, columns in attributes.items()
    }
    snapshots = len(offsets)
    if not attributes or snapshots < 3:
        gram = torch.zeros(len(attributes), snapshots, len(attributes), snapshots, dtype=torch.float64)
        return RenderedTrajectories(trajectories, gram, 1, offsets.shape[2])
    looked = _rendered_snapshots(snapshots)
    changes: list[list[Tensor]] = [[] for _ in attributes]
    with torch.no_grad():
        for t in looked[1:-1]:
            pixels = render(offsets[t])
            stride = max(1, -(-len(pixels) // MOST_PIXELS))
            for i, (name, columns) in enumerate(attributes.items()):
                straight = offsets[t].clone()
                straight[:, columns] = trajectories[name].amplitude[t] * offsets[-1, :, columns]
                changes[i].append((pixels - render(straight))[::stride].flatten())
    still = torch.zeros_like(changes[0][0])
    spread = _interpolation_weights(looked, snapshots)
    rows = torch.cat([torch.stack([still, *pixel_rows, still]) for pixel_rows in changes])
    products = (rows @ rows.T).double().reshape(len(attributes), len(looked), len(attributes), len(looked))
    gram = torch.einsum("ts,asbu,vu->atbv", spread, products, spread)
    return RenderedTrajectories(trajectories, gram, max(1, rows.shape[1]), offsets.shape[2])


def _rendered_snapshots(snapshots: int) -> list[int]:
    """Snapshots that are rendered, even and both ends among them."""
    if snapshots <= MOST_SNAPSHOTS:
        return list(range(snapshots))
    return [round(i * (snapshots - 1) / (MOST_SNAPSHOTS - 1)) for i in range(MOST_SNAPSHOTS)]


def _interpolation_weights(looked: Sequence[int], snapshots: int) -> Tensor:
    """How much of each snapshot that is looked at every one holds. [T,L] float64"""
    shares = torch.zeros(snapshots, len(looked), dtype=torch.float64)
    shares[looked, range(len(looked))] = 1.0
    for column, (a, b) in enumerate(pairwise(looked)):
        inner = torch.arange(a + 1, b)
        share = (inner - a).double() / (b - a)
        shares[inner, column], shares[inner, column + 1] = 1.0 - share, share
    return shares


def rendered_importance(offsets: Tensor, render: Render, seed: int = 0) -> dict[str, float]:
    """How much an error of one spread in each attribute shows in pictures, half way; these add up to 1.

    Args:
        offsets: [T,M,C]
        render: pixels of some views
    """
    draws = torch.Generator().manual_seed(seed)
    middle = offsets[len(offsets) // 2].float()
    importance = {}
    with torch.no_grad():
        expected = render(middle)
        for name, columns in moving_attributes(offsets).items():
            spread = float(offsets[1:, :, columns].float().square().mean().sqrt())
            moved = middle.clone()
            moved[:, columns] += 0.1 * spread * torch.randn(moved[:, columns].shape, generator=draws)
            importance[name] = float((render(moved) - expected).square().mean()) if len(expected) else 1.0
    total = sum(importance.values())
    return {name: value / total if total > 0 else 1.0 / len(importance) for name, value in importance.items()}
