"""`progdf fit`: the field of a finished run, fitted anew."""

from __future__ import annotations

from dataclasses import replace

from trainer.optimize.losses import perceptual_loss
from trainer.options import FitOptions, TextOptions
from trainer.resolve import check_field_options
from trainer.run.finish import RunResult, finish_run
from trainer.run.record import render_run_views, reopen_run
from trainer.run.threads import use_threads
from trainer.setup import whole_views, widen_views
from trainer.store.progress import RunLog
from trainer.store.run_folder import read_views


def refit(options: FitOptions, quiet: bool = False) -> RunResult:
    """Fit the field of a finished run anew and rewrite its .gdf and report; nothing is optimized.

    Raises:
        ProgdfError: the folder is no finished run, or its scene is gone or another.
    """
    check_field_options(options.field)
    use_threads(options.threads)
    run = reopen_run(options.run, options.scene)
    log = RunLog(run.folder.log, quiet, refits=True)
    try:
        with log.stage("views"):
            setup = render_run_views(run)
            names = [view.camera.name for view in setup.train]
            edited = {s: read_views(run.folder, "edited", names, s) for s in run.trajectory.strengths}
            # what grows beyond the region's boxes is seen as well, or the slider is timed on half of it
            whole = run.record.plan.optimize.as_printed
            setup = whole_views(setup) if whole else widen_views(setup, edited)
        perceptual, warning = perceptual_loss()
        if warning:
            log.say(warning)
        own = run.record.plan
        field = replace(
            options.field, as_printed=own.field.as_printed, draft=own.field.draft, seed=own.field.seed
        )
        texts = asked_texts(options.texts, own.texts)
        plan = replace(own, field=field, texts=texts)
        record = replace(run.record, plan=plan)
        return finish_run(run.folder, setup, run.trajectory, record, perceptual, log)
    finally:
        log.close()


def asked_texts(typed: TextOptions, own: TextOptions) -> TextOptions:
    """What CLIP is asked: the command's own texts, or the run's."""
    return TextOptions(
        typed.text_before or own.text_before,
        typed.text_after or own.text_after,
        own.asked or bool(typed.text_before or typed.text_after),
    )
