"""Training run: scene → views → edited views → trajectory → field → .gdf and report, each saved to disk."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field.trajectory import Trajectory, load_trajectory, save_trajectory
from progdf.formats.scene_file import load_scene
from progdf.gaussians import BASE_CHANNELS, ZERO, Gaussians
from progdf.gdf.file import save_gdf
from progdf.io.atomic import read_file
from progdf.io.cameras import load_cameras, save_cameras
from progdf.io.images import contact_sheet, read_picture
from progdf.io.json_values import check_text, to_json
from progdf.io.picture_camera import find_picture_camera
from progdf.rasterize.engines import get_engine
from progdf.region import Region
from progdf.scene.regions import check_region, parse_region
from progdf.terminal import group_digits
from trainer.editors import check_editor, check_new_editor, editor_row, make_editor
from trainer.editors.base import ImageEditor, PastingEditor
from trainer.editors.instruct import InstructEditor
from trainer.editors.pictures import picture_cameras
from trainer.editors.procedural import edit_course
from trainer.fit.draft import draft_grade, draft_views
from trainer.fit.fit import choose_path, drop_idle_attributes
from trainer.fit.network import PART as NETWORK
from trainer.fit.slider_uniformity import equalized_strengths
from trainer.optimize.growth import fade_in
from trainer.optimize.losses import Perceptual, describe_loss, perceptual_loss
from trainer.optimize.retime import resolve_slider, smooth_course
from trainer.options import EditKind, OptimizeOptions, TrainOptions, flat_values
from trainer.regions.from_pictures import CHANGED, RegionRequest, region_checks, region_kinds
from trainer.report.agreement import measure_agreement
from trainer.resolve import recorded_options, resolve, use_threads
from trainer.setup import (
    Pictures,
    TrainingSetup,
    check_given_cameras,
    confines_edit,
    edit_views,
    editor_strengths,
    make_training_setup,
    quantize_image,
    render_thumbnails,
    whole_views,
    widen_views,
)
from trainer.store.pretrained import LastValueCache
from trainer.store.progress import LATER, RunLog
from trainer.store.run_folder import (
    RunFolder,
    check_folder,
    lock_folder,
    open_run_folder,
    read_views,
    remove_stale_views,
    write_views,
)
from trainer.store.state import interrupt_on_signals
from trainer.views.crops import only_recolors
from trainer.views.view import BACKGROUND, View, fit_size, make_view, with_near_plane

from .agree import AgreedEditor, PaintCache, agree_views
from .finish import RunResult, end_rows, finish_run, load_evaluator, load_result, write_finals, write_result
from .kinds import Approach, choose_approach, resolve_approach
from .paint import RING, TURNS, train_decal
from .record import RunRecord, read_record
from .removal import is_removal, remove_region
from .resume import check_exists, decide_resume, explain_stop, load_region, picture_digests
from .training import StrengthSource, optimize_members, retime_trajectory

_MAX_CACHED_PIXELS = 1_000_000  # pixels and painted members whose editor state is cached, up to 80 bytes each


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
    editor = cache(partial(_make_editor, options, setup, folder, log))
    with log.stage("edit"):
        edited, approach, trial, between = _edit_views(options, setup, editor, folder, log)
        optimization = resolve_approach(options, approach)
        # if more strengths may be requested, the boxes must not depend on which of them exist already
        strengths = (1.0,) if _requests_more_strengths(options, optimization) else edited
        train_edits = {s: edited[s][: len(setup.train)] for s in strengths}
        setup = whole_views(setup) if options.optimize.as_printed else widen_views(setup, train_edits)
    if optimization.solver == "colors":  # small sums, over which torch's threads spun for 100 s on 16 cores
        torch.set_num_threads(1)
    recorded = folder.state.load("recorded")
    if recorded is None:
        with log.stage("agree"):
            agreement = _agreement(options, setup, edited, approach.kind, folder, log)
        trajectory, outcome = _record(
            options, optimization, setup, edited, between, editor, perceptual, folder=folder, log=log
        )
        record = RunRecord(
            recorded_options(options),
            options.scene.resolve(),
            [view.camera.name for view in setup.held_out],
            BACKGROUND,
            approach.kind,
            optimization.group_steps or 0,
            kind_trial=trial,
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
    del edited, train_edits, between  # the needed parts are read again from disk
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


def _make_editor(options: TrainOptions, setup: TrainingSetup, folder: RunFolder, log: RunLog) -> ImageEditor:
    """Return the run's editor. A generative editor is wrapped so that its views agree."""
    settings = replace(options.editor, cache=folder.paintings)
    glances = partial(render_thumbnails, options.views, setup.scene, setup.region)
    editor = make_editor(settings, setup.scene, setup.region, setup.views, glances)
    if editor_row(settings).model is None:
        return editor
    painter = cast(InstructEditor, editor)
    log.say(painter.note)
    easel = PaintCache(painter, painter.recipe, painter.kept, settings.seed)
    approved = None
    if settings.anchor is not None:
        camera = fit_size(
            find_picture_camera(settings.anchor, origin=setup.scene.origin), painter.request.size
        )
        (camera,) = with_near_plane([camera], setup.scene)
        view = make_view(setup.scene, setup.region, camera, setup.background)
        if not bool((view.mask > 0.0).any()):
            raise ProgdfError(f"{settings.anchor} shows nothing of the region; take it from elsewhere")
        approved = view, read_picture(settings.anchor, size=(camera.width, camera.height))
    return agree_views(easel, setup, editor, log, approved)


