"""Training run: scene → views → edited views → trajectory → field → .gdf and report, each saved to disk."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch

from progdf.field.trajectory import Trajectory, load_trajectory, save_trajectory
from progdf.formats.scene_file import load_scene
from progdf.gaussians import BASE_CHANNELS, ZERO, Gaussians
from progdf.gdf.file import save_gdf
from progdf.io.atomic import read_file
from progdf.io.cameras import load_cameras, save_cameras
from progdf.io.images import contact_sheet
from progdf.io.json_values import check_text, to_json
from progdf.rasterize.engines import get_engine
from progdf.region import Region
from progdf.scene.regions import check_region, parse_region
from progdf.terminal import group_digits
from trainer.editors import check_editor, check_new_editor, editor_row, make_editor
from trainer.editors.base import PastingEditor
from trainer.editors.pictures import picture_cameras
from trainer.fit.draft import draft_grade, draft_views
from trainer.fit.fit import choose_path, drop_idle_attributes
from trainer.fit.network import PART as NETWORK
from trainer.optimize.growth import fade_in
from trainer.optimize.losses import Perceptual, describe_loss, perceptual_loss
from trainer.optimize.retime import smooth_course
from trainer.options import EditKind, OptimizeOptions, TrainOptions, flat_values
from trainer.regions.from_pictures import RegionRequest, region_checks, region_kinds
from trainer.report.agreement import measure_agreement
from trainer.resolve import recorded_options, resolve, use_threads
from trainer.setup import (
    Pictures,
    TrainingSetup,
    check_given_cameras,
    make_training_setup,
    whole_views,
    widen_views,
)
from trainer.store.pretrained import LastValueCache
from trainer.store.progress import RunLog
from trainer.store.run_folder import (
    RunFolder,
    check_folder,
    lock_folder,
    open_run_folder,
    remove_stale_views,
    write_views,
)
from trainer.store.state import interrupt_on_signals
from trainer.views.crops import only_recolors
from trainer.views.view import BACKGROUND

from .edited_views import EditedViews
from .finish import RunResult, end_rows, finish_run, load_evaluator, load_result, write_finals, write_result
from .paint import RING, TURNS, train_decal
from .record import RunRecord, read_record
from .removal import is_removal, remove_region
from .resume import check_exists, decide_resume, explain_stop, load_region, picture_digests
from .training import optimize_members, retime_trajectory


def check_command(options: TrainOptions) -> None:
    """Check everything that the command names, as far as possible without the scene.

    A resumed run no longer needs its sources, as its region and its edited views are saved.

    Args:
        options: resolved options

    Raises:
        ProgdfError: the folder is occupied, the editor or the segmenter cannot run, a file is missing, or a
            text for the run's record is not UTF-8.
    """
    for name, _, value in flat_values(recorded_options(options)):
        for part in value if isinstance(value, tuple) else (value,):
            check_text(str(part), f"the record of --{name.replace('_', '-')}")
    get_engine(options.optimize.engine)
    check_editor(options.editor.editor)
    folder = check_folder(options.out, options.edit)
    views = options.views
    if not options.scene.is_dir():  # some formats are folders
        read_file(options.scene, 0)
    if views.cameras is not None and not options.resume:
        load_cameras(views.cameras, ZERO)
    if views.pictures:
        cameras = [] if views.cameras is None else load_cameras(views.cameras, ZERO)
        picture_cameras(views.pictures, cameras, ZERO)
    if not options.resume or load_region(options.out) is None:
        check_region(options.region.region, region_checks(region_request(options, quiet=True)))
    is_new = not folder.root.is_dir() or not any(folder.root.iterdir())
    if is_new or (editor_row(options.editor).slow_strengths and not options.resume):
        check_new_editor(replace(options.editor, cache=folder.paintings))


def region_request(
    options: TrainOptions, quiet: bool, say: Callable[[str], None] | None = None
) -> RegionRequest:
    """Return the request for a region made from pictures. Segmentation masks are saved in the run's folder.

    Args:
        options: resolved options
        quiet, say: see `RegionRequest`
    """

    def cache() -> Path:
        # never write into a folder that is not a run folder
        return open_run_folder(options.out, options.edit).segment_masks

    return RegionRequest(options.region, options.views, cache, quiet, say)


def train(options: TrainOptions, quiet: bool = False, shared: LastValueCache | None = None) -> RunResult:
    """Edit a region of a scene and write its .gdf file.

    Args:
        options: unresolved options
        quiet: no output on the screen; log.txt is always written
        shared: cache for consecutive runs in this process, while the files do not change

    Raises:
        ProgdfError: invalid scene, region, cameras or edited views. No .gdf file is changed.
        KeyboardInterrupt: interrupted; the message explains how to resume. No .gdf file is changed.
    """
    options = resolve(options)
    shared = shared or LastValueCache()
    check_command(options)
    use_threads(options.threads)
    scene = shared.get("scene", options.scene.resolve(), lambda: load_scene(options.scene))
    region = load_region(options.out) if options.resume else None
    notes = list[str]()
    if region is None:
        selected, notes = select_region(options, scene, quiet, shared)
        region = replace(selected, name=options.name)
    folder = open_run_folder(options.out, options.edit)
    with interrupt_on_signals(), lock_folder(folder), explain_stop(folder):
        session = decide_resume(folder, options, region, len(scene))
        log = RunLog(folder.log, quiet, progress=folder.progress)
        try:
            for note in (*session.notes, *notes):
                log.say(note)
            if editor_row(options.editor).run == "pasted":  # takes seconds, so it is not resumed
                result = _run_decal(options, scene, region, folder, log)
                folder.state.end()
                return result
            if session.does == "nothing":
                return load_result(folder, options.name, scene, log)
            use_threads(session.threads)
            with check_exists(folder), folder.state.writing():
                if session.does == "start":
                    _write_draft(options, scene, region, folder, log)
                result = _run_training(options, scene, region, folder, shared, log)
            folder.state.end()
            return result
        except KeyboardInterrupt:
            log.note("interrupted")
            raise
        finally:
            log.close()


def select_region(
    options: TrainOptions, scene: Gaussians, quiet: bool, shared: LastValueCache
) -> tuple[Region, list[str]]:
    """Return the region that resolved options name, and lines for the log.

    Raises:
        ProgdfError: see `parse_region`; or the cameras do not show the scene.
    """

    def select() -> tuple[Region, list[str]]:
        notes = list[str]()
        check_given_cameras(options.views, scene)  # fail before a folder is created
        kinds = region_kinds(region_request(options, quiet, notes.append))
        return parse_region(options.region.region, scene, options.name, kinds, notes.append), notes

    return shared.get("region", (options.scene.resolve(), options.region, options.views), select)


def _run_training(
    options: TrainOptions,
    scene: Gaussians,
    region: Region,
    folder: RunFolder,
    shared: LastValueCache,
    log: RunLog,
) -> RunResult:
    """Run all stages. Skip finished stages of the saved state, or repeat them with the same bits."""
    perceptual, warning = perceptual_loss()
    if warning:
        log.say(warning)
    with log.stage("views"):
        setup = _render_originals(options, scene, region, folder, shared)
    log.say(f"{len(scene)} Gaussians, {len(region)} in the region; {_describe_views(setup)}")
    for note in setup.notes:
        log.say(note)
    if is_removal(options, setup, log):
        return remove_region(options, setup, folder, log)
    views = EditedViews(options, setup, folder, log)
    with log.stage("edit"):
        views.prepare()
        edited = views.pictures
        kind = views.approach.kind
        optimization = views.optimization
        # if more strengths may be requested, the boxes must not depend on which of them exist already
        strengths = (1.0,) if views.requests_strengths else edited
        train_edits = {s: edited[s][: len(setup.train)] for s in strengths}
        setup = whole_views(setup) if options.optimize.as_printed else widen_views(setup, train_edits)
    if optimization.solver == "colors":  # small sums, over which torch's threads spun for 100 s on 16 cores
        torch.set_num_threads(1)
    recorded = folder.state.load("recorded")
    if recorded is None:
        with log.stage("agree"):
            agreement = _agreement(options, setup, edited, kind, folder, log)
        trajectory, outcome = _record(options, optimization, setup, views, perceptual, folder, log)
        record = RunRecord(
            recorded_options(options),
            options.scene.resolve(),
            [view.camera.name for view in setup.held_out],
            BACKGROUND,
            kind,
            optimization.group_steps or 0,
            kind_trial=views.trial,
            agreement=agreement,
            up=setup.up.to_json() if setup.up is not None else None,
            pictures=picture_digests(options),
            **outcome,
        )
        extra = {"members": region.members, "score": region.score}
        save_trajectory(folder.trajectory, trajectory, extra, to_json(record))
        setup = setup.keep_solved(record.effort)
        with log.stage("final"):
            grown = setup.extend(trajectory.added)
            finals = grown.scene.replace_rows(grown.region.members, end_rows(grown, trajectory))
            write_finals(setup, finals, folder, log)
        folder.state.save("recorded", {}, log.capture_state().values)
        del trajectory, grown, finals
    else:
        log.restore(recorded)
        log.say("the trajectory is recorded")
    del edited, train_edits, views  # the needed parts are read again from disk
    trajectory, _, about = load_trajectory(folder.trajectory)
    record = read_record(about)
    begun = folder.state.load(NETWORK)
    setup = setup.keep_solved(record.effort)
    result = finish_run(folder, setup, trajectory, record, perceptual, log, begun)
    # only at the end, as a stopped run needs all views to resume
    save_cameras(folder.cameras, [view.camera for view in setup.views], scene.origin)
    remove_stale_views(folder, [view.camera.name for view in setup.views])
    return result


def _run_decal(
    options: TrainOptions, scene: Gaussians, region: Region, folder: RunFolder, log: RunLog
) -> RunResult:
    """Place a decal, measure it, and write the files of a run, except for a trajectory."""
    with log.stage("edit"):
        editor = cast(PastingEditor, make_editor(options.editor, scene, region, ()))
    view = editor.view
    with log.stage("fit"):
        painted = train_decal(editor, scene, options.name, log)
    decal = f"decal:{Path(options.editor.editor.partition(':')[2]).name}"
    figures = painted.figures
    name = view.camera.name
    view_psnr = figures["own"]
    side_psnrs = figures["turned"]
    about = {"edit": {"psnr_to_views": view_psnr}, "paint": figures}
    save_cameras(folder.cameras, [view.camera], scene.origin)
    front_index = TURNS.index(0)
    mask = view.mask[..., None].expand(-1, -1, 3)
    pictures = {"original": view.image, "mask": mask, "edited": painted.expected[front_index]}
    for folder_name, picture in (pictures | {"final": painted.shown[front_index]}).items():
        write_views(folder, folder_name, {name: picture})
    labels = [f"{degrees:+d}°" if degrees else "0°" for degrees in TURNS]
    title = f"{options.name}: {options.editor.editor}"
    notes = [[], [f"{error} dB" if error is not None else "" for error in side_psnrs.values()]]
    report = {
        **about,
        "views": {"held_out": False, "edit": [name]},
        "time": log.rounded_seconds(),
        "memory_mb": log.peak_mb(),
        "plan": to_json(recorded_options(options)),
        "pictures": picture_digests(options),
    }
    rows = [painted.expected, painted.shown]
    sheet = contact_sheet(rows, ["projected", "the edit"], labels, title, notes=notes)
    result = write_result(folder, replace(painted.gdf, instruction=decal, report=about), report, sheet)
    added, pixels, moved = (group_digits(figures[name]) for name in ("added", "pixels", "moved"))
    log.say(
        f"{added} Gaussians added for {pixels} painted pixels, {moved} of the scene moved behind them; "
        f"{view_psnr} dB in the decal's own view, {figures['ring']} dB in the {RING} pixels around it, "
        f"{side_psnrs['-30']} and {side_psnrs['+30']} dB from 30° to its sides"
    )
    log.say(result.line)
    return result


def _write_draft(
    options: TrainOptions, scene: Gaussians, region: Region, folder: RunFolder, log: RunLog
) -> None:
    """Write a first slider with only a grade, if a grade can represent the edit."""
    if folder.draft == folder.gdf(options.name) or not editor_row(options.editor).color_function:
        return
    folder.draft.unlink(missing_ok=True)
    start_time = time.perf_counter()
    views = draft_views(options.views, scene, region)
    draft = draft_grade(views, options.editor, options.name) if views is not None else None
    if draft is None:
        log.say("no draft: a single color map cannot represent this edit")
        return
    save_gdf(folder.draft, draft)
    log.say(
        "{} after {:.1f} s: a grade of degree {degree}, {psnr:.1f} dB in views that it was not fitted to; "
        "training goes on".format(folder.draft, time.perf_counter() - start_time, **draft.report["draft"])
    )


def _describe_views(setup: TrainingSetup) -> str:
    """Return a description of the number, use and size of the views."""
    cameras = [view.camera for view in setup.views]
    sizes = dict.fromkeys(f"{camera.width}x{camera.height}" for camera in cameras)
    held_out_part = f" and {len(setup.held_out)} to measure with"
    use_of_others = held_out_part if setup.held_out else ", by which the edit is measured too"
    return f"{len(setup.train)} views to train on{use_of_others}, {', '.join(sizes)} pixels"


def _render_originals(
    options: TrainOptions, scene: Gaussians, region: Region, folder: RunFolder, shared: LastValueCache
) -> TrainingSetup:
    """Render the views and write them to disk."""
    key = options.views, region.members.numpy().tobytes(), region.score.numpy().tobytes()
    setup = shared.get("views", key, lambda: make_training_setup(options.views, scene, region))
    setup = replace(setup, region=region)
    views = setup.views
    remove_stale_views(folder, [view.camera.name for view in views])
    write_views(folder, "original", {view.camera.name: view.image for view in views})
    masks = {view.camera.name: view.mask[..., None].expand(-1, -1, 3) for view in views}
    write_views(folder, "mask", masks)
    save_cameras(folder.cameras, [view.camera for view in views], scene.origin)
    return setup


def _agreement(
    options: TrainOptions,
    setup: TrainingSetup,
    edited: Pictures,
    kind: EditKind,
    folder: RunFolder,
    log: RunLog,
) -> Mapping[str, Any] | None:
    """Measure how well the edited views agree; None for editors that edit all views alike."""
    saved = folder.state.load("edited")
    shared = saved.values.get("shared", {}) if saved is not None else {}
    row = editor_row(options.editor)
    if kind == "geometry" or not row.per_view:
        return shared or None
    count = len(setup.train)
    agreement = measure_agreement(setup, edited[1.0][:count], edited[1.0][count:] or edited[1.0])
    agreement = replace(agreement, contrast=shared.get("contrast", 1.0))
    log.say(agreement.line(row.remedy, setup.judged_on))
    return {**shared, **agreement.figures()}


def _record(
    options: TrainOptions,
    optimization: OptimizeOptions,
    setup: TrainingSetup,
    views: EditedViews,
    perceptual: Perceptual,
    folder: RunFolder,
    log: RunLog,
) -> tuple[Trajectory, dict[str, Any]]:
    """Optimize, and return the trajectory on its slider and the figures for the run's record."""
    objective = describe_loss(optimization, perceptual.name)
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
        recolors = only_recolors(trajectory.offsets)
        # a grade has no attributes to drop
        if trajectory.maps is None and (not recolors or trajectory.end.shape[1] > BASE_CHANNELS):
            choosing, _ = load_evaluator(folder, setup, setup.judging, trajectory).halves()
            prunes = not optimization.as_printed
            trajectory, costs = drop_idle_attributes(trajectory, choosing, prunes)
        count = len(trajectory)
        reason = ""
        has_one_target = len(trajectory.strengths) == 1
        if has_one_target and not optimization.as_printed and options.field.field != "neural":
            # external pictures may be gone by now and have no intermediate strengths; generative models
            # edited only strength 1
            row = editor_row(options.editor)
            painter = None if row.external or row.slow_strengths else views.editor
            retimed = partial(retime_trajectory, setup=setup, optimization=optimization, log=log)
            moves_groups = bool(optimization.group_steps)
            trajectory, reason = choose_path(trajectory, setup, painter, moves_groups, retimed)
        else:
            trajectory = retime_trajectory(trajectory, setup, optimization, log)
        trajectory = fade_in(trajectory)
    log.say(f"{count} recordings, {len(trajectory)} kept; without an attribute, dB: {costs or 'none moves'}")
    if reason:
        log.say(f"between original and edit: {reason}")
    return trajectory, {
        "objective": objective,
        "losses": losses,
        "effort": effort,
        "attribute_worth_db": costs,
    }
