"""How many threads a run takes."""

from __future__ import annotations

import os

import torch

from progdf.errors import ProgdfError
from progdf.rasterize import set_threads
from trainer.options import MOST_THREADS


def use_threads(wanted: int) -> None:
    """Give torch and the rasterizer `wanted` threads; 0 is all cores."""
    count = wanted_threads(wanted)
    torch.set_num_threads(count)
    set_threads(count)


def wanted_threads(wanted: int) -> int:
    """How many threads `wanted` means.

    Raises:
        ProgdfError: fewer than none, or more than any machine has.
    """
    if not 0 <= wanted <= MOST_THREADS:
        raise ProgdfError(f"--threads must be between 0 and {MOST_THREADS}, got {wanted}")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return wanted or cores
