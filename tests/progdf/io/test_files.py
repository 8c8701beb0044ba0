"""Tests of atomic outputs, and of locks that one process holds until it ends."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import filelock
import pytest

from progdf.cli.info import kind_of
from progdf.errors import ProgdfError
from progdf.formats.scene_file import load_scene
from progdf.gdf.file import load_gdf
from progdf.io.atomic import LOCK, LockedError, atomic_write, hold_lock, is_locked, is_temporary
from progdf.io.cameras import load_cameras
from progdf.io.images import open_picture
from progdf.io.session import SessionFile, read_session, sha256
from progdf.io.tensors import open_npy
from tests.helpers.full_disk import files_up_to, refuse_temporary_files
from tests.helpers.refused import refusal


def test_file_appears_only_when_complete(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    with atomic_write(path) as temporary_file:
        temporary_file.write_text("half")
        assert not path.exists()
        temporary_file.write_text("whole")
    assert path.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_interrupted_write_leaves_the_old_file_and_nothing_else(
    error: type[BaseException], tmp_path: Path
) -> None:
    path = tmp_path / "out.txt"
    path.write_text("old")

    def write() -> None:
        with atomic_write(path) as temporary_file:
            temporary_file.write_text("half")
            raise error

    with pytest.raises(error):
        write()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_full_disk_error_names_the_file_and_keeps_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    path.write_text("old")
    refused = pytest.raises(ProgdfError, match=r"/out\.txt cannot be written \(.*\); choose a place")
    with (
        refused as caught,
        files_up_to(100),
        atomic_write(path) as temporary_file,
        atomic_write(temporary_file) as within,
    ):
        within.write_text("x" * 1000)
    assert isinstance(caught.value.__cause__, OSError), "training tells a full disk by it"
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_open_reader_keeps_the_old_content(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    path.write_text("old")
    with path.open() as reader:
        with atomic_write(path) as temporary_file:
            temporary_file.write_text("new")
        assert reader.read() == "old"
    assert path.read_text() == "new"


def test_permissions_follow_the_umask_or_the_old_file(tmp_path: Path) -> None:
    ordinary = tmp_path / "ordinary.txt"
    old = tmp_path / "old.txt"
    ordinary.touch()
    old.touch()
    old.chmod(0o640)
    for path, expected in ((tmp_path / "new.txt", ordinary), (old, old)):
        mode = expected.stat().st_mode
        with atomic_write(path) as temporary_file:
            temporary_file.write_text("x")
        assert path.stat().st_mode == mode


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o002])
def test_new_file_obeys_the_umask_without_changing_it(
    mask: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    earlier = os.umask(mask)
    try:
        with monkeypatch.context() as patched:
            # the umask holds for all threads of the process, and reading it changes it for a moment
            patched.setattr(os, "umask", lambda mask: pytest.fail("the umask was changed"))
            with atomic_write(tmp_path / "new.txt") as temporary_file:
                temporary_file.write_text("x")
    finally:
        os.umask(earlier)
    assert (tmp_path / "new.txt").stat().st_mode & 0o777 == 0o666 & ~mask


def test_suffix_is_kept_for_writers_that_depend_on_it(tmp_path: Path) -> None:
    with atomic_write(tmp_path / "picture.png") as temporary_file:
        assert temporary_file.suffix == ".png"


def test_missing_folder_and_folder_in_place_of_a_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="does not exist"), atomic_write(tmp_path / "no" / "a.txt"):
        pass
    with pytest.raises(ProgdfError, match="is a folder"), atomic_write(tmp_path):
        pass


def test_unwritable_folder_error_names_the_given_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_temporary_files(monkeypatch, errno.EACCES)
    path = tmp_path / "out.txt"
    with pytest.raises(ProgdfError) as refused, atomic_write(path):
        pass
    assert str(refused.value).startswith(f"{path} cannot be written (Permission denied); ")


def test_write_through_a_link_replaces_its_target(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    for name in ("old", "new"):  # the second target does not exist
        real = tmp_path / "there" / f"{name}.txt"
        link = tmp_path / f"{name}.txt"
        link.symlink_to(Path("there") / real.name)
        if name == "old":
            real.write_text("old")
        with atomic_write(link) as temporary_file:
            temporary_file.write_text("whole")
        assert link.is_symlink()
        assert real.read_text() == "whole"
    assert sorted(path.name for path in (tmp_path / "there").iterdir()) == ["new.txt", "old.txt"]


def read_session_file(path: Path) -> SessionFile:
    return read_session(path, SessionFile)


@pytest.mark.parametrize(
    "read", [load_scene, load_gdf, kind_of, load_cameras, open_npy, open_picture, read_session_file, sha256]
)
def test_pipe_as_input_is_refused_without_waiting(read: Callable[[Path], object], tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    signal.alarm(20)  # ends the process if a reader waits
    try:
        for path in (pipe, Path("/dev/zero")):
            assert refusal(read, path) == f"{path} is a pipe or a device; give a file"
    finally:
        signal.alarm(0)


def test_pipe_as_output_gets_the_bytes_and_stays_a_pipe(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.png"
    os.mkfifo(pipe)
    handle = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        with atomic_write(pipe) as temporary_file:
            temporary_file.write_text("half")
            temporary_file.write_text("whole")
        assert os.read(handle, 100) == b"whole"
    finally:
        os.close(handle)
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


KILLED = """
import os, signal, sys
from progdf.io.atomic import is_temporary, atomic_write
with atomic_write(sys.argv[1]) as beside:
    beside.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_leftovers_of_a_killed_process_are_removed_at_the_next_write(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False)
    left = list(tmp_path.iterdir())
    assert len(left) == 1
    assert is_temporary(left[0].name)
    own = [tmp_path / name for name in (".out.abcdefgh.txt", ".progdf", ".progdf-notes.txt", "x.progdf-1")]
    for mine in own:
        mine.write_text("mine")
    elsewhere = tmp_path / ".progdf-00000000-1-abcdefgh.txt"  # another machine's, which may still run
    elsewhere.write_text("half")
    with atomic_write(tmp_path / "a.txt") as running:
        with atomic_write(path) as temporary_file:
            temporary_file.write_text("whole")
        assert running.exists(), "a process that runs keeps what it writes"
        running.write_text("whole")
    folder = tmp_path / f"{left[0].name.rpartition('-')[0]}-abcdefgh"  # as `temporary_subfolder` creates it
    folder.mkdir()
    (folder / "frame_0000.png").touch()
    os.utime(elsewhere, (0, 0))
    assert sorted(tmp_path.iterdir()) == sorted([*own, elsewhere, folder, path, tmp_path / "a.txt"])
    with atomic_write(path) as temporary_file:
        temporary_file.write_text("whole")
    assert not elsewhere.exists(), "it has not been written to for a day"
    assert not folder.exists(), "its process was killed"


