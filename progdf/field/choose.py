"""Choice of the field to ship: the smallest that adds at most a tenth of the edit's own error.

The full offsets are stored in the smallest integers that are precise enough. Then ranks grow by rendered
error per byte. For that the trajectory is rendered once (docs/method.md 5).

Numbers of different attributes cannot be compared, and an error that is invisible in every picture does not
count. So every attribute is straightened (its offset replaced by a_0(s) times the full one), one at a time,
at every snapshot. The change in the pictures is one row of pixels per attribute and snapshot. The inner
products of these rows predict the error of any ranks. Errors of several attributes may add up or cancel. The
ranks grow by this prediction, and renders of the field decide.
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
from progdf.system.equality import equal_fields
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

MAX_ADDED_ERROR_SHARE = 0.1
"""Share of an edit's error against its editor that its field may add."""


def allowed_error(own: float, added: float = MAX_ADDED_ERROR_SHARE) -> float:
    """Return the mean squared error that a field may add to an edit's own error.

    An error of at least `LEVEL` may grow by the share `added`. A smaller error may grow to (1 + added) ·
    `LEVEL`, because 8 bits hardly show it.
    """
    return (1.0 + added) * max(own, LEVEL) - own


SAMPLES = 13
"""Number of strengths at which errors are measured."""

Render = Callable[[Tensor], Tensor]
"""Function from offsets of the members to the relevant pixels of some views, concatenated. [M,C] -> [P,3]"""

MAX_PIXELS = 40_000
"""Maximum number of pixels of each render that are used, evenly spaced."""

MAX_FITTED_SNAPSHOTS = 40
"""Maximum number of snapshots to render. Between two of them, changes are interpolated linearly."""

PARAMETER_ERROR_WEIGHT = 0.1
"""Weight of the parameter error relative to the rendered error, for members not visible in these views."""

Ends = Mapping[str, tuple[Tensor, Tensor]]
"""Attribute → stored full offset, see `separable.quantize_bases`.

An absent attribute is stored in float32.
"""


class Field(Protocol):
    """Source of the members' offsets at any strength, baked or not."""

    @property
    def attributes(self) -> Collection[str]:
        """Names of the attributes that change."""
        ...

    def offsets(self, s: float) -> Tensor:
        """Return packed raw-space offsets at strength `s`. [M,C] float32"""
        ...


@dataclass(frozen=True)
class Candidate:
    """Field and its error against the trajectory."""

    field: BakedField
    curve: tuple[float, ...]  # PSNR at `sample_strengths()`, dB
    label: str  # description, e.g. "separable (means int16 + 2, sh0 int8)"
    excess: float = 0.0  # error as a multiple of the allowed error; accepted up to 1
    to_editor: float | None = None  # PSNR to the editor's own pictures, over all strengths, dB

    @property
    def worst(self) -> float:
        """Smallest PSNR over the slider, dB."""
        return min(self.curve)

    @property
    def mean(self) -> float:
        """Mean PSNR over the slider, dB."""
        return sum(self.curve) / len(self.curve)


def sample_strengths() -> tuple[float, ...]:
    """Return the strengths at which errors are measured.

    They are evenly spaced, without the ends, where the error is 0 by construction.
    """
    return tuple((i + 1) / (SAMPLES + 1) for i in range(SAMPLES))


