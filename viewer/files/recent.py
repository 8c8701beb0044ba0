"""Scenes and sessions opened before, the last one first: one path a line in the user's folder of state."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from progdf.io.atomic import atomic_write, state_folder

from .autosave import session_of

MOST = 12


def is_listed(path: Path) -> bool:
    """Whether it may be a scene or a session: no edit, and no work that was saved or put aside by itself."""
    return path.suffix.lower() != ".gdf" and session_of(path) is None and "\n" not in str(path)


def read(folder: Path | None = None) -> tuple[Path, ...]:
    """Those that are still there; none where nothing can be read."""
    try:
        lines = ((folder or state_folder()) / "recent.txt").read_text("utf-8", "surrogateescape").splitlines()
        return tuple(path for path in map(Path, lines) if is_listed(path) and path.is_file())[:MOST]
    except (OSError, ValueError):
        return ()


def remember(paths: Sequence[Path], folder: Path | None = None) -> tuple[Path, ...]:
    """Put scenes and sessions in front, the last one first; what cannot be written is not remembered."""
    folder = folder or state_folder()
    kept = dict.fromkeys([*(path.resolve() for path in reversed(paths)), *read(folder)])
    files = tuple(path for path in kept if is_listed(path))[:MOST]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(folder / "recent.txt") as temporary_file:
            temporary_file.write_text(
                "".join(f"{path}\n" for path in files), encoding="utf-8", errors="surrogateescape"
            )
    except OSError:
        pass
    return files
