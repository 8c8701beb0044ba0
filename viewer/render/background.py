"""Work in other threads: in turn on a named thread, and the last result of a computation."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from typing import Generic, TypeVar

from progdf.threads import StoppedError, stopped_by

_T = TypeVar("_T")

AHEAD = "ahead"
"""Thread of the work that the pointer waits for."""


def run_in_background(work: Callable[..., object], *arguments: object, thread: str = AHEAD) -> None:
    """Run `work` in another thread, after the work submitted to it earlier."""
    _worker(thread).submit(work, *arguments)


@cache
def _worker(thread: str) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix=thread)


class LatestResult(Generic[_T]):
    """Last result of a computation in another thread. A newer request replaces a waiting one.

    Args:
        thread: name of the thread, see `run_in_background`
    """

    def __init__(self, thread: str = AHEAD) -> None:
        self._thread = thread
        self._key: object = None
        self._value: _T | None = None
        self._pending: object = None  # key of the computation in progress
        self._stop = threading.Event()

    def get(self, key: object, make: Callable[[], _T]) -> _T | None:
        """Return the result for a key; None while it is computed."""
        if key != self._key:
            self.drop()
            self._key = key
            self._pending = key
            self._stop = threading.Event()
            run_in_background(self._compute, key, make, self._stop, thread=self._thread)
        return self._value

    def finish(self, key: object, make: Callable[[], _T]) -> _T:
        """Return the result for a key; compute it at once if needed."""
        value = self._value
        if value is None or not self.has(key):
            value = make()
            self.drop()
            self._key = key
            self._value = value
        return value

    def has(self, key: object) -> bool:
        """Return True if the result for a key is available."""
        return key == self._key and self._value is not None

    @property
    def value(self) -> _T | None:
        """Result of the last request; None while it is computed."""
        return self._value

    @property
    def is_busy(self) -> bool:
        """True if a requested result is missing."""
        return self._pending is not None

    def drop(self) -> None:
        """Cancel the computation and forget the result."""
        self._stop.set()
        self._key = self._value = self._pending = None

    def _compute(self, key: object, make: Callable[[], _T], stop: threading.Event) -> None:
        if stop.is_set():
            return
        try:
            with stopped_by(stop), suppress(StoppedError):
                value = make()
                if key is self._key:
                    self._value = value
        finally:
            if key is self._pending:
                self._pending = None
