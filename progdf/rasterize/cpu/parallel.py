"""How many threads the kernels run on, and the pool that they share."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from typing import TypeVar

_T = TypeVar("_T")
_thread_count: int | None = None


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


def run_chunks(kernel: Callable[[int], _T], chunks: int) -> list[_T]:
    """Call `kernel(chunk)` for chunks 0, 1, …, each once, on this thread and those of the pool.

    A pool thread that has not begun when this one has run out of chunks is not waited for: waking one takes
    50 µs, as long as a small kernel. Kernels release the interpreter's lock.

    Returns:
        what the calls returned, by chunk
    """
    if min(threads(), chunks) <= 1:
        return [kernel(chunk) for chunk in range(chunks)]
    results: dict[int, _T] = {}
    following = itertools.count()

    def work() -> None:
        while (chunk := next(following)) < chunks:
            results[chunk] = kernel(chunk)

    others = [_pool().submit(work) for _ in range(min(threads(), chunks) - 1)]
    try:
        work()
    finally:
        begun = [other for other in others if not other.cancel()]
        wait(begun)
    for other in begun:
        other.result()  # raises what was raised there
    return [results[chunk] for chunk in range(chunks)]


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(1, _cores() - 1), thread_name_prefix="rasterize")


if hasattr(os, "register_at_fork"):  # a forked process has its parent's pool without the threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
