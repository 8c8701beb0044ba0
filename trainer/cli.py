"""`progdf train`, `progdf fit` and `progdf ablate`: the command line, made from the options' dataclasses."""

from __future__ import annotations

from collections.abc import Sequence

from progdf.command_line import parsed
from trainer.options import AblateOptions, FitOptions, TrainOptions
from trainer.presets import under_preset
from trainer.region_options import RegionOptions, ViewsOptions, joined


def train(argv: Sequence[str]) -> int:
    """Run `progdf train`; 0 when the edit is written. Raises ProgdfError for what the user can mend."""
    options = train_options(argv)
    from trainer.run import train as run  # only now: --help and a mistyped option need no torch

    run(options)
    return 0


def fit(argv: Sequence[str]) -> int:
    """Run `progdf fit`; 0 when the edit is rewritten. Raises ProgdfError for what the user can mend."""
    options = parsed(FitOptions, argv, "progdf fit")
    from trainer.run import refit

    refit(options)
    return 0


def train_options(argv: Sequence[str]) -> TrainOptions:
    """What a command line asks for: what it says itself, then its preset, then the defaults."""
    options = parsed(TrainOptions, argv, "progdf train")
    if options.preset == "default":
        return options
    return parsed(TrainOptions, argv, "progdf train", under_preset(options, options.preset))


def region(argv: Sequence[str]) -> int:
    """Run `progdf region`; 0 when it is shown or kept. Raises ProgdfError for what the user can mend."""
    options = parsed(RegionOptions, joined(argv), "progdf region")
    from trainer.region_picture import show

    print(show(options))
    return 0


def views(argv: Sequence[str]) -> int:
    """Run `progdf views`; 0 when they are written. Raises ProgdfError for what the user can mend."""
    options = parsed(ViewsOptions, argv, "progdf views")
    from trainer.original_views import write

    print(write(options))
    return 0


def ablate(argv: Sequence[str]) -> int:
    """Run `progdf ablate`; 0 when the table is written. Raises ProgdfError for what the user can mend."""
    options = parsed(AblateOptions, argv, "progdf ablate")
    from trainer.ablate import ablate as run
    from trainer.ablation_table import print_table

    done = run(options)
    print_table(done.outcomes, done.title, done.perceptual)
    return 0
