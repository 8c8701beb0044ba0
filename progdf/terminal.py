"""Text on a terminal: names in files may hold anything, also what would command it."""

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
