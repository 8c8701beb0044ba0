"""`progdf evaluate`: a finished run's figures in one table and one picture, or the suite of known courses."""

from __future__ import annotations

from progdf.errors import ProgdfError
from progdf.io.atomic import make_folder
from progdf.io.images import write_image
from progdf.terminal import print_line
from trainer.optimize.losses import Perceptual, perceptual_loss
from trainer.pipeline.threads import use_threads
from trainer.report.clip import Texts
from trainer.store.run_folder import write_json

from .measures import Evaluation, evaluate_run
from .opened import OpenedRun, open_run
from .options import EvaluateOptions
from .picture import evaluation_picture
from .suite import CaseResult, run_suite
from .suite_report import suite_json, suite_picture, suite_table
from .table import evaluation_json, evaluation_table


def evaluate(options: EvaluateOptions) -> None:
    """Print a table; write it and its picture: RUN/evaluation.json and .png, of a suite RUN/sliders.*

    Raises:
        ProgdfError: the folder is no finished run, a file of it is damaged, or its scene is gone or another;
            the suite's folder cannot be written to.
    """
    use_threads(options.threads)
    if options.suite is None:
        evaluate_folder(options)
    else:
        evaluate_suite(options)


def evaluate_suite(options: EvaluateOptions) -> list[CaseResult]:
    """Train and compare the suite's edits in the folder `options.run`."""
    for name in ("scene", "text_before", "text_after"):
        if getattr(options, name):
            raise ProgdfError(f"--{name.replace('_', '-')} is for a run; leave it away with --suite")
    make_folder(options.run)
    perceptual = _perceptual()
    found = run_suite(options.run, perceptual, options.threads, print_line)
    write_json(options.run / "sliders.json", suite_json(found, perceptual.name))
    write_image(options.run / "sliders.png", suite_picture(found))
    _print_table(suite_table(found))
    print_line(f"wrote {options.run / 'sliders.json'} and sliders.png")
    return found


def evaluate_folder(options: EvaluateOptions) -> Evaluation:
    """Measure the finished run in the folder `options.run`."""
    opened = open_run(options.run, options.scene)
    perceptual = _perceptual()
    found = evaluate_run(opened, perceptual, _texts(opened, options))
    folder = opened.run.folder
    write_json(folder.root / "evaluation.json", evaluation_json(found))
    write_image(folder.root / "evaluation.png", evaluation_picture(opened, found))
    _print_table(evaluation_table(found))
    print_line(f"wrote {folder.root / 'evaluation.json'} and evaluation.png")
    return found


def _perceptual() -> Perceptual:
    measure, warning = perceptual_loss()
    if warning:
        print_line(warning.replace("training with", "measuring with"))
    return measure


def _print_table(table: str) -> None:
    for line in table.splitlines():
        print_line(line)


def _texts(opened: OpenedRun, options: EvaluateOptions) -> Texts:
    """What CLIP is asked: the command's own words, or the run's."""
    own = opened.run.record.plan.texts
    return Texts(options.text_before or own.before, options.text_after or own.after, True)
