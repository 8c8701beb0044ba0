"""Trained edit: edited views -> trajectory -> field -> .gdf and report, each saved to disk."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import torch

from progdf.field.trajectory import Trajectory
from progdf.io.cameras import save_cameras
from trainer.editors import editor_row
from trainer.fit.delivered import load_delivered
from trainer.fit.fit import choose_path, drop_idle_attributes, may_have_idle_attributes
from trainer.methods import METHODS
from trainer.optimize.growth import fade_in
from trainer.optimize.losses import Perceptual, perceptual_loss
from trainer.optimize.retime import smooth_course
from trainer.options import TrainOptions
from trainer.paper.network import PART as NETWORK
from trainer.report.agreement import measure_agreement
from trainer.resolve import recorded_options
from trainer.store.progress import RunLog
from trainer.store.run_folder import (
    RunFolder,
    remove_stale_views,
)
from trainer.views.setup import TrainingSetup
from trainer.views.view import BACKGROUND

from .edited_views import EditedViews
from .finish import (
    FULL_REPORT,
    RECORDED,
    ReportRequest,
    RunResult,
    end_rows,
    finish_run,
    load_evaluator,
    read_report,
    report_run,
)
from .record import RunRecord, load_recording, save_recording, write_finals
from .resume import picture_digests
from .training import optimize_members, retime_trajectory


def train_region(
    options: TrainOptions,
    setup: TrainingSetup,
    folder: RunFolder,
    log: RunLog,
    request: ReportRequest = FULL_REPORT,
) -> RunResult:
    """Edit the views, optimize the members, fit the field, and write the files of the run.

    Finished stages of the saved state are skipped, or repeated with the same bits.

    Args:
        options: resolved options
        setup: scene, region and original views
        folder: folder of the run
        log: log of the run
        request: extent of the report, and a callback at the delivery
    """
    perceptual, _ = perceptual_loss()
    views = EditedViews(options, setup, folder, log)
    with log.stage("edit"):
        views.prepare()
        edited = views.pictures
        # if more strengths may be requested, the boxes must not depend on which of them exist already
        strengths = (1.0,) if views.requests_strengths else edited
        train_edits = {s: edited[s][: len(setup.train)] for s in strengths}
        setup = METHODS[options.preset].box_views(setup, train_edits)
    if views.optimization.solver == "colors":  # small sums: torch's threads spun for 100 s on 16 cores
        torch.set_num_threads(1)
    recorded = folder.state.load(RECORDED)
    if recorded is None:
        _save_trajectory(options, setup, views, perceptual, folder, log)
    else:
        log.restore(recorded)
        log.say("the trajectory is recorded")
    del edited, train_edits, views  # the needed parts are read again from disk
    trajectory, record = load_recording(folder)
    setup = setup.keep_solved(record.effort)
    delivered = load_delivered(folder.state, setup.scene, trajectory)
    if delivered is None:
        begun = folder.state.load(NETWORK)
        result = finish_run(folder, setup, trajectory, record, perceptual, log, begun, request)
    else:
        log.say(f"{options.name} is ready; completing its report")
        request.on_delivery()
        result = RunResult(
            folder, folder.gdf(options.name), read_report(folder), delivered.shipped_trajectory
        )
        result = report_run(result, delivered, setup, record, perceptual, log, request.level)
    # only at the end, as a stopped run needs all views to resume
    save_cameras(folder.cameras, [view.camera for view in setup.views], setup.scene.origin)
    remove_stale_views(folder, [view.camera.name for view in setup.views])
    return result


def _save_trajectory(
    options: TrainOptions,
    setup: TrainingSetup,
    views: EditedViews,
    perceptual: Perceptual,
    folder: RunFolder,
    log: RunLog,
) -> None:
    """Measure the edited views, optimize the members, and save the trajectory and its final pictures."""
    with log.stage("agree"):
        agreement = _agreement(options, setup, views, folder, log)
    trajectory, outcome = _record(options, setup, views, perceptual, folder, log)
    record = RunRecord(
        recorded_options(options),
        options.scene.resolve(),
        [view.camera.name for view in setup.held_out],
        BACKGROUND,
        views.approach.kind,
        views.optimization.group_steps or 0,
        kind_trial=views.trial,
        agreement=agreement,
        up=setup.up.to_json() if setup.up is not None else None,
        pictures=picture_digests(options),
        lower="" if setup.lower is None else str(setup.lower.layers),
        **outcome,
    )
    save_recording(folder, setup.region, trajectory, record)
    setup = setup.keep_solved(record.effort)
    with log.stage("final"):
        grown = setup.extend(trajectory.added)
        finals = grown.scene.replace_rows(grown.region.members, end_rows(grown, trajectory))
        write_finals(setup, finals, folder, log)
    folder.state.save(RECORDED, {}, log.capture_state().values)


def _agreement(
    options: TrainOptions, setup: TrainingSetup, views: EditedViews, folder: RunFolder, log: RunLog
) -> dict[str, Any] | None:
    """Measure how well the edited views agree; None for editors that edit all views alike."""
    saved = folder.state.load("edited")
    shared = saved.values.get("shared", {}) if saved is not None else {}
    row = editor_row(options.editor)
    if views.approach.kind == "geometry" or not row.per_view:
        return shared or None
    edited = views.pictures
    count = len(setup.train)
    agreement = measure_agreement(setup, edited[1.0][:count], edited[1.0][count:] or edited[1.0])
    agreement = replace(agreement, contrast=shared.get("contrast", 1.0))
    log.say(agreement.line(row.remedy, setup.judged_on))
    return {**shared, **agreement.figures()}


def _record(
    options: TrainOptions,
    setup: TrainingSetup,
    views: EditedViews,
    perceptual: Perceptual,
    folder: RunFolder,
    log: RunLog,
) -> tuple[Trajectory, dict[str, Any]]:
    """Optimize, and return the trajectory on its slider and the figures for the run's record."""
    optimization = views.optimization
    method = METHODS[options.preset]
    objective = method.describe_loss(optimization, perceptual.name)
    log.say(f"loss: {objective}")
    if options.optimize.group_steps and optimization.kind != "geometry":
        log.say(f"--group-steps: without effect on this {optimization.kind} edit, whose loss is {objective}")
    with log.stage("optimize"):
        trajectory, losses, effort = optimize_members(
            options, optimization, setup, views.pictures, perceptual, folder.state, log, views.source
        )
    setup = setup.keep_solved(effort).extend(trajectory.added)
    with log.stage("retime"):
        trajectory = smooth_course(trajectory)
        costs: dict[str, float] = {}
        if may_have_idle_attributes(trajectory):
            choosing, _ = load_evaluator(folder, setup, setup.judging, trajectory).halves()
            trajectory, costs = drop_idle_attributes(trajectory, choosing, method.cleans)
        count = len(trajectory)
        reason = ""
        retimed = partial(
            retime_trajectory, setup=setup, slider=optimization.slider, cleans=method.cleans, log=log
        )
        has_one_target = len(trajectory.strengths) == 1
        if has_one_target and method.cleans and options.field.field != "neural":
            # external pictures may be gone by now and have no intermediate strengths; generative models
            # edited only strength 1
            row = editor_row(options.editor)
            painter = None if row.external or row.slow_strengths else views.editor
            moves_groups = bool(optimization.group_steps)
            trajectory, reason = choose_path(trajectory, setup, painter, moves_groups, retimed)
        else:
            trajectory = retimed(trajectory)
        trajectory = fade_in(trajectory)
    cost_text = f"; dB lost without each attribute: {costs}" if costs else ""
    if len(trajectory) <= count:
        log.say(f"kept {len(trajectory)} of {count} recordings{cost_text}")
    else:
        log.say(f"{len(trajectory)} recordings, {len(trajectory) - count} of them added{cost_text}")
    if reason:
        log.say(f"between original and edit: {reason}")
    return trajectory, {
        "objective": objective,
        "losses": losses,
        "effort": effort,
        "attribute_worth_db": costs,
    }
