"""Files that are whole or absent, locks between processes, and the folders of the user."""

from __future__ import annotations

import errno
import getpass
import os
import platform
import re
import secrets
import shutil
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from platformdirs import user_cache_path, user_pictures_path, user_state_path

from progdf.errors import ProgdfError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

_HOST = f"{zlib.crc32(platform.node().encode()):08x}"
_TEMPORARY = re.compile(r"\.progdf-(?P<host>[0-9a-f]{8})-(?P<process>\d{1,9})-\w{8}(\..*)?", re.DOTALL)
_COMPLETE = ".complete"  # ending of a folder of `write_files_together` whose files only have to be moved
_A_DAY = 86400.0
_DEVICE = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³]) *(\..*)?", re.I | re.S)
_IN_USE = (5, 32)  # ERROR_ACCESS_DENIED, ERROR_SHARING_VIOLATION
_WAITS_S = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary file beside `path`, renamed to it when the block ends well and removed when it does not.

        with atomic_write("scene.ply") as temporary:
            temporary.write_bytes(…)

    A link stays and the file it leads to is replaced. A pipe or a device gets the bytes when all are there.
    What processes that were killed have left in the folder goes too.

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
    # the suffix stays, as some writers (Pillow, numpy) choose the format by it
    temporary_file = _temporary_path(target.parent, target.suffix)
    try:
        _create(temporary_file, target.stat().st_mode & 0o777 if target.exists() else None)
    except OSError as error:
        raise write_error(target, error) from error
    try:
        yield temporary_file
        replace_file(temporary_file, target)
    except (OSError, ProgdfError) as error:  # the latter of one within, which knows `temporary_file` alone
        full = disk_full(error)
        if full is None:
            raise
        raise write_error(target, full) from full
    finally:
        temporary_file.unlink(missing_ok=True)


