"""Text for a person at a terminal: numbers and sizes in words, names without control characters; and what a
terminal sends to end a program."""

from __future__ import annotations

import logging
import math
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

ENDINGS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Sent by who wants a process to end, and by a terminal that is closed; Windows has no SIGHUP."""


@contextmanager
def handle_signals(
    signals: tuple[signal.Signals, ...], handler: Callable[[int, FrameType | None], None]
) -> Iterator[None]:
    """Python lets only the main thread handle signals; elsewhere the owner of that thread does."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heeded = [number for number in signals if signal.getsignal(number) != signal.SIG_IGN]  # nohup's stays
    earlier = {number: signal.signal(number, handler) for number in heeded}
    try:
        yield
    finally:
        for number, was in earlier.items():
            signal.signal(number, was)


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
