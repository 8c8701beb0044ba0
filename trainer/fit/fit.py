"""Fit of the shipped field to a recorded trajectory, and its errors beside those of baselines."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from progdf.field import BakedField, Candidate, FieldChoice, FieldEvaluator, choose_field
from progdf.field.baked import GradeForm, NeuralForm
from progdf.field.choose import MAX_FITTED_SNAPSHOTS, SAMPLES
from progdf.field.separable import fit_keyframes, keyframe_rows, moving_attributes
from progdf.field.trajectory import Trajectory
from progdf.gaussians import BASE_CHANNELS, Gaussians, attribute_slices, pack
from progdf.rasterize import alpha_weights
from trainer.editors.base import ImageEditor
from trainer.optimize.retime import select_recordings
from trainer.options import FieldKind, FieldOptions
from trainer.quality import QUALITIES
from trainer.store.memory import release_memory
from trainer.views.choose import split_held_out
from trainer.views.crops import only_recolors
from trainer.views.setup import TrainingSetup
from trainer.views.view import View

from .color_path import find_end_path
from .evaluate import Evaluator, make_evaluator

THINNING_SHARE = 0.25
"""Part of `QualityLimits.added_error` reserved for leaving out functions of members, see `thin_model`."""

_PATH_VIEWS = 3  # views on which a path is chosen
_PATH_GAIN_DB = 0.5  # a curved path must be better by this: it takes several times the bytes
# slider values at which a path is compared with the editor's picture at 0.5; the best one counts
_HALF_STRENGTHS = (0.3, 0.4, 0.5, 0.6, 0.7)


def choose_path(
    trajectory: Trajectory,
    setup: TrainingSetup,
    editor: ImageEditor | None,
    in_parts: bool,
    retimed: Callable[[Trajectory], Trajectory],
) -> tuple[Trajectory, str]:
    """Choose the trajectory, its straight line or a path by the colors; return it with the reason in words.

    Args:
        trajectory: the recorded trajectory of one target
        setup: scene, region, and held-out views; the views that fields are chosen on decide
        editor: the editor of the views; None if it makes no picture of strength 0.5
        in_parts: connected parts were moved rigidly
        retimed: returns a trajectory with its slider retimed; called only if the recorded path may be kept
    """
    if in_parts:
        return retimed(trajectory), "as the parts move"
    line = select_recordings(trajectory, [0, len(trajectory) - 1])
    if editor is None or editor.stages:
        members = setup.region.members
        rows = pack(setup.scene[members], with_shN=line.end.shape[1] > BASE_CHANNELS)
        path = find_end_path(line, rows, visibility(setup.scene, members, setup.train))
        return path.trajectory, path.reason
    trajectory = retimed(trajectory)
    views = split_held_out(setup.judging)[0][:_PATH_VIEWS]
    half_pictures = {0.5: [editor.edit(view, 0.5) for view in views]}
    evaluator = make_evaluator(
        setup.scene, setup.region, views, half_pictures, setup.background, trajectory.end.shape[1]
    )

    def nearest(way: Trajectory) -> float:
        return max(
            evaluator.psnr(evaluator.pictures(way.at(s)), evaluator.edited[0.5]) for s in _HALF_STRENGTHS
        )

    recorded_psnr = nearest(trajectory)
    straight_psnr = nearest(line)
    why = (
        f"PSNR to the editor's pictures at strength 0.5: recorded path {recorded_psnr:.1f} dB, "
        f"straight path {straight_psnr:.1f} dB"
    )
    if recorded_psnr >= straight_psnr + _PATH_GAIN_DB:
        return trajectory, f"as recorded: {why}"
    return line, f"straight: {why}"


BASELINES = (4,)  # numbers of keyframes of the stored baselines; `keyframes` holds the one of two
_MIN_ATTRIBUTE_GAIN_DB = 0.1  # an attribute that improves the edit by less is not stored


@dataclass(frozen=True)
class Fitted:
    """The chosen field, the candidates and the baselines."""

    # the field with its errors against the trajectory, on views not used for the choice
    chosen: Candidate
    choice: FieldChoice  # with the errors on the views used for the choice
    baselines: Mapping[str, Candidate]  # keyframe fields by name, on the same views as `chosen`


def fit_field(
    trajectory: Trajectory,
    seen: Evaluator,
    choosing: Evaluator,
    reporting: Evaluator,
    weights: Tensor,
    options: FieldOptions,
) -> Fitted:
    """Fit the smallest field that meets the target, see `FieldEvaluator`, or the best one if none does.

    Args:
        trajectory: the recorded trajectory
        seen: training views, on which ranks are chosen
        choosing: held-out views, which decide the choice
        reporting: other held-out views, on which the chosen field's errors are measured
        weights: visibility of each member. [M]
        options: kind and target of the field
    """
    assert options.field != "neural"
    choice = choose_field(
        trajectory.s,
        trajectory.nodes,
        seen.counted_pixels,
        weights,
        "separable" if options.field == "auto" else options.field,
        field_evaluator(trajectory, choosing, options),
    )
    return measure_choice(choice, trajectory, reporting)


def field_evaluator(trajectory: Trajectory, views: Evaluator, options: FieldOptions) -> FieldEvaluator:
    """Return an evaluator that tests a field against the editor's pictures of these views.

    The pictures are compared at every strength that has some. With `target_psnr`, the field is tested against
    the recordings instead.
    """
    edited = {s: views.count(views.edited[e]) for s, e in trajectory.stage_strengths if e in views.edited}
    course = trajectory.s, trajectory.offsets, views.counted_pixels, trajectory.at
    if options.target_psnr is not None:
        return FieldEvaluator(*course, target=options.target_psnr)
    added = QUALITIES[options.quality].added_error
    if trajectory.bands > 1:
        added *= 1.0 - THINNING_SHARE
    return FieldEvaluator(*course, edited=edited, added=added)


def measure_choice(choice: FieldChoice, trajectory: Trajectory, reporting: Evaluator) -> Fitted:
    """Measure the chosen field and the baselines on views not used for the choice."""
    release_memory()
    best = choice.best
    errors = FieldEvaluator(trajectory.s, trajectory.offsets, reporting.counted_pixels, trajectory.at)
    if best.to_editor is not None:
        choice = replace(choice, why=f"{choice.why}, with it {best.to_editor:.1f} dB")
    baselines = {
        name: errors.candidate(field, name.replace("keyframes", "") + " keyframes")
        for name, field in fit_baselines(trajectory).items()
    }
    return Fitted(errors.candidate(best.field, best.label), choice, baselines)


def fit_baselines(trajectory: Trajectory) -> dict[str, BakedField]:
    """Return the keyframe fields of `BASELINES` by name, on the trajectory's slider."""
    fields = dict[str, BakedField]()
    for count in BASELINES:
        rows = keyframe_rows(trajectory.s, count)
        nodes = torch.stack([trajectory.node(i) for i in rows])
        fields[f"keyframes{count}"] = fit_keyframes(trajectory.s[rows], nodes, count, trajectory.s.tolist())
    return fields


