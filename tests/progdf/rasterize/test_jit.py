"""Tests of the kernel cache, whose truncated files are recompiled, and of vectors of eight numbers."""

from __future__ import annotations

import importlib.util
import logging
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock
from numpy.typing import NDArray

from progdf.io import atomic
from progdf.rasterize.cpu import jit
from progdf.rasterize.cpu.blend import exp2
from progdf.rasterize.cpu.jit import (
    WIDTH,
    Number,
    Vector,
    broadcast,
    kernel,
    lane_indices,
    lane_sum,
    lane_sums,
    ldexp,
    load,
    select,
    store,
    truncate,
)

Array = NDArray[Any]

SOURCE = """
from progdf.rasterize.cpu.jit import kernel

@kernel(cache=True)
def twice(number):
    return 2 * number
"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cache"
    folder.mkdir()
    monkeypatch.setattr(jit, "kernel_cache", lambda: folder)
    (tmp_path / "kernels.py").write_text(SOURCE)
    return folder


def twice(cache: Path) -> Callable[[float], float]:
    """Return the kernel as a new process gets it, compiled or from the cache."""
    spec = importlib.util.spec_from_file_location("kernels", cache.parent / "kernels.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found: Callable[[float], float] = module.twice
    return found


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("share", [0.0, 0.5])
def test_truncated_cache_file_is_dropped_and_recompiled(suffix: str, share: float, cache: Path) -> None:
    assert twice(cache)(4) == 8
    (file,) = cache.rglob(f"*{suffix}")
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    assert twice(cache)(4) == 8
    assert file.read_bytes()
    assert twice(cache)(4) == 8


def test_cold_cache_announces_compilation_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    with caplog.at_level(logging.WARNING, logger="progdf"):
        first = jit.kernel_cache.__wrapped__()
        (first / "some.nbi").touch()
        assert jit.kernel_cache.__wrapped__() == first
    assert [record.getMessage() for record in caplog.records] == [
        "compiling the rasterizer's kernels (about 20 s, once per machine)"
    ]


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the user's temporary folder, the only writable one."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return atomic.temporary_folder()


def homeless() -> Path:
    raise RuntimeError("Could not determine home directory.")


def test_kernels_are_cached_in_temporary_files_without_a_home(
    temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pathlib.Path.home", homeless)
    assert temporary in jit.find_cache_folder().parents
    assert jit.find_cache_folder() == jit.find_cache_folder(), "not a folder a process"
    assert atomic.state_folder() == temporary


def test_processes_share_a_temporary_cache_if_the_cache_is_unwritable(
    temporary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "file"))
    monkeypatch.setattr("pathlib.Path.home", lambda: tmp_path / "file")
    folder = jit.find_cache_folder()
    assert temporary in folder.parents
    assert folder == jit.find_cache_folder()


def test_temporary_folder_writable_by_others_is_not_used(
    temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pathlib.Path.home", homeless)
    temporary.mkdir()
    temporary.chmod(0o777)
    folder = jit.find_cache_folder()
    assert temporary not in folder.parents
    assert os.stat(folder).st_mode & 0o077 == 0


def test_second_process_waits_for_kernels_that_another_compiles(cache: Path) -> None:
    """Wait, as both processes would write the same files."""
    assert twice(cache)(4) == 8, "and from here on it is loaded in no time, unless it waits"
    results: list[float] = []
    drawing = threading.Thread(target=lambda: results.append(twice(cache)(4)))
    with FileLock(cache / "twice.lock"):
        drawing.start()
        drawing.join(1.0)
        assert not results
    drawing.join(60.0)
    assert results == [8]


def numbers(seed: int, rows: int = 1) -> Array:
    return np.random.default_rng(seed).normal(size=(rows, WIDTH)).astype(np.float32) * 3


@kernel(fast=True)
def _arithmetic(a: Array, b: Array, single: Number, out: Array) -> None:
    x = load(a, np.uint64(0))
    y = load(b, np.uint64(0))
    store(out, np.uint64(0), x + y)
    store(out, np.uint64(8), x - y)
    store(out, np.uint64(16), single * x)
    store(out, np.uint64(24), x / y)
    added = x
    added += single
    store(out, np.uint64(32), added)


def test_arithmetic_is_per_lane_and_broadcasts_a_scalar() -> None:
    a = numbers(0)[0]
    b = numbers(1)[0]
    out = np.zeros(40, np.float32)
    _arithmetic(a, b, np.float32(1.5), out)
    expected = [a + b, a - b, np.float32(1.5) * a, a / b, a + np.float32(1.5)]
    np.testing.assert_allclose(out.reshape(5, 8), expected, rtol=2e-7)


@kernel(fast=True)
def _comparisons(a: Array, b: Array, out: Array) -> None:
    x = load(a, np.uint64(0))
    y = load(b, np.uint64(0))
    one = np.float32(1.0)
    zero = np.float32(0.0)
    store(out, np.uint64(0), select(x < y, broadcast(one), broadcast(zero)))
    store(out, np.uint64(8), select(x <= y, one, zero))
    store(out, np.uint64(16), select(x > y, one, zero))
    store(out, np.uint64(24), select((zero < x) & (x < y), x, y))


def test_comparisons_are_per_lane_and_distinguish_less_from_equal() -> None:
    a = numbers(2)[0]
    b = numbers(3)[0]
    b[:3] = a[:3]
    out = np.zeros(32, np.float32)
    _comparisons(a, b, out)
    expected = [a < b, a <= b, a > b, np.where((a > 0) & (a < b), a, b)]
    np.testing.assert_array_equal(out.reshape(4, 8), np.array(expected, np.float32))


@kernel(fast=True)
def _at(source: Array, start: Number, out: Array) -> None:
    store(out, start, load(source, start) + lane_indices())


def test_loads_and_stores_start_anywhere_and_keep_other_values() -> None:
    source = np.arange(20, dtype=np.float32)
    out = np.full(20, -1, np.float32)
    _at(source, np.uint64(5), out)
    np.testing.assert_array_equal(out[5:13], np.arange(5, 13) + np.arange(8))
    assert (out[:5] == -1).all()
    assert (out[13:] == -1).all()


@kernel(fast=True)
def _sums(rows: Array, out: Array) -> None:
    flat = rows.reshape(-1)
    r = (
        load(flat, np.uint64(0)), load(flat, np.uint64(8)), load(flat, np.uint64(16)),
        load(flat, np.uint64(24)), load(flat, np.uint64(32)), load(flat, np.uint64(40)),
        load(flat, np.uint64(48)), load(flat, np.uint64(56)),
    )  # fmt: skip
    store(out, np.uint64(0), lane_sums(r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7]))
    for k in range(8):
        out[8 + k] = lane_sum(load(flat, np.uint64(8 * k)))


def test_eight_sums_at_once_match_eight_single_sums() -> None:
    rows = numbers(4, rows=8)
    out = np.zeros(16, np.float32)
    _sums(rows, out)
    np.testing.assert_allclose(out[:8], rows.sum(axis=1, dtype=np.float64), rtol=1e-5)
    np.testing.assert_allclose(out[8:], rows.sum(axis=1, dtype=np.float64), rtol=1e-5)


@kernel(fast=True)
def _wholes(a: Array, out: Array) -> None:
    x = load(a, np.uint64(0))
    store(out, np.uint64(0), truncate(x))
    store(out, np.uint64(8), ldexp(broadcast(np.float32(0.75)), truncate(x)))


def test_truncation_is_towards_zero_and_ldexp_scales_by_powers_of_two() -> None:
    a = np.array([-125.5, -3.999, -1, -0.5, 0, 0.5, 3.999, 100], np.float32)
    out = np.zeros(16, np.float32)
    _wholes(a, out)
    np.testing.assert_array_equal(out[:8], np.trunc(a))
    np.testing.assert_array_equal(out[8:], 0.75 * 2.0 ** np.trunc(a))


@kernel(fast=True)
def _exp2(a: Array, out: Array) -> None:
    for k in range(a.size // 8):
        at = np.uint64(8 * k)
        powers: Vector = exp2(load(a, at))
        store(out, at, powers)


def test_exp2_is_accurate_and_exact_at_integers() -> None:
    a = np.concatenate([np.linspace(-20, 0, 4000), -np.arange(120.0), np.zeros(8)]).astype(np.float32)
    out = np.empty_like(a)
    _exp2(a, out)
    np.testing.assert_allclose(out, np.exp2(a.astype(np.float64)), rtol=2.5e-7)
    np.testing.assert_array_equal(out[4000:4120], np.exp2(-np.arange(120.0)))


def test_vectors_of_another_type_fail_to_compile() -> None:
    from numba.core.errors import TypingError

    with pytest.raises(TypingError):
        _arithmetic(numbers(0)[0], numbers(1)[0], "one", np.zeros(40, np.float32))
