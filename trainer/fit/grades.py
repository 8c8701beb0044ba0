"""Packing of a color edit: the grade with the smallest residual that adds little to the edit's own error.

Packings of one solution differ by the rounding of their residuals. Where geometry stands still, a picture is
linear in the members' colors, apart from limits at black and white. So the changes of the picture by each
exact basis and by each rounded basis are enough to weigh a packing at every strength: as many pictures as
it has bases, instead of one for each strength. Nothing is baked or drawn until the choice is made. The chosen
grade is then drawn on all pixels, which also checks the linear estimate (docs/method.md 5).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from progdf.field import BakedField, Candidate, FieldChoice, FieldEvaluator
from progdf.field.baked import GradeForm, find_segment
from progdf.field.choose import pick_candidate, sample_strengths
from progdf.field.grade import (
    RESIDUAL_STEPS,
    ResidualBases,
    bake_grade,
    band_offsets,
    fit_grade,
    map_form,
    mapped_bands,
    member_bands,
    rank_limit,
)
from progdf.field.trajectory import Trajectory
from progdf.metrics.image import decibels
from progdf.system.equality import equal_fields
from progdf.threads import map_threads, one_thread
from trainer.options import FieldOptions
from trainer.store.memory import release_memory

from .evaluate import Evaluator, sample_members
from .fit import Fitted, field_evaluator, measure_choice


@dataclass(frozen=True)
class GradePacking:
    """Solution of a color edit, and the grades that store it."""

    __eq__ = equal_fields

    trajectory: Trajectory
    rows: Tensor  # raw values of the members before the edit, packed. [M,14+3K]
    weights: Tensor  # visibility of the members. [M]
    degree: int  # degree of the maps
    table: Tensor  # map at each knot. [S,K,3]
    mapped: Tensor  # change of the members' bands by the maps. [S,M,3B]
    course: Tensor  # residual of the lowest bands. [S,M,3b]
    bases: ResidualBases  # exact bases of the residual of all members
    among: Tensor | None = None  # these members among all; None: all. [M] int64

    def take(self, members: Tensor) -> GradePacking:
        """Return the solution for some members, whose grades have the bases of those of all. [m] int64"""
        return replace(
            self,
            trajectory=self.trajectory.take(members),
            rows=self.rows[members],
            weights=self.weights[members],
            mapped=self.mapped[:, members],
            course=self.course[:, members],
            among=members,
        )

    def fit(self, rank: int, index: int) -> GradeForm:
        """Return the grade with a number of bases, in steps of `RESIDUAL_STEPS[index]`."""
        exact, largest = self.bases.first(rank)
        if self.among is not None:
            exact = exact[:, self.among]
        return fit_grade(
            self.trajectory.s,
            self.degree,
            self.table,
            self.course,
            rank,
            self.weights,
            mask=self.trajectory.mask,
            coarser=RESIDUAL_STEPS[index],
            bases=(exact, largest),
        )

    def plain_field(self, form: GradeForm) -> UnbakedGrade:
        """Return the offsets of a grade of these members."""
        return UnbakedGrade(form, self.mapped, self.rows.shape[1])


@dataclass(frozen=True)
class UnbakedGrade:
    """Offsets of a grade from its map and its residual. The viewer evaluates the form of `bake_grade`."""

    __eq__ = equal_fields

    form: GradeForm
    mapped: Tensor  # change of the members' bands by the map at each knot. [S,M,3B]
    channels: int  # width of a packed row

    @property
    def attributes(self) -> tuple[str, ...]:
        """Attributes that may change, see `progdf.field.choose.Field`."""
        return ("sh0", "shN") if self.channels > 14 else ("sh0",)

    def offsets(self, s: float) -> Tensor:
        """Return packed raw-space offsets at a strength from 0 to 1. [M,C] float32"""
        form = self.form
        right, share = find_segment(form.knots, s)
        change = torch.lerp(self.mapped[right - 1], self.mapped[right], share)
        coefficients = torch.lerp(form.coefficients[right - 1], form.coefficients[right], share)
        width = form.residual.shape[2]
        for levels, scale, coefficient in zip(form.residual, form.scale, coefficients, strict=True):
            change[:, :width] += levels * (coefficient * scale)
        return band_offsets(change.view(len(change), -1, 3), self.channels)


def grade_packing(trajectory: Trajectory, rows: Tensor, weights: Tensor) -> GradePacking:
    """Split a trajectory into its maps and the residual of its members, see `fit_grades`."""
    degree, table = trajectory.map_course
    alone = replace(map_form(trajectory.s, degree, table, len(rows)), mask=trajectory.mask)
    mapped = mapped_bands(alone, rows)
    course = mapped[:, :, : 3 * trajectory.bands].neg()
    for i, residual in enumerate(course):
        residual += member_bands(trajectory.node(i))[:, : trajectory.bands].flatten(1)
    bases = ResidualBases.of(course, weights)
    return GradePacking(trajectory, rows, weights, degree, table, mapped, course, bases)


class PackingScale:
    """Weighs packings of one solution by the linear change of the evaluated pixels.

    Args:
        packing: the members of the views
        views: evaluated pixels, in which only colors change
        judge: limits, from the same views
    """

    def __init__(self, packing: GradePacking, views: Evaluator, judge: FieldEvaluator) -> None:
        self._packing = packing
        self._views = views
        self._judge = judge
        trajectory = packing.trajectory
        self._knots = trajectory.s
        self._stages = judge.stages
        self._pictures = [views.counted_pixels(trajectory.at(s)).flatten() for s in self._stages]
        finished = packing.rows + trajectory.end
        # a channel below black at the end hides its error
        self._shown = [crop.still_colors(finished) > 0.0 for crop in views.crops]
        self._course = self._changes(list(packing.course))

    def _changes(self, fields: Sequence[Tensor]) -> Tensor:
        """Return the change of the evaluated pixels by changes of the bands. [m,3b] each -> [R,3P]"""
        pixels = sum(int(pixels.sum()) for pixels in self._views.pixels)
        found = torch.zeros(len(fields), pixels, 3)

        def add(i: int) -> None:
            bands = fields[i].view(len(fields[i]), -1, 3)
            if bool(bands.any()):
                views = zip(self._views.crops, self._shown, strict=True)
                found[i] = self._views.count([crop.change(bands, shown) for crop, shown in views])

        map_threads(add, range(len(fields)))
        return found.flatten(1)

    def candidate(self, form: GradeForm) -> Candidate:
        """Return a grade, not baked, with its estimated error, see `FieldEvaluator.candidate`."""
        scaled = [levels * scale for levels, scale in zip(form.residual, form.scale, strict=True)]
        errors = form.coefficients @ self._changes(scaled) - self._course  # at the knots. [S,3P]
        products = (errors @ errors.T).double() / max(1, errors.shape[1])
        curve = list[float]()
        for s in sample_strengths():
            right, share = find_segment(self._knots, s)
            ends = torch.tensor([1.0 - share, share], dtype=torch.float64)
            curve.append(float(ends @ products[right - 1 : right + 1, right - 1 : right + 1] @ ends))
        to_views = list[float]()
        for s, picture in zip(self._stages, self._pictures, strict=True):
            right, share = find_segment(self._knots, s)
            shown = picture + torch.lerp(errors[right - 1], errors[right], share)
            to_views.append(self._judge.editor_error(s, shown.clamp_(0.0, 1.0).view(-1, 3)))
        excess, to_editor = self._judge.judge_errors(to_views)
        excess = max(excess, self._judge.path_excess(curve))
        ticks = tuple(form.knots.tolist())
        field = BakedField("grade", form.knots, {}, self._packing.rows.shape[1], ticks, form)
        return Candidate(field, tuple(map(decibels, curve)), form.label, excess, to_editor)


@one_thread()  # for thousands of small pictures, synchronizing torch's threads costs more than they save
def fit_grades(
    trajectory: Trajectory,
    rows: Tensor,
    choosing: Evaluator,
    reporting: Evaluator,
    weights: Tensor,
    options: FieldOptions,
) -> Fitted:
    """Fit the grade of a recorded map with the smallest residual that meets the target, see `fit_field`.

    The residual has the smallest sufficient number of bases or one more, quantized as coarsely as possible.
    Packings are weighed (`PackingScale`), in large regions on a sample (`sample_members`). The chosen grade
    is then drawn on all pixels of the choosing views, and stored in finer steps while it fails there.

    Args:
        trajectory: the recorded trajectory, with its maps
        rows: raw values of the members before the edit, packed. [M,14+3K]
        choosing, reporting, weights, options: see `fit_field`
    """
    packing = grade_packing(trajectory, rows, weights)
    choice, form = _choose_grade(packing, choosing, options)
    mapped = packing.mapped
    del packing  # baking needs as much memory as the residual and its bases
    release_memory()
    field = bake_grade(form, rows, mapped)
    del mapped
    choice = replace(choice, best=replace(choice.best, field=field))
    return measure_choice(choice, trajectory, reporting)


def _choose_grade(
    packing: GradePacking, choosing: Evaluator, options: FieldOptions
) -> tuple[FieldChoice, GradeForm]:
    """Return the choice of `fit_grades`, not baked, and its grade of all members."""
    trajectory = packing.trajectory
    members, sampled = sample_members(choosing)
    is_sample = len(members) < len(packing.rows)
    part = packing.take(members) if is_sample else packing
    judge = field_evaluator(part.trajectory, sampled, options)
    scale = PackingScale(part, sampled, judge)
    tried = list[Candidate]()
    steps = list[tuple[int, int]]()  # number of bases, and index of the step size, of each candidate
    smallest = math.inf

    def fails(rank: int, index: int = 0) -> bool:
        nonlocal smallest
        form = part.fit(rank, index)
        if form.bytes_per_member > smallest:
            return False
        candidate = scale.candidate(form)
        tried.append(candidate)
        steps.append((rank, index))
        smallest = min(smallest, math.inf if candidate.excess > 1.0 else form.bytes_per_member)
        return candidate.excess > 1.0

    limit = rank_limit(packing.course)
    low = 0
    fewest = 0
    while fails(fewest) and fewest < limit:
        low = fewest + 1
        fewest = min(2 * fewest + 1, limit)
    fewest = bisect_left(range(fewest), True, lo=low, key=lambda rank: not fails(rank))
    for rank in range(max(1, fewest), min(fewest + 1, limit) + 1):
        bisect_left(range(1, len(RESIDUAL_STEPS)), True, key=partial(fails, rank))
    choice = pick_candidate(tried, judge.wanted)
    rank, index = next(at for at, one in zip(steps, tried, strict=True) if one is choice.best)
    everything = field_evaluator(trajectory, choosing, options) if is_sample else judge
    choice = replace(choice, why=choice.why.replace(judge.wanted, everything.wanted))
    return check_on_all(choice, packing, rank, index, everything)


def check_on_all(
    choice: FieldChoice, packing: GradePacking, rank: int, index: int, evaluator: FieldEvaluator
) -> tuple[FieldChoice, GradeForm]:
    """Return a choice and its grade of all members, finer or with more bases while it fails on all pixels.

    Args:
        choice: the choice by weight
        packing: all members
        rank, index: number of bases and index of the step size of the chosen grade
        evaluator: all pixels of the choosing views
    """

    def measure() -> tuple[GradeForm, float, float | None]:
        form = packing.fit(rank, index)
        return form, *evaluator.added_excess(packing.plain_field(form))

    form, excess, to_editor = measure()
    limit = rank_limit(packing.course)
    while excess > 1.0 and choice.met and (index or rank < limit):
        if index:
            index = index - 1
        else:
            rank = rank + 1
        form, excess, to_editor = measure()
    best = replace(choice.best, label=form.label, excess=excess, to_editor=to_editor)
    return replace(choice, best=best, met=excess <= 1.0), form