class FieldEvaluator:
    """Evaluator that renders fields and decides whether they are accepted.

    With the editor's own pictures, a field may add at most `allowed_error` to the trajectory's error against
    them. This limit applies to all pictures together and to the finished edit alone. The mean error against
    the trajectory over the slider must stay below this limit too. Without such pictures, the worst PSNR
    against the trajectory decides.

    Args:
        strengths: strengths of the snapshots. [T]
        offsets: offsets of the snapshots. [T,M,C]
        render: renders the relevant pixels; held-out views give an unbiased result
        truth: offsets at any strength, [M,C]; None interpolates linearly between snapshots
        edited: the same pixels in the editor's own pictures, by slider value, 1 last
        target: smallest PSNR over the slider if there are no such pictures, dB
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
        added: float = MAX_ADDED_ERROR_SHARE,
    ) -> None:
        self._truth_at = truth or (lambda s: interpolate_at(strengths, offsets, s))
        self._render = render
        self._has_edited = bool(edited)
        self._added = added
        self._zero_offsets = torch.zeros(offsets.shape[1:])
        self._edited = edited or {1.0: self._render_all(self._truth_at, [1.0])[0]}
        self._own_errors = self._editor_errors(self._truth_at)
        self._allowed = allowed_error(fmean(self._own_errors), added) if edited else 10 ** (-target / 10)
        own = decibels(fmean(self._own_errors))
        share = f"adds at most {100 * added:.3g} % to the edit's own error ({own:.1f} dB to the editor)"
        self.wanted = share if edited else f"reaches {target:g} dB"
        """Condition that accepted fields meet, in words."""

    @property
    def stages(self) -> tuple[float, ...]:
        """Slider values of the editor's pictures, ascending; without such pictures, 1 alone."""
        return tuple(self._edited)

    def editor_error(self, s: float, pixels: Tensor) -> float:
        """Return the mean squared error of pixels against the editor's picture at a stage. [P,3]"""
        return ROUNDING + _mse(pixels, self._edited[s])

    def judge_errors(self, errors: Sequence[float]) -> tuple[float, float | None]:
        """Return `excess` and `to_editor` of a candidate from its errors at `stages`.

        Without the editor's pictures, the excess is that at strength 1 against the trajectory.
        """
        excess = (fmean(errors) - fmean(self._own_errors)) / self._allowed
        if not self._has_edited:
            return excess, None
        end_allowed = allowed_error(self._own_errors[-1], self._added)
        return max(excess, (errors[-1] - self._own_errors[-1]) / end_allowed), decibels(fmean(errors))

    def path_excess(self, curve: Sequence[float]) -> float:
        """Return the error over the slider against the trajectory, as a multiple of the allowed error.

        Args:
            curve: mean squared error at `sample_strengths()`
        """
        return (fmean(curve) if self._has_edited else max(curve)) / self._allowed

    def end_excess(self, end: Tensor) -> float:
        """Return the error of offsets at strength 1, as a multiple of the allowed error there. [M,C]"""
        allowed = allowed_error(self._own_errors[-1], self._added) if self._has_edited else self._allowed
        with torch.no_grad():
            added = _mse(self._render(end), self._edited[max(self._edited)]) + ROUNDING - self._own_errors[-1]
        return added / allowed

    def candidate(self, field: Field, label: str) -> Candidate:
        """Return the field with its error."""
        assert isinstance(field, BakedField)
        curve = self._trajectory_errors(field)
        end_excess, to_editor = self._editor_excess(field)
        excess = max(end_excess, self.path_excess(curve))
        return Candidate(field, tuple(decibels(e) for e in curve), label, excess, to_editor)

    def added_excess(self, field: Field) -> tuple[float, float | None]:
        """Return `excess` and `to_editor` of a candidate from the editor's strengths alone, if it has some.

        The error against the trajectory, which hardly ever decides, takes several times as many renders.
        """
        excess, to_editor = self._editor_excess(field)
        if not self._has_edited:
            excess = max(excess, self.path_excess(self._trajectory_errors(field)))
        return excess, to_editor

    def _editor_excess(self, field: Field) -> tuple[float, float | None]:
        """Return the error that a field adds at `stages` and its PSNR there, see `judge_errors`."""
        return self.judge_errors(self._editor_errors(lambda s: self._offsets(field, s)))

    def curve(self, field: Field) -> tuple[float, ...]:
        """Return the PSNR at `sample_strengths()`, dB."""
        return tuple(decibels(e) for e in self._trajectory_errors(field))

    @cached_property
    def _expected_pictures(self) -> list[Tensor]:
        """Pixels of the trajectory at `sample_strengths()`. [P,3] each"""
        return self._render_all(self._truth_at, sample_strengths())

    def _trajectory_errors(self, field: Field) -> list[float]:
        pictures = self._render_all(partial(self._offsets, field), sample_strengths())
        return list(map(_mse, pictures, self._expected_pictures))

    def _editor_errors(self, course: Callable[[float], Tensor]) -> list[float]:
        pictures = self._render_all(course, self.stages)
        return [self.editor_error(s, picture) for s, picture in zip(self.stages, pictures, strict=True)]

    def _render_all(self, course: Callable[[float], Tensor], strengths: Sequence[float]) -> list[Tensor]:
        """Render the relevant pixels, each strength on one thread."""

        @torch.no_grad()
        def render(s: float) -> Tensor:
            return self._render(course(s))

        return map_threads(render, strengths)

    def _offsets(self, field: Field, s: float) -> Tensor:
        # a field without attributes does not know its number of members
        return field.offsets(s) if field.attributes else self._zero_offsets


def _mse(a: Tensor, b: Tensor) -> float:
    return float((a - b).double().square().mean()) if len(a) else 0.0


