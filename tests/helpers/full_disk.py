"""Simulated full or read-only disks."""

from __future__ import annotations

import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from progdf.io.atomic import is_temporary


@contextmanager
def files_up_to(size: int) -> Iterator[None]:
    """Limit the size of files. The system refuses larger ones, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def refuse_temporary_files(monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    """Refuse to create files for `atomic_write`, with a code of `errno`."""
    system_open = os.open

    def refuse(path: Any, flags: int, *more: Any, **named: Any) -> int:
        if flags & os.O_CREAT and is_temporary(Path(path).name):
            raise OSError(code, os.strerror(code), str(path))
        return system_open(path, flags, *more, **named)

    monkeypatch.setattr(os, "open", refuse)
