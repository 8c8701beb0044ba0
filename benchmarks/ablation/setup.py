"""What all variants of an ablation share: the run's views and edited views, and who judges."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor

from progdf.gaussians import BASE_CHANNELS
from trainer.editors.base import EditKind
from trainer.fit.evaluate import Judge, make_judge
from trainer.fit.fit import visibility
from trainer.options import QUICK_STAGES, QUICK_STEPS, QUICK_VIEWS, TrainOptions
from trainer.pipeline.reopen import FinishedRun, its_views, options_of
from trainer.report.report import Columns, columns_of
from trainer.setup.training_setup import Pictures, Stand, widened
from trainer.store.run_folder import read_views
from trainer.views.view import View

from .variants import Variant

_T = TypeVar("_T")
_LAID_OVER = ("slider",)  # options that the optimisation does not depend on
_COMMAND = ("out", "scene", "threads", "resume", "save_every", "quick", "preset")  # nor anything else


@dataclass(frozen=True)
class Ground:
    """What all variants share.

    Args:
        run: the finished run
        options: its own, as a draft if asked for
        kind: what the edit moves
        stand: scene, region, views whose boxes hold the edit
        edited: strength → the edited training views, whole
        judge: held-out views with the editor's pictures of the shown columns
        columns: where on the run's slider the variants are shown, and what the editor was asked there
        seen: a few training views, on which the field's ranks are chosen
        weights: how visible each member is. [M]
        digest: of all of this but the options
    """

    run: FinishedRun
    options: TrainOptions
    kind: EditKind
    stand: Stand
    edited: Pictures
    judge: Judge
    columns: Columns
    seen: Judge
    weights: Tensor
    digest: str


def run_options(run: FinishedRun) -> TrainOptions:
    """The options of a finished run, with the group steps that it found out."""
    options = options_of(run.about)
    if options.group_steps is None:
        return replace(options, group_steps=run.about.get("group_steps"))
    return options


def make_ground(run: FinishedRun, options: TrainOptions, kind: EditKind, quick: bool) -> Ground:
    """The run's views and edited views; for a draft every so manieth of them.

    Args:
        run: the finished run
        options: its own
        kind: what the edit moves
        quick: a draft

    Raises:
        ProgdfError: an edited view is gone.
    """
    stand, strengths = its_views(run), run.trajectory.strengths
    options = replace(options, reedit_every=0)
    if quick:
        strengths = tuple(_thinned(strengths, QUICK_STAGES))
        train = _thinned(stand.train, max(2, QUICK_VIEWS - len(stand.held_out)))
        stand = replace(stand, train=train)
        options = replace(options, steps=min(options.steps, QUICK_STEPS), stages=len(strengths))
    edited = {s: _edited(run, stand.train, s) for s in strengths}
    stand = widened(stand, edited)
    columns = columns_of(run.trajectory.asked)
    shown = [strength for _, strength in columns[1:] if strength is not None]
    few = _thinned(stand.train, 4)
    channels = BASE_CHANNELS + 3 * run.scene.shN.shape[1]

    def judge(views: Sequence[View], pictures: Pictures) -> Judge:
        return make_judge(run.scene, run.region, views, pictures, stand.background, channels)

    drawn = {s: _edited(run, stand.held_out, s) for s in shown}
    digest = hashlib.sha256(run.region.members.numpy().tobytes())
    for pictures in (*edited.values(), *drawn.values()):
        for picture in pictures:
            digest.update(picture.numpy().tobytes())
    for view in (*stand.train, *stand.held_out):
        digest.update(view.image.numpy().tobytes())
    return Ground(
        run,
        options,
        kind,
        stand,
        edited,
        judge(stand.held_out, drawn),
        columns,
        judge(few, {1.0: _edited(run, few, 1.0)}),
        visibility(run.scene, run.region.members, stand.train),
        digest.hexdigest(),
    )


def digest_of(ground: Ground, variant: Variant, optimisation: bool = False) -> str:
    """Of all that decides a variant's figures, or of its optimisation alone."""
    without = (*_COMMAND, *_LAID_OVER) if optimisation else _COMMAND
    options = plain(replace(ground.options, **variant.changes))
    decides = {name: value for name, value in options.items() if name not in without}
    told = json.dumps([ground.digest, decides, variant.linear and not optimisation], sort_keys=True)
    return hashlib.sha256(told.encode()).hexdigest()


def plain(options: TrainOptions) -> dict[str, Any]:
    """The options as JSON values."""
    return {name: str(v) if isinstance(v, Path) else v for name, v in asdict(options).items()}


def _edited(run: FinishedRun, views: Sequence[View], strength: float) -> list[Tensor]:
    return read_views(run.folder, "edited", [view.camera.name for view in views], strength)


def _thinned(values: Sequence[_T], count: int) -> list[_T]:
    """At most `count` of them, evenly spread, the last among them."""
    count = min(count, len(values))
    return [values[round((i + 1) * len(values) / count) - 1] for i in range(count)]
