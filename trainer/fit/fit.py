"""From a recorded trajectory to the field that is shipped, its errors beside those of honest baselines."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from progdf.field import BakedField, Candidate, FieldChoice, FieldEvaluator, choose_field
from progdf.field.baked import GradeForm, NeuralForm
from progdf.field.choose import ADDED, MAX_FITTED_SNAPSHOTS, SAMPLES, pick_candidate
from progdf.field.grade import (
    COARSER,
    bake_grade,
    fit_grade,
    map_form,
    mapped_bands,
    member_bands,
    rank_limit,
)
from progdf.field.separable import fit_keyframes, keyframe_rows, moving_attributes
from progdf.field.trajectory import Trajectory
from progdf.gaussians import BASE_CHANNELS, Gaussians, attribute_slices
from progdf.rasterize import alpha_weights
from progdf.threads import one_thread
from trainer.editors.base import ImageEditor
from trainer.optimize.retime import select_recordings
from trainer.options import FieldKind, FieldOptions
from trainer.setup import TrainingSetup
from trainer.store.progress import release_memory
from trainer.views.choose import split_held_out
from trainer.views.view import View

from .evaluate import Evaluator, make_evaluator

THINNED = 0.025
"""Of what a field may add, what is left to functions that single members do not have, see `thin_model`."""

_VIEWS = 3
_BETTER = 0.5  # dB by which the own way has to be nearer: it takes several times the bytes
_HALFWAY = (0.3, 0.4, 0.5, 0.6, 0.7)  # a way is judged where it comes nearest to the half


def choose_path(
    trajectory: Trajectory,
    setup: TrainingSetup,
    editor: ImageEditor | None,
    in_parts: bool,
    retimed: Callable[[Trajectory], Trajectory],
) -> tuple[Trajectory, str]:
    """The trajectory or its straight line, and why, in words.

    Args:
        trajectory: of one target, as recorded
        setup: scene, region, and the held-out views, of which those that fields are chosen on judge
        editor: what made the edited views; None where it pictures no half
        in_parts: connected parts were moved as wholes
        retimed: lays the slider over a trajectory; done only where its own way may be kept
    """
    if in_parts:
        return retimed(trajectory), "as the parts move"
    line = select_recordings(trajectory, [0, len(trajectory) - 1])
    if editor is None or editor.stages:
        return line, "straight: the editor pictures the end alone"
    trajectory = retimed(trajectory)
    views = split_held_out(setup.judging)[0][:_VIEWS]
    halves = {0.5: [editor.edit(view, 0.5) for view in views]}
    evaluator = make_evaluator(
        setup.scene, setup.region, views, halves, setup.background, trajectory.end.shape[1]
    )

    def nearest(way: Trajectory) -> float:
        return max(evaluator.psnr(evaluator.pictures(way.at(s)), evaluator.edited[0.5]) for s in _HALFWAY)

    ours = nearest(trajectory)
    direct = nearest(line)
    why = (
        f"the editor's half is met to {ours:.1f} dB by the recorded way, to {direct:.1f} dB by a straight one"
    )
    return (trajectory, f"as recorded: {why}") if ours >= direct + _BETTER else (line, f"straight: {why}")


BASELINES = (2, 4)
_PAYS = 0.1  # dB that an attribute must be worth to be stored


@dataclass(frozen=True)
class Fitted:
    """The chosen field and what it was chosen against."""

    # the field with its errors against the trajectory, on views that the choice has not seen
    chosen: Candidate
    choice: FieldChoice  # with the errors on the views that it was made on
    baselines: Mapping[str, Candidate]  # keyframe fields by name, on the same views as `chosen`


def fit_field(
    trajectory: Trajectory,
    seen: Evaluator,
    choosing: Evaluator,
    reporting: Evaluator,
    weights: Tensor,
    options: FieldOptions,
) -> Fitted:
    """The smallest field that serves, see `FieldEvaluator`, or where none does the best.

    Args:
        trajectory: what was recorded
        seen: training views, on which ranks are chosen
        choosing: held-out views, which have the last word on the choice
        reporting: other held-out views, on which the chosen field's errors are taken
        weights: how visible each member is. [M]
        options: which field
    """
    assert options.field != "neural"
    choice = choose_field(
        trajectory.s,
        trajectory.nodes,
        seen.counted_pixels,
        weights,
        "separable" if options.field == "auto" else options.field,
        field_evaluator(trajectory, choosing, options.target_psnr),
    )
    return _measure_choice(choice, trajectory, reporting)


@one_thread()  # thousands of small pictures: torch's threads wait for each other longer than they work
def fit_grades(
    trajectory: Trajectory,
    rows: Tensor,
    choosing: Evaluator,
    reporting: Evaluator,
    weights: Tensor,
    options: FieldOptions,
) -> Fitted:
    """The grade of a recorded map with the smallest residual beside it that serves, see `fit_field`: the
    fewest bases or one more, in levels as coarse as may be.

    Args:
        trajectory: what was recorded, with its maps
        rows: raw values of the members before the edit, packed. [M,14+3K]
        choosing, reporting, weights, options: see `fit_field`
    """
    degree, table = trajectory.map_course
    alone = replace(map_form(trajectory.s, degree, table, len(rows)), mask=trajectory.mask)
    mapped = mapped_bands(alone, rows)
    lowest = [member_bands(trajectory.node(i))[:, : trajectory.bands] for i in range(len(table))]
    course = torch.stack(lowest).flatten(2) - mapped[:, :, : 3 * trajectory.bands]
    evaluator = field_evaluator(trajectory, choosing, options.target_psnr)
    tried = list[Candidate]()
    smallest = math.inf

    def fails(rank: int, index: int = 0) -> bool:
        nonlocal smallest
        form = fit_grade(trajectory.s, degree, table, course, rank, weights, alone.mask, COARSER[index])
        if form.bytes_per_member > smallest:
            return False
        release_memory()
        field = bake_grade(form, rows, mapped)
        if index and evaluator.end_excess(field.offsets(1.0)) > 1.0:  # one look instead of twenty
            return True
        candidate = evaluator.candidate(field, form.label)
        tried.append(replace(candidate, field=replace(field, attributes={})))  # which are large
        smallest = min(smallest, math.inf if tried[-1].excess > 1.0 else form.bytes_per_member)
        return tried[-1].excess > 1.0

    limit = rank_limit(course)
    low = 0
    fewest = 0
    while fails(fewest) and fewest < limit:
        low = fewest + 1
        fewest = min(2 * fewest + 1, limit)
    fewest = bisect_left(range(fewest), True, lo=low, key=lambda rank: not fails(rank))
    for rank in range(max(1, fewest), min(fewest + 1, limit) + 1):
        bisect_left(range(1, len(COARSER)), True, key=partial(fails, rank))
    choice = pick_candidate(tried, evaluator.wanted)
    form = choice.best.field.origin
    assert isinstance(form, GradeForm)
    field = replace(choice.best.field, attributes=bake_grade(form, rows, mapped).attributes)
    return _measure_choice(replace(choice, best=replace(choice.best, field=field)), trajectory, reporting)


def field_evaluator(trajectory: Trajectory, views: Evaluator, target: float | None) -> FieldEvaluator:
    """What decides whether a field serves: the editor's own pictures of these views, at the strengths of
    which there are some; or a target in dB."""
    edited = {s: views.count(views.edited[e]) for s, e in trajectory.stage_strengths if e in views.edited}
    course = trajectory.s, trajectory.offsets, views.counted_pixels, trajectory.at
    if target is None:
        added = ADDED if trajectory.bands < 2 else ADDED - THINNED
        return FieldEvaluator(*course, edited=edited, added=added)
    return FieldEvaluator(*course, target=target)


def _measure_choice(choice: FieldChoice, trajectory: Trajectory, reporting: Evaluator) -> Fitted:
    """The choice with its errors, and baselines with theirs, on views that it has not seen."""
    release_memory()
    best = choice.best
    errors = FieldEvaluator(trajectory.s, trajectory.offsets, reporting.counted_pixels, trajectory.at)
    if best.to_editor is not None:
        choice = replace(choice, why=f"{choice.why}, with it {best.to_editor:.1f} dB")
    baselines = dict[str, Candidate]()
    for count in BASELINES:
        rows = keyframe_rows(trajectory.s, count)
        nodes = torch.stack([trajectory.node(i) for i in rows])
        field = fit_keyframes(trajectory.s[rows], nodes, count, trajectory.s.tolist())
        baselines[f"keyframes{count}"] = errors.candidate(field, f"{count} keyframes")
    return Fitted(errors.candidate(best.field, best.label), choice, baselines)


def expected_looks(trajectory: Trajectory, kind: FieldKind) -> int:
    """About how often `fit_field` looks at its views, for a progress bar."""
    snapshots = min(len(trajectory), MAX_FITTED_SNAPSHOTS)
    moving = len(moving_attributes(trajectory.offsets))
    looks = SAMPLES if kind == "lossless" else (1 + moving) * snapshots + 6 * SAMPLES
    return looks + SAMPLES * (3 + len(BASELINES))


def evaluate_field(
    trajectory: Trajectory, reporting: Evaluator, field: BakedField, target: float | None
) -> Fitted:
    """A field that is there already, a network's, beside the same baselines."""
    evaluator = field_evaluator(trajectory, reporting, target)
    network = evaluator.candidate(field, field.kind)
    why = f"a network was asked for{'; none' if network.excess > 1.0 else ' and'} {evaluator.wanted}"
    choice = FieldChoice(network, network.excess <= 1.0, (network,), why)
    return _measure_choice(choice, trajectory, reporting)