def expected_renders(trajectory: Trajectory, kind: FieldKind) -> int:
    """Return the approximate number of renders of all views by `fit_field`, for a progress bar."""
    snapshots = min(len(trajectory), MAX_FITTED_SNAPSHOTS)
    moving = len(moving_attributes(trajectory.offsets))
    fitting = SAMPLES if kind == "lossless" else (1 + moving) * snapshots + 6 * SAMPLES
    return fitting + SAMPLES * (3 + len(BASELINES))


def evaluate_field(
    trajectory: Trajectory, reporting: Evaluator, field: BakedField, options: FieldOptions
) -> Fitted:
    """Measure the field of a network beside the same baselines."""
    evaluator = field_evaluator(trajectory, reporting, options)
    network = evaluator.candidate(field, field.kind)
    why = f"a network was requested{'; none' if network.excess > 1.0 else ' and'} {evaluator.wanted}"
    choice = FieldChoice(network, network.excess <= 1.0, (network,), why)
    return measure_choice(choice, trajectory, reporting)


def field_figures(candidate: Candidate) -> dict[str, Any]:
    """Return a field's size and errors for report.json."""
    field = candidate.field
    return {
        "kind": field.kind,
        "bytes_per_gaussian": round(field.bytes_per_member, 1),
        "parameters": stored_numbers(field),
        "psnr_mean": round(candidate.mean, 2),
        "psnr_worst": round(candidate.worst, 2),
    }


