"""Outputs are whole or absent; a lock is held by one process, and let go of when it ends."""

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


def test_a_file_appears_when_it_is_complete_and_not_before(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    with atomic_write(path) as temporary_file:
        temporary_file.write_text("half")
        assert not path.exists()
        temporary_file.write_text("whole")
    assert path.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_interrupted_write_leaves_the_old_file_and_nothing_beside_it(
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


def test_a_full_disk_is_told_with_the_name_of_the_file_and_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    path.write_text("old")
    told = pytest.raises(ProgdfError, match=r"/out\.txt cannot be written \(.*\); choose a place")
    with (
        told as caught,
        files_up_to(100),
        atomic_write(path) as temporary_file,
        atomic_write(temporary_file) as within,
    ):
        within.write_text("x" * 1000)
    assert isinstance(caught.value.__cause__, OSError), "training tells a full disk by it"
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_whoever_still_reads_the_old_file_keeps_it(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    path.write_text("old")
    with path.open() as reader:
        with atomic_write(path) as temporary_file:
            temporary_file.write_text("new")
        assert reader.read() == "old"
    assert path.read_text() == "new"


def test_permissions_are_those_of_an_ordinary_file_or_of_the_old_one(tmp_path: Path) -> None:
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
def test_a_new_file_obeys_the_umask_and_nobody_elses_is_touched(
    mask: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    earlier = os.umask(mask)
    try:
        with monkeypatch.context() as patched:
            # the process's umask holds for all its threads: to look at it is to change it for a moment
            patched.setattr(os, "umask", lambda mask: pytest.fail("the umask was changed"))
            with atomic_write(tmp_path / "new.txt") as temporary_file:
                temporary_file.write_text("x")
    finally:
        os.umask(earlier)
    assert (tmp_path / "new.txt").stat().st_mode & 0o777 == 0o666 & ~mask


def test_the_suffix_is_kept_for_writers_that_go_by_it(tmp_path: Path) -> None:
    with atomic_write(tmp_path / "picture.png") as temporary_file:
        assert temporary_file.suffix == ".png"


def test_a_missing_folder_and_a_folder_in_place_of_a_file_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="does not exist"), atomic_write(tmp_path / "no" / "a.txt"):
        pass
    with pytest.raises(ProgdfError, match="is a folder"), atomic_write(tmp_path):
        pass


def test_a_place_that_cannot_be_written_to_is_told_by_the_name_that_was_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_temporary_files(monkeypatch, errno.EACCES)
    path = tmp_path / "out.txt"
    with pytest.raises(ProgdfError) as told, atomic_write(path):
        pass
    assert str(told.value).startswith(f"{path} cannot be written (Permission denied); ")


def test_a_link_stays_a_link_and_what_it_leads_to_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    for name in ("old", "new"):  # the second leads to nothing yet
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
def test_a_pipe_that_is_read_from_is_refused_and_not_waited_for(
    read: Callable[[Path], object], tmp_path: Path
) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    signal.alarm(20)  # ends the process, where a reader waits
    try:
        for path in (pipe, Path("/dev/zero")):
            assert refusal(read, path) == f"{path} is a pipe or a device; give a file"
    finally:
        signal.alarm(0)


def test_a_pipe_gets_the_bytes_and_stays_a_pipe(tmp_path: Path) -> None:
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


def test_what_a_killed_process_left_goes_at_the_next_write_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False)
    left = list(tmp_path.iterdir())
    assert len(left) == 1
    assert is_temporary(left[0].name)
    own = [tmp_path / name for name in (".out.abcdefgh.txt", ".progdf", ".progdf-notes.txt", "x.progdf-1")]
    for mine in own:
        mine.write_text("mine")
    elsewhere = tmp_path / ".progdf-00000000-1-abcdefgh.txt"  # another machine's, which may be at work
    elsewhere.write_text("half")
    with atomic_write(tmp_path / "a.txt") as running:
        with atomic_write(path) as temporary_file:
            temporary_file.write_text("whole")
        assert running.exists(), "a process that runs keeps what it writes"
        running.write_text("whole")
    folder = tmp_path / f"{left[0].name.rpartition('-')[0]}-abcdefgh"  # as `temporary_subfolder` makes
    folder.mkdir()
    (folder / "frame_0000.png").touch()
    os.utime(elsewhere, (0, 0))
    assert sorted(tmp_path.iterdir()) == sorted([*own, elsewhere, folder, path, tmp_path / "a.txt"])
    with atomic_write(path) as temporary_file:
        temporary_file.write_text("whole")
    assert not elsewhere.exists(), "it has not been written to for a day"
    assert not folder.exists(), "its process was killed"


def test_a_name_as_long_as_names_can_be_is_written(tmp_path: Path) -> None:
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


def test_a_lock_is_let_go_of_when_its_process_is_killed(tmp_path: Path) -> None:
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


def test_the_copy_of_a_folder_that_is_locked_is_not_locked(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    with hold_lock(tmp_path / "run" / LOCK):
        shutil.copytree(tmp_path / "run", tmp_path / "copy")
        copied = tmp_path / "copy" / LOCK
        copied.chmod(0o444)  # as from a read-only place
        assert not is_locked(copied)
        with hold_lock(copied):
            assert is_locked(copied)


def test_asking_for_a_lock_writes_nothing(tmp_path: Path) -> None:
    assert not is_locked(tmp_path / LOCK)
    assert not is_locked(tmp_path / "nowhere" / LOCK)
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_written_is_not_locked_and_cannot_be_held(
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
    refusal[0] = errno.ENOLCK  # a file system without locks: one trains there as before there were any
    with hold_lock(tmp_path / LOCK):
        assert not is_locked(tmp_path / LOCK)


def test_a_link_in_the_place_of_a_lock_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "private").write_text("mine")
    (tmp_path / "private").chmod(0o400)
    (tmp_path / LOCK).symlink_to(tmp_path / "private")
    with pytest.raises(ProgdfError, match="is a link"), hold_lock(tmp_path / LOCK):
        pass
    assert not is_locked(tmp_path / LOCK)
    assert (tmp_path / "private").read_text() == "mine"
    assert (tmp_path / "private").stat().st_mode & 0o777 == 0o400


def test_a_name_that_is_too_long_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="cannot be read \\(File name too long\\)"):
        load_scene(tmp_path / ("9" * 5000))