def field_figures(candidate: Candidate) -> dict[str, Any]:
    """A field's size and errors as report.json has them."""
    field = candidate.field
    return {
        "kind": field.kind,
        "bytes_per_gaussian": round(field.bytes_per_member, 1),
        "parameters": stored_numbers(field),
        "psnr_mean": round(candidate.mean, 2),
        "psnr_worst": round(candidate.worst, 2),
    }


def choice_figures(fitted: Fitted) -> dict[str, Any]:
    """What was tried and why the chosen field was, as report.json has it."""
    tried = [
        {
            "field": candidate.label,
            **field_figures(candidate),
            "psnr_to_editor": None if candidate.to_editor is None else round(candidate.to_editor, 2),
        }
        for candidate in fitted.choice.tried
    ]
    return {"chosen": fitted.chosen.label, "why": fitted.choice.why, "tried": tried}


def visibility(
    scene: Gaussians, members: Tensor, views: Sequence[View], looked: Callable[[], None] | None = None
) -> Tensor:
    """Blended weight of each member over the views, mean 1, never 0 so that no row is left to chance. [M]

    `scene`: the original, where rows are added with these as they are at strength 1.

    Members are weighted by it, numbers by nothing (docs/experiments.md, Separable fields).

    Members that no picture shows stay in the region: leaving them out saves 0 to 6 % of the bytes.
    """
    total = torch.zeros(len(members))
    for view in views:
        camera = view.camera
        everywhere = torch.ones_like(view.mask)
        total += alpha_weights(scene, camera, everywhere)[members, 2].float()
        if looked is not None:
            looked()
    return total / total.mean().clamp_min(1e-12) + 1e-3


