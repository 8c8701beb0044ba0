"""Options from a command line, made from their dataclass; what is wrong with them is one line."""

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
    """How help shows an option that may be left out: its value's name, and what happens then."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {absent})" if absent else "")


def parse_options(
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
    """`--up -y` as `--up=-y`, and so with --orbit: what begins with a minus would be taken for an option."""
    joined: list[str] = []
    for argument in argv:
        if joined and joined[-1] in ("--up", "--orbit"):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def _short_message(box: str) -> str:
    """What tyro's message says, without the title, the frame and the advice below the rule.

    Where the output cannot show a frame, the title stands above a rule of its own.
    """
    text = re.sub(r"\x1b\[[0-9;]*m", "", box)
    lines = [line.strip("│ \t") for line in text.splitlines()]
    parts = "\n".join(line for line in lines if not line.startswith(("╭", "╰")))
    sections = re.split(r"^[─-]{4,}$", parts, flags=re.MULTILINE)
    message = " ".join(sections[0 if "╭" in text else 1 % len(sections)].split())
    message = re.sub(r"'None', |, 'None'", "", message).rstrip(".")  # None: the option left out
    return message or "the options cannot be read"