def _edit_views(
    options: TrainOptions,
    setup: TrainingSetup,
    editor: Callable[[], ImageEditor],
    folder: RunFolder,
    log: RunLog,
) -> tuple[Pictures, Approach, dict[str, Any] | None, StrengthSource | None]:
    """Edit all views and choose how to train.

    Returns: the edited views by strength, read lazily from disk; the training approach; the figures of the
    trial run that chose it; and a source of further strengths, if training may request them.
    """
    views = setup.views
    spec = options.editor.editor
    names = [view.camera.name for view in views]
    edits: dict[float, Sequence[Tensor]] = {}
    on_the_way = names  # views with strengths other than 1
    known = list[float]()  # strengths edited by the stopped run
    approach = Approach("color")
    trial = None

    def edit(strengths: Sequence[float], views: Sequence[View] = views) -> Pictures:
        nonlocal on_the_way
        new = [s for s in strengths if s not in edits]
        parallel = editor_row(options.editor).is_parallel
        is_confined = confines_edit(editor(), approach.kind)
        way = course if _fits_cache(options, setup) else partial(edit_course, editor())
        with log.steps("edit", len(views) * len(new)) as advance:
            within = views
            if options.region.region == CHANGED:  # few members are found for paint finer than the Gaussians
                within = [view.with_painted([editor().edit(view, 1.0)]) for view in views]
            edits.update(edit_views(parallel, within, new, folder, is_confined, advance, way))
        log.say(f"{spec}: a {approach.kind} edit at strength {', '.join(f'{s:g}' for s in strengths)}")
        if min(strengths) < 1.0:
            on_the_way = [view.camera.name for view in views]
        edited = [*dict.fromkeys((*known, *edits))]
        saved = {"strengths": edited, "on_the_way": on_the_way, **asdict(approach)}
        shared = painter.figures if isinstance(painter := editor(), AgreedEditor) else {}
        folder.state.save("edited", {}, saved | {"trial": trial, "shared": shared})
        return edits

    @cache
    def course(view: View) -> Callable[[float], Tensor]:
        return edit_course(editor(), view)

    def look(s: float, some: Sequence[View]) -> list[Tensor]:
        pictures = [course(view)(s) for view in some]
        if confines_edit(editor(), approach.kind):
            pictures = [view.confine(picture) for view, picture in zip(some, pictures, strict=True)]
        return [quantize_image(picture) for picture in pictures]

    def between() -> StrengthSource | None:
        more = _requests_more_strengths(options, resolve_approach(options, approach))
        return StrengthSource(edit, look) if more else None

    done = folder.state.load("edited")
    if done is not None:
        try:
            on_the_way = done.values["on_the_way"]
            for s in done.values["strengths"]:
                wanted = set(names if s == 1.0 else on_the_way)
                cameras = [view.camera for view in views if view.camera.name in wanted]
                edits[s] = read_views(folder, "edited", cameras, s)
            approach = Approach(*(done.values[name] for name in ("kind", "group_steps", "grow")))
            trial = done.values["trial"]
            log.say("the edited views are on disk")
            log.expect(expected_work(setup, resolve_approach(options, approach), len(edits)))
            return edits, approach, trial, between()
        except ProgdfError as error:
            edits.clear()
            known = done.values["strengths"]
            log.say(f"the views are edited again: {str(error).partition(';')[0]}")
    painter = editor()
    note = editor_row(options.editor).note(options.editor.text)
    if note:
        log.say(note)
    approach, trial = choose_approach(options, setup, painter, log)
    optimization = resolve_approach(options, approach)
    strengths = editor_strengths(editor(), optimization.stages)
    log.expect(expected_work(setup, optimization, len(strengths)))
    if _requests_more_strengths(options, optimization):
        strengths = (1.0,)
    elif not optimization.as_printed and resolve_slider(optimization.slider, strengths) == "even":
        strengths = equalized_strengths(editor(), spec, views, strengths)
    edited = edit(strengths)
    _check_change(edited, setup, spec)
    if rest := [s for s in known if s not in edited]:
        edited = edit(rest, [view for view in views if view.camera.name in on_the_way])
    return edited, approach, trial, between()


