"""Locks between processes: the system lets go of them when their process ends, however it ends."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

from progdf.errors import ProgdfError

from .atomic import write_error

LOCK = "run.lock"
"""Of the folder of a training, locked while it is trained."""

_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP)
"""Said by file systems that have none."""


class LockedError(ProgdfError):
    """Another process holds the lock."""


@contextlib.contextmanager
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
        with contextlib.suppress(OSError):
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
