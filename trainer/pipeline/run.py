"""The whole job: scene → views → edited views → trajectory → field → .gdf and report, each on disk."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field.trajectory import Trajectory, load_trajectory, save_trajectory
from progdf.formats.scene_file import load_scene
from progdf.gaussians import BASE_CHANNELS, Gaussians
from progdf.io.cameras import save_cameras
from progdf.io.json_values import convert_json, plain
from progdf.region import Region
from progdf.scene.regions import parse_region
from trainer.editors import GIVEN, VIEW_BY_VIEW, make_editor
from trainer.editors.base import EditKind
from trainer.editors.folder import FolderEditor
from trainer.fit.fit import drop_idle_attributes
from trainer.fit.network import PART as NETWORK
from trainer.fit.own_path import choose_path
from trainer.fit.slider_uniformity import equalized_strengths
from trainer.optimize.losses import Perceptual, perceptual_loss
from trainer.optimize.settings import Optimization, resolve_slider
from trainer.optimize.unseen import unseen_members_of
from trainer.pipeline.fit_and_report import load_result
from trainer.pipeline.threads import use_threads, wanted_threads
from trainer.plan import Plan, plan_optimization
from trainer.regions.from_pictures import region_kinds
from trainer.report.agreement import Agreement, measure_agreement
from trainer.setup.training_setup import (
    Pictures,
    TrainingSetup,
    confines_edit,
    edit_views,
    editor_strengths,
    make_training_setup,
    quantize_image,
    whole_views,
    widen_views,
)
from trainer.store.interrupts import interrupt_on_signals
from trainer.store.progress import RunLog
from trainer.store.run_folder import (
    RunFolder,
    lock_folder,
    open_run_folder,
    read_views,
    remove_stale_views,
    write_views,
)
from trainer.views.crops import only_recolors
from trainer.views.view import BACKGROUND, render_view

from .fit_and_report import RunResult, end_rows, finish_run, load_evaluator
from .kind_trial import Approach, choose_approach
from .preflight import check_command, region_settings
from .record import RunRecord
from .reedit import reedit
from .resume import check_exists, decide_resume, explain_stop, load_region, picture_digests
from .training import JointNetwork, optimize_members, retime_trajectory

__all__ = ["RunResult", "train"]


def train(plan: Plan, out: Path, threads: int = 0, resume: bool = False, quiet: bool = False) -> RunResult:
    """Edit a region of a scene and write its .gdf file.

    Args:
        plan: see `make_plan`
        out: folder of the run
        threads: CPU threads; 0 takes all cores
        resume: go on with a run that was stopped in this folder
        quiet: nothing on the screen; log.txt is written all the same

    Raises:
        ProgdfError: scene, region, cameras or edited views that do not work; no .gdf is touched.
        KeyboardInterrupt: interrupted; the message says how to go on. No .gdf is touched.
    """
    check_command(plan, out, resume)
    use_threads(threads)
    scene = load_scene(plan.scene)
    region, notes = load_region(out) if resume else None, list[str]()
    if region is None:
        kinds = region_kinds(region_settings(plan, out, quiet, notes.append))
        region = parse_region(plan.region.region, scene, plan.name, kinds, notes.append)
    folder = open_run_folder(out, plan.edit)
    with interrupt_on_signals(), lock_folder(folder), explain_stop(folder):
        session = decide_resume(folder, plan, region, len(scene), wanted_threads(threads), resume)
        log = RunLog(folder.log, quiet, progress=folder.progress)
        try:
            for note in (*session.notes, *notes):
                log.say(note)
            if session.does == "nothing":
                return load_result(folder, plan.name, scene, log)
            use_threads(session.threads)
            with check_exists(folder):
                result = _run_training(plan, scene, region, folder, log)
            folder.state.end()
            return result
        except KeyboardInterrupt:
            log.note("interrupted")
            raise
        finally:
            log.close()


def _run_training(plan: Plan, scene: Gaussians, region: Region, folder: RunFolder, log: RunLog) -> RunResult:
    """Everything; what the saved state says is done is not done again, or is repeated to the same bits."""
    perceptual, warning = perceptual_loss()
    if warning:
        log.say(warning)
    with log.stage("views"):
        setup = _render_originals(plan, scene, region, folder)
    log.say(f"{len(scene)} Gaussians, {len(region)} in the region; {_describe_views(setup)}")
    for note in setup.notes:
        log.say(note)
    with log.stage("edit"):
        edited, approach, trial = _edit_views(plan, setup, folder, log)
        train_edits = {s: pictures[: len(setup.train)] for s, pictures in edited.items()}
        setup = whole_views(setup) if plan.optimization.whole else widen_views(setup, train_edits)
    recorded = folder.state.load("recorded")
    if recorded is None:
        with log.stage("agree"):
            agreement = _agreement(plan, setup, edited, approach.kind, log)
        optimization = plan_optimization(plan.optimization, approach.kind, approach.group_steps)
        _record(plan, optimization, setup, train_edits, trial, perceptual, folder, log, agreement)
        folder.state.save("recorded", {}, log.capture_state().values)
    else:
        log.restore(recorded)
        log.say("the trajectory is recorded")
    trajectory, _, about = load_trajectory(folder.trajectory)
    begun = folder.state.load(NETWORK)
    return finish_run(folder, setup, trajectory, convert_json(about, RunRecord), perceptual, log, begun)


def _describe_views(setup: TrainingSetup) -> str:
    """How many views there are, for what, and of how many pixels."""
    cameras = [view.camera for view in setup.views]
    sizes = dict.fromkeys(f"{camera.width}x{camera.height}" for camera in cameras)
    use = f"{len(setup.train)} views to train on and {len(setup.held_out)} to measure with"
    if not setup.held_out:
        use = f"{len(setup.train)} views to train on, by which the edit is measured too"
    return f"{use}, {', '.join(sizes)} pixels"


def _render_originals(plan: Plan, scene: Gaussians, region: Region, folder: RunFolder) -> TrainingSetup:
    """The views, rendered and on disk."""
    setup = make_training_setup(plan.views, scene, region)
    views = setup.views
    remove_stale_views(folder, [view.camera.name for view in views])
    write_views(folder, "original", {view.camera.name: view.image for view in views})
    masks = {view.camera.name: view.mask[..., None].expand(-1, -1, 3) for view in views}
    write_views(folder, "mask", masks)
    save_cameras(folder.cameras, [view.camera for view in views], scene.origin)
    return setup


def _edit_views(
    plan: Plan, setup: TrainingSetup, folder: RunFolder, log: RunLog
) -> tuple[dict[float, list[Tensor]], Approach, dict[str, Any] | None]:
    """What the editor makes of all views, by strength, read where it is on disk; how to train towards it, and
    what a trial of that found.
    """
    views = setup.views
    names = [view.camera.name for view in views]
    done = folder.state.load("edited")
    if done is not None:
        try:
            edited = {s: read_views(folder, "edited", names, s) for s in done.values["strengths"]}
            log.say("the edited views are on disk")
            return edited, Approach(done.values["kind"], done.values["group_steps"]), done.values["trial"]
        except ProgdfError as error:
            log.say(f"the views are edited again: {str(error).partition(';')[0]}")
    spec = plan.editor.editor
    editor = make_editor(spec, setup.scene, setup.region, views, plan.editor.settings(folder.painted))
    if isinstance(editor, FolderEditor) and editor.warning is not None:
        log.say(editor.warning)
    approach, trial = choose_approach(plan.optimization, setup, editor, plan.editor.knows_kind, log)
    kind = approach.kind
    stages = plan_optimization(plan.optimization, kind, approach.group_steps).stages
    strengths = editor_strengths(editor, stages)
    if plan.optimization.refinements.asks_evenly and resolve_slider(plan.slider, strengths) == "even":
        strengths = equalized_strengths(editor, spec, views, strengths)
    confined = confines_edit(editor, kind)
    with log.steps("edit", len(views) * len(strengths)) as advance:
        edited = edit_views(editor, views, strengths, folder, confined, advance)
    if all(
        torch.equal(p, quantize_image(v.image)) for s in edited for p, v in zip(edited[s], views, strict=True)
    ):
        raise ProgdfError(
            f"{spec} changes none of the views; check the region and what the editor is asked for"
        )
    log.say(f"{spec}: a {kind} edit at strength {', '.join(f'{s:g}' for s in strengths)}")
    saved = {"strengths": list(edited), "kind": kind, "group_steps": approach.group_steps, "trial": trial}
    folder.state.save("edited", {}, saved)
    return edited, approach, trial


def _agreement(
    plan: Plan, setup: TrainingSetup, edited: Pictures, kind: EditKind, log: RunLog
) -> Agreement | None:
    """Whether the edited views agree; None where an editor cannot but edit all alike."""
    if kind == "geometry" or plan.editor.family not in VIEW_BY_VIEW:
        return None
    count = len(setup.train)
    found = measure_agreement(setup, edited[1.0][:count], edited[1.0][count:] or edited[1.0])
    log.say(found.line(plan.editor.family, setup.judged_on))
    return found


def _record(
    plan: Plan,
    optimization: Optimization,
    setup: TrainingSetup,
    edited: Pictures,
    trial: Mapping[str, Any] | None,
    perceptual: Perceptual,
    folder: RunFolder,
    log: RunLog,
    agreement: Agreement | None,
) -> None:
    """Optimize, and write the trajectory and the finished edit's views."""
    kind, scene, region = optimization.kind, setup.scene, setup.region
    pictures = picture_digests(plan)
    objective = optimization.objective(perceptual.name)
    log.say(f"loss: {objective}")
    if plan.optimization.group_steps and kind != "geometry":
        log.say(f"--group-steps: without effect on this {kind} edit, whose loss is {objective}")
    with log.stage("optimize"):
        renewal = reedit(plan.editor, plan.optimization.reedit_every, setup, kind, folder, log)
        unseen_members = unseen_members_of(setup, kind) if optimization.refinements.propagates else None
        trajectory, losses = optimize_members(
            optimization,
            setup,
            edited,
            perceptual,
            folder.state,
            log,
            renewal,
            unseen_members,
            JointNetwork(plan.field.network, plan.slider) if plan.optimization.joint else None,
        )

    def retimed(trajectory: Trajectory) -> Trajectory:
        return retime_trajectory(trajectory, setup, plan.slider, optimization.raw, log)

    with log.stage("retime"):
        costs: dict[str, float] = {}
        if not only_recolors(trajectory.offsets) or trajectory.end.shape[1] > BASE_CHANNELS:
            choosing, _ = load_evaluator(folder, setup, setup.judging, trajectory).halves()
            trajectory, costs = drop_idle_attributes(trajectory, choosing, optimization.refinements.prunes)
        recorded = len(trajectory)
        way = ""
        of_one_end = len(edited) == 1 and not optimization.few  # whose solver lays the way
        if not optimization.raw and plan.field.field != "neural" and of_one_end:
            editor = None  # of pictures made elsewhere: their folder may be gone by now, and there is no half
            if plan.editor.family not in GIVEN:
                views, settings = setup.views, plan.editor.settings(folder.painted)
                editor = make_editor(plan.editor.editor, scene, region, views, settings)
            trajectory, way = choose_path(trajectory, setup, editor, bool(optimization.group_steps), retimed)
        else:
            trajectory = retimed(trajectory)
    log.say(
        f"{recorded} recordings, {len(trajectory)} kept; without an attribute, dB: {costs or 'none moves'}"
    )
    if way:
        log.say(f"between original and edit: {way}")
    record = RunRecord(
        plan,
        plan.scene.resolve(),
        [view.camera.name for view in setup.held_out],
        BACKGROUND,
        kind,
        optimization.group_steps,
        trial,
        objective,
        losses,
        costs,
        agreement.figures() if agreement is not None else None,
        len(unseen_members.places) if unseen_members is not None else 0,
        setup.up.to_json() if setup.up is not None else None,
        pictures,
    )
    extra = {"members": region.members, "score": region.score}
    save_trajectory(folder.trajectory, trajectory, extra, plain(record))
    with log.stage("final"):
        edited_scene = scene.replace_rows(region.members, end_rows(setup, trajectory))
        views = setup.views
        finals = {}
        with log.looks("picture the edit", len(views)) as looked:
            for view in views:
                finals[view.camera.name] = render_view(edited_scene, view.camera, setup.background)
                looked()
        write_views(folder, "final", finals)
