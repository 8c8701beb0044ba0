"""Atomic file writing, locks between processes, and the standard folders of the user."""

from __future__ import annotations

import errno
import getpass
import os
import platform
import re
import secrets
import shutil
import tempfile
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from progdf.errors import ProgdfError
from progdf.system.files import is_owned, replace_file
from progdf.system.processes import is_running

_DISK_FULL_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

_HOST_HASH = f"{zlib.crc32(platform.node().encode()):08x}"
_TEMPORARY_NAME = re.compile(r"\.progdf-(?P<host>[0-9a-f]{8})-(?P<process>\d{1,9})-\w{8}(\..*)?", re.DOTALL)
_COMPLETE_SUFFIX = ".complete"  # ending of a `write_files_together` folder that is ready to move
_ABANDONED_AFTER_S = 86400.0
_DEVICE_NAME = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³]) *(\..*)?", re.I | re.S)


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary file beside `path` that is renamed to it if the block succeeds, otherwise removed.

        with atomic_write("scene.ply") as temporary:
            temporary.write_bytes(…)

    If `path` is a link, the file it points to is replaced. A pipe or a device receives all bytes at the end.
    Temporary files of killed processes in the folder are removed.

    Raises:
        ProgdfError: the folder does not exist or cannot be written to, the disk is full, or `path` is a
            folder.
    """
    target = Path(path)
    if target.is_dir():
        raise ProgdfError(f"{target} is a folder; give the name of a file in it")
    if target.exists() and not target.is_file():
        with _copy_into(target) as temporary_file:
            yield temporary_file
        return
    if target.is_symlink():
        target = Path(os.path.realpath(target))
    if not target.parent.is_dir():
        raise ProgdfError(f"the folder {target.parent} does not exist; create it first")
    # same suffix as the target, as some writers (Pillow, numpy) choose the format by it
    temporary_file = _temporary_path(target.parent, target.suffix)
    try:
        _create(temporary_file, target.stat().st_mode & 0o777 if target.exists() else None)
    except OSError as error:
        raise write_error(target, error) from error
    try:
        yield temporary_file
        replace_file(temporary_file, target)
    except (OSError, ProgdfError) as error:  # raised by a nested write, which only knows `temporary_file`
        full = disk_full(error)
        if full is None:
            raise
        raise write_error(target, full) from full
    finally:
        temporary_file.unlink(missing_ok=True)


def write_file(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Write a file, complete or not at all, text as UTF-8; see `atomic_write`."""
    with atomic_write(path) as temporary_file:
        temporary_file.write_bytes(content.encode() if isinstance(content, str) else content)


def temporary_subfolder(folder: Path) -> Path:
    """Create a temporary folder in `folder`, for files to move out once complete. The caller removes it.

    Temporary files of killed processes in `folder` are removed.

    Raises:
        OSError: it cannot be created.
    """
    subfolder = _temporary_path(folder)
    subfolder.mkdir()
    return subfolder


@contextmanager
def write_files_together(folder: Path) -> Iterator[Path]:
    """Yield an empty temporary folder whose files move to the same paths in `folder` if the block succeeds.

    Files of the same names are replaced, and other files stay. A link is replaced, not followed.

    Guarantee: if the block raises, or the process ends within it, `folder` is unchanged. After the block all
    files are new. A new folder appears by one rename. In an existing folder, one rename marks the set as
    complete, and from then on the moves are finished, never undone. A single interrupt does not stop the
    moves. If the process is killed between two moves, each file is complete, either old or new. The next
    write of this program in `folder` moves the remaining files.

    Raises:
        ProgdfError: the folder cannot be created or written, or a folder has the name of a file.
    """
    is_new = not folder.is_dir()
    parent = folder.absolute().parent if is_new else folder
    if not parent.is_dir():
        raise ProgdfError(f"the folder {parent} does not exist; create it first")
    try:
        temporary = temporary_subfolder(parent)
    except OSError as error:
        raise write_error(folder, error) from error
    complete = temporary.with_name(temporary.name + _COMPLETE_SUFFIX)
    try:
        yield temporary
        if is_new:
            temporary.rename(folder)
            return
        for path in _files_below(temporary):
            _match_target(path, folder / path.relative_to(temporary))
        temporary.rename(complete)
    except OSError as error:
        raise write_error(folder, error) from error
    except ProgdfError as error:
        full = disk_full(error)
        if full is not None:
            raise write_error(folder, full) from full
        raise ProgdfError(str(error).replace(str(temporary), str(folder))) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if complete.is_dir():
            _finish_moves(complete)


