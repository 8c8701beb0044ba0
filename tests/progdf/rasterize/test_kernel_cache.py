"""The cache of compiled kernels: damage costs a compilation, never a picture; only our own code is run."""

from __future__ import annotations

import importlib.util
import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock

from progdf.io import atomic
from progdf.rasterize.cpu import jit

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
    """The kernel as a new process has it: compiled, or from the cache."""
    spec = importlib.util.spec_from_file_location("kernels", cache.parent / "kernels.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found: Callable[[float], float] = module.twice
    return found


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("kept", [0.0, 0.5])
def test_a_damaged_file_is_dropped_and_compiled_anew(suffix: str, kept: float, cache: Path) -> None:
    assert twice(cache)(4) == 8
    jit.record_cache(cache)
    (cache / "forward.ready").touch()
    (file,) = cache.rglob(f"*{suffix}")
    content = file.read_bytes()
    file.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(Exception):  # noqa: B017, PT011  what numba raises depends on where the cut is
        twice(cache)(4)
    assert jit.drop_damaged(cache)
    assert not (cache / "forward.ready").exists(), "or nobody is told why it takes so long"
    assert twice(cache)(4) == 8
    jit.record_cache(cache)
    assert not jit.drop_damaged(cache)
    assert twice(cache)(4) == 8
    assert file.read_bytes()


def test_one_flipped_bit_of_machine_code_is_not_run(cache: Path) -> None:
    assert twice(cache)(4) == 8
    jit.record_cache(cache)
    (file,) = cache.rglob("*.nbc")
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    assert jit.drop_damaged(cache)
    assert not file.exists()


def test_files_of_a_process_at_work_stay_if_they_are_whole(cache: Path) -> None:
    assert twice(cache)(4) == 8
    assert not jit.drop_damaged(cache)
    assert len(list(cache.rglob("*.nb?"))) == 2
    jit.record_cache(cache)
    assert twice(cache)(0.5) == 1.0, "the index grows"
    assert not jit.drop_damaged(cache)
    assert len(list(cache.rglob("*.nb?"))) == 3


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_files_that_nobody_recorded_are_dropped_if_they_are_cut(suffix: str, cache: Path) -> None:
    assert twice(cache)(4) == 8
    (file,) = cache.rglob(f"*{suffix}")
    file.write_bytes(file.read_bytes()[:-20])
    assert jit.drop_damaged(cache)
    assert twice(cache)(4) == 8


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"[" * 100_000, b'{"a": {}}'])
def test_a_damaged_list_of_checksums_is_no_list(content: bytes, cache: Path) -> None:
    (cache / "checksums.json").write_bytes(content)
    jit.drop_damaged(cache)
    assert twice(cache)(4) == 8


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's folder among temporary files, where there is no other."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return atomic.temporary_folder()


def homeless() -> Path:
    raise RuntimeError("Could not determine home directory.")


def test_without_a_home_the_kernels_are_kept_among_temporary_files(
    temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pathlib.Path.home", homeless)
    assert temporary in jit.find_cache_folder().parents
    assert jit.find_cache_folder() == jit.find_cache_folder(), "not a folder a process"
    assert atomic.state_folder() == temporary


def test_where_the_cache_cannot_be_written_all_processes_share_one_elsewhere(
    temporary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "file"))
    monkeypatch.setattr("pathlib.Path.home", lambda: tmp_path / "file")
    folder = jit.find_cache_folder()
    assert temporary in folder.parents
    assert folder == jit.find_cache_folder()


def test_a_temporary_folder_that_others_may_write_to_is_not_used(
    temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pathlib.Path.home", homeless)
    temporary.mkdir()
    temporary.chmod(0o777)
    folder = jit.find_cache_folder()
    assert temporary not in folder.parents
    assert os.stat(folder).st_mode & 0o077 == 0


def test_a_second_process_waits_for_the_kernels_that_another_compiles(
    cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Both would write the same files, and the checksums of one would be wrong for those of the other."""
    jit.compile_lock.cache_clear()
    entered = threading.Event()

    def draw() -> None:
        with jit.compilation("made up", 1):
            entered.set()

    with FileLock(cache / "compiling.lock"):
        drawing = threading.Thread(target=draw)
        drawing.start()
        assert not entered.wait(0.3)
        (cache / "made up.ready").touch()
    drawing.join(10.0)
    assert entered.is_set()
    assert not caplog.messages, "the second finds all that it needs"
    jit.compile_lock.cache_clear()
