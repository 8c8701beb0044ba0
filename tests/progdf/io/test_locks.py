"""Locks between processes: who holds one, how it is let go of, and what is no lock."""

from __future__ import annotations

import errno
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import filelock
import pytest

from progdf.errors import ProgdfError
from progdf.io.atomic import LOCK, LockedError, hold_lock, is_locked

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
