"""Which field to ship: the smallest that adds at most a tenth of the error which the edit itself has.

Ends are stored in the smallest integers that serve, then ranks grow by rendered error per byte. For that the
trajectory is rendered once (docs/method.md 5). Numbers of different attributes cannot be compared, and an
error that no picture shows is none: so every attribute is straightened (its offset replaced by a_0(s) times
the full one), one at a time, at every snapshot, and the change in the pictures is one row of pixels per
attribute and snapshot. The inner products of these rows predict the error of any ranks; errors of several
attributes may add up or cancel. Ranks are grown on that prediction, and the pictures have the last word.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from statistics import fmean
from typing import Literal, Protocol

import torch
from torch import Tensor

from progdf.metrics.image import LEVEL, ROUNDING, decibels
from progdf.threads import map_threads

from .baked import END_TYPES, BakedField, interpolate_at
from .separable import (
    AttributeTrajectory,
    channel_weights,
    check_trajectory,
    decode_bases,
    fit_amplitude,
    fit_keyframes,
    moving_attributes,
    principal_modes,
    quantize_bases,
    store_attribute,
)

ADDED = 0.1
"""Share of the error that an edit has against its editor which its field may add."""


def allowed_error(own: float, added: float = ADDED) -> float:
    """What may be added to an edit's own error, mean square: this share of it, where it is less than 8 bits
    show as much as brings both there."""
    return (1.0 + added) * max(own, LEVEL) - own


SAMPLES = 13
"""Strengths at which errors are taken."""

Render = Callable[[Tensor], Tensor]
"""Offsets of the members -> the pixels that count, of some views side by side. [M,C] -> [P,3]"""

MAX_PIXELS = 40_000
"""Pixels kept of each render; of more, evenly spread ones."""

MAX_FITTED_SNAPSHOTS = 40
"""Snapshots that are rendered; between two of them changes are taken to go straight."""

UNSEEN = 0.1
"""Say of the bare numbers beside the pictures, for members that these views do not show."""

Ends = Mapping[str, tuple[Tensor, Tensor]]
"""By attribute, as `separable.quantize_bases` gives them; one that is not named is in float32."""


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
    label: str  # what it is, e.g. "separable (means int16 + 2, sh0 int8)"
    excess: float = 0.0  # its error as a multiple of what is allowed: up to 1 it serves
    to_editor: float | None = None  # PSNR to the editor's own pictures, all strengths together, dB

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
    """Renders fields and says whether they serve.

    Beside the editor's own pictures a field serves that adds at most `allowed_error` of what the trajectory
    has against them: where there are such pictures, all together, and at the finished edit alone; and on the
    way, against the trajectory, on the mean. Without them its worst PSNR against the trajectory decides.

    Args:
        strengths: of the snapshots. [T]
        offsets: [T,M,C]
        render: the pixels that count; held-out views are the honest choice
        truth: the offsets at any strength, [M,C]; None is straight from snapshot to snapshot
        edited: the same pixels of the editor's own pictures, by the strength on the slider, 1 the last
        target: least PSNR over the slider where there are no such pictures, dB
        added: share of the edit's error that may be added
    """

    def __init__(
        self,
        strengths: Tensor,
        offsets: Tensor,
        render: Render,
        truth: Callable[[float], Tensor] | None = None,
        edited: Mapping[float, Tensor] | None = None,
        target: float = 40.0,
        added: float = ADDED,
    ) -> None:
        course = truth or (lambda s: interpolate_at(strengths, offsets, s))
        self._render, self._rule, self._added = render, bool(edited), added
        self._nothing = torch.zeros(offsets.shape[1:])
        self._expected = self._pictures(course, sample_strengths())
        self._edited = edited or {1.0: self._pictures(course, [1.0])[0]}
        self._own = self._errors(course)
        self._allowed = allowed_error(fmean(self._own), added) if edited else 10 ** (-target / 10)
        own = decibels(fmean(self._own))
        tenth = f"adds at most a tenth to the edit's own error ({own:.1f} dB to the editor)"
        self.wanted = tenth if edited else f"reaches {target:g} dB"
        """What a field that serves does, in words."""

    def end_excess(self, end: Tensor) -> float:
        """The error of these offsets at strength 1 as a multiple of what is allowed there. [M,C]"""
        allowed = allowed_error(self._own[-1], self._added) if self._rule else self._allowed
        with torch.no_grad():
            added = _difference(self._render(end), self._edited[max(self._edited)]) + ROUNDING - self._own[-1]
        return added / allowed

    def candidate(self, field: Field, label: str) -> Candidate:
        """The field with its error."""
        assert isinstance(field, BakedField)
        curve = self._deviations(field)
        found = self._errors(lambda s: self._offsets(field, s))
        on_the_way = fmean(curve) if self._rule else max(curve)
        excess = max(fmean(found) - fmean(self._own), on_the_way) / self._allowed
        if self._rule:
            excess = max(excess, (found[-1] - self._own[-1]) / allowed_error(self._own[-1], self._added))
        to_editor = decibels(fmean(found)) if self._rule else None
        return Candidate(field, tuple(decibels(e) for e in curve), label, excess, to_editor)

    def curve(self, field: Field) -> tuple[float, ...]:
        """PSNR at `sample_strengths()`, dB."""
        return tuple(decibels(e) for e in self._deviations(field))

    def _deviations(self, field: Field) -> list[float]:
        pictures = self._pictures(partial(self._offsets, field), sample_strengths())
        return list(map(_difference, pictures, self._expected))

    def _errors(self, course: Callable[[float], Tensor]) -> list[float]:
        pictures = self._pictures(course, [*self._edited])
        return [ROUNDING + _difference(*pair) for pair in zip(pictures, self._edited.values(), strict=True)]

    def _pictures(self, course: Callable[[float], Tensor], strengths: Sequence[float]) -> list[Tensor]:
        """The pixels that count, each strength's on one thread."""

        @torch.no_grad()
        def render(s: float) -> Tensor:
            return self._render(course(s))

        return map_threads(render, strengths)

    def _offsets(self, field: Field, s: float) -> Tensor:
        # a field that moves nothing does not know how many members it has
        return field.offsets(s) if field.attributes else self._nothing