def drop_idle_attributes(
    trajectory: Trajectory, evaluator: Evaluator, prunes: bool = True
) -> tuple[Trajectory, dict[str, float]]:
    """Take out the attributes whose movement does not show: worth less than 0.1 dB against the edited views,
    all that are taken out together.

    Args:
        trajectory: as recorded
        evaluator: held-out views
        prunes: whether anything is taken out that moves at all

    Returns:
        The trajectory (without the higher SH bands' columns if these go; that of a grade as it is), and what
        leaving out each attribute that moves would cost, dB.
    """
    offsets = trajectory.offsets
    end = trajectory.end
    costs: dict[str, float] = {}
    slices = attribute_slices(end.shape[1])
    target = evaluator.edited[1.0]
    now = complete = evaluator.psnr(evaluator.pictures(end), target)
    for name in ("shN", "quats", "log_scales", "means", "logit_opacities", "sh0"):
        if name not in slices or not bool(end[:, slices[name]].any()):
            continue
        tried = end.clone()
        tried[:, slices[name]] = 0.0
        then = evaluator.psnr(evaluator.pictures(tried), target)
        costs[name] = round(now - then, 3)
        if prunes and trajectory.maps is None and complete - then < _PAYS:
            now = then
            offsets = offsets.clone()
            offsets[:, :, slices[name]] = 0.0
            end = tried
    # a grade is of all bands that the scene has, whether or not its map moves them
    if trajectory.maps is None and "shN" in slices and not bool(end[:, slices["shN"]].any()):
        offsets = offsets[:, :, :BASE_CHANNELS].clone()
        end = end[:, :BASE_CHANNELS].clone()
    return replace(trajectory, offsets=offsets, end=end), costs


def stored_numbers(field: BakedField) -> int:
    """How many numbers the field holds for all members together, coefficients included; of a network, those
    that are learned and the recorded end."""
    form = field.origin
    if isinstance(form, NeuralForm):
        return form.network.parameters + form.network.end.numel()
    if isinstance(form, GradeForm):
        parts = (form.table, form.residual, form.scale, form.coefficients, form.mask)
        return sum(part.numel() for part in parts if part is not None)
    return sum(part.numel() for bases in field.attributes.values() for part in vars(bases).values())
