"""Text for a person at a terminal: numbers and sizes in words, names without control characters."""

from __future__ import annotations

import logging
import math


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


def format_count(count: int, noun: str = "Gaussian") -> str:
    """1 as "1 Gaussian", 12345 as "12 345 Gaussians"."""
    return f"{group_digits(count)} {noun}{'' if count == 1 else 's'}"


def file_size(count: int) -> str:
    """Bytes for a person: "4.7 MB", "1.8 kB"."""
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB"


def format_duration(seconds: float) -> str:
    """ "12 s", "3 min", "1 h 20 min"."""
    if seconds < 90:
        return f"{max(round(seconds), 1)} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def format_place(at: float, size: float, digits: int) -> str:
    """A coordinate of something of this size: so many digits, and those by which it is farther off."""
    beyond = math.log10(abs(at) / size) if at and size > 0 else 0.0
    return f"{at:.{digits + max(0, math.floor(beyond))}g}"


def group_digits(number: int) -> str:
    """12345 as "12 345"."""
    return f"{number:,}".replace(",", " ")