@dataclass(frozen=True)
class FieldChoice:
    """Chosen field and the reason for the choice."""

    best: Candidate  # the chosen field
    met: bool  # true if the field is accepted
    tried: tuple[Candidate, ...]  # all evaluated fields
    why: str = ""  # reason in words, as in "the smallest of 6 that reach 40 dB"


def choose_field(
    strengths: Tensor,
    offsets: Tensor,
    render: Render,
    weights: Tensor | None = None,
    kind: Literal["separable", "lossless"] = "separable",
    evaluator: FieldEvaluator | None = None,
) -> FieldChoice:
    """Return the smallest accepted field.

    Args:
        strengths: strengths of the snapshots, ascending from 0 to 1. [T]
        offsets: raw offsets of the members. The first row is 0, the last the recorded end. [T,M,C] float32
        render: renders the relevant pixels of a small number of views; ranks are chosen by it
        weights: importance of an error: visibility [M] or sensitivity [M,C]; None: uniform
        kind: "lossless" keeps every snapshot, whatever the size
        evaluator: makes the final decision, best on views that `render` does not include; None uses `render`

    Returns:
        The choice. If no field is accepted, the best one, with `met` false.

    Raises:
        ValueError: the trajectory is invalid, or the weights do not fit it.
    """
    check_trajectory(strengths, offsets)
    evaluator = evaluator or FieldEvaluator(strengths, offsets, render)
    if kind == "lossless":
        everything = fit_keyframes(strengths, offsets, len(strengths))
        candidate = evaluator.candidate(everything, f"all {len(strengths)} snapshots")
        return FieldChoice(candidate, candidate.excess <= 1.0, (candidate,), "lossless")
    spread = channel_weights(weights, offsets.shape[1], offsets.shape[2])
    seen = render_trajectories(offsets, spread, render, store_ends(offsets, evaluator))
    return pick_candidate(_grow_fields(seen, strengths, evaluator), evaluator.wanted)


def pick_candidate(tried: Sequence[Candidate], wanted: str) -> FieldChoice:
    """Return the smallest accepted field, or else the best."""
    fields = "1 field" if len(tried) == 1 else f"{len(tried)} fields"
    accepted = [candidate for candidate in tried if candidate.excess <= 1.0]
    if accepted:
        best = min(accepted, key=lambda c: (c.field.bytes_per_member, c.excess))
        return FieldChoice(best, True, tuple(tried), f"the smallest of {fields} that {wanted}")
    best = min(tried, key=lambda c: c.excess)
    return FieldChoice(best, False, tuple(tried), f"the best of {fields}; none {wanted}")


def store_ends(offsets: Tensor, evaluator: FieldEvaluator) -> Ends:
    """Quantize each attribute's full offset to integers. offsets: [T,M,C]

    All start in the smallest type. The attribute that gains most per byte gets the next larger type, until
    the decoded end is accepted.
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

    current = excess(chosen)
    while current > 1.0:
        larger = [{**chosen, name: k + 1} for name, k in chosen.items() if k + 1 < len(END_TYPES)]
        if not larger:
            break
        gains = [(current - excess(c)) / (size(c) - size(chosen)) for c in larger]
        chosen = larger[gains.index(max(gains))]
        current = excess(chosen)
    return {name: kinds[name][k] for name, k in chosen.items() if k < len(kinds[name])}


def _grow_fields(seen: RenderedTrajectories, strengths: Tensor, evaluator: FieldEvaluator) -> list[Candidate]:
    """Return separable fields along the path of growing ranks.

    The steps double until a field is accepted. A bisection then finds the smallest accepted one.
    """
    path = grow_ranks(seen)
    tried = dict[int, Candidate]()

    def is_accepted(i: int) -> bool:
        if i not in tried:
            tried[i] = _fit_ranks(seen, strengths, path[i], evaluator)
        return tried[i].excess <= 1.0

    reach = 0
    last = len(path) - 1
    while not is_accepted(reach) and reach < last:
        reach = min(2 * reach + 1, last)
    bisect_left(range(reach), True, lo=reach // 2, key=is_accepted)
    return list(tried.values())


def _fit_ranks(
    seen: RenderedTrajectories, strengths: Tensor, ranks: Mapping[str, int], evaluator: FieldEvaluator
) -> Candidate:
    """Return the field with these ranks.

    Rendered errors choose the bases. If that field is not accepted, bases chosen by parameter errors are
    tried too, and the better field is returned. Rendered errors are the better guide, except for parts that
    move far: there, straightening an attribute changes more than a sum of effects can express.
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
    """Return ranks from 0 upwards. Each step adds the basis that removes the most rendered error per byte."""
    widths = {name: trajectory.offsets.shape[2] for name, trajectory in seen.trajectories.items()}
    ranks = dict.fromkeys(seen.trajectories, 0)
    path = [dict(ranks)]
    error = float(seen.mse(ranks).mean())
    while error >= 1e-10:  # 100 dB
        growing = [n for n in ranks if ranks[n] < seen.modes[n].shape[1]]
        if not growing:
            break
        next_errors = {n: float(seen.mse({**ranks, n: ranks[n] + 1}).mean()) for n in growing}
        name = max(growing, key=lambda n: math.log(error / max(next_errors[n], 1e-30)) / widths[n])
        ranks[name] += 1
        error = next_errors[name]
        path.append(dict(ranks))
    return path


