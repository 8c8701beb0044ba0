"""Command line parsing from a dataclass of options, with one-line errors."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from typing import Any, TypeVar

import tyro

from progdf.errors import ProgdfError

_Options = TypeVar("_Options")


def absent_option(metavar: str | None, absent: str = "") -> Any:
    """Return the tyro configuration of an optional argument.

    Args:
        metavar: name of the value in the help
        absent: description of the default in the help, or "" for none
    """
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {absent})" if absent else "")


def parse_options(
    kind: type[_Options], argv: Sequence[str], command: str, default: _Options | None = None
) -> _Options:
    """Parse options from the command line; `--help` prints and exits.

    Args:
        kind: a dataclass of options
        argv: the command line
        command: name of the command in help and errors
        default: source of options that argv does not set; None for the defaults of the dataclass

    Raises:
        ProgdfError: an option is missing, unknown or of the wrong kind, in one line.
    """
    errors = io.StringIO()
    argv = _join_negative_values(argv)
    try:
        with contextlib.redirect_stderr(errors):
            if default is None:
                return tyro.cli(kind, args=argv, prog=command)
            return tyro.cli(kind, args=argv, prog=command, default=default)
    except SystemExit as leaving:
        if not leaving.code:
            raise
        raise ProgdfError(f"{_short_message(errors.getvalue())}; see {command} --help") from None


def _join_negative_values(argv: Sequence[str]) -> list[str]:
    """Join `--up -y` to `--up=-y`, and likewise --orbit: tyro would parse the negative value as an option."""
    joined: list[str] = []
    for argument in argv:
        if joined and joined[-1] in ("--up", "--orbit"):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def _short_message(box: str) -> str:
    """Return the text of a tyro message, without the title, the frame and the advice below the rule.

    If the output cannot show a frame, the title is followed by its own rule.
    """
    text = re.sub(r"\x1b\[[0-9;]*m", "", box)
    lines = [line.strip("│ \t") for line in text.splitlines()]
    parts = "\n".join(line for line in lines if not line.startswith(("╭", "╰")))
    sections = re.split(r"^[─-]{4,}$", parts, flags=re.MULTILINE)
    message = " ".join(sections[0 if "╭" in text else 1 % len(sections)].split())
    message = re.sub(r"'None', |, 'None'", "", message).rstrip(".")  # None stands for an omitted option
    return message or "the options cannot be read"
