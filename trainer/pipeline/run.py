"""The whole job: scene → views → edited views → trajectory → field → .gdf and report, each on disk."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field.trajectory import load_trajectory, save_trajectory
from progdf.formats.scene_file import load_scene
from progdf.gaussians import BASE_CHANNELS, Gaussians
from progdf.gdf.file import load_gdf
from progdf.io.cameras import save_cameras
from progdf.io.json_values import decode_json, typed
from progdf.rasterize import set_threads
from progdf.region import Region
from progdf.scene.region_spec import parse_region
from trainer.editors import GIVEN, VIEW_BY_VIEW, check_editor, make_editor
from trainer.editors.base import EditKind
from trainer.editors.folder import FolderEditor
from trainer.fit.evenness import even_strengths
from trainer.fit.fit import without_idle_attributes
from trainer.fit.network import PART as NETWORK
from trainer.fit.own_path import kept_way
from trainer.optimize.losses import Perceptual, perceptual_loss
from trainer.optimize.retime import before_fit
from trainer.optimize.settings import idle_options, objective_line, slider_meant, stages_to_ask
from trainer.optimize.unseen import followers_of
from trainer.options import (
    MOST_THREADS,
    NETWORK_OPTIONS,
    FitOptions,
    TrainOptions,
    check_network_options,
    plain_options,
    settled,
)
from trainer.regions.from_pictures import region_kinds, region_settings
from trainer.report.agreement import Agreement, measured
from trainer.setup.training_setup import (
    Pictures,
    Stand,
    edited_views,
    editor_settings,
    eight_bits,
    make_stand,
    strengths_to_ask,
    to_confine,
    widened,
)
from trainer.store.interrupts import stopping
from trainer.store.progress import RunLog
from trainer.store.run_folder import RunFolder, claim, locked, read_views, remove_stale_views, write_views
from trainer.views.crops import only_recolors
from trainer.views.view import BACKGROUND, pictured

from .fit_and_report import RunResult, end_rows, finished, kept_judge
from .kind_trial import Approach, how_to_train
from .preflight import check_command
from .reedit import reedit
from .reopen import its_views, reopened
from .resume import kept_region, one_line, open_session, still_there
from .training import retimed, trained

__all__ = ["RunResult", "refit", "train", "use_threads"]


def train(options: TrainOptions, quiet: bool = False) -> RunResult:
    """Edit a region of a scene and write its .gdf file.

    Args:
        options: see TrainOptions
        quiet: nothing on the screen; log.txt is written all the same

    Raises:
        ProgdfError: options, scene, region, cameras or edited views that do not work; no .gdf is touched.
        KeyboardInterrupt: interrupted; the message says how to go on. No .gdf is touched.
    """
    options = settled(options)
    edit = {"scene": str(options.scene.resolve()), "region": options.region, "editor": options.editor}
    check_command(options, edit)
    use_threads(options.threads)
    scene = load_scene(options.scene)
    region, notes = kept_region(options), list[str]()
    if region is None:
        kinds = region_kinds(region_settings(options, edit, quiet, notes.append))
        region = parse_region(options.region, scene, options.name, kinds)
    folder = claim(options.out, edit)
    with stopping(), locked(folder), one_line(folder):
        session = open_session(folder, options, edit, region, wanted_threads(options.threads))
        log = RunLog(folder.log, quiet)
        try:
            for note in (*session.notes, *notes):
                log.say(note)
            if session.does == "nothing":
                return _found(folder, options, scene, log)
            use_threads(session.threads)
            with still_there(folder):
                result = _trained(options, scene, region, folder, log)
            folder.state.end()
            return result
        except KeyboardInterrupt:
            log.note("interrupted")
            raise
        finally:
            log.close()


def _found(folder: RunFolder, options: TrainOptions, scene: Gaussians, log: RunLog) -> RunResult:
    """The result of a run that is finished."""
    path = folder.gdf(options.name)
    load_gdf(path, scene)
    trajectory, _, _ = load_trajectory(folder.trajectory)
    log.say(f"{folder.root} is finished: nothing is left to do, and {path} is whole")
    try:
        report = typed(decode_json(folder.report.read_bytes()), dict[str, Any])
    except ValueError as error:
        raise ProgdfError(f"{folder.report} is damaged ({error}); train again without --resume") from error
    return RunResult(folder, path, report, trajectory)


def _trained(
    options: TrainOptions, scene: Gaussians, region: Region, folder: RunFolder, log: RunLog
) -> RunResult:
    """Everything; what the saved state says is done is not done again, or is repeated to the same bits."""
    perceptual, warning = perceptual_loss(options.perceptual)
    if warning:
        log.say(warning)
    with log.stage("views"):
        stand = _looked_at(options, scene, region, folder)
    views = [*stand.train, *stand.held_out]
    log.say(
        f"{len(scene)} Gaussians, {len(region)} in the region; {len(stand.train)} views to train on and "
        f"{len(stand.held_out)} to measure with, {views[0].camera.width}x{views[0].camera.height} pixels"
    )
    for note in stand.notes:
        log.say(note)
    with log.stage("edit"):
        edited, approach, trial = _edited(options, stand, folder, log)
        train_edits = {s: pictures[: len(stand.train)] for s, pictures in edited.items()}
        stand = widened(stand, train_edits)
    recorded = folder.state.load("recorded")
    if recorded is None:
        with log.stage("agree"):
            agreement = _agreement(options, stand, edited, approach.kind, log)
        _record(options, stand, train_edits, approach, trial, perceptual, folder, log, agreement)
        folder.state.save("recorded", {}, log.saved().values)
    else:
        log.restore(recorded)
        log.say("the trajectory is recorded")
    trajectory, extra, about = load_trajectory(folder.trajectory)
    trajectory = before_fit(trajectory, extra)
    measure = perceptual if options.perceptual == "alex" else perceptual_loss()[0]
    begun = folder.state.load(NETWORK)
    return finished(folder, stand, trajectory, about, measure, log, options.field, begun)


def _looked_at(options: TrainOptions, scene: Gaussians, region: Region, folder: RunFolder) -> Stand:
    """The views, rendered and on disk."""
    stand = make_stand(options, scene, region)
    views = [*stand.train, *stand.held_out]
    remove_stale_views(folder, [view.camera.name for view in views])
    write_views(folder, "original", {view.camera.name: view.image for view in views})
    masks = {view.camera.name: view.mask[..., None].expand(-1, -1, 3) for view in views}
    write_views(folder, "mask", masks)
    save_cameras(folder.cameras, [view.camera for view in views])
    return stand


def _edited(
    options: TrainOptions, stand: Stand, folder: RunFolder, log: RunLog
) -> tuple[dict[float, list[Tensor]], Approach, dict[str, Any] | None]:
    """What the editor makes of all views, by strength, read where it is on disk; how to train towards it, and
    what a trial of that found.
    """
    views = [*stand.train, *stand.held_out]
    names = [view.camera.name for view in views]
    done = folder.state.load("edited")
    if done is not None:
        try:
            edited = {s: read_views(folder, "edited", names, s) for s in done.values["strengths"]}
            log.say("the edited views are on disk")
            return edited, Approach(done.values["kind"], done.values["group_steps"]), done.values["trial"]
        except ProgdfError as error:
            log.say(f"the views are edited again: {str(error).partition(';')[0]}")
    editor = make_editor(options.editor, stand.scene, stand.region, views, editor_settings(options, folder))
    if isinstance(editor, FolderEditor) and editor.warning is not None:
        log.say(editor.warning)
    approach, trial = how_to_train(options, stand, editor, log)
    kind = approach.kind
    strengths = strengths_to_ask(editor, stages_to_ask(options, kind))
    if slider_meant(options.slider, options.editor, strengths) == "even":
        strengths = even_strengths(editor, options.editor, views, strengths)
    confined = to_confine(editor, options, kind)
    with log.steps("edit", len(views) * len(strengths)) as advance:
        edited = edited_views(editor, views, strengths, folder, confined, advance)
    if all(
        torch.equal(p, eight_bits(v.image)) for s in edited for p, v in zip(edited[s], views, strict=True)
    ):
        raise ProgdfError(
            f"{options.editor} changes none of the views; check the region and what the editor is asked for"
        )
    log.say(f"{options.editor}: a {kind} edit at strength {', '.join(f'{s:g}' for s in strengths)}")
    saved = {"strengths": list(edited), "kind": kind, "group_steps": approach.group_steps, "trial": trial}
    folder.state.save("edited", {}, saved)
    return edited, approach, trial


def _agreement(
    options: TrainOptions, stand: Stand, edited: Pictures, kind: EditKind, log: RunLog
) -> Agreement | None:
    """Whether the edited views agree, told in the log; None where an editor cannot but edit all alike."""
    if kind == "geometry" or check_editor(options.editor)[0] not in VIEW_BY_VIEW:
        return None
    count = len(stand.train)
    found = measured(stand, edited[1.0][:count], edited[1.0][count:])
    log.say(found.told(check_editor(options.editor)[0]))
    return found


def _record(
    options: TrainOptions,
    stand: Stand,
    edited: Pictures,
    approach: Approach,
    trial: Mapping[str, Any] | None,
    perceptual: Perceptual,
    folder: RunFolder,
    log: RunLog,
    agreement: Agreement | None,
) -> None:
    """Optimise, and write the trajectory and the finished edit's views."""
    kind, scene, region = approach.kind, stand.scene, stand.region
    objective = objective_line(options, kind, perceptual.name)
    log.say(f"loss: {objective}")
    if idle := idle_options(options, kind):
        log.say(f"{', '.join(idle)}: without effect on this {kind} edit, whose loss is {objective}")
    with log.stage("optimise"):
        renewal = reedit(options, stand, kind, folder, log)
        followers = followers_of(options, stand, kind)
        trajectory, losses = trained(
            replace(options, group_steps=approach.group_steps),
            stand,
            edited,
            kind,
            perceptual,
            folder.state,
            log,
            renewal,
            followers,
        )
    with log.stage("retime"):
        costs: dict[str, float] = {}
        if not only_recolors(trajectory.offsets) or trajectory.end.shape[1] > BASE_CHANNELS:
            judge = kept_judge(folder, stand, stand.held_out, trajectory)
            trajectory, costs = without_idle_attributes(trajectory, judge)
        recorded = len(trajectory)
        way = ""
        if options.recording == "smooth" and options.field != "neural" and len(edited) == 1:
            editor = None  # of pictures made elsewhere: their folder may be gone by now, and there is no half
            if check_editor(options.editor)[0] not in GIVEN:
                views = [*stand.train, *stand.held_out]
                editor = make_editor(options.editor, scene, region, views, editor_settings(options, folder))
            in_parts = bool(approach.group_steps)
            trajectory, way = kept_way(
                trajectory, stand, editor, in_parts, lambda t: retimed(t, stand, options, log)
            )
        else:
            trajectory = retimed(trajectory, stand, options, log)
    log.say(
        f"{recorded} recordings, {len(trajectory)} kept; without an attribute, dB: {costs or 'none moves'}"
    )
    if way:
        log.say(f"between original and edit: {way}")
    about = {
        "scene": str(options.scene.resolve()),
        "held_out": [view.camera.name for view in stand.held_out],
        "background": list(BACKGROUND),
        "options": plain_options(options),
        "kind": kind,
        "group_steps": approach.group_steps,
        "kind_trial": trial,
        "objective": objective,
        "losses": losses,
        "attribute_worth_db": costs,
        "agreement": agreement.figures() if agreement is not None else None,
        "followed": len(followers.places),
        "up": stand.up.saved() if stand.up is not None else None,
    }
    save_trajectory(folder.trajectory, trajectory, {"members": region.members, "score": region.score}, about)
    with log.stage("final"):
        edited_scene = scene.replace_rows(region.members, end_rows(stand, trajectory))
        views = [*stand.train, *stand.held_out]
        finals = {}
        with log.looks("picture the edit", len(views)) as looked:
            for view in views:
                finals[view.camera.name] = pictured(edited_scene, view.camera, stand.background)
                looked()
        write_views(folder, "final", finals)


