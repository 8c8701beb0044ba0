"""Which field to ship: ranks by rendered error per byte, kinds by the fewest bytes that meet the target
(docs/method.md 5).

Nothing is fitted and rendered only to be thrown away: `render_trajectories` looks at the trajectory once,
ranks are grown on what that predicts, and the pictures have the last word.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from progdf.metrics.image import decibels

from .baked import BakedField
from .evaluate import Candidate, FieldEvaluator, sample_strengths
from .keyframes import Between, bending_snapshots, fit_keyframes, fit_lossless
from .rendered import Modes, Render, RenderedTrajectories, picture_gram, render_trajectories
from .separable import channel_weights, check_trajectory, moving_attributes, principal_modes, store_attribute

__all__ = [
    "Candidate",
    "FieldChoice",
    "FieldEvaluator",
    "Kind",
    "choose_field",
    "sample_strengths",
    "separable_within",
]

Kind = Literal["auto", "separable", "keyframes", "lossless"]

MOST_BYTES = 400.0
"""Bytes a member beyond which a separable field is not grown; nine keyframes of 14 numbers take 448."""

CLOSE = 0.02
"""Share of its bytes that may be saved in vain before the search for ranks goes on."""

SPARE = 1.0
"""Decibels above the target at which the search goes on all the same."""

KEYFRAMES = (2, 3, 4, 5, 6, 9, 12, 17)


@dataclass(frozen=True)
class FieldChoice:
    """What was chosen and why.

    Args:
        best: the field
        met: whether it reaches what was asked of it: the target, or the budget where there is no target
        tried: everything that was looked at
        why: in words, as "the smallest of 6 that reach 40 dB"
    """

    best: Candidate
    met: bool
    tried: tuple[Candidate, ...]
    why: str = ""


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
        kind: "auto" tries separable and keyframe fields; "lossless" is every snapshot, whatever it takes
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
    tried: list[Candidate] = []
    gram: Tensor | None = None
    if kind == "lossless":
        everything = fit_lossless(strengths, offsets, recorded)
        found = evaluator.candidate(everything, f"all {len(strengths)} snapshots")
        fits = budget is None or everything.bytes_per_member <= budget
        met = fits and (not math.isfinite(target) or found.worst >= target)
        return FieldChoice(found, met, (found,), "nothing is left out")
    if kind in ("auto", "separable"):
        spread = channel_weights(weights, offsets.shape[1], offsets.shape[2])
        seen = render_trajectories(offsets, spread, render)
        gram = seen.pictures
        tried += _grow_fields(seen, strengths, target, budget, evaluator, recorded)
    if kind in ("auto", "keyframes"):
        limit = min([budget or math.inf, *(c.field.bytes_per_member for c in tried if c.worst >= target)])
        gram = picture_gram(offsets, render) if gram is None else gram
        tried += _keyframes(
            strengths, offsets, gram, target, limit, evaluator, recorded, curves=kind != "auto"
        )
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
        found = evaluate(i)
        correction = found.worst - expected[i]
        low, high = (low, i) if found.worst >= target else (i, high)
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
    found = []
    for modes in (
        emphasize_modes(seen, ranks),
        {n: principal_modes(c.gram) for n, c in seen.trajectories.items()},
    ):
        attributes = {
            name: store_attribute(trajectory, modes[name][0][:, : ranks[name]])
            for name, trajectory in seen.trajectories.items()
        }
        field = BakedField("separable", strengths.float(), attributes, seen.channels, ticks)
        found.append(evaluator.candidate(field, f"separable ({label})"))
        if found[-1].worst >= enough or not any(ranks.values()):
            break
    return max(found, key=lambda candidate: candidate.worst)


def _keyframes(
    strengths: Tensor,
    offsets: Tensor,
    gram: Tensor,
    target: float,
    most_bytes: float,
    evaluator: FieldEvaluator,
    recorded: Sequence[float] | None,
    curves: bool,
) -> list[Candidate]:
    """Keyframe fields: ever more of them until the target is met, or from the most bytes down while it is."""
    width = sum(columns.stop - columns.start for columns in moving_attributes(offsets).values())
    counts = [count for count in KEYFRAMES if count <= len(strengths)]
    bounded = math.isfinite(most_bytes)
    if bounded:  # int8 beside the end in float32
        counts = [c for c in counts if (4 + c - 2) * width <= most_bytes][::-1] or counts[:1]
    tried: list[Candidate] = []
    for count in counts:
        kept = bending_snapshots(strengths, gram, count)
        forms: tuple[Between, ...] = ("linear", "cubic") if curves and count > 2 else ("linear",)
        here = [
            evaluator.candidate(
                fit_keyframes(strengths, offsets, count, recorded, torch.int8, kept, between),
                f"{count} keyframes" + (", cubic" if between == "cubic" else ""),
            )
            for between in forms
        ]
        tried += here
        if (max(c.worst for c in here) >= target) != bounded:
            break
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
