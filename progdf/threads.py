"""Thread counts of torch and the kernels, and the thread pool that the kernels share.

In code with hundreds of small torch operations per second, torch's threads wait for each other at every
operation and spin against the rasterizer's threads. Solving an edit of one picture took 5.2 s on two threads
and 2.6 s on one. So torch uses one thread, except for large operations.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache, partial
from typing import TypeVar

import torch

from progdf.system.processes import usable_cores

_A = TypeVar("_A")
_T = TypeVar("_T")

MAX_THREADS = torch.get_num_threads()
"""Initial number of threads of torch."""

_ITEMS_PER_THREAD = 2  # items of `stream_threads` that are computed together, per thread

_thread_count: int | None = None
_local = threading.local()


@contextmanager
def _torch_threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count or MAX_THREADS)
    try:
        yield
    finally:
        torch.set_num_threads(before)


one_thread = partial(_torch_threads, 1)
"""Context manager and decorator that limits torch to one thread."""

all_threads = partial(_torch_threads, 0)
"""Context manager and decorator that lets torch use its initial number of threads, for baking networks."""


def set_threads(count: int | None) -> None:
    """Set the number of threads of the cpu engine, ≥ 1; None: all cores available to the process.

    Images and gradients are bit-identical for every count.

    Raises:
        ValueError: the count is below 1.
    """
    global _thread_count
    if count is not None and count < 1:
        raise ValueError(f"the number of threads must be at least 1, got {count}")
    _thread_count = count


def threads() -> int:
    """Return the number of threads of the next call of the cpu engine."""
    return usable_cores() if _thread_count is None else _thread_count


class StoppedError(Exception):
    """Error raised in a cancelled computation."""


@contextmanager
def stopped_by(event: threading.Event) -> Iterator[None]:
    """Raise StoppedError in `run_chunks` of this thread, between two chunks, once the event is set."""
    _local.stop = event
    try:
        yield
    finally:
        del _local.stop


@contextmanager
def without_pool() -> Iterator[None]:
    """Run the kernels of this thread on it alone, so that background work leaves the other cores free."""
    before = getattr(_local, "is_inner", False)
    _local.is_inner = True
    try:
        yield
    finally:
        _local.is_inner = before


def run_chunks(kernel: Callable[[int], _T], chunks: int) -> list[_T]:
    """Call `kernel(chunk)` once for each chunk 0, 1, …, on this thread and those of the pool.

    When this thread finds no more chunks, it cancels pool threads that have not started. Waking one takes 50
    µs, as long as a small kernel. Kernels release the interpreter lock. numba's own parallel loops are no
    replacement, see docs/lab/experiments.md, The rasterizer's threads.

    Nested calls run on the thread of the outer kernel. The pool is busy with the other chunks and would delay
    the nested ones until these are finished.

    Returns:
        Results by chunk.

    Raises:
        StoppedError: the event of `stopped_by` is set.
    """
    stop: threading.Event | None = getattr(_local, "stop", None)
    remaining = iter(range(chunks))
    results: dict[int, _T] = {}
    is_inner = getattr(_local, "is_inner", False)

    def work() -> None:
        _local.is_inner = is_inner or chunks > 1
        try:
            for chunk in remaining:  # a shared iterator, so that each chunk goes to one thread
                if stop is not None and stop.is_set():
                    raise StoppedError
                results[chunk] = kernel(chunk)
        finally:
            _local.is_inner = is_inner

    helper_count = 0 if is_inner else min(threads(), chunks) - 1
    helpers = [_pool().submit(work) for _ in range(helper_count)]
    try:
        work()
    finally:
        started = [helper for helper in helpers if not helper.cancel()]
        wait(started)
    for helper in started:
        helper.result()  # raises exceptions of the pool thread
    return [results[chunk] for chunk in range(chunks)]


@one_thread()  # as in the pool's threads; otherwise rounding would depend on the thread of an item
def map_threads(work: Callable[[_A], _T], items: Sequence[_A]) -> list[_T]:
    """Return `work(item)` of every item, on the threads of the cpu engine; bit-identical for any number."""
    return run_chunks(lambda index: work(items[index]), len(items))


def stream_threads(work: Callable[[_A], _T], items: Sequence[_A]) -> Iterator[_T]:
    """Yield the results of `map_threads` in order, a few at a time, for results too large to keep all."""
    count = _ITEMS_PER_THREAD * threads()
    for start in range(0, len(items), count):
        yield from map_threads(work, items[start : start + count])


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(1, usable_cores() - 1), "kernels", torch.set_num_threads, (1,))


if hasattr(os, "register_at_fork"):  # a forked process inherits the pool without its threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