def write_file(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Write a file, text as UTF-8, whole or not at all; see `atomic_write`."""
    with atomic_write(path) as temporary_file:
        temporary_file.write_bytes(content.encode() if isinstance(content, str) else content)


def temporary_subfolder(folder: Path) -> Path:
    """A new empty folder in `folder`, for what is moved out of it when it is whole; the caller removes it.

    What processes that were killed have left there goes.

    Raises:
        OSError: it cannot be made.
    """
    made = _temporary_path(folder)
    made.mkdir()
    return made


@contextmanager
def write_files_together(folder: Path) -> Iterator[Path]:
    """Yield an empty temporary folder; at a good end its files move to the same places in `folder`.

    Files of the same names are replaced, others stay. A link is replaced, not followed.

    Guarantee: if the block raises, or the process ends within it, `folder` is as before; after the block all
    files are new. A folder that did not exist appears by one rename. In an existing folder one rename marks
    the set as complete, and from there on it only moves forward. One interrupt does not stop the moves. If
    the process is killed between two of them, single files are old or new, each of them whole, until the next
    write of this program in `folder` moves the rest.

    Raises:
        ProgdfError: the folder cannot be made or written, or a folder has the place of a file.
    """
    is_new = not folder.is_dir()
    home = folder.absolute().parent if is_new else folder
    if not home.is_dir():
        raise ProgdfError(f"the folder {home} does not exist; create it first")
    try:
        temporary = temporary_subfolder(home)
    except OSError as error:
        raise write_error(folder, error) from error
    complete = temporary.with_name(temporary.name + _COMPLETE)
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
    """Move a complete set to its places, also if an interrupt comes meanwhile.

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
        ProgdfError: the target is no file.
    """
    if target.is_symlink() or not target.exists():
        return
    if not target.is_file():
        raise ProgdfError(f"{target} is no file; choose another name")
    with suppress(OSError):  # a file system without permissions
        path.chmod(target.stat().st_mode & 0o777)


def _move_complete(complete: Path) -> None:
    """Move the files of a complete set to their places beside it, as far as they are not there yet."""
    for path in _files_below(complete):
        target = complete.parent / path.relative_to(complete)
        target.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, target)
    shutil.rmtree(complete, ignore_errors=True)


def _temporary_path(folder: Path, suffix: str = "") -> Path:
    remove_abandoned(folder)
    return folder / f".progdf-{_HOST}-{os.getpid()}-{secrets.token_hex(4)}{suffix}"


def replace_file(path: Path, target: Path) -> None:
    """`os.replace`, which Windows refuses while anybody has the target open, if only to read or to scan it.

    Raises:
        OSError: it still does after two seconds, or the file cannot be moved at all.
    """
    for wait in _WAITS_S:
        try:
            os.replace(path, target)
            return
        except PermissionError as error:
            if getattr(error, "winerror", None) not in _IN_USE:
                raise
        time.sleep(wait)
    os.replace(path, target)


def _create(path: Path, mode: int | None) -> None:
    """A new empty file with these permissions; None: those of an ordinary file.

    The system itself takes the umask off: to ask for the umask is to change it, for all threads.
    """
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666 if mode is None else 0o600)
    os.close(handle)
    if mode is not None:
        with suppress(OSError):  # a file system without permissions
            path.chmod(mode)


@contextmanager
def _copy_into(target: Path) -> Iterator[Path]:
    """A temporary file whose bytes go into a pipe or a device in the end."""
    with tempfile.TemporaryDirectory(prefix="progdf-") as folder:
        buffer = Path(folder) / f"whole{target.suffix}"
        buffer.touch()
        yield buffer
        with buffer.open("rb") as source, target.open("wb") as sink:
            shutil.copyfileobj(source, sink)


def is_portable(name: str) -> bool:
    """Whether every system can have a file of this name, also with an ending: Windows is the strictest."""
    return not (_DEVICE.fullmatch(name) or set('<>:"/\\|?*') & set(name) or name.endswith((".", " ")))


def numbered_names(stem: str, suffix: str = "") -> Iterator[str]:
    """STEM, STEM-2, STEM-3 …, each with the suffix."""
    return (f"{stem}-{number}{suffix}" if number > 1 else f"{stem}{suffix}" for number in count(1))


def is_temporary(name: str) -> bool:
    """Whether a name is one that `atomic_write` or `temporary_subfolder` gives while something is written."""
    return _TEMPORARY.fullmatch(name) is not None


def remove_abandoned(folder: Path) -> None:
    """Remove temporary files of killed processes from a folder, and finish their complete sets.

    Those of other machines, and all on Windows, have to be a day old.
    """
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            name = _TEMPORARY.fullmatch(entry.name)
            with suppress(OSError):
                if name is None or entry.is_symlink() or _is_in_use(name, entry):
                    continue
                if entry.is_dir() and entry.name.endswith(_COMPLETE):
                    if is_owned(Path(entry.path)):
                        _move_complete(Path(entry.path))
                elif entry.is_dir():
                    shutil.rmtree(entry.path, ignore_errors=True)
                elif entry.is_file():
                    os.unlink(entry.path)


def _is_in_use(name: re.Match[str], entry: os.DirEntry[str]) -> bool:
    if name["host"] != _HOST or sys.platform == "win32":
        return time.time() - entry.stat().st_mtime <= _A_DAY
    try:
        os.kill(int(name["process"]), 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def check_not_an_input(out: Path, inputs: Sequence[Path]) -> None:
    """Raises ProgdfError where the result would take the place of what it is made from."""
    for path in inputs:
        if out.exists() and path.exists() and os.path.samefile(out, path):
            raise ProgdfError(f"{out} is one of the files to read; choose another name for the result")


def make_folder(path: str | os.PathLike[str]) -> None:
    """Make a folder, and those above it, where there is none yet.

    Raises:
        ProgdfError: a file has its place, or it cannot be made.
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
    """The one line for a file or a folder that cannot be written."""
    reason = error.strerror or error
    return ProgdfError(f"{path} cannot be written ({reason}); choose a place that can be written to")


def disk_full(error: BaseException) -> OSError | None:
    """What the system said of a disk that takes no more, if that is behind `error`."""
    cause = error if isinstance(error, OSError) else error.__cause__
    return cause if isinstance(cause, OSError) and cause.errno in _FULL else None


def check_regular(path: str | os.PathLike[str]) -> None:
    """Refuse what can be opened but not read like a file.

    Raises:
        ProgdfError: it is a pipe, which is waited for, or a device, which may never end.
    """
    if os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path):
        raise ProgdfError(f"{path} is a pipe or a device; give a file")


