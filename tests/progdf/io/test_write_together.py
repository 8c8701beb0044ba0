"""Tests of files that appear together, stopped by an error, an interrupt, a full disk and kill -9."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from progdf.errors import ProgdfError
from progdf.formats.ply import load_ply
from progdf.formats.scene_file import frame_path, save_frames
from progdf.gaussians import Gaussians
from progdf.io import atomic
from progdf.io.atomic import write_file, write_files_together
from tests.helpers.full_disk import files_up_to
from tests.helpers.scenes import random_gaussians
from viewer.pictures import film

NAMES = ["a", "b", "c", "sub/d"]
posix = pytest.mark.skipif(os.name == "nt", reason="needs POSIX processes")


def write_old(folder: Path) -> Path:
    (folder / "sub").mkdir(parents=True)
    for name in [*NAMES, "other"]:
        (folder / name).write_text("old")
    return folder


def write_new(folder: Path) -> None:
    with write_files_together(folder) as temporary:
        (temporary / "sub").mkdir()
        for name in NAMES:
            (temporary / name).write_text("new")


def contents(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()
    }


OLD = dict.fromkeys([*NAMES, "other"], "old")
NEW = dict.fromkeys(NAMES, "new") | {"other": "old"}


def test_files_are_replaced_together(tmp_path: Path) -> None:
    write_new(write_old(tmp_path / "x"))
    assert contents(tmp_path / "x") == NEW


def test_new_folder_appears_complete(tmp_path: Path) -> None:
    write_new(tmp_path / "x")
    assert contents(tmp_path / "x") == dict.fromkeys(NAMES, "new")
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("a"), ProgdfError("a")])
@pytest.mark.parametrize("exists", [True, False])
def test_failed_block_changes_nothing(tmp_path: Path, error: BaseException, exists: bool) -> None:
    if exists:
        write_old(tmp_path / "x")

    def fail() -> None:
        with write_files_together(tmp_path / "x") as temporary:
            (temporary / "a").write_text("new")
            raise error

    with pytest.raises(type(error)):
        fail()
    assert contents(tmp_path) == ({f"x/{name}": "old" for name in OLD} if exists else {})
    assert (tmp_path / "x").exists() == exists


def test_interrupt_between_moves_ends_with_all_new_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_old(tmp_path / "x")
    moved = 0
    move = atomic.replace_file

    def interrupted(path: Path, target: Path) -> None:
        nonlocal moved
        moved += 1
        if moved == 2:
            raise KeyboardInterrupt
        move(path, target)

    monkeypatch.setattr(atomic, "replace_file", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_new(folder)
    assert contents(folder) == NEW


@posix
@pytest.mark.parametrize("number", [1, 2, 3, 4])
@pytest.mark.parametrize("before", [True, False])
def test_kill_between_moves_is_finished_by_the_next_write(tmp_path: Path, number: int, before: bool) -> None:
    folder = write_old(tmp_path / "x")

    def killed() -> None:
        count = 0
        move = atomic.replace_file

        def counted(path: Path, target: Path) -> None:
            nonlocal count
            count += 1
            if count == number and before:
                os.kill(os.getpid(), signal.SIGKILL)
            move(path, target)
            if count == number:
                os.kill(os.getpid(), signal.SIGKILL)

        atomic.replace_file = counted
        write_new(folder)

    assert in_a_child(killed) == -signal.SIGKILL
    assert set(contents(folder)) >= {*NAMES, "other"}, "each file is there at any time"
    write_file(folder / "next", "next")
    assert contents(folder) == NEW | {"next": "next"}


@posix
def test_kill_within_the_block_leaves_the_old_files(tmp_path: Path) -> None:
    folder = write_old(tmp_path / "x")

    def killed() -> None:
        with write_files_together(folder) as temporary:
            (temporary / "a").write_text("new")
            os.kill(os.getpid(), signal.SIGKILL)

    assert in_a_child(killed) == -signal.SIGKILL
    write_file(folder / "next", "next")
    assert contents(folder) == OLD | {"next": "next"}


def in_a_child(work: Callable[[], object]) -> int:
    child = os.fork()
    if child == 0:
        try:
            work()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@posix
def test_complete_set_of_another_user_is_not_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    host = atomic._HOST_HASH
    planted = tmp_path / f".progdf-{host}-999999999-00000000.complete"
    planted.mkdir()
    (planted / "a").write_text("planted")
    monkeypatch.setattr(atomic, "is_owned", lambda path: False)
    write_file(tmp_path / "b", "b")
    assert not (tmp_path / "a").exists()


def test_folder_in_place_of_a_file_is_refused(tmp_path: Path) -> None:
    folder = write_old(tmp_path / "x")
    (folder / "b").unlink()
    (folder / "b").mkdir()
    with pytest.raises(ProgdfError, match=r"b is not a file"):
        write_new(folder)
    assert (folder / "a").read_text() == "old"


@posix
def test_permissions_are_kept_and_links_are_replaced(tmp_path: Path) -> None:
    folder = write_old(tmp_path / "x")
    (folder / "a").chmod(0o640)
    (folder / "b").unlink()
    (folder / "b").symlink_to(folder / "other")
    write_new(folder)
    assert stat.S_IMODE((folder / "a").stat().st_mode) == 0o640
    assert not (folder / "b").is_symlink()
    assert (folder / "other").read_text() == "old"


def test_missing_parent_is_reported_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="does not exist; create it first"):
        write_new(tmp_path / "no" / "x")


def scenes(count: int, stop: BaseException | None = None) -> Iterator[Gaussians]:
    for number in range(count):
        yield random_gaussians(10, seed=number)
    if stop is not None:
        raise stop


@pytest.mark.parametrize("stop", [KeyboardInterrupt(), ProgdfError("a"), OSError(errno.EIO, "a")])
@pytest.mark.parametrize("name", ["turn.ply", "turn.compressed.ply", "turn.glb"])
def test_stopped_frames_leave_the_earlier_ones(tmp_path: Path, stop: BaseException, name: str) -> None:
    path = tmp_path / name
    before = {file: file.read_bytes() for file in save_frames(path, scenes(3))}
    with pytest.raises((KeyboardInterrupt, ProgdfError)):
        save_frames(path, scenes(2, stop))
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_frames_replace_earlier_ones(tmp_path: Path) -> None:
    path = tmp_path / "turn.ply"
    save_frames(path, [random_gaussians(5), random_gaussians(5)])
    paths = save_frames(path, scenes(2))
    assert paths == [frame_path(path, 0), frame_path(path, 1)]
    assert torch.equal(load_ply(paths[1]).means, random_gaussians(10, seed=1).means)
    assert sorted(tmp_path.iterdir()) == paths


@posix
@pytest.mark.parametrize("name", ["turn.ply", "turn.glb", "turn.usdc", "turn.compressed.ply"])
def test_full_disk_leaves_the_earlier_frames(tmp_path: Path, name: str) -> None:
    if name.endswith(".usdc"):
        pytest.importorskip("pxr")
    path = tmp_path / name
    before = {file: file.read_bytes() for file in save_frames(path, scenes(2))}
    large = [random_gaussians(10), random_gaussians(10), random_gaussians(4000)]
    if name.endswith(".usdc"):
        large = large[2:]
    with (
        files_up_to(30_000),
        pytest.raises(ProgdfError, match=r"cannot be written .*File too large") as caught,
    ):
        save_frames(path, large)
    assert ".progdf-" not in str(caught.value)
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


def pictures(count: int, stop: BaseException | None = None) -> Iterator[film.Pixels]:
    for number in range(count):
        yield np.full((4, 6, 3), number, np.uint8)
    if stop is not None:
        raise stop


@pytest.mark.parametrize("exists", [True, False])
def test_stopped_film_leaves_the_folder_unchanged(tmp_path: Path, exists: bool) -> None:
    folder = tmp_path / "film"
    if exists:
        folder.mkdir()
    with pytest.raises(KeyboardInterrupt):
        film.write_sequence(folder, pictures(2, KeyboardInterrupt()))
    assert folder.exists() == exists
    film.write_sequence(folder, pictures(2))
    assert sorted(path.name for path in folder.iterdir()) == ["frame_0000.png", "frame_0001.png"]
    shutil.rmtree(folder)
    assert not list(tmp_path.iterdir())
