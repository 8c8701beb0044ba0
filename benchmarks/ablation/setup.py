"""Shared inputs of all variants of an ablation: the run's views, edited views and evaluators."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

from torch import Tensor

from progdf.gaussians import BASE_CHANNELS
from progdf.io.json_values import to_json
from trainer.editors import make_editor
from trainer.editors.base import confines_edit, editor_strengths
from trainer.fit.evaluate import Evaluator, make_evaluator
from trainer.fit.fit import visibility
from trainer.options import EditKind, TrainOptions, with_values
from trainer.report.report import Columns, columns_of
from trainer.resolve import QUICK_STAGES, QUICK_STEPS, QUICK_VIEWS
from trainer.run.record import FinishedRun, render_run_views
from trainer.store.run_folder import quantize_image, read_views
from trainer.views.boxes import Pictures, widen_views
from trainer.views.crops import only_recolors
from trainer.views.setup import TrainingSetup, render_thumbnails
from trainer.views.view import View

from .variants import Variant

_T = TypeVar("_T")


@dataclass(frozen=True)
class AblationSetup:
    """Shared inputs of all variants."""

    run: FinishedRun  # the finished run
    plan: TrainOptions  # the run's plan, reduced for a draft
    kind: EditKind  # attributes that the edit changes
    setup: TrainingSetup  # scene, region, views whose boxes contain the edit
    edited: Pictures  # strength → the edited training views, whole
    evaluator: Evaluator  # held-out views with the editor's pictures of `columns`, for any edit
    # `evaluator` and `seen` for edits of colors only, which render faster
    still: tuple[Evaluator, Evaluator]
    columns: Columns  # slider values of the drawn pictures, with the editor's strengths
    seen: Evaluator  # a small number of training views, on which the field's ranks are chosen
    weights: Tensor  # visibility of each member. [M]
    digest: str  # hash of all inputs except the plan

    def evaluators(self, offsets: Tensor) -> tuple[Evaluator, Evaluator]:
        """Return the evaluators of held-out views and of `seen` that suit these offsets. [T,M,C]"""
        return self.still if only_recolors(offsets) else (self.evaluator, self.seen)


def run_plan(run: FinishedRun) -> TrainOptions:
    """Return the plan of a finished run, with the group steps that it chose."""
    plan = run.record.plan
    if plan.optimize.group_steps is not None:
        return plan
    return with_values(plan, group_steps=run.record.group_steps)


def make_ablation_setup(run: FinishedRun, plan: TrainOptions, kind: EditKind, quick: bool) -> AblationSetup:
    """Load the run's views and edited views; for a draft, evenly spaced ones of them.

    Args:
        run: the finished run
        plan: its plan
        kind: attributes that the edit changes
        quick: make a draft

    Raises:
        ProgdfError: an edited view is missing.
    """
    setup = render_run_views(run)
    strengths = run.trajectory.strengths
    if quick:
        strengths = tuple(_thin(strengths, QUICK_STAGES))
        train = _thin(setup.train, max(2, QUICK_VIEWS - len(setup.held_out)))
        setup = replace(setup, train=train)
        plan = with_values(plan, steps=min(plan.optimize.steps, QUICK_STEPS), stages=len(strengths))
    edited = {s: _read_edited(run, setup.train, s) for s in strengths}
    setup = widen_views(setup, edited)
    columns = columns_of(run.trajectory.stage_strengths)
    column_strengths = [strength for _, strength in columns[1:] if strength is not None]
    rank_views = _thin(setup.train, 4)
    channels = BASE_CHANNELS + 3 * run.scene.shN.shape[1]

    def evaluator(views: Sequence[View], pictures: Pictures, still: bool) -> Evaluator:
        return make_evaluator(run.scene, run.region, views, pictures, setup.background, channels, still)

    held_out = {s: _read_edited(run, setup.held_out, s) for s in column_strengths}
    learned = {1.0: _read_edited(run, rank_views, 1.0)}
    digest = hashlib.sha256(run.region.members.numpy().tobytes())
    for pictures in (*edited.values(), *held_out.values()):
        for picture in pictures:
            digest.update(picture.numpy().tobytes())
    for view in (*setup.train, *setup.held_out):
        digest.update(view.image.numpy().tobytes())
    return AblationSetup(
        run=run,
        plan=plan,
        kind=kind,
        setup=setup,
        edited=edited,
        evaluator=evaluator(setup.held_out, held_out, False),
        still=(evaluator(setup.held_out, held_out, True), evaluator(rank_views, learned, True)),
        columns=columns,
        seen=evaluator(rank_views, learned, False),
        weights=visibility(run.scene, run.region.members, setup.train),
        digest=digest.hexdigest(),
    )


def edit_at_equal_strengths(shared: AblationSetup) -> Pictures:
    """Edit the training views at the same number of strengths, evenly spaced."""
    return editor_pictures(shared.run, shared.setup.views, shared.setup.train, len(shared.edited))


def editor_pictures(
    run: FinishedRun, all_views: Sequence[View], views: Sequence[View], strengths: Sequence[float] | int
) -> Pictures:
    """Edit views with a run's editor.

    Args:
        run: the finished run
        all_views: its views
        views: views to edit, from the run or others
        strengths: the strengths, or the number of evenly spaced ones
    """
    options = replace(run.record.plan.editor, cache=run.folder.paintings)
    glances = partial(render_thumbnails, run.record.plan.views, run.scene, run.region)
    editor = make_editor(options, run.scene, run.region, all_views, glances)
    is_confined = confines_edit(editor, run.record.kind)

    def picture(view: View, strength: float) -> Tensor:
        edited = editor.edit(view, strength)
        return quantize_image(view.confine(edited) if is_confined else edited)

    if isinstance(strengths, int):
        strengths = editor_strengths(editor, strengths)
    return {strength: [picture(view, strength) for view in views] for strength in strengths}


def digest_of(shared: AblationSetup, variant: Variant, seed: int, optimization: bool = False) -> str:
    """Hash the inputs of a variant's figures, or of its optimization only. `seed`: see `Variant.plan`"""
    inputs = to_json(variant.plan(shared.plan, seed))
    del inputs["scene"]  # its renders are in the setup's digest
    if optimization:
        del inputs["optimize"]["slider"]
        if inputs["field"]["field"] != "neural":
            del inputs["field"]
    name = variant.trains_as if optimization else variant.name  # the name stands for its patches
    text = json.dumps([shared.digest, inputs, name], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _read_edited(run: FinishedRun, views: Sequence[View], strength: float) -> Sequence[Tensor]:
    return read_views(run.folder, "edited", [view.camera for view in views], strength)


def _thin(values: Sequence[_T], count: int) -> list[_T]:
    """Return at most `count` of the values, evenly spread, including the last."""
    count = min(count, len(values))
    return [values[round((i + 1) * len(values) / count) - 1] for i in range(count)]
