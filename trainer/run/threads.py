"""How many threads a run takes."""

from __future__ import annotations

import os

import torch

from progdf.errors import ProgdfError
from progdf.rasterize import set_threads
from trainer.options import MOST_THREADS


def use_threads(threads: int) -> None:
    """Give torch and the rasterizer `threads` threads; 0 is all cores."""
    count = count_threads(threads)
    torch.set_num_threads(count)
    set_threads(count)


def count_threads(threads: int) -> int:
    """How many threads `threads` means.

    Raises:
        ProgdfError: fewer than none, or more than any machine has.
    """
    if not 0 <= threads <= MOST_THREADS:
        raise ProgdfError(f"--threads must be between 0 and {MOST_THREADS}, got {threads}")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return threads or cores