def _finish_moves(complete: Path) -> None:
    """Move a complete set to its destination, even if an interrupt arrives meanwhile.

    Raises:
        ProgdfError: a file cannot be replaced.
    """
    try:
        _move_complete(complete)
    except OSError as error:
        raise write_error(complete.parent, error) from error
    except BaseException:
        _move_complete(complete)
        raise


def _files_below(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if not path.is_dir())


def _match_target(path: Path, target: Path) -> None:
    """Give a new file the permissions of the file that it will replace.

    Raises:
        ProgdfError: the target is not a regular file.
    """
    if target.is_symlink() or not target.exists():
        return
    if not target.is_file():
        raise ProgdfError(f"{target} is not a file; choose another name")
    with suppress(OSError):  # a file system without permissions
        path.chmod(target.stat().st_mode & 0o777)


def _move_complete(complete: Path) -> None:
    """Move the remaining files of a complete set to the folder that contains it."""
    for path in _files_below(complete):
        target = complete.parent / path.relative_to(complete)
        target.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, target)
    shutil.rmtree(complete, ignore_errors=True)


def _temporary_path(folder: Path, suffix: str = "") -> Path:
    remove_abandoned(folder)
    return folder / f".progdf-{_HOST_HASH}-{os.getpid()}-{secrets.token_hex(4)}{suffix}"


def _create(path: Path, mode: int | None) -> None:
    """Create an empty file with the given permissions; None for the default ones.

    The system applies the umask. Reading the umask would require changing it for all threads.
    """
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666 if mode is None else 0o600)
    os.close(handle)
    if mode is not None:
        with suppress(OSError):  # a file system without permissions
            path.chmod(mode)


@contextmanager
def _copy_into(target: Path) -> Iterator[Path]:
    """Yield a temporary file whose bytes are written to a pipe or a device at the end."""
    with tempfile.TemporaryDirectory(prefix="progdf-") as folder:
        buffer = Path(folder) / f"whole{target.suffix}"
        buffer.touch()
        yield buffer
        with buffer.open("rb") as source, target.open("wb") as sink:
            shutil.copyfileobj(source, sink)


def is_portable(name: str) -> bool:
    """Return whether a file name is valid on every system, with or without an ending.

    Windows is the strictest.
    """
    return not (_DEVICE_NAME.fullmatch(name) or set('<>:"/\\|?*') & set(name) or name.endswith((".", " ")))


def numbered_names(stem: str, suffix: str = "") -> Iterator[str]:
    """Iterate over STEM, STEM-2, STEM-3 …, each with the suffix."""
    return (f"{stem}-{number}{suffix}" if number > 1 else f"{stem}{suffix}" for number in count(1))


def is_temporary(name: str) -> bool:
    """Return whether a name is a temporary name of `atomic_write` or `temporary_subfolder`."""
    return _TEMPORARY_NAME.fullmatch(name) is not None


def remove_abandoned(folder: Path) -> None:
    """Remove temporary files of killed processes from a folder, and finish moving their complete sets.

    Files of other machines, and all files on Windows, must be a day old.
    """
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            name = _TEMPORARY_NAME.fullmatch(entry.name)
            with suppress(OSError):
                if name is None or entry.is_symlink() or _is_in_use(name, entry):
                    continue
                if entry.is_dir() and entry.name.endswith(_COMPLETE_SUFFIX):
                    if is_owned(Path(entry.path)):
                        _move_complete(Path(entry.path))
                elif entry.is_dir():
                    shutil.rmtree(entry.path, ignore_errors=True)
                elif entry.is_file():
                    os.unlink(entry.path)


def _is_in_use(name: re.Match[str], entry: os.DirEntry[str]) -> bool:
    running = is_running(int(name["process"])) if name["host"] == _HOST_HASH else None
    if running is None:
        return time.time() - entry.stat().st_mtime <= _ABANDONED_AFTER_S
    return running


def check_not_an_input(out: Path, inputs: Sequence[Path]) -> None:
    """Raise ProgdfError if the output file is one of the input files."""
    for path in inputs:
        if out.exists() and path.exists() and os.path.samefile(out, path):
            raise ProgdfError(f"{out} is one of the files to read; choose another name for the result")


def make_folder(path: str | os.PathLike[str]) -> None:
    """Create a folder and its parents if they do not exist.

    Raises:
        ProgdfError: a file has that name, or the folder cannot be created.
    """
    if Path(path).exists() and not Path(path).is_dir():
        raise ProgdfError(f"{path} is a file; give the name of a folder")
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(path, error) from error
    except RecursionError:
        raise ProgdfError(f"{path} is too deep; choose another folder") from None


def write_error(path: str | os.PathLike[str], error: OSError) -> ProgdfError:
    """Return the error for a file or a folder that cannot be written."""
    reason = error.strerror or error
    return ProgdfError(f"{path} cannot be written ({reason}); choose a place that can be written to")


