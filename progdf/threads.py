"""On how many threads torch and the kernels work, and the thread pool that the kernels share.

Where torch is asked for hundreds of small things a second, its threads wait for each other at every one, and
spin against the rasterizer's: an edit of one picture was solved in 5.2 s on two threads and in 2.6 on one.
So it works on one, but where it has much to do at once.
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

_A = TypeVar("_A")
_T = TypeVar("_T")

MAX_THREADS = torch.get_num_threads()

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
"""Let torch work on one thread meanwhile; also as a decorator."""

all_threads = partial(_torch_threads, 0)
"""Let torch work on as many threads as when the program began: for networks that are baked."""


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
    """Raised when the result was cancelled."""


@contextmanager
def stopped_by(event: threading.Event) -> Iterator[None]:
    """Cancel what this thread does, between two chunks, once the event is set: StoppedError."""
    _local.stop = event
    try:
        yield
    finally:
        del _local.stop


def run_chunks(kernel: Callable[[int], _T], chunks: int) -> list[_T]:
    """Call `kernel(chunk)` for chunks 0, 1, …, each once, on this thread and those of the pool.

    A pool thread that has not begun when this one has run out of chunks is not waited for: waking one takes
    50 µs, as long as a small kernel. Kernels release the interpreter's lock. numba's own parallel loops are
    no replacement: see docs/experiments.md, The rasterizer's threads. What a kernel calls this for stays on
    its thread: the pool is busy with the others, and would keep what it is asked for until they are done.

    Returns:
        what the calls returned, by chunk
    """
    stop: threading.Event | None = getattr(_local, "stop", None)
    following, results, is_inner = iter(range(chunks)), {}, getattr(_local, "is_inner", False)

    def work() -> None:
        _local.is_inner = is_inner or chunks > 1
        try:
            for chunk in following:  # each is one thread's
                if stop is not None and stop.is_set():
                    raise StoppedError
                results[chunk] = kernel(chunk)
        finally:
            _local.is_inner = is_inner

    others = [_pool().submit(work) for _ in range(0 if is_inner else min(threads(), chunks) - 1)]
    try:
        work()
    finally:
        started = [other for other in others if not other.cancel()]
        wait(started)
    for other in started:
        other.result()  # raises what was raised there
    return [results[chunk] for chunk in range(chunks)]


@one_thread()  # as those of the pool have: else who gets an item would decide on its last bits
def map_threads(work: Callable[[_A], _T], items: Sequence[_A]) -> list[_T]:
    """`work` of every item, on as many threads as the cpu engine has; the same bits on any number."""
    return run_chunks(lambda index: work(items[index]), len(items))


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(1, _cores() - 1), "kernels", torch.set_num_threads, (1,))


if hasattr(os, "register_at_fork"):  # a forked process has its parent's pool without the threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