def choice_figures(fitted: Fitted) -> dict[str, Any]:
    """Return the tried fields and the reason of the choice for report.json."""
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
    """Return the blending weight of each member, summed over the views and scaled to mean 1. [M]

    The weights are never 0, so that every row is determined. They weight members, not single values
    (docs/lab/experiments.md, Separable fields). Members not visible in any view stay in the region: leaving
    them out saves 0 to 6 % of the bytes.

    Args:
        scene: the original; if the edit adds rows, with these rows as they are at strength 1
        members: rows of the region in `scene`. [M] int64
        views: views to render
        looked: called after each view, for a progress bar
    """
    total = torch.zeros(len(members))
    for view in views:
        camera = view.camera
        everywhere = torch.ones_like(view.mask)
        total += alpha_weights(scene, camera, everywhere)[members, 2].float()
        if looked is not None:
            looked()
    return total / total.mean().clamp_min(1e-12) + 1e-3


def may_have_idle_attributes(trajectory: Trajectory) -> bool:
    """Return True if attributes could be dropped. A grade has none, nor has an edit of base colors only."""
    if trajectory.maps is not None:
        return False
    return not only_recolors(trajectory.offsets) or trajectory.end.shape[1] > BASE_CHANNELS


def drop_idle_attributes(
    trajectory: Trajectory, evaluator: Evaluator, prunes: bool = True
) -> tuple[Trajectory, dict[str, float]]:
    """Remove attributes whose change is not visible.

    All removed attributes together cost less than 0.1 dB against the edited views.

    Args:
        trajectory: the recorded trajectory
        evaluator: held-out views
        prunes: False only measures the costs

    Returns:
        The trajectory, without the columns of the higher SH bands if they do not move (a grade's stays
        unchanged), and the cost of leaving out each moving attribute, dB.
    """
    offsets = trajectory.offsets
    end = trajectory.end
    costs: dict[str, float] = {}
    slices = attribute_slices(end.shape[1])
    target = evaluator.edited[1.0]
    current_psnr = full_psnr = evaluator.psnr(evaluator.pictures(end), target)
    for name in ("shN", "quats", "log_scales", "means", "logit_opacities", "sh0"):
        if name not in slices or not bool(end[:, slices[name]].any()):
            continue
        tried = end.clone()
        tried[:, slices[name]] = 0.0
        psnr = evaluator.psnr(evaluator.pictures(tried), target)
        costs[name] = round(current_psnr - psnr, 3)
        if prunes and trajectory.maps is None and full_psnr - psnr < _MIN_ATTRIBUTE_GAIN_DB:
            current_psnr = psnr
            offsets = offsets.clone()
            offsets[:, :, slices[name]] = 0.0
            end = tried
    # a grade covers all bands of the scene, even those that its map does not move
    if trajectory.maps is None and "shN" in slices and not bool(end[:, slices["shN"]].any()):
        offsets = offsets[:, :, :BASE_CHANNELS].clone()
        end = end[:, :BASE_CHANNELS].clone()
    return replace(trajectory, offsets=offsets, end=end), costs


def stored_numbers(field: BakedField) -> int:
    """Return the count of values that a field stores for all members, coefficients included.

    For a network, these are the learned parameters and the recorded endpoint.
    """
    form = field.origin
    if isinstance(form, NeuralForm):
        return form.network.parameters + form.network.end.numel()
    if isinstance(form, GradeForm):
        parts = (form.table, form.residual, form.scale, form.coefficients, form.mask)
        return sum(part.numel() for part in parts if part is not None)
    return sum(part.numel() for bases in field.attributes.values() for part in vars(bases).values())