def _difference(a: Tensor, b: Tensor) -> float:
    return float((a - b).double().square().mean()) if len(a) else 0.0


@dataclass(frozen=True)
class FieldChoice:
    """What was chosen and why."""

    best: Candidate  # the field
    met: bool  # whether it serves
    tried: tuple[Candidate, ...]  # everything that was looked at
    why: str = ""  # in words, as "the smallest of 6 that reach 40 dB"


def choose_field(
    strengths: Tensor,
    offsets: Tensor,
    render: Render,
    weights: Tensor | None = None,
    kind: Literal["separable", "lossless"] = "separable",
    evaluator: FieldEvaluator | None = None,
) -> FieldChoice:
    """The smallest field that serves.

    Args:
        strengths: of the snapshots, ascending from 0 to 1. [T]
        offsets: raw offsets of the members; the first row is 0, the last the recorded end. [T,M,C] float32
        render: of a few views and their interesting pixels; the ranks are chosen on it
        weights: how much an error of each number shows: visibility [M] or [M,C]; None is evenly
        kind: "lossless" is every snapshot, whatever it takes
        evaluator: decides in the end, best on views that `render` does not show; None decides by `render`

    Returns:
        The choice; where nothing serves, the best there is, with `met` false.

    Raises:
        ValueError: no trajectory, or weights that do not fit.
    """
    check_trajectory(strengths, offsets)
    evaluator = evaluator or FieldEvaluator(strengths, offsets, render)
    if kind == "lossless":
        everything = fit_keyframes(strengths, offsets, len(strengths))
        candidate = evaluator.candidate(everything, f"all {len(strengths)} snapshots")
        return FieldChoice(candidate, candidate.excess <= 1.0, (candidate,), "nothing is left out")
    spread = channel_weights(weights, offsets.shape[1], offsets.shape[2])
    seen = render_trajectories(offsets, spread, render, store_ends(offsets, evaluator))
    return pick_candidate(_grow_fields(seen, strengths, evaluator), evaluator.wanted)


