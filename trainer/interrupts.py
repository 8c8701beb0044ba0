"""Ctrl-C and SIGTERM end a run at once, except between steps that must stay whole: there they wait."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def stopping() -> Iterator[None]:
    """SIGTERM is a KeyboardInterrupt too, so that both end in the same way."""

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        raise KeyboardInterrupt

    with _handled((signal.SIGTERM,), stop):
        yield


@contextmanager
def held() -> Iterator[Callable[[], bool]]:
    """Hold Ctrl-C and SIGTERM back; the yielded function tells whether one came.

    Ask it where the state is whole, save, and raise KeyboardInterrupt. A second signal does not wait, and
    neither does one that nobody asked about.
    """
    came = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal came
        if came:
            raise KeyboardInterrupt
        came = True

    with _handled(_SIGNALS, note):
        yield lambda: came
    if came:
        raise KeyboardInterrupt


@contextmanager
def _handled(
    signals: tuple[signal.Signals, ...], handler: Callable[[int, FrameType | None], None]
) -> Iterator[None]:
    """Python lets only the main thread handle signals; elsewhere whoever owns that thread does."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    earlier = {number: signal.signal(number, handler) for number in signals}
    try:
        yield
    finally:
        for number, was in earlier.items():
            signal.signal(number, was)
