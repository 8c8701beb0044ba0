"""Tests of the memory that a training keeps for reuse."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

_CHECK = """
import resource
import numpy as np
from trainer.store.memory import reuse_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(8 << 20, np.float64)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

reuse_memory()
first = faults()
print(first, faults())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs the C library of GNU")
def test_freed_blocks_of_64_mb_are_reused() -> None:
    # without huge pages; the kernel may still map 16 or 64 kB at once
    environment = {**os.environ, "NUMPY_MADVISE_HUGEPAGE": "0"}
    code = subprocess.run(
        [sys.executable, "-c", _CHECK], capture_output=True, text=True, check=True, env=environment
    )
    first, second = map(int, code.stdout.split())
    assert first > 500
    assert second < 0.06 * first
