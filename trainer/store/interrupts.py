"""Ctrl-C, SIGTERM and SIGHUP end a run at once, except in steps that must stay whole: there they wait."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

_ENDINGS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Sent by who wants a process to end, and by a terminal that is closed; Windows has no SIGHUP."""


@contextmanager
def interrupt_on_signals() -> Iterator[None]:
    """SIGTERM and SIGHUP are a KeyboardInterrupt too, so that all end in the same way."""

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        raise KeyboardInterrupt

    with _handle_signals(_ENDINGS, stop):
        yield


@contextmanager
def defer_signals() -> Iterator[Callable[[], bool]]:
    """Hold Ctrl-C, SIGTERM and SIGHUP back; the yielded function says whether one came.

    Ask it where the state is whole, save, and raise KeyboardInterrupt. A second signal does not wait, and
    neither does one that nobody asked about.
    """
    came = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal came
        if came:
            raise KeyboardInterrupt
        came = True

    with _handle_signals((signal.SIGINT, *_ENDINGS), note):
        yield lambda: came
    if came:
        raise KeyboardInterrupt


@contextmanager
def _handle_signals(
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