def pick_candidate(tried: Sequence[Candidate], wanted: str) -> FieldChoice:
    """The smallest that serves, else the best."""
    looked = f"{len(tried)} field{'s'[: len(tried) != 1]}"
    if good := [c for c in tried if c.excess <= 1.0]:
        best = min(good, key=lambda c: (c.field.bytes_per_member, c.excess))
        return FieldChoice(best, True, tuple(tried), f"the smallest of {looked} that {wanted}")
    best = min(tried, key=lambda c: c.excess)
    return FieldChoice(best, False, tuple(tried), f"the best of {looked}; none {wanted}")


def store_ends(offsets: Tensor, evaluator: FieldEvaluator) -> Ends:
    """Each attribute's end in integers: all in the smallest, then the one that shows most per byte in larger
    ones, until what they decode to serves. [T,M,C]
    """
    moving = moving_attributes(offsets)
    end = offsets[-1]
    kinds = {
        name: [quantize_bases(end[None, :, columns], kind) for kind in END_TYPES[:-1]]
        for name, columns in moving.items()
    }
    chosen = dict.fromkeys(moving, 0)

    def excess(chosen: Mapping[str, int]) -> float:
        stored = end.clone()
        for name, level in chosen.items():
            if level < len(kinds[name]):
                stored[:, moving[name]] = decode_bases(*kinds[name][level])[0]
        return evaluator.end_excess(stored)

    def size(chosen: Mapping[str, int]) -> int:
        return sum(END_TYPES[k].itemsize * (moving[n].stop - moving[n].start) for n, k in chosen.items())

    now = excess(chosen)
    while now > 1.0 and (
        larger := [{**chosen, name: k + 1} for name, k in chosen.items() if k + 1 < len(END_TYPES)]
    ):
        gains = [(now - excess(c)) / (size(c) - size(chosen)) for c in larger]
        chosen = larger[gains.index(max(gains))]
        now = excess(chosen)
    return {name: kinds[name][k] for name, k in chosen.items() if k < len(kinds[name])}


