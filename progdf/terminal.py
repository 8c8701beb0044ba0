"""Text on a terminal: names in files may hold anything, also what would command it."""

from __future__ import annotations

import logging


def printable(text: str) -> str:
    """The text on one line, with its escape (\\x1b, \\n) for what is nothing to look at."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def say(line: str) -> None:
    """Print a line, `printable`."""
    print(printable(line))


class PrintableFormatter(logging.Formatter):
    """Records as lines that are `printable`."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))
