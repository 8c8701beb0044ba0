"""What is remembered for the user, recent files and their thumbnails; and paths as a user types them."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import subprocess
import sys
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

MAX_RECENT = 12
THUMBNAIL_SIZE = (336, 252)
"""Pixels."""
MAX_THUMBNAILS = 64
"""Files in the folder; the oldest go."""


def is_listed(path: Path) -> bool:
    """Whether it may be a scene or a session: no edit, and no work that was saved or put aside by itself."""
    return path.suffix.lower() not in (".gdf", ".cube") and session_of(path) is None and "\n" not in str(path)


def read_recent(missing: bool = False) -> tuple[Path, ...]:
    """Those that are still there, and with `missing` the others; none where nothing can be read."""
    try:
        lines = (state_folder() / "recent.txt").read_text("utf-8", "surrogateescape").splitlines()
        known = [path for path in map(Path, lines) if is_listed(path)]
        return tuple(path for path in known if missing or path.is_file())[:MAX_RECENT]
    except (OSError, ValueError):
        return ()


def remember_recent(paths: Sequence[Path]) -> tuple[Path, ...]:
    """Put scenes and sessions in front, the last one first; what cannot be written is not remembered. Those
    that are there."""
    known = dict.fromkeys([*(path.resolve() for path in reversed(paths)), *read_recent(missing=True)])
    return _write_recent([path for path in known if is_listed(path)])


def forget_recent(path: Path) -> tuple[Path, ...]:
    """Take one off the list; those that are left and there."""
    return _write_recent([other for other in read_recent(missing=True) if other != path])


def _write_recent(files: Sequence[Path]) -> tuple[Path, ...]:
    files = files[:MAX_RECENT]
    _remember("recent.txt", "".join(f"{path}\n" for path in files))
    return tuple(path for path in files if path.is_file())


def _remember(name: str, text: str) -> None:
    """Write a file of the program's state; what cannot be written is not remembered."""
    with contextlib.suppress(OSError):
        state_folder().mkdir(parents=True, exist_ok=True)
        with atomic_write(state_folder() / name) as temporary_file:
            temporary_file.write_text(text, encoding="utf-8", errors="surrogateescape")


def describe_age(seconds: float) -> str:
    """ "just now", "5 min ago", "3 h ago", "yesterday", "12 days ago", "4 months ago"."""
    minutes = int(seconds / 60.0)
    days = int(seconds / 86_400.0)
    if days:
        return "yesterday" if days == 1 else f"{days} days ago" if days < 60 else f"{days // 30} months ago"
    return "just now" if minutes < 2 else f"{minutes} min ago" if minutes < 90 else f"{minutes // 60} h ago"


def read_layout() -> Layout:
    """How the window was laid out last; as at first where nothing can be read."""
    try:
        return read_json(state_folder() / "layout.json", Layout)
    except ProgdfError:
        return Layout()


def keep_layout(layout: Layout) -> None:
    """Remember it; what cannot be written is not remembered."""
    _remember("layout.json", json.dumps(plain(layout)))


def read_keys() -> dict[str, Any]:
    """The keys that the person gave to actions, see `keys.bind`; none where there is no such file.

    Raises:
        ProgdfError: it cannot be read; one line.
    """
    path = keys_file()
    return read_json(path, dict[str, Any]) if path.is_file() else {}


def keys_file() -> Path:
    """Where they are."""
    return state_folder() / "keys.json"


def write_keys(keys: Mapping[str, Sequence[str]]) -> Path:
    """Begin that file with all there are, where there is none; its path.

    Raises:
        ProgdfError: it cannot be written; one line.
    """
    path = keys_file()
    if not path.exists():
        make_folder(path.parent)
        with atomic_write(path) as temporary_file:
            lines = ",\n".join(
                f" {json.dumps(action)}: {json.dumps(chords)}" for action, chords in keys.items()
            )
            temporary_file.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")
    return path


def keep_thumbnail(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Keep the picture [H,W,3] of a file; where that cannot be, there is none."""
    file = _thumbnail(path)
    with contextlib.suppress(OSError, ProgdfError):
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(file) as temporary_file:
            Image.fromarray(pixels).save(temporary_file)
        thumbnails = sorted(file.parent.glob("*.png"), key=lambda path: path.stat().st_mtime)
        for old in thumbnails[:-MAX_THUMBNAILS]:
            old.unlink(missing_ok=True)


def thumbnail_time(path: Path) -> float:
    """When the picture of a file was kept, as it was left; seconds since 1970, 0 where there is none."""
    with contextlib.suppress(OSError):
        return _thumbnail(path).stat().st_mtime
    return 0.0


def load_thumbnail(path: Path) -> NDArray[np.uint8] | None:
    """The picture of a file, None where there is none or it is damaged: it is made again. [H,W,3]"""
    return read_thumbnail(_thumbnail(path))


def read_thumbnail(file: Path) -> NDArray[np.uint8] | None:
    """A picture at the size of one, None where there is none or it is damaged. [H,W,3]"""
    try:
        return np.asarray(flatten_onto(open_picture(file), "white", THUMBNAIL_SIZE))
    except ProgdfError:
        return None


def _thumbnail(path: Path) -> Path:
    digest = hashlib.sha256(str(path.resolve()).encode("utf-8", "surrogateescape")).hexdigest()[:24]
    return state_folder() / "thumbnails" / f"{digest}.png"


def open_in_program(path: Path) -> bool:
    """Open a file in the program that the desktop has for it; whether there is one to ask."""
    try:
        if sys.platform == "win32":
            os.startfile(path, "edit")
        else:
            command = "open" if sys.platform == "darwin" else "xdg-open"
            subprocess.Popen([command, str(path)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    except OSError:
        return False
    return True


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