def _grow_fields(seen: RenderedTrajectories, strengths: Tensor, evaluator: FieldEvaluator) -> list[Candidate]:
    """Separable fields along the path of growing ranks, in ever longer steps until one serves and back by
    halves."""
    path, tried = grow_ranks(seen), dict[int, Candidate]()

    def serves(i: int) -> bool:
        if i not in tried:
            tried[i] = _separable(seen, strengths, path[i], evaluator)
        return tried[i].excess <= 1.0

    reach = 0
    last = len(path) - 1
    while not serves(reach) and reach < last:
        reach = min(2 * reach + 1, last)
    bisect_left(range(reach), True, lo=reach // 2, key=serves)
    return list(tried.values())


def _separable(
    seen: RenderedTrajectories, strengths: Tensor, ranks: Mapping[str, int], evaluator: FieldEvaluator
) -> Candidate:
    """The field of these ranks: pictures choose the bases or, where these do not serve, numbers if better.

    Pictures are the better guide but for parts that move far, where straightening an attribute changes more
    than a sum of effects can say.
    """
    candidates = []
    ticks = tuple(strengths.tolist())
    for modes in (seen.modes, {n: principal_modes(c.gram) for n, c in seen.trajectories.items()}):
        attributes = {
            name: store_attribute(trajectory, modes[name][:, : ranks[name]])
            for name, trajectory in seen.trajectories.items()
        }
        field = BakedField("separable", strengths.float(), attributes, seen.channels, ticks)
        stored = ", ".join(f"{name} {bases.label}" for name, bases in attributes.items())
        candidates.append(evaluator.candidate(field, f"separable ({stored or 'nothing moves'})"))
        if candidates[-1].excess <= 1.0 or not any(ranks.values()):
            break
    return min(candidates, key=lambda candidate: candidate.excess)


def grow_ranks(seen: RenderedTrajectories) -> list[dict[str, int]]:
    """Ranks from none upwards; each step adds the basis that takes most rendered error per byte."""
    widths = {name: trajectory.offsets.shape[2] for name, trajectory in seen.trajectories.items()}
    ranks = dict.fromkeys(seen.trajectories, 0)
    path = [dict(ranks)]
    now = float(seen.mse(ranks).mean())
    while now >= 1e-10 and (growing := [n for n in ranks if ranks[n] < seen.modes[n].shape[1]]):  # 100 dB
        then = {n: float(seen.mse({**ranks, n: ranks[n] + 1}).mean()) for n in growing}
        name = max(growing, key=lambda n: math.log(now / max(then[n], 1e-30)) / widths[n])
        ranks[name], now = ranks[name] + 1, then[name]
        path.append(dict(ranks))
    return path


@dataclass(frozen=True)
class RenderedTrajectories:
    """What straightening each attribute changes in the pictures."""

    trajectories: Mapping[str, AttributeTrajectory]  # by attribute
    gram: Tensor  # inner products of these changes over pixels and colors. [A,T,A,T] float64
    values: int  # numbers that each inner product sums over
    channels: int  # width of a packed row

    @cached_property
    def modes(self) -> Mapping[str, Tensor]:
        """Each attribute's best bases, as `separable.principal_modes` gives them."""
        modes = {}
        for i, (name, trajectory) in enumerate(self.trajectories.items()):
            seen = self.gram[i, :, i]
            parameters = float(trajectory.gram.diagonal().sum())
            share = UNSEEN * float(seen.diagonal().sum()) / parameters if parameters > 0 else 0.0
            modes[name] = principal_modes(seen + share * trajectory.gram)
        return modes

    def mse(self, ranks: Mapping[str, int]) -> Tensor:
        """Expected mean squared error of the pictures at each snapshot. [T] float64"""
        snapshots = self.gram.shape[1]
        remaining = torch.eye(snapshots, dtype=torch.float64).repeat(len(self.trajectories), 1, 1)
        for i, name in enumerate(self.trajectories):
            mix = self.modes[name][:, : ranks.get(name, 0)]
            remaining[i] -= mix @ mix.T  # row t: what remains there, as a sum of the rows of pixels
        half = torch.einsum("ats,asbu->atbu", remaining, self.gram)
        return torch.einsum("atbu,btu->t", half, remaining).clamp(min=0) / self.values


def render_trajectories(
    offsets: Tensor, weights: Tensor, render: Render, ends: Ends | None = None
) -> RenderedTrajectories:
    """Straighten every attribute at every snapshot, and look.

    Args:
        offsets: [T,M,C] float32, the first row 0
        weights: how much an error of each number shows, ≥ 0. [M,C]
        render: called (1 + A)·(T − 2) times at most, where T counts no more than `MAX_FITTED_SNAPSHOTS`
        ends: as they are stored; the last row of the offsets becomes what they decode to
    """
    attributes = moving_attributes(offsets)
    ends = ends or {}
    if ends:
        offsets = offsets.clone()
        for name, stored in ends.items():
            offsets[-1, :, attributes[name]] = decode_bases(*stored)[0]
    trajectories = {
        name: fit_amplitude(offsets[:, :, columns], weights[:, columns], ends.get(name))
        for name, columns in attributes.items()
    }
    snapshots = len(offsets)
    if not attributes or snapshots < 3:
        gram = torch.zeros(len(attributes), snapshots, len(attributes), snapshots, dtype=torch.float64)
        return RenderedTrajectories(trajectories, gram, 1, offsets.shape[2])
    count = min(snapshots, MAX_FITTED_SNAPSHOTS)
    looked = [round(i * (snapshots - 1) / (count - 1)) for i in range(count)]  # even, both ends among them
    changes: list[list[Tensor]] = [[] for _ in attributes]
    with torch.no_grad():
        for t in looked[1:-1]:
            pixels = render(offsets[t])
            stride = max(1, -(-len(pixels) // MAX_PIXELS))
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


def _interpolation_weights(looked: Sequence[int], snapshots: int) -> Tensor:
    """How much of each snapshot that is looked at every one holds. [T,L] float64"""
    shares = torch.zeros(snapshots, len(looked), dtype=torch.float64)
    shares[looked, range(len(looked))] = 1.0
    for column, (a, b) in enumerate(pairwise(looked)):
        inner = torch.arange(a + 1, b)
        share = (inner - a).double() / (b - a)
        shares[inner, column] = 1.0 - share
        shares[inner, column + 1] = share
    return shares
