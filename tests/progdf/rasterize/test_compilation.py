"""Tests of the compilation: in another process, its end, its cancellation and its mark, and its count."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from progdf.rasterize import first_start
from progdf.rasterize.cpu import compilation, jit
from tests.helpers.paths import ROOT


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the file of an importable module, whose mark would be in the same folder."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(compilation, "kernel_cache", lambda: tmp_path)
    return tmp_path / "slow_kernels.py"


def test_warm_up_runs_in_another_process(module: Path) -> None:
    done = module.with_name("done")
    module.write_text(f"def warm_up():\n    open({str(done)!r}, 'w').close()\n", "utf-8")
    compilation.compile_elsewhere("slow_kernels", threading.Event())
    assert done.exists()
    assert "slow_kernels" not in sys.modules


def test_stop_ends_the_other_process(module: Path) -> None:
    module.write_text("import time\n\ndef warm_up():\n    time.sleep(600)\n", "utf-8")
    stop = threading.Event()
    stop.set()
    begin = time.monotonic()
    compilation.compile_elsewhere("slow_kernels", stop)
    assert time.monotonic() - begin < 300


def test_failure_is_silent_and_leaves_no_mark(module: Path) -> None:
    module.write_text("raise ImportError\n", "utf-8")
    compilation.compile_elsewhere("slow_kernels", threading.Event())
    assert not compilation.is_compiled("slow_kernels")
    compilation.mark_compiled("slow_kernels")
    assert compilation.is_compiled("slow_kernels")


def test_kernels_are_counted_up_to_their_total(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "_with_cache_folder", lambda compile_now, function: function)

    @jit.kernel(cache=True)
    def double(value: int) -> int:
        return 2 * value

    @jit.kernel(cache=True)
    def add(value: int) -> int:
        return 1 + value

    @jit.kernel(cache=True)
    def extra(value: int) -> int:
        return value

    reports: list[tuple[int, int]] = []
    with compilation.count_kernels(2, lambda done, total: reports.append((done, total))):
        assert double(3) == double(3) == 6  # only the first call counts
        assert add(3) == 4
        assert extra(3) == 3
    assert reports == [(0, 2), (1, 2), (2, 2), (2, 2)]
    assert jit.listeners == []


@pytest.mark.parametrize("purpose", first_start.KERNELS)
def test_first_start_counts_every_kernel_once(purpose: str, tmp_path: Path) -> None:
    """Count in a new process with the kernels on the disk; the marks are in a folder of their own."""
    code = (
        "from pathlib import Path\n"
        "from progdf.rasterize import first_start\n"
        "from progdf.rasterize.cpu import compilation\n"
        f"compilation._marker = lambda name: Path({str(tmp_path)!r}, name)\n"
        f"assert first_start.needs_kernels({purpose!r})\n"
        "calls = []\n"
        f"first_start.compile_rasterizer({purpose!r}, lambda *numbers: calls.append(numbers))\n"
        "calls.append(len(calls))\n"
        f"assert not first_start.needs_kernels({purpose!r})\n"
        "print(calls)\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    total = first_start.KERNELS[purpose]
    assert ran.stdout.strip() == str([*((done, total) for done in range(total + 1)), total + 1])
