"""Unsaved work, kept in a file beside its session: written now and then, found after a crash, put aside.

- bear.session.json: the session; for a scene that never had one, the name it would get
- bear.autosave.session.json: its unsaved work; -2, -3 … where others wait for somebody to decide about them
- bear.discarded.session.json: work that was discarded, the last `MOST_DISCARDED`
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

from progdf.io.atomic import replace_file
from progdf.io.session import SUFFIX

AUTOSAVE_S = 20.0
"""Seconds from a change to its autosave."""

MOST_DISCARDED = 3
_KINDS = "autosave", "discarded"


class SessionAutosave:
    """The autosave of one window, which never writes over another's."""

    def __init__(self) -> None:
        self.path: Path | None = None
        """Its file; None before there is one."""
        self._due: float | None = None
        self._kept: object = None  # what the file holds

    def wait(
        self, now: float, kept: object, beside: Callable[[], Path], save: Callable[[Path], None]
    ) -> float:
        """Write unsaved work once it is old enough; 0 where it was written, or is already.

        Args:
            now: seconds of any clock that does not go back
            kept: the work
            beside: gives the session's file
            save: writes the work into a file; what it raises is the caller's

        Returns:
            Seconds until it is time.
        """
        if kept == self._kept:
            self._due = None
            return 0.0
        if self._due is None:
            self._due = now + AUTOSAVE_S
        if now < self._due:
            return self._due - now
        self.write(kept, beside, save)
        return 0.0

    def write(self, kept: object, beside: Callable[[], Path], save: Callable[[Path], None]) -> Path:
        """Write it at once; the file. Arguments as of `wait`."""
        self._due, self._kept = None, kept
        if self.path is None:
            self.path = next(path for path in _numbered_paths(beside(), "autosave") if not path.exists())
        save(self.path)
        return self.path

    def stop(self) -> None:
        """There is nothing unsaved."""
        self._due = None

    def continue_from(self, path: Path) -> None:
        """The work of an autosave was opened: the file is this window's from now on."""
        self.path, self._due, self._kept = path, None, None

    def drop(self) -> None:
        """Delete the file: its work is saved."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)
        self.path, self._due, self._kept = None, None, None

    def discard(self) -> Path | None:
        """Put the file aside; where it went, None where there is none."""
        path, self.path, self._due, self._kept = self.path, None, None, None
        return put_aside(path) if path is not None and path.exists() else None


def session_of(path: Path) -> Path | None:
    """The session whose work an autosave, or discarded work, holds; None where `path` is neither."""
    found = re.fullmatch(rf"(.+)\.({'|'.join(_KINDS)})(-\d+)?{re.escape(SUFFIX)}", path.name)
    return path.with_name(found[1] + SUFFIX) if found else None


def is_discarded(path: Path) -> bool:
    """Whether it is work that was discarded, by its name."""
    return ".discarded" in path.name and session_of(path) is not None


def find_autosaves(session: Path, numbered: bool = False) -> tuple[Path, ...]:
    """Autosaves that lie beside a session, the latest first.

    Args:
        session: its file, which need not exist
        numbered: also those of NAME-2, NAME-3 …, as sessions of one scene are called
    """
    pattern = re.escape(stem(session)) + (r"(-\d+)?" if numbered else "")
    pattern += rf"\.autosave(-\d+)?{re.escape(SUFFIX)}"
    try:
        found = [path for path in session.parent.iterdir() if re.fullmatch(pattern, path.name)]
        return tuple(sorted(found, key=lambda path: path.stat().st_mtime, reverse=True))
    except OSError:
        return ()


def put_aside(path: Path) -> Path:
    """An autosave as discarded work, in the place of the oldest where there are `MOST_DISCARDED`.

    Raises:
        OSError: it cannot be moved.
    """
    session = session_of(path) or path
    names = [
        name for name, _ in zip(_numbered_paths(session, "discarded"), range(MOST_DISCARDED), strict=False)
    ]
    free = [name for name in names if not name.exists()]
    to = free[0] if free else min(names, key=lambda name: name.stat().st_mtime)
    replace_file(path, to)
    os.utime(to)  # the age that counts is since when it is discarded
    return to


def free_session(path: Path, own: Path | None) -> Path:
    """`path`, with a number where a session of that name exists, or unsaved work of it that is not `own`."""

    def taken(session: Path) -> bool:
        return session.exists() or any(found != own for found in find_autosaves(session))

    return next(session for session in _numbered_paths(path) if not taken(session))


def stem(session: Path) -> str:
    """A session's name without its endings."""
    return session.name.removesuffix(SUFFIX) if session.name.endswith(SUFFIX) else session.stem


def _numbered_paths(session: Path, kind: str = "") -> Iterator[Path]:
    """NAME, NAME-2, NAME-3 …; with a kind NAME.kind, NAME.kind-2 …"""
    name, number = stem(session) + f".{kind}" * bool(kind), 1
    while True:
        yield session.with_name(name + f"-{number}" * (number > 1) + SUFFIX)
        number += 1