def read_file(path: str | os.PathLike[str], most: int = -1) -> bytes:
    """What a file holds, or its first `most` bytes.

    Raises:
        ProgdfError: it is not there, no file, or cannot be read.
    """
    check_regular(path)
    try:
        with open(path, "rb") as file:
            return file.read(most)
    except (OSError, ValueError) as error:
        raise open_error(path, error) from error


def open_error(path: str | os.PathLike[str], error: OSError | ValueError) -> ProgdfError:
    """The one line for a file that cannot be opened; a ValueError is of a name with a NUL."""
    if isinstance(error, ValueError):
        return ProgdfError(f"{path} cannot be the name of a file; check the name")
    if isinstance(error, FileNotFoundError):
        return ProgdfError(f"{path} does not exist; check the name and the folder")
    if isinstance(error, IsADirectoryError) or os.path.isdir(path):
        return ProgdfError(f"{path} is a folder; give the name of a file in it")
    return ProgdfError(f"{path} cannot be read ({error.strerror or error}); check its permissions")


LOCK = "run.lock"
"""Of the folder of a training, locked while it is trained."""

_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP)
"""Said by file systems that have none."""


class LockedError(ProgdfError):
    """Another process holds the lock."""


@contextmanager
def hold_lock(path: Path, wait_s: float = 0.0) -> Iterator[None]:
    """Hold the lock of this file meanwhile. The file alone means nothing: it stays, and a copy is not locked.

    Args:
        path: the file; made where there is none, in a folder that exists
        wait_s: how long to wait for another process

    Raises:
        LockedError: another process holds it.
        ProgdfError: it cannot be made or written. A file system without locks is none of this: nothing is
            held then.
    """
    from filelock import FileLock, Timeout  # asyncio, which most commands do without

    if path.is_symlink():
        raise ProgdfError(f"{path} is a link, which is not followed; remove the link")
    if os.path.isfile(path) and not os.access(path, os.W_OK):
        with suppress(OSError):
            path.chmod(0o644)  # a copy of one from a read-only place
    lock = FileLock(path)
    try:
        lock.acquire(timeout=wait_s)
    except Timeout:
        raise LockedError(f"{path} is locked by another process; wait for it") from None
    except NotImplementedError:  # filelock before 4, for ENOSYS
        pass
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise write_error(path, error) from error
    try:
        yield
    finally:
        lock.release()


def is_locked(path: Path) -> bool:
    """Whether a process holds the lock of this file; nothing is written where there is none."""
    if not os.path.isfile(path):  # nor where it may not be looked at
        return False
    try:
        with hold_lock(path):
            return False
    except LockedError:
        return True
    except ProgdfError:  # who cannot write here cannot hold it either
        return False


def cache_folder() -> Path:
    """For what can be made again: %LOCALAPPDATA%, ~/Library/Caches or $XDG_CACHE_HOME."""
    return _folder(user_cache_path("progdf", appauthor=False, opinion=False))


def state_folder() -> Path:
    """For what is remembered from one time to the next: %LOCALAPPDATA%, ~/Library or $XDG_STATE_HOME."""
    return _folder(user_state_path("progdf", appauthor=False))


def pictures_folder() -> Path:
    """The user's own pictures, as the desktop calls the folder."""
    return _folder(user_pictures_path())


def temporary_folder() -> Path:
    """One of the user's own where temporary files are, for who has no home or may not write there."""
    who = str(os.getuid()) if hasattr(os, "getuid") else getpass.getuser()
    return Path(tempfile.gettempdir()) / f"progdf-{who}"


def is_owned(path: Path) -> bool:
    """Return True if a file or folder, not followed if it is a link, belongs to the user."""
    return sys.platform == "win32" or path.lstat().st_uid == os.getuid()


def is_private(folder: Path) -> bool:
    """Whether nobody but the user could have put something into a folder."""
    if sys.platform == "win32":
        return True
    status = folder.lstat()
    return status.st_uid == os.getuid() and not folder.is_symlink() and not status.st_mode & 0o022


def _folder(path: Path) -> Path:
    try:
        Path.home()
    except RuntimeError:  # no HOME, and the system does not know the user
        return temporary_folder()
    return path