def refit(options: FitOptions, quiet: bool = False) -> RunResult:
    """Fit the field of a finished run anew and rewrite its .gdf and report; nothing is optimised.

    Raises:
        ProgdfError: the folder is no finished run, or its scene is gone or another.
    """
    check_network_options(options)
    use_threads(options.threads)
    run = reopened(options.run, options.scene)
    log = RunLog(run.folder.log, quiet, refits=True)
    try:
        with log.stage("views"):
            stand = its_views(run)
            names = [view.camera.name for view in stand.train]
            edited = {s: read_views(run.folder, "edited", names, s) for s in run.trajectory.strengths}
            # what grows beyond the region's boxes is seen as well, or the slider is timed on half of it
            stand = widened(stand, edited)
        perceptual, warning = perceptual_loss()
        if warning:
            log.say(warning)
        said = {"text_before": options.text_before, "text_after": options.text_after}
        said = {name: text for name, text in {**said, "clip_model": options.clip_model}.items() if text}
        network = {name: getattr(options, name) for name in NETWORK_OPTIONS if name != "fit"}
        asked = ("target_psnr", "bytes_budget")
        aims = {name: getattr(options, name) for name in asked}
        now = {"field": options.field, "fit": "after", **aims, **network, **said}
        about = {**run.about, "options": {**run.about["options"], **now}}
        return finished(run.folder, stand, run.trajectory, about, perceptual, log, options.field)
    finally:
        log.close()


def use_threads(wanted: int) -> None:
    """Give torch and the rasteriser `wanted` threads; 0 is all cores."""
    count = wanted_threads(wanted)
    torch.set_num_threads(count)
    set_threads(count)


def wanted_threads(wanted: int) -> int:
    """How many threads `wanted` means.

    Raises:
        ProgdfError: fewer than none, or more than any machine has.
    """
    if not 0 <= wanted <= MOST_THREADS:
        raise ProgdfError(f"--threads is {wanted}; 0 to {MOST_THREADS} would be right")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return wanted or cores