def disk_full(error: BaseException) -> OSError | None:
    """Return the system error for a full disk if `error` is one or is caused by one, otherwise None."""
    cause = error if isinstance(error, OSError) else error.__cause__
    return cause if isinstance(cause, OSError) and cause.errno in _DISK_FULL_ERRORS else None


def check_regular(path: str | os.PathLike[str]) -> None:
    """Refuse pipes and devices. Reading a pipe blocks, and a device may never end.

    Raises:
        ProgdfError: the path is a pipe or a device.
    """
    if os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path):
        raise ProgdfError(f"{path} is a pipe or a device; give a file")


def read_file(path: str | os.PathLike[str], most: int = -1) -> bytes:
    """Return the content of a file, or its first `most` bytes.

    Raises:
        ProgdfError: the file does not exist, is not a regular file, or cannot be read.
    """
    check_regular(path)
    try:
        with open(path, "rb") as file:
            return file.read(most)
    except (OSError, ValueError) as error:
        raise open_error(path, error) from error


def open_error(path: str | os.PathLike[str], error: OSError | ValueError) -> ProgdfError:
    """Return the error for a file that cannot be opened. A ValueError comes from a name with a NUL."""
    if isinstance(error, ValueError):
        return ProgdfError(f"{path} cannot be the name of a file; check the name")
    if isinstance(error, FileNotFoundError):
        return ProgdfError(f"{path} does not exist; check the name and the folder")
    if isinstance(error, IsADirectoryError) or os.path.isdir(path):
        return ProgdfError(f"{path} is a folder; give the name of a file in it")
    return ProgdfError(f"{path} cannot be read ({error.strerror or error}); check its permissions")


LOCK = "run.lock"
"""Name of the lock file in a run folder, locked during training."""

_NO_LOCK_ERRORS = (errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP)
"""Errors of file systems without locks."""


class LockedError(ProgdfError):
    """Error for a lock that another process holds."""


@contextmanager
def hold_lock(path: Path, wait_s: float = 0.0) -> Iterator[None]:
    """Hold the lock of a file during the block. The file stays afterwards, and a copy of it is not locked.

    On a file system without locks, no lock is held and no error is raised.

    Args:
        path: the lock file, in an existing folder; created if missing
        wait_s: time to wait for another process, seconds

    Raises:
        LockedError: another process holds the lock.
        ProgdfError: the file cannot be created or written.
    """
    from filelock import FileLock, Timeout  # imports asyncio, which most commands do not need

    if path.is_symlink():
        raise ProgdfError(f"{path} is a link, which is not followed; remove the link")
    if os.path.isfile(path) and not os.access(path, os.W_OK):
        with suppress(OSError):
            path.chmod(0o644)  # it may be a copy from a read-only folder
    lock = FileLock(path)
    try:
        lock.acquire(timeout=wait_s)
    except Timeout:
        raise LockedError(f"{path} is locked by another process; wait for it") from None
    except NotImplementedError:  # filelock before 4, for ENOSYS
        pass
    except OSError as error:
        if error.errno not in _NO_LOCK_ERRORS:
            raise write_error(path, error) from error
    try:
        yield
    finally:
        lock.release()


def is_locked(path: Path) -> bool:
    """Return whether a process holds the lock of a file. A missing file is not created."""
    if not os.path.isfile(path):  # also False without permission to look
        return False
    try:
        with hold_lock(path):
            return False
    except LockedError:
        return True
    except ProgdfError:  # not writable, so it cannot be locked either
        return False


def cache_folder() -> Path:
    """Return the folder for reproducible files: %LOCALAPPDATA%, ~/Library/Caches or $XDG_CACHE_HOME."""
    from platformdirs import user_cache_path  # here, so that `progdf doctor` starts without the package

    return _or_temporary(user_cache_path("progdf", appauthor=False, opinion=False))


def state_folder() -> Path:
    """Return the folder for persistent state: %LOCALAPPDATA%, ~/Library or $XDG_STATE_HOME."""
    from platformdirs import user_state_path

    return _or_temporary(user_state_path("progdf", appauthor=False))


def pictures_folder() -> Path:
    """Return the user's pictures folder, as configured on the desktop."""
    from platformdirs import user_pictures_path

    return _or_temporary(user_pictures_path())


def temporary_folder() -> Path:
    """Return a per-user folder for temporary files, used if the home folder is missing or read-only."""
    user = str(os.getuid()) if hasattr(os, "getuid") else getpass.getuser()
    return Path(tempfile.gettempdir()) / f"progdf-{user}"


def _or_temporary(path: Path) -> Path:
    try:
        Path.home()
    except RuntimeError:  # no HOME, and the system does not know the user
        return temporary_folder()
    return path
