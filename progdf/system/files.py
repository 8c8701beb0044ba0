"""Files on each system: replacing an open file, owners, and writing to the disk."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

_IN_USE_ERRORS = (5, 32)  # Windows: ERROR_ACCESS_DENIED, ERROR_SHARING_VIOLATION
_RETRY_DELAYS_S = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)


def replace_file(path: Path, target: Path) -> None:
    """Replace a file as `os.replace` does, with retries on Windows.

    Windows refuses to replace a file that a process has open, even for reading or a virus scan.

    Raises:
        OSError: the target is still in use after two seconds, or the file cannot be moved.
    """
    for wait in _RETRY_DELAYS_S:
        try:
            os.replace(path, target)
            return
        except PermissionError as error:
            if getattr(error, "winerror", None) not in _IN_USE_ERRORS:
                raise
        time.sleep(wait)
    os.replace(path, target)


def is_owned(path: Path) -> bool:
    """Return whether a file, folder or link itself belongs to the user (always True on Windows)."""
    return sys.platform == "win32" or path.lstat().st_uid == os.getuid()


def is_private(folder: Path) -> bool:
    """Return whether only the user can write to a folder that is not a link (always True on Windows)."""
    if sys.platform == "win32":
        return True
    status = folder.lstat()
    return status.st_uid == os.getuid() and not folder.is_symlink() and not status.st_mode & 0o022


def flush_to_disk(path: Path) -> None:
    """Flush a file to the disk, as must be done before it is renamed. Windows flushes writable files only."""
    handle = os.open(path, os.O_RDONLY if sys.platform != "win32" else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
