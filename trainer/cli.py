"""The command lines of the trainer's commands, made from dataclasses."""

from __future__ import annotations

from collections.abc import Sequence

from progdf.cli.options import parse_options
from progdf.terminal import print_line

from .options import (
    BatchOptions,
    EvaluateOptions,
    FitOptions,
    ShowRegionOptions,
    TrainOptions,
    WriteViewsOptions,
    apply_preset,
)


def train(argv: Sequence[str]) -> int:
    """Run `progdf train`; 0 when the edit is written. Raises ProgdfError for what the user can mend."""
    options = train_options(argv)
    from trainer.run.run import train as run  # only now: --help and a mistyped option need no torch

    run(options)
    return 0


def batch(argv: Sequence[str]) -> int:
    """Run `progdf batch`; 0 all done, 2 something is wrong and nothing was started, 3 some failed."""
    options = parse_options(BatchOptions, argv, "progdf batch")
    from trainer.batch.run import batch as run

    return run(options)


def fit(argv: Sequence[str]) -> int:
    """Run `progdf fit`; 0 when the edit is rewritten. Raises ProgdfError for what the user can mend."""
    options = parse_options(FitOptions, argv, "progdf fit")
    from .run.finish import refit

    refit(options)
    return 0


def evaluate(argv: Sequence[str]) -> int:
    """Run `progdf evaluate`; 0 when all is measured. Raises ProgdfError for what the user can mend."""
    options = parse_options(EvaluateOptions, argv, "progdf evaluate")
    from trainer.evaluate.command import evaluate as run

    run(options)
    return 0


def train_options(argv: Sequence[str]) -> TrainOptions:
    """What a command line asks for: what it says itself, then its preset, then the defaults."""
    options = parse_options(TrainOptions, argv, "progdf train")
    if options.preset == "default":
        return options
    return parse_options(TrainOptions, argv, "progdf train", apply_preset(options, options.preset))


def region(argv: Sequence[str]) -> int:
    """Run `progdf region`; 0 when it is shown or kept. Raises ProgdfError for what the user can mend."""
    options = parse_options(ShowRegionOptions, argv, "progdf region")
    from trainer.regions.command import show

    for line in show(options):
        print_line(line)
    return 0


def views(argv: Sequence[str]) -> int:
    """Run `progdf views`; 0 when they are written. Raises ProgdfError for what the user can mend."""
    options = parse_options(WriteViewsOptions, argv, "progdf views")
    from .regions.command import write

    for line in write(options):
        print_line(line)
    return 0
