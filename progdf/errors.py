"""The error that a person at the keyboard can mend, and text from files made safe to print."""

from __future__ import annotations

import logging


def escape_text(text: str) -> str:
    """The text on one line, with its escape (\\x1b, \\n) for what is nothing to look at."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def print_line(line: str) -> None:
    """Print a line with `escape_text`."""
    print(escape_text(line))


class PrintableFormatter(logging.Formatter):
    """Log records as lines with `escape_text`."""

    def format(self, record: logging.LogRecord) -> str:
        return escape_text(super().format(record))


class ProgdfError(ValueError):
    """Something the user can mend: a broken file, a wrong option, two files that do not belong together.

    The message is one line, `WHAT IS WRONG; WHAT WOULD BE RIGHT`, whatever names in files hold. Commands
    print it and exit with status 2.
    """

    def __str__(self) -> str:
        return escape_text(" ".join(super().__str__().split()))
