"""Completion of a typed path: the files and folders that begin with it."""

from __future__ import annotations

import os
from functools import lru_cache

MAX_FOUND = 200
"""Maximum number of completions of a path."""


def completions(typed: str) -> tuple[str, ...]:
    """Return the paths that begin with a typed path, folders first, each of them with a final separator.

    Case is ignored. Hidden names are only found if their dot was typed. There are none for an empty text or
    a folder that cannot be read.
    """
    head, name = os.path.split(typed)
    folder = os.path.expanduser(head or ".")
    try:
        changed = os.stat(folder).st_mtime_ns
    except (OSError, ValueError):  # ValueError: a null character
        return ()
    return _listed(typed, name, folder, changed) if typed.strip() else ()


def complete(typed: str) -> str:
    """Return a typed path with the longest part that all its completions share; unchanged without one."""
    found = completions(typed)
    if not found:
        return typed
    lower = [path.lower() for path in found]
    low = min(lower)
    high = max(lower)
    size = next((i for i, (a, b) in enumerate(zip(low, high, strict=False)) if a != b), len(low))
    return found[0][:size]


@lru_cache(maxsize=1)  # called in every frame of the dialog
def _listed(typed: str, name: str, folder: str, changed: int) -> tuple[str, ...]:
    """Return the completions; `changed` is the time of the folder's last change, in ns."""
    found = list[tuple[bool, str]]()
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                is_hidden = entry.name.startswith(".") and not name.startswith(".")
                if not is_hidden and entry.name.casefold().startswith(name.casefold()):
                    found.append((not entry.is_dir(), entry.name))
    except OSError:
        return ()
    found.sort(key=lambda item: (item[0], item[1].casefold()))
    start = typed[: len(typed) - len(name)]
    return tuple(
        start + entry_name + ("" if is_file else os.sep) for is_file, entry_name in found[:MAX_FOUND]
    )
