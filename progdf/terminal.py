"""Terminal output and processes: formatted numbers, text without control characters, signals, priority."""

from __future__ import annotations

import _thread
import ctypes
import logging
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from queue import SimpleQueue
from types import FrameType

ENDINGS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that request the end of the process, or report a closed terminal. Windows has no SIGHUP."""


_BELOW_NORMAL_PRIORITY_CLASS = 0x4000  # of the Windows API

REDELIVERY_DELAY_S = 0.02  # long enough for the callback that lost a signal to return

_lost_signals = SimpleQueue[int]()  # a queue whose `put` is safe inside weakref callbacks


@dataclass
class _Delivery:
    """State of the signals of the main thread."""

    number: int = signal.SIGINT  # the latest signal
    depth: int = 0  # number of open `handle_signals` blocks; lost signals are sent again only inside one
    thread: threading.Thread | None = None  # runs `_send_lost_signals`


_delivery = _Delivery()


@contextmanager
def handle_signals(
    signals: tuple[signal.Signals, ...], handler: Callable[[int, FrameType | None], None]
) -> Iterator[None]:
    """Handle signals inside the block. Ignored signals stay ignored, as under nohup.

    Python ignores an exception that leaves a weakref callback, a `__del__` or a ctypes callback. A
    KeyboardInterrupt lost in this way is detected by `sys.unraisablehook`, and its signal is sent again.

    Python lets only the main thread handle signals. In other threads the block changes nothing.

    Args:
        signals: the signals to handle
        handler: called with the signal's number and the interrupted frame; may raise KeyboardInterrupt
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: FrameType | None) -> None:
        _delivery.number = number
        if frame is not None and frame.f_code is note_lost_interrupt.__code__:
            _lost_signals.put(number)  # an exception here would be lost, too
            return
        handler(number, frame)

    def note_lost_interrupt(unraisable: sys.UnraisableHookArgs) -> None:
        if unraisable.exc_type is not KeyboardInterrupt:
            earlier_hook(unraisable)
            return
        _lost_signals.put(_delivery.number)

    if _delivery.thread is None or not _delivery.thread.is_alive():  # none, or of a parent process
        _delivery.thread = threading.Thread(target=_send_lost_signals, daemon=True)
        _delivery.thread.start()
    earlier_hook = sys.unraisablehook
    sys.unraisablehook = note_lost_interrupt
    _delivery.depth += 1
    handled = [number for number in signals if signal.getsignal(number) != signal.SIG_IGN]
    earlier = {number: signal.signal(number, handle) for number in handled}
    try:
        yield
    finally:
        _delivery.depth -= 1
        for number, earlier_handler in earlier.items():
            signal.signal(number, earlier_handler)
        sys.unraisablehook = earlier_hook


def _send_lost_signals() -> None:
    """Send each lost signal again, once the callback that lost it has had time to return."""
    while True:
        number = _lost_signals.get()
        time.sleep(REDELIVERY_DELAY_S)
        if _delivery.depth:
            signal_main_thread(number)


def signal_main_thread(number: int = signal.SIGINT) -> None:
    """Send a signal to the main thread, which wakes it where it waits (not on Windows)."""
    if sys.platform == "win32":
        _thread.interrupt_main(signal.Signals(number))
    else:
        signal.pthread_kill(threading.main_thread().ident or 0, number)


NICENESS = 10
"""Niceness that `lower_priority` adds, as by nice(1): a tenth of a core that another program keeps busy.

SCHED_IDLE would give it nothing, and an unprivileged process cannot leave that policy again.
"""


def lower_priority(process: int | None = None) -> None:
    """Lower the priority of a process for good; do nothing where the system refuses.

    Linux keeps a niceness per thread, so all threads that run now get it. New threads inherit it.

    Args:
        process: id of a child that has just started; None: this process. On Windows, start a child with
            BELOW_NORMAL_PRIORITY_CLASS instead
    """
    if sys.platform == "win32":
        if process is None:
            this_process = ctypes.c_void_p(-1)  # as GetCurrentProcess returns it
            ctypes.windll.kernel32.SetPriorityClass(this_process, _BELOW_NORMAL_PRIORITY_CLASS)
        return
    with suppress(OSError):
        niceness = os.getpriority(os.PRIO_PROCESS, 0) + NICENESS
        threads = [process or 0]
        if process is None and sys.platform == "linux":
            threads = [int(name) for name in os.listdir("/proc/self/task")]
        for thread in threads:
            os.setpriority(os.PRIO_PROCESS, thread, niceness)


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