def _fits_cache(options: TrainOptions, setup: TrainingSetup) -> bool:
    """Return True if the strength-independent editor state of all views fits the cache."""
    painted = len(setup.region) if editor_row(options.editor).paints_members else 0
    return sum(int((view.mask > 0.0).sum()) + painted for view in setup.views) <= _MAX_CACHED_PIXELS


def _check_change(edited: Pictures, setup: TrainingSetup, spec: str) -> None:
    """Raise a ProgdfError if no view shows an edit."""
    originals = [quantize_image(view.image) for view in setup.views]
    if all(torch.equal(*pair) for views in edited.values() for pair in zip(views, originals, strict=True)):
        raise ProgdfError(f"{spec} changes none of the views; check the region and the editor's settings")


def _requests_more_strengths(options: TrainOptions, optimization: OptimizeOptions) -> bool:
    """Return True if training requests further strengths once the error of the first ones is known."""
    row = editor_row(options.editor)
    is_fixed = options.optimize.stages or row.external or row.slow_strengths
    return optimization.solver == "colors" and not is_fixed


def expected_work(setup: TrainingSetup, optimization: OptimizeOptions, strengths: int) -> dict[str, float]:
    """Return the expected work per stage for `RunLog.expect`, in units of preparing one view.

    Args:
        setup: scene, region, views
        optimization: fully resolved options
        strengths: number of edited strengths
    """
    views = len(setup.views)
    train = len(setup.train)
    work = {name: each * views for name, each in LATER.items()} | {
        "views": views,
        "edit": 0.1 * views * strengths,
    }
    if optimization.solver == "colors":
        return work | {"weights": 0.5 * train, "model": 1.5 * train, "optimize": 0.45 * train * strengths}
    group_steps = optimization.group_steps or 0
    return work | {"move parts": 0.2 * group_steps * strengths, "optimize": 0.25 * optimization.steps}


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
    edited: Pictures,
    between: StrengthSource | None,
    editor: Callable[[], ImageEditor],
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
            options, optimization, setup, edited, perceptual, folder.state, log, between
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
            painter = None if row.external or row.slow_strengths else editor()
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