def test_longest_possible_name_is_written(tmp_path: Path) -> None:
    path = tmp_path / ("n" * 251 + ".txt")
    with atomic_write(path) as temporary_file:
        temporary_file.write_text("whole")
    assert path.read_text() == "whole"


HOLDER = """
import sys, time
from pathlib import Path
from progdf.io.atomic import hold_lock
with hold_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


def test_lock_is_released_when_its_process_is_killed(tmp_path: Path) -> None:
    path = tmp_path / LOCK
    holder = subprocess.Popen([sys.executable, "-P", "-c", HOLDER, str(path)], stdout=subprocess.PIPE)
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        assert is_locked(path)
        with pytest.raises(LockedError), hold_lock(path):
            pass
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.communicate()
    assert path.is_file(), "the file stays"
    assert not is_locked(path)
    with hold_lock(path):
        assert is_locked(path), "of this process too"


def test_copy_of_a_locked_folder_is_not_locked(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    with hold_lock(tmp_path / "run" / LOCK):
        shutil.copytree(tmp_path / "run", tmp_path / "copy")
        copied = tmp_path / "copy" / LOCK
        copied.chmod(0o444)  # as from a read-only folder
        assert not is_locked(copied)
        with hold_lock(copied):
            assert is_locked(copied)


def test_checking_a_lock_writes_nothing(tmp_path: Path) -> None:
    assert not is_locked(tmp_path / LOCK)
    assert not is_locked(tmp_path / "nowhere" / LOCK)
    assert list(tmp_path.iterdir()) == []


def test_unwritable_folder_is_not_locked_and_cannot_be_locked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / LOCK).touch()

    refusal = [errno.EROFS]

    def refuse(self: filelock.FileLock, timeout: float | None = None) -> None:
        raise OSError(refusal[0], "no")

    monkeypatch.setattr(filelock.FileLock, "acquire", refuse)
    for refusal[0] in (errno.EROFS, errno.EACCES, errno.ENOSPC):
        assert not is_locked(tmp_path / LOCK)
        with (
            pytest.raises(ProgdfError, match=r"run\.lock cannot be written \(no\); "),
            hold_lock(tmp_path / LOCK),
        ):
            pass
    refusal[0] = errno.ENOLCK  # a file system without locks, where training runs unlocked
    with hold_lock(tmp_path / LOCK):
        assert not is_locked(tmp_path / LOCK)


def test_link_in_place_of_a_lock_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "private").write_text("mine")
    (tmp_path / "private").chmod(0o400)
    (tmp_path / LOCK).symlink_to(tmp_path / "private")
    with pytest.raises(ProgdfError, match="is a link"), hold_lock(tmp_path / LOCK):
        pass
    assert not is_locked(tmp_path / LOCK)
    assert (tmp_path / "private").read_text() == "mine"
    assert (tmp_path / "private").stat().st_mode & 0o777 == 0o400


def test_overlong_name_is_reported_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="cannot be read \\(File name too long\\)"):
        load_scene(tmp_path / ("9" * 5000))
