"""Files that are whole or absent: written beside their place, renamed when they are complete."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from progdf.errors import ProgdfError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def written_whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside `path`, renamed to it when the block ends well and removed when it does not.

        with written_whole("scene.ply") as beside:
            beside.write_bytes(…)

    Raises:
        ProgdfError: the folder does not exist or cannot be written to, the disk is full, or `path` is a
            folder.
    """
    target = Path(path)
    if target.is_dir():
        raise ProgdfError(f"{target} is a folder; give the name of a file in it")
    if not target.parent.is_dir():
        raise ProgdfError(f"the folder {target.parent} does not exist; make it first")
    # the suffix stays, as some writers (Pillow, numpy) choose the format by it
    try:
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.stem}.", suffix=target.suffix)
    except OSError as error:
        raise unwritable(target, error) from error
    os.close(handle)
    beside = Path(name)
    try:
        beside.chmod(target.stat().st_mode & 0o777 if target.exists() else 0o666 & ~_umask())
        yield beside
        os.replace(beside, target)
    except (OSError, ProgdfError) as error:  # the latter of one within, which knows `beside` alone
        full = disk_full(error)
        if full is None:
            raise
        raise unwritable(target, full) from full
    finally:
        beside.unlink(missing_ok=True)


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
        raise unwritable(path, error) from error


def unwritable(path: str | os.PathLike[str], error: OSError) -> ProgdfError:
    """The one line for a file or a folder that cannot be written."""
    reason = error.strerror or error
    return ProgdfError(f"{path} cannot be written ({reason}); give a place that can be written to")


def disk_full(error: BaseException) -> OSError | None:
    """What the system said of a disk that takes no more, if that is behind `error`."""
    cause = error if isinstance(error, OSError) else error.__cause__
    return cause if isinstance(cause, OSError) and cause.errno in _FULL else None


def open_failure(path: str | os.PathLike[str], error: OSError) -> ProgdfError:
    """The one line for a file that cannot be opened."""
    if isinstance(error, FileNotFoundError):
        return ProgdfError(f"{path} does not exist; check the name and the folder")
    if isinstance(error, IsADirectoryError) or Path(path).is_dir():
        return ProgdfError(f"{path} is a folder; give the name of a file in it")
    return ProgdfError(f"{path} cannot be read ({error.strerror or error}); check its permissions")


def _umask() -> int:
    mask = os.umask(0o022)
    os.umask(mask)
    return mask
