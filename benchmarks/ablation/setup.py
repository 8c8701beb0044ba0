"""What all variants of an ablation share: the run's views and edited views, and who judges."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

from torch import Tensor

from progdf.gaussians import BASE_CHANNELS
from progdf.io.json_values import plain
from trainer.editors import make_editor
from trainer.fit.evaluate import Evaluator, make_evaluator
from trainer.fit.fit import visibility
from trainer.options import EditKind, TrainOptions, with_values
from trainer.report.report import Columns, columns_of
from trainer.resolve import QUICK_STAGES, QUICK_STEPS, QUICK_VIEWS
from trainer.run.record import FinishedRun, render_run_views
from trainer.setup import (
    Pictures,
    TrainingSetup,
    confines_edit,
    editor_strengths,
    quantize_image,
    take_glances,
    widen_views,
)
from trainer.store.run_folder import read_views
from trainer.views.crops import only_recolors
from trainer.views.view import View

from .variants import Variant

_T = TypeVar("_T")


@dataclass(frozen=True)
class AblationSetup:
    """What all variants share."""

    run: FinishedRun  # the finished run
    plan: TrainOptions  # its own, as a draft if asked for
    kind: EditKind  # what the edit moves
    setup: TrainingSetup  # scene, region, views whose boxes hold the edit
    edited: Pictures  # strength → the edited training views, whole
    evaluator: Evaluator  # held-out views with the editor's pictures of the shown columns, for whatever moves
    # the same, and `seen`, for what moves nothing but colors, which they draw faster
    still: tuple[Evaluator, Evaluator]
    columns: Columns  # where on the run's slider the variants are shown, and what the editor was asked there
    seen: Evaluator  # a few training views, on which the field's ranks are chosen
    weights: Tensor  # how visible each member is. [M]
    digest: str  # of all of this but the plan

    def evaluators(self, offsets: Tensor) -> tuple[Evaluator, Evaluator]:
        """Held-out views and `seen`, for what moves as these do. [T,M,C]"""
        return self.still if only_recolors(offsets) else (self.evaluator, self.seen)


def run_plan(run: FinishedRun) -> TrainOptions:
    """The plan of a finished run, with the group steps that it found out."""
    plan = run.record.plan
    if plan.optimize.group_steps is not None:
        return plan
    return with_values(plan, group_steps=run.record.group_steps)


def make_ablation_setup(run: FinishedRun, plan: TrainOptions, kind: EditKind, quick: bool) -> AblationSetup:
    """The run's views and edited views; for a draft every so manieth of them.

    Args:
        run: the finished run
        plan: its own
        kind: what the edit moves
        quick: a draft

    Raises:
        ProgdfError: an edited view is gone.
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
    shown = [strength for _, strength in columns[1:] if strength is not None]
    few = _thin(setup.train, 4)
    channels = BASE_CHANNELS + 3 * run.scene.shN.shape[1]

    def evaluator(views: Sequence[View], pictures: Pictures, still: bool) -> Evaluator:
        return make_evaluator(run.scene, run.region, views, pictures, setup.background, channels, still)

    drawn = {s: _read_edited(run, setup.held_out, s) for s in shown}
    learned = {1.0: _read_edited(run, few, 1.0)}
    digest = hashlib.sha256(run.region.members.numpy().tobytes())
    for pictures in (*edited.values(), *drawn.values()):
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
        evaluator=evaluator(setup.held_out, drawn, False),
        still=(evaluator(setup.held_out, drawn, True), evaluator(few, learned, True)),
        columns=columns,
        seen=evaluator(few, learned, False),
        weights=visibility(run.scene, run.region.members, setup.train),
        digest=digest.hexdigest(),
    )


def edit_at_equal_strengths(shared: AblationSetup) -> Pictures:
    """The training views as the editor has them at as many strengths, these equally far apart."""
    return editor_pictures(shared.run, shared.setup.views, shared.setup.train, len(shared.edited))


def editor_pictures(
    run: FinishedRun, all_views: Sequence[View], views: Sequence[View], strengths: Sequence[float] | int
) -> Pictures:
    """What a run's editor makes of views.

    Args:
        run: the finished run
        all_views: its views
        views: these or others
        strengths: at which, or at how many, these equally far apart
    """
    options = replace(run.record.plan.editor, cache=run.folder.paintings)
    glances = partial(take_glances, run.record.plan.views, run.scene, run.region)
    editor = make_editor(options, run.scene, run.region, all_views, glances)
    is_confined = confines_edit(editor, run.record.kind)

    def picture(view: View, strength: float) -> Tensor:
        made = editor.edit(view, strength)
        return quantize_image(view.confine(made) if is_confined else made)

    if isinstance(strengths, int):
        strengths = editor_strengths(editor, strengths)
    return {strength: [picture(view, strength) for view in views] for strength in strengths}


def digest_of(shared: AblationSetup, variant: Variant, seed: int, optimization: bool = False) -> str:
    """Of all that decides a variant's figures, or of its optimization alone. `seed`: see `Variant.plan`"""
    decides = plain(variant.plan(shared.plan, seed))
    del decides["scene"]  # its pictures are in the setup's digest
    if optimization:
        del decides["optimize"]["slider"]
        if decides["field"]["field"] != "neural":
            del decides["field"]
    name = variant.trains_as if optimization else variant.name  # of which its patches are
    told = json.dumps([shared.digest, decides, name], sort_keys=True)
    return hashlib.sha256(told.encode()).hexdigest()


def _read_edited(run: FinishedRun, views: Sequence[View], strength: float) -> Sequence[Tensor]:
    return read_views(run.folder, "edited", [view.camera for view in views], strength)


def _thin(values: Sequence[_T], count: int) -> list[_T]:
    """At most `count` of them, evenly spread, the last among them."""
    count = min(count, len(values))
    return [values[round((i + 1) * len(values) / count) - 1] for i in range(count)]
