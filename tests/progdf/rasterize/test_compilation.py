"""Tests of the compilation in another process: its end, its cancellation and its mark."""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

import pytest

from progdf.rasterize.cpu import compilation


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
