"""Compilation of kernels in another process, once per machine.

numba compiles in one thread at a time. While a thread compiles for seconds, the first call of any kernel in
another thread waits, even of a small or cached one. Another process does not hold up this one.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .jit import kernel_cache, listeners

_POLL_S = 0.2  # seconds between two looks at the process that compiles


def is_compiled(module: str) -> bool:
    """Return True if the kernels of a module have been compiled on this machine, see `mark_compiled`."""
    return _marker(module).exists()


def mark_compiled(module: str) -> None:
    """Note that the kernels of a module are in the cache."""
    with suppress(OSError):
        _marker(module).touch()


@contextmanager
def count_kernels(total: int, report: Callable[[int, int], None]) -> Iterator[None]:
    """Report 0 of `total`, and the number of ready kernels after each one that is first called in the block.

    Args:
        total: number of kernels that the block calls; the number never exceeds it
        report: receives both numbers, also from other threads
    """
    done = 0
    lock = threading.Lock()

    def count() -> None:
        nonlocal done
        with lock:
            done = min(done + 1, total)
            report(done, total)

    report(0, total)
    listeners.append(count)
    try:
        yield
    finally:
        listeners.remove(count)


def compile_elsewhere(module: str, stop: threading.Event) -> None:
    """Call the function `warm_up` of a module in another process, and wait for its end.

    If that fails, the first use of the kernels compiles them.

    Args:
        module: name of the module
        stop: ends the work once it is set
    """
    command = [sys.executable, "-P", "-c", f"import {module}; {module}.warm_up()"]
    silent = subprocess.DEVNULL
    with suppress(OSError), subprocess.Popen(command, stdin=silent, stdout=silent, stderr=silent) as process:
        while process.poll() is None:
            if stop.wait(_POLL_S):
                process.kill()


def _marker(module: str) -> Path:
    return kernel_cache() / f"{module}.compiled"