@dataclass(frozen=True)
class RenderedTrajectories:
    """Rendered effect of straightening each attribute."""

    __eq__ = equal_fields

    trajectories: Mapping[str, AttributeTrajectory]  # by attribute
    gram: Tensor  # inner products of the rendered changes over pixels and channels. [A,T,A,T] float64
    values: int  # number of values summed by each inner product
    channels: int  # width of a packed row

    @cached_property
    def modes(self) -> Mapping[str, Tensor]:
        """Best bases of each attribute, see `separable.principal_modes`."""
        modes = {}
        for i, (name, trajectory) in enumerate(self.trajectories.items()):
            seen = self.gram[i, :, i]
            parameters = float(trajectory.gram.diagonal().sum())
            share = (
                PARAMETER_ERROR_WEIGHT * float(seen.diagonal().sum()) / parameters if parameters > 0 else 0.0
            )
            modes[name] = principal_modes(seen + share * trajectory.gram)
        return modes

    def mse(self, ranks: Mapping[str, int]) -> Tensor:
        """Return the expected mean squared error of the renders at each snapshot. [T] float64"""
        snapshots = self.gram.shape[1]
        remaining = torch.eye(snapshots, dtype=torch.float64).repeat(len(self.trajectories), 1, 1)
        for i, name in enumerate(self.trajectories):
            mix = self.modes[name][:, : ranks.get(name, 0)]
            remaining[i] -= mix @ mix.T  # row t: the remainder at snapshot t, as a sum of the rows of pixels
        half = torch.einsum("ats,asbu->atbu", remaining, self.gram)
        return torch.einsum("atbu,btu->t", half, remaining).clamp(min=0) / self.values


def render_trajectories(
    offsets: Tensor, weights: Tensor, render: Render, ends: Ends | None = None
) -> RenderedTrajectories:
    """Straighten every attribute at every snapshot and render the change.

    Args:
        offsets: [T,M,C] float32, the first row 0
        weights: importance of an error in each number, ≥ 0. [M,C]
        render: called at most (1 + A)·(T − 2) times, where T is at most `MAX_FITTED_SNAPSHOTS`
        ends: stored full offsets; their decoded form replaces the last row of the offsets
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
    # evenly spaced, both ends included
    looked = [round(i * (snapshots - 1) / (count - 1)) for i in range(count)]
    changes: list[list[Tensor]] = [[] for _ in attributes]
    with torch.no_grad():
        for t in looked[1:-1]:
            pixels = render(offsets[t])
            stride = max(1, -(-len(pixels) // MAX_PIXELS))
            for i, (name, columns) in enumerate(attributes.items()):
                straightened = offsets[t].clone()
                straightened[:, columns] = trajectories[name].amplitude[t] * offsets[-1, :, columns]
                changes[i].append((pixels - render(straightened))[::stride].flatten())
    no_change = torch.zeros_like(changes[0][0])
    spread = _interpolation_weights(looked, snapshots)
    rows = torch.cat([torch.stack([no_change, *pixel_rows, no_change]) for pixel_rows in changes])
    products = (rows @ rows.T).double().reshape(len(attributes), len(looked), len(attributes), len(looked))
    gram = torch.einsum("ts,asbu,vu->atbv", spread, products, spread)
    return RenderedTrajectories(trajectories, gram, max(1, rows.shape[1]), offsets.shape[2])


def _interpolation_weights(looked: Sequence[int], snapshots: int) -> Tensor:
    """Return the weight of each rendered snapshot in every snapshot. [T,L] float64"""
    shares = torch.zeros(snapshots, len(looked), dtype=torch.float64)
    shares[looked, range(len(looked))] = 1.0
    for column, (a, b) in enumerate(pairwise(looked)):
        inner = torch.arange(a + 1, b)
        share = (inner - a).double() / (b - a)
        shares[inner, column] = 1.0 - share
        shares[inner, column + 1] = share
    return shares
