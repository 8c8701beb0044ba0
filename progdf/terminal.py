"""Terminal output: formatted numbers, and text without control characters."""

from __future__ import annotations

import logging
import math
import os
import re
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager


def escape_text(text: str) -> str:
    """Return the text on one line, with escapes (\\x1b, \\n) for characters that are not printable."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def shorten(text: str, length: int = 80) -> str:
    """Return a text for a message, without its middle if it is longer than `length` characters."""
    if len(text) <= length:
        return text
    head = length * 5 // 8
    tail = length - 1 - head
    return f"{text[:head]}…{text[-tail:]}"


def elide(message: str) -> str:
    """Return a message without the middle of very long values.

    Paths that exist, or whose folder exists, stay whole so that the user can find them.
    """
    clauses = _LONG_WORD.sub(_shorten_word, message).split("; ")
    return "; ".join(
        shorten(clause, MAX_CLAUSE) if len(clause) > MAX_CLAUSE else clause for clause in clauses
    )


MAX_CLAUSE = 600  # characters of a part of a message between semicolons
_MAX_PATH = 300  # characters of a word with a path separator
_LONG_WORD = re.compile(r"[^\s'\"]{81,}")


def _shorten_word(match: re.Match[str]) -> str:
    word = match[0].rstrip(":;,.)")
    suffix = match[0][len(word) :]
    folder = os.path.dirname(word)
    if len(word) <= _MAX_PATH and folder:
        return match[0]
    if os.path.lexists(word) or (folder and os.path.isdir(folder)):
        return match[0]
    return shorten(word) + suffix


def print_line(line: str) -> None:
    """Print a line with `escape_text`."""
    print(escape_text(line))


class PrintableFormatter(logging.Formatter):
    """Formatter that writes each log record on one line, see `escape_text`."""

    def format(self, record: logging.LogRecord) -> str:
        return escape_text(super().format(record))


@contextmanager
def notice_when_slow(text: str, seconds: float = 1.0) -> Iterator[None]:
    """Print a line to stderr, if that is a terminal, when the block takes longer than `seconds`."""
    if not sys.stderr.isatty():
        yield
        return
    notice = threading.Timer(seconds, print, [escape_text(text)], {"file": sys.stderr, "flush": True})
    notice.daemon = True
    notice.start()
    try:
        yield
    finally:
        notice.cancel()


def format_count(count: int, noun: str = "Gaussian") -> str:
    """Return a count with its noun: "1 Gaussian", "12 345 Gaussians"."""
    return f"{group_digits(count)} {noun}{'' if count == 1 else 's'}"


def file_size(count: int) -> str:
    """Return a number of bytes as text: "4.7 MB", "1.8 kB"."""
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB"


def format_duration(seconds: float) -> str:
    """Return a duration as text: "12 s", "3 min", "1 h 20 min"."""
    if seconds < 90:
        return f"{max(round(seconds), 1)} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def format_place(at: float, size: float, digits: int) -> str:
    """Return a coordinate in an object of a given size as text.

    It has `digits` significant digits, plus one for each power of ten by which it exceeds the size.
    """
    beyond = math.log10(abs(at) / size) if at and size > 0 else 0.0
    return f"{at:.{digits + max(0, math.floor(beyond))}g}"


def group_digits(number: int) -> str:
    """Return a number with groups of three digits: "12 345"."""
    return f"{number:,}".replace(",", " ")
