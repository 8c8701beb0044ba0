"""What is remembered for the user, recent files and their thumbnails; and paths as a user types them."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from progdf.errors import ProgdfError
from progdf.io.atomic import atomic_write, make_folder, state_folder
from progdf.io.images import flatten_onto, open_picture
from progdf.io.json_values import plain, read_json
from viewer.state.workspace import Layout

from .session import session_of

MOST_RECENT = 12
THUMBNAIL_SIZE = (336, 252)
"""Pixels."""
MOST_THUMBNAILS = 64
"""Files in the folder; the oldest go."""


def is_listed(path: Path) -> bool:
    """Whether it may be a scene or a session: no edit, and no work that was saved or put aside by itself."""
    return path.suffix.lower() not in (".gdf", ".cube") and session_of(path) is None and "\n" not in str(path)


def read_recent(folder: Path | None = None) -> tuple[Path, ...]:
    """Those that are still there; none where nothing can be read."""
    try:
        lines = ((folder or state_folder()) / "recent.txt").read_text("utf-8", "surrogateescape").splitlines()
        return tuple(path for path in map(Path, lines) if is_listed(path) and path.is_file())[:MOST_RECENT]
    except (OSError, ValueError):
        return ()


def remember_recent(paths: Sequence[Path], folder: Path | None = None) -> tuple[Path, ...]:
    """Put scenes and sessions in front, the last one first; what cannot be written is not remembered."""
    folder = folder or state_folder()
    known = dict.fromkeys([*(path.resolve() for path in reversed(paths)), *read_recent(folder)])
    files = tuple(path for path in known if is_listed(path))[:MOST_RECENT]
    lines = "".join(f"{path}\n" for path in files)
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(folder / "recent.txt") as temporary_file:
            temporary_file.write_text(lines, encoding="utf-8", errors="surrogateescape")
    return files


def read_layout(folder: Path | None = None) -> Layout:
    """How the window was laid out last; as at first where nothing can be read."""
    try:
        return read_json((folder or state_folder()) / "layout.json", Layout)
    except ProgdfError:
        return Layout()


def keep_layout(layout: Layout, folder: Path | None = None) -> None:
    """Remember it; what cannot be written is not remembered."""
    folder = folder or state_folder()
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(folder / "layout.json") as temporary_file:
            temporary_file.write_text(json.dumps(plain(layout)), encoding="utf-8")


def read_keys(folder: Path | None = None) -> dict[str, Any]:
    """The keys that the person gave to actions, see `keys.bind`; none where there is no such file.

    Raises:
        ProgdfError: it cannot be read; one line.
    """
    path = keys_file(folder)
    return read_json(path, dict[str, Any]) if path.is_file() else {}


def keys_file(folder: Path | None = None) -> Path:
    """Where they are."""
    return (folder or state_folder()) / "keys.json"


def write_keys(keys: Mapping[str, Sequence[str]], folder: Path | None = None) -> Path:
    """Begin that file with all there are, where there is none; its path.

    Raises:
        ProgdfError: it cannot be written; one line.
    """
    path = keys_file(folder)
    if not path.exists():
        make_folder(path.parent)
        with atomic_write(path) as temporary_file:
            lines = ",\n".join(
                f" {json.dumps(action)}: {json.dumps(chords)}" for action, chords in keys.items()
            )
            temporary_file.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")
    return path


def keep_thumbnail(path: Path, pixels: NDArray[np.uint8], folder: Path | None = None) -> None:
    """Keep the picture [H,W,3] of a file; where that cannot be, there is none."""
    file = _thumbnail(path, folder)
    with contextlib.suppress(OSError, ProgdfError):
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(file) as temporary_file:
            Image.fromarray(pixels).save(temporary_file)
        thumbnails = sorted(file.parent.glob("*.png"), key=lambda path: path.stat().st_mtime)
        for old in thumbnails[:-MOST_THUMBNAILS]:
            old.unlink(missing_ok=True)


def load_thumbnail(path: Path, folder: Path | None = None) -> NDArray[np.uint8] | None:
    """The picture of a file, None where there is none or it is damaged: it is made again. [H,W,3]"""
    try:
        return np.asarray(flatten_onto(open_picture(_thumbnail(path, folder)), "white", THUMBNAIL_SIZE))
    except ProgdfError:
        return None


def _thumbnail(path: Path, folder: Path | None) -> Path:
    digest = hashlib.sha256(str(path.resolve()).encode("utf-8", "surrogateescape")).hexdigest()[:24]
    return (folder or state_folder()) / "thumbnails" / f"{digest}.png"


def parse_path(text: str) -> Path:
    """The path; the home of an unknown user is a name like any other, and missing.

    Raises:
        ProgdfError: no file can be called so.
    """
    try:
        possible = b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        possible = False
    if not possible:
        raise ProgdfError(f"{text} cannot be a file name; type another name")
    return Path(os.path.expanduser(text))  # pathlib's raises for an unknown user
