"""`progdf evaluate`: a finished run's figures in one table and one picture."""

from __future__ import annotations

from progdf.io.images import write_image
from progdf.terminal import print_line
from trainer.optimize.losses import perceptual_loss
from trainer.options import EvaluateOptions
from trainer.pipeline.refit import asked_texts
from trainer.pipeline.threads import use_threads
from trainer.store.run_folder import write_json

from .measures import Evaluation, evaluate_run
from .opened import open_run
from .picture import evaluation_picture
from .table import evaluation_json, evaluation_table


def evaluate(options: EvaluateOptions) -> Evaluation:
    """Measure a finished run; print a table, write it and its picture: RUN/evaluation.json and .png.

    Raises:
        ProgdfError: the folder is no finished run, a file of it is damaged, or its scene is gone or another.
    """
    use_threads(options.threads)
    opened = open_run(options.run, options.scene)
    perceptual, warning = perceptual_loss()
    if warning:
        print_line(warning.replace("training with", "measuring with"))
    texts = asked_texts(options.texts, opened.run.record.plan.texts)
    evaluation = evaluate_run(opened, perceptual, texts)
    folder = opened.run.folder
    write_json(folder.root / "evaluation.json", evaluation_json(evaluation))
    write_image(folder.root / "evaluation.png", evaluation_picture(opened, evaluation))
    for line in evaluation_table(evaluation).splitlines():
        print_line(line)
    print_line(f"wrote {folder.root / 'evaluation.json'} and evaluation.png")
    return evaluation
