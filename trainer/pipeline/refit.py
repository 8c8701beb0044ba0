"""`progdf fit`: the field of a finished run, fitted anew."""

from __future__ import annotations

from dataclasses import replace

from trainer.optimize.losses import perceptual_loss
from trainer.option_checks import check_network_options
from trainer.options import FitOptions
from trainer.pipeline.fit_and_report import RunResult, finish_run
from trainer.pipeline.reopen import render_run_views, reopen_run
from trainer.pipeline.threads import use_threads
from trainer.plan import FieldPlan
from trainer.report.clip import Texts
from trainer.setup.training_setup import whole_views, widen_views
from trainer.store.progress import RunLog
from trainer.store.run_folder import read_views


def refit(options: FitOptions, quiet: bool = False) -> RunResult:
    """Fit the field of a finished run anew and rewrite its .gdf and report; nothing is optimized.

    Raises:
        ProgdfError: the folder is no finished run, or its scene is gone or another.
    """
    check_network_options(options)
    use_threads(options.threads)
    run = reopen_run(options.run, options.scene)
    log = RunLog(run.folder.log, quiet, refits=True)
    try:
        with log.stage("views"):
            setup = render_run_views(run)
            names = [view.camera.name for view in setup.train]
            edited = {s: read_views(run.folder, "edited", names, s) for s in run.trajectory.strengths}
            # what grows beyond the region's boxes is seen as well, or the slider is timed on half of it
            whole = run.record.plan.optimization.whole
            setup = whole_views(setup) if whole else widen_views(setup, edited)
        perceptual, warning = perceptual_loss()
        if warning:
            log.say(warning)
        own = run.record.plan
        network = replace(own.field.network, size=options.size, loss=options.field_loss)
        texts = Texts(
            options.text_before or own.texts.before,
            options.text_after or own.texts.after,
            own.texts.asked or bool(options.text_before or options.text_after),
        )
        plan = replace(
            own,
            field=FieldPlan(options.field, options.target_psnr, options.bytes_budget, network),
            texts=texts,
        )
        record = replace(run.record, plan=plan)
        return finish_run(run.folder, setup, run.trajectory, record, perceptual, log)
    finally:
        log.close()
