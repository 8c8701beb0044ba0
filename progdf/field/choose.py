"""Which field to ship: ranks by rendered error per byte, kinds by the fewest bytes that meet the target
(method.md 5).

Nothing is fitted and rendered only to be thrown away: `rendered_courses` looks at the trajectory once,
ranks are grown on what that predicts, and the pictures have the last word.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from progdf.field.baked import BakedField
from progdf.field.keyframes import fit_keyframes
from progdf.field.ranks import decibels, emphasised_modes, expected_worst, grown_ranks
from progdf.field.rendered import Render, RenderedCourses, rendered_courses
from progdf.field.separable import channel_weights, check_trajectory, leading_modes, stored_attribute

Kind = Literal["auto", "separable", "keyframes"]

MOST_BYTES = 400.0
"""Bytes a member beyond which a separable field is not grown; nine keyframes of 14 numbers take 448."""

CLOSE = 0.02
"""Share of its bytes that may be saved in vain before the search for ranks goes on."""

KEYFRAMES = (2, 3, 4, 5, 6, 9, 12, 17)
SAMPLES = 25


@dataclass(frozen=True)
class Candidate:
    """A field and its error against the trajectory.

    Args:
        field: the field
        curve: PSNR at `sample_strengths()`, dB
        label: what it is, e.g. "separable (means 2, sh0 3)"
    """

    field: BakedField
    curve: tuple[float, ...]
    label: str

    @property
    def worst(self) -> float:
        """Least PSNR over the slider, dB."""
        return min(self.curve)

    @property
    def mean(self) -> float:
        """Mean PSNR over the slider, dB."""
        return sum(self.curve) / len(self.curve)


@dataclass(frozen=True)
class Choice:
    """What was chosen, whether it meets the target, and everything that was tried."""

    best: Candidate
    met: bool
    tried: tuple[Candidate, ...]


def sample_strengths() -> tuple[float, ...]:
    """Strengths at which errors are taken: even, the ends left out where the error is 0 by construction."""
    return tuple((i + 1) / (SAMPLES + 1) for i in range(SAMPLES))


class FieldJudge:
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
        course = truth or (lambda s: _between(strengths, offsets, s))
        self._render = render
        self._nothing = torch.zeros_like(offsets[0])
        with torch.no_grad():
            self._expected = [render(course(s)) for s in sample_strengths()]

    def curve(self, field: BakedField) -> tuple[float, ...]:
        """PSNR at `sample_strengths()`, dB."""
        with torch.no_grad():
            return tuple(
                decibels(float((self._render(self._offsets(field, s)) - expected).double().square().mean()))
                for s, expected in zip(sample_strengths(), self._expected, strict=True)
            )

    def _offsets(self, field: BakedField, s: float) -> Tensor:
        # a field that moves nothing does not know how many members it has
        return field.offsets(s) if field.attributes else self._nothing

    def candidate(self, field: BakedField, label: str) -> Candidate:
        """The field with its error."""
        return Candidate(field, self.curve(field), label)


def choose_field(
    strengths: Tensor,
    offsets: Tensor,
    render: Render,
    weights: Tensor | None = None,
    kind: Kind = "auto",
    target: float = 40.0,
    budget: float | None = None,
    judge: FieldJudge | None = None,
    recorded: Sequence[float] | None = None,
) -> Choice:
    """The smallest field whose worst PSNR against the trajectory reaches the target.

    Args:
        strengths: of the snapshots, ascending from 0 to 1. [T]
        offsets: raw offsets of the members; the first row is 0, the last the recorded end. [T,M,C] float32
        render: of a few views and their interesting pixels; the ranks are chosen on it
        weights: how much an error of each number shows: visibility [M] or [M,C]; None is evenly
        kind: "auto" tries both kinds
        target: least PSNR over the slider, dB
        budget: most bytes a member; None is as many as it takes
        judge: has the last word, best on views that `render` does not show; None judges on `render`
        recorded: strengths for the slider's ticks; `strengths` when None

    Returns:
        The choice; where nothing reaches the target within the budget, the best there is, with `met` false.

    Raises:
        ValueError: no trajectory, or weights that do not fit.
    """
    check_trajectory(strengths, offsets)
    judge = judge or FieldJudge(strengths, offsets, render)
    tried: list[Candidate] = []
    if kind in ("auto", "separable"):
        spread = channel_weights(weights, offsets.shape[1], offsets.shape[2])
        seen = rendered_courses(offsets, spread, render)
        tried += _grown(seen, strengths, target, budget, judge, recorded)
    if kind in ("auto", "keyframes"):
        limit = min([budget or math.inf, *(c.field.bytes_per_member for c in tried if c.worst >= target)])
        tried += _keyframes(strengths, offsets, target, limit, judge, recorded)
    allowed = [c for c in tried if budget is None or c.field.bytes_per_member <= budget] or tried[:1]
    good = [candidate for candidate in allowed if candidate.worst >= target]
    if good:
        return Choice(min(good, key=lambda c: (c.field.bytes_per_member, -c.worst)), True, tuple(tried))
    return Choice(max(allowed, key=lambda c: c.worst), False, tuple(tried))


def separable_within(
    seen: RenderedCourses,
    strengths: Tensor,
    budget: float,
    judge: FieldJudge,
    recorded: Sequence[float] | None = None,
) -> Candidate:
    """The separable field with the ranks expected to be best within `budget` bytes a member."""
    return _separable(seen, strengths, grown_ranks(seen, budget)[-1], judge, recorded)


def _grown(
    seen: RenderedCourses,
    strengths: Tensor,
    target: float,
    budget: float | None,
    judge: FieldJudge,
    recorded: Sequence[float] | None,
) -> list[Candidate]:
    """Separable fields along the path of growing ranks, until one just meets the target."""
    path = grown_ranks(seen, budget or MOST_BYTES)
    expected = expected_worst(seen, path)
    widths = {name: course.offsets.shape[2] for name, course in seen.courses.items()}
    stored = [sum((4 + ranks[name]) * width for name, width in widths.items()) for ranks in path]
    tried: dict[int, Candidate] = {}

    def look(i: int) -> Candidate:
        if i not in tried:
            tried[i] = _separable(seen, strengths, path[i], judge, recorded)
        return tried[i]

    # the prediction leads to the place, each look corrects it, until the smallest that holds is cornered
    low, high = -1, len(path)
    correction = 0.0
    while high - low > 1:
        if low >= 0 and high < len(path) and stored[high] - stored[low] <= CLOSE * stored[high]:
            break
        likely = [i for i in range(low + 1, high) if expected[i] + correction >= target]
        i = likely[0] if likely else high - 1
        found = look(i)
        correction = found.worst - expected[i]
        low, high = (low, i) if found.worst >= target else (i, high)
    return list(tried.values())


def _separable(
    seen: RenderedCourses,
    strengths: Tensor,
    ranks: Mapping[str, int],
    judge: FieldJudge,
    recorded: Sequence[float] | None,
) -> Candidate:
    """The field of these ranks: bases as pictures or as the bare numbers want them, whichever looks better.

    Pictures are the better guide but for parts that move far, where straightening an attribute changes more
    than a sum of effects can say.
    """
    ticks = tuple(strengths.tolist() if recorded is None else recorded)
    label = ", ".join(f"{name} {rank}" for name, rank in ranks.items() if rank) or "rank 0"
    found = []
    for modes in (emphasised_modes(seen, ranks), {n: leading_modes(c.gram) for n, c in seen.courses.items()}):
        attributes = {
            name: stored_attribute(course, modes[name][0][:, : ranks[name]])
            for name, course in seen.courses.items()
        }
        field = BakedField("separable", strengths.float(), attributes, seen.channels, ticks)
        found.append(judge.candidate(field, f"separable ({label})"))
        if not any(ranks.values()):
            break
    return max(found, key=lambda candidate: candidate.worst)


def _keyframes(
    strengths: Tensor,
    offsets: Tensor,
    target: float,
    most_bytes: float,
    judge: FieldJudge,
    recorded: Sequence[float] | None,
) -> list[Candidate]:
    """Keyframe fields, ever more, until one meets the target or is larger than what is known to."""
    tried: list[Candidate] = []
    for count in (n for n in KEYFRAMES if n <= len(strengths)):
        field = fit_keyframes(strengths, offsets, count, recorded, torch.int8)
        if tried and field.bytes_per_member > most_bytes:
            break
        tried.append(judge.candidate(field, f"{count} keyframes"))
        if tried[-1].worst >= target:
            break
    return tried


def _between(strengths: Tensor, offsets: Tensor, s: float) -> Tensor:
    """The trajectory at `s`, linear between snapshots. [M,C]"""
    right = int(
        torch.searchsorted(strengths, torch.tensor(s, dtype=strengths.dtype)).clamp(1, len(strengths) - 1)
    )
    low, high = float(strengths[right - 1]), float(strengths[right])
    return torch.lerp(offsets[right - 1], offsets[right], (s - low) / (high - low))
