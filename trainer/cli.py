"""`progdf train`, `progdf fit` and `progdf ablate`: the command line, made from the options' dataclasses."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from typing import TypeVar

import tyro

from progdf.errors import ProgdfError
from trainer.options import AblateOptions, FitOptions, TrainOptions
from trainer.presets import under_preset

_Options = TypeVar("_Options")


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


def ablate(argv: Sequence[str]) -> int:
    """Run `progdf ablate`; 0 when the table is written. Raises ProgdfError for what the user can mend."""
    options = parsed(AblateOptions, argv, "progdf ablate")
    from trainer.ablate import ablate as run
    from trainer.ablation_table import print_table

    done = run(options)
    print_table(done.outcomes, done.title, done.perceptual)
    return 0


def parsed(
    kind: type[_Options], argv: Sequence[str], command: str, default: _Options | None = None
) -> _Options:
    """Options from the command line; `--help` prints and exits.

    Args:
        kind: a dataclass of options
        argv: the command line
        command: what help and errors call it
        default: where options come from that argv does not give; None: the dataclass

    Raises:
        ProgdfError: an option is missing, unknown or of the wrong kind, in one line.
    """
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            if default is None:
                return tyro.cli(kind, args=list(argv), prog=command)
            return tyro.cli(kind, args=list(argv), prog=command, default=default)
    except SystemExit as leaving:
        if not leaving.code:
            raise
        raise ProgdfError(f"{_first_words(said.getvalue())}; see {command} --help") from None


def _first_words(box: str) -> str:
    """What tyro's framed message says, without the frame and the advice below the rule."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", box)
    lines = [line.strip("│ \t").strip() for line in text.splitlines()]
    kept = []
    for line in lines:
        if line.startswith("────"):
            break
        if line and not line.startswith(("╭", "╰")):
            kept.append(line)
    return " ".join(kept) or "the options cannot be read"
