"""How many threads the kernels run on, and the pool that they share."""

from __future__ import annotations

import ctypes
import itertools
import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from functools import cache
from typing import TypeVar

_T = TypeVar("_T")
_thread_count: int | None = None
_left = threading.local()
_stops = threading.local()


def set_threads(count: int | None) -> None:
    """Let the cpu engine use `count` threads (≥ 1); None: all cores that this process may use.

    The image and its gradients are the same bits for every count.
    """
    global _thread_count
    if count is not None and count < 1:
        raise ValueError(f"the number of threads must be at least 1, got {count}")
    _thread_count = count


def threads() -> int:
    """How many threads the next call of the cpu engine uses."""
    return _cores() if _thread_count is None else _thread_count


class StoppedError(Exception):
    """Nobody wants the result any more."""


@contextmanager
def stopped_by(event: threading.Event) -> Iterator[None]:
    """Let what this thread does be given up, between two chunks, once the event is set: StoppedError."""
    _stops.event = event
    try:
        yield
    finally:
        del _stops.event


def run_chunks(kernel: Callable[[int], _T], chunks: int) -> list[_T]:
    """Call `kernel(chunk)` for chunks 0, 1, …, each once, on this thread and those of the pool.

    A pool thread that has not begun when this one has run out of chunks is not waited for: waking one takes
    50 µs, as long as a small kernel. Kernels release the interpreter's lock.

    Returns:
        what the calls returned, by chunk
    """
    stop: threading.Event | None = getattr(_stops, "event", None)

    def run(chunk: int) -> _T:
        if stop is not None and stop.is_set():
            raise StoppedError
        return kernel(chunk)

    if min(threads(), chunks) <= 1:
        return [run(chunk) for chunk in range(chunks)]
    results: dict[int, _T] = {}
    following = itertools.count()
    core = _current_core()

    def work() -> None:
        while (chunk := next(following)) < chunks:
            results[chunk] = run(chunk)

    def work_elsewhere() -> None:
        _leave(core)
        work()

    others = [_pool().submit(work_elsewhere) for _ in range(min(threads(), chunks) - 1)]
    try:
        work()
    finally:
        begun = [other for other in others if not other.cancel()]
        wait(begun)
    for other in begun:
        other.result()  # raises what was raised there
    return [results[chunk] for chunk in range(chunks)]


def _leave(core: int) -> None:
    """Keep this thread off a core.

    A virtual machine's idle cores look busy to Linux, which therefore wakes a thread on the core of the one
    that wakes it: both would share it for up to two ticks, 8 ms, while the other core idles.
    """
    if sys.platform == "linux" and core >= 0 and getattr(_left, "core", None) != core:
        others = os.sched_getaffinity(os.getpid()) - {core}
        if others:
            with suppress(OSError):  # a container may forbid it
                os.sched_setaffinity(0, others)
        _left.core = core


@cache
def _find_getcpu() -> Callable[[], int]:
    """glibc's sched_getcpu; elsewhere a function that returns −1."""
    found = getattr(ctypes.PyDLL(None), "sched_getcpu", None) if sys.platform == "linux" else None
    return found or (lambda: -1)


def _current_core() -> int:
    return _find_getcpu()()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(1, _cores() - 1), thread_name_prefix="rasterize")


if hasattr(os, "register_at_fork"):  # a forked process has its parent's pool without the threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
