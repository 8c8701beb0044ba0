"""Entry points of the trainer's commands. Each parses its command line into a dataclass of options."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from progdf.cli.options import parse_options
from progdf.errors import ProgdfError
from progdf.system.processes import lower_priority
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
    """Run `progdf train`; return 0 when edit and report are written. Raises ProgdfError for user errors."""
    options = train_options(argv)
    from trainer.run.run import train as run  # late import: --help and option errors do not need torch

    if options.editor.family in ("api", "comfy"):
        _ask_to_send(options)
    run(options, on_delivery=lower_priority)
    return 0


def _ask_to_send(options: TrainOptions) -> None:
    """Print where pictures are sent, and ask once if that is another machine and --yes is not given.

    Raises:
        ProgdfError: the user declines, or nobody can be asked.
    """
    from trainer.editors.server.editor import check_served, explain_sending
    from trainer.resolve import resolve

    resolved = resolve(options)
    line = explain_sending(resolved.editor, resolved.views.views, resolved.optimize.stages)
    print(line, file=sys.stderr)
    if options.editor.yes or check_served(resolved.editor).address.is_local:
        return
    if not sys.stdin.isatty():
        raise ProgdfError("pictures are sent to another machine only if you agree; add --yes")
    if input("Send them? [y/N] ").strip().lower() not in ("y", "yes"):
        raise ProgdfError("nothing was sent; use a server on this machine, or answer y")


def batch(argv: Sequence[str]) -> int:
    """Run `progdf batch`; return 0 if all jobs succeeded, 2 if an error prevented the start, 3 if some jobs
    failed."""
    options = parse_options(BatchOptions, argv, "progdf batch")
    from trainer.batch.run import batch as run

    return run(options)


def fit(argv: Sequence[str]) -> int:
    """Run `progdf fit`; return 0 when the edit is rewritten. Raises ProgdfError for user errors."""
    options = parse_options(FitOptions, argv, "progdf fit")
    from .run.finish import refit

    refit(options)
    return 0


def evaluate(argv: Sequence[str]) -> int:
    """Run `progdf evaluate`; return 0 when all is measured. Raises ProgdfError for user errors."""
    options = parse_options(EvaluateOptions, argv, "progdf evaluate")
    if options.suite is not None:
        from trainer.evaluate.suite.run import evaluate_suite

        evaluate_suite(options)
        return 0
    from trainer.evaluate.command import evaluate as run

    run(options)
    return 0


def train_options(argv: Sequence[str]) -> TrainOptions:
    """Parse a command line. Its own values override those of its preset, which override the defaults."""
    options = parse_options(TrainOptions, argv, "progdf train")
    if options.preset == "default":
        return options
    return parse_options(TrainOptions, argv, "progdf train", apply_preset(options, options.preset))


def region(argv: Sequence[str]) -> int:
    """Run `progdf region`; return 0 when the output is written. Raises ProgdfError for user errors."""
    options = parse_options(ShowRegionOptions, argv, "progdf region")
    from trainer.regions.command import show

    for line in show(options):
        print_line(line)
    return 0


def views(argv: Sequence[str]) -> int:
    """Run `progdf views`; return 0 when the views are written. Raises ProgdfError for user errors."""
    options = parse_options(WriteViewsOptions, argv, "progdf views")
    from .regions.command import write

    for line in write(options):
        print_line(line)
    return 0
