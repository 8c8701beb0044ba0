"""How many threads the fast engine uses."""

from __future__ import annotations

import os

_wanted: int | None = None


def set_threads(count: int | None) -> None:
    """Let the cpu engine use `count` threads (≥ 1); None: all cores that this process may use.

    The picture and its gradients are the same bits for every count.
    """
    global _wanted
    if count is not None and count < 1:
        raise ValueError(f"{count} threads asked for, expected at least 1")
    _wanted = count


def threads() -> int:
    """Threads that the cpu engine asks for at its next call."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    return cores if _wanted is None else _wanted
