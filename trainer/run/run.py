"""Training run: write a draft, render the views, then train the edit, paste paint or remove the region."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from progdf.formats.scene_file import load_scene
from progdf.gaussians import Gaussians
from progdf.gdf.file import save_gdf
from progdf.io.cameras import save_cameras
from progdf.rasterize.first_start import compile_rasterizer, needs_kernels
from progdf.region import Region
from progdf.terminal import format_count
from trainer.editors import editor_row
from trainer.fit.draft import draft_grade, draft_views
from trainer.optimize.losses import perceptual_loss
from trainer.options import TrainOptions
from trainer.resolve import prepare_process, resolve
from trainer.store.pretrained import LastValueCache
from trainer.store.progress import RunLog
from trainer.store.run_folder import (
    RunFolder,
    lock_folder,
    open_run_folder,
    remove_refused_run,
    remove_stale_views,
    write_views,
)
from trainer.store.state import interrupt_on_signals
from trainer.views.lower_layers import open_lower_layers
from trainer.views.setup import TrainingSetup, make_training_setup

from .command import check_command, select_region, shown_pictures
from .finish import ReportRequest, RunResult, complete_report, load_result
from .pasted import paste_decal
from .removed import is_removal, remove_region
from .resume import DELIVERED, check_exists, decide_resume, explain_stop, load_region
from .trained import train_region

_LOWER = "the pictures show {}: only the difference from these layers is trained"


def train(
    options: TrainOptions,
    quiet: bool = False,
    shared: LastValueCache | None = None,
    on_delivery: Callable[[], None] = lambda: None,
) -> RunResult:
    """Edit a region of a scene and write its .gdf file.

    Args:
        options: unresolved options
        quiet: no output on the screen; log.txt is always written
        shared: cache for consecutive runs in this process, while the files do not change
        on_delivery: called once the .gdf file is written, before the report

    Raises:
        ProgdfError: invalid scene, region, cameras or edited views. No .gdf file is changed, and a new run
            leaves no files, see `remove_refused_run`.
        KeyboardInterrupt: interrupted; the message explains how to resume. No .gdf file is changed, unless
            only the report was left.
    """
    options = resolve(options)
    check_command(options)
    with remove_refused_run(RunFolder(options.out)):
        return _train(options, quiet, shared or LastValueCache(), on_delivery)


def _train(
    options: TrainOptions, quiet: bool, shared: LastValueCache, on_delivery: Callable[[], None]
) -> RunResult:
    """Train with resolved and checked options, see `train`."""
    prepare_process(options.threads)
    scene = shared.get("scene", options.scene.resolve(), lambda: load_scene(options.scene))
    lower = open_lower_layers(shown_pictures(options), options.scene, scene)
    base = scene if lower is None else lower.base
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

            def deliver() -> None:
                if folder.state.identity() is not None:
                    folder.state.save(DELIVERED, {}, {})
                on_delivery()

            request = ReportRequest(options.report, deliver)
            for note in (*session.notes, *notes):
                log.say(note)
            if session.does in ("start", "go on"):
                _compile_kernels(options, log)
            if editor_row(options.editor).run == "pasted":  # takes seconds, so it is not resumed
                setup = TrainingSetup(base, region, lower=lower)
                if lower is not None:
                    log.say(_LOWER.format(lower.layers))
                result = paste_decal(options, setup, folder, log)
                on_delivery()
                folder.state.end()
                return result
            if session.does == "report":
                return complete_report(folder.root, options.scene, quiet, request)
            if session.does == "nothing":
                return load_result(folder, options.name, scene, log)
            prepare_process(session.threads)
            with check_exists(folder), folder.state.writing():
                if session.does == "start":
                    _write_draft(options, base, region, folder, log)
                setup = _prepare_views(options, base, region, folder, shared, log)
                if lower is not None:
                    log.say(_LOWER.format(lower.layers))
                setup = replace(setup, lower=lower)
                run = remove_region if is_removal(options, setup, log) else train_region
                result = run(options, setup, folder, log, request)
            folder.state.end()
            return result
        except KeyboardInterrupt:
            log.note("interrupted")
            raise
        finally:
            log.close()


def _compile_kernels(options: TrainOptions, log: RunLog) -> None:
    """Compile the kernels that the run needs, the first time on a machine."""
    purpose = "solve" if editor_row(options.editor).color_function else "descend"
    if needs_kernels(purpose):
        with log.kernels() as report:
            compile_rasterizer(purpose, report)


def _prepare_views(
    options: TrainOptions,
    scene: Gaussians,
    region: Region,
    folder: RunFolder,
    shared: LastValueCache,
    log: RunLog,
) -> TrainingSetup:
    """Render the views, write them to disk and describe them in the log."""
    _, warning = perceptual_loss()
    if warning:
        log.say(warning)
    with log.stage("views"), log.steps("views", 1):
        setup = _render_originals(options, scene, region, folder, shared)
    log.say(f"{len(scene)} Gaussians, {len(region)} in the region; {_describe_views(setup)}")
    for note in setup.notes:
        log.say(note)
    return setup


def _write_draft(
    options: TrainOptions, scene: Gaussians, region: Region, folder: RunFolder, log: RunLog
) -> None:
    """Write draft.gdf, a grade for use during training, if a grade can represent the edit."""
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
    seconds = time.perf_counter() - start_time
    degree = draft.report["draft"]["degree"]
    psnr = draft.report["draft"]["psnr"]
    log.say(
        f"{folder.draft} after {seconds:.1f} s: a grade of degree {degree}, {psnr:.1f} dB in held-out views; "
        "training continues"
    )


def _describe_views(setup: TrainingSetup) -> str:
    """Return a description of the number, use and size of the views."""
    cameras = [view.camera for view in setup.views]
    sizes = dict.fromkeys(f"{camera.width}x{camera.height}" for camera in cameras)
    training = format_count(len(setup.train), "training view")
    measuring = ", used to measure the edit too"
    if setup.held_out:
        measuring = f" and {format_count(len(setup.held_out), 'held-out view')}"
    return f"{training}{measuring}, {', '.join(sizes)} pixels"


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
