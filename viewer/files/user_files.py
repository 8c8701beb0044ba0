"""User state: recent files and their thumbnails, layout, key bindings; and parsing of typed paths."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from progdf.color.grade import parse_grade
from progdf.color.looks import look_name
from progdf.errors import ProgdfError
from progdf.formats import cube
from progdf.io.atomic import atomic_write, make_folder, state_folder
from progdf.io.images import flatten_onto, open_picture
from progdf.io.json_values import read_json, to_json
from viewer.state.forms import CUBE_LOOK, OutsideSettings
from viewer.state.workspace import Layout

from .session import session_of

MAX_RECENT = 12  # number of recent files
THUMBNAIL_SIZE = (336, 252)  # width and height, px
MAX_THUMBNAILS = 64  # files in the folder; the oldest are deleted


def is_listed(path: Path) -> bool:
    """Return whether the path may be a scene or session, and not an edit, autosave or discarded work."""
    return path.suffix.lower() not in (".gdf", ".cube") and session_of(path) is None and "\n" not in str(path)


def read_recent(missing: bool = False) -> tuple[Path, ...]:
    """Return the recent files that exist; with `missing`, missing ones too. Empty for an unreadable list."""
    try:
        lines = (state_folder() / "recent.txt").read_text("utf-8", "surrogateescape").splitlines()
        known = [path for path in map(Path, lines) if is_listed(path)]
        return tuple(path for path in known if missing or path.is_file())[:MAX_RECENT]
    except (OSError, ValueError):
        return ()


def remember_recent(paths: Sequence[Path]) -> tuple[Path, ...]:
    """Put scenes and sessions at the top of the recent files, the last one first.

    Write errors are ignored. Returns the recent files that exist.
    """
    known = dict.fromkeys([*(path.resolve() for path in reversed(paths)), *read_recent(missing=True)])
    return _write_recent([path for path in known if is_listed(path)])


def forget_recent(path: Path) -> tuple[Path, ...]:
    """Remove a file from the recent files. Return the remaining ones that exist."""
    return _write_recent([other for other in read_recent(missing=True) if other != path])


def _write_recent(files: Sequence[Path]) -> tuple[Path, ...]:
    files = files[:MAX_RECENT]
    _remember("recent.txt", "".join(f"{path}\n" for path in files))
    return tuple(path for path in files if path.is_file())


def _remember(name: str, text: str) -> None:
    """Write a file in the program's state folder. Write errors are ignored."""
    with contextlib.suppress(OSError):
        state_folder().mkdir(parents=True, exist_ok=True)
        with atomic_write(state_folder() / name) as temporary_file:
            temporary_file.write_text(text, encoding="utf-8", errors="surrogateescape")


def describe_age(seconds: float) -> str:
    """Describe an age: "just now", "5 min ago", "3 h ago", "yesterday", "12 days ago" or "4 months ago"."""
    minutes = int(seconds / 60.0)
    days = int(seconds / 86_400.0)
    if days >= 60:
        return f"{days // 30} months ago"
    if days == 1:
        return "yesterday"
    if days:
        return f"{days} days ago"
    if minutes >= 90:
        return f"{minutes // 60} h ago"
    if minutes >= 2:
        return f"{minutes} min ago"
    return "just now"


def read_layout() -> Layout:
    """Read the saved layout of the window, or return the default one if it is unreadable."""
    try:
        return read_json(state_folder() / "layout.json", Layout)
    except ProgdfError:
        return Layout()


def keep_layout(layout: Layout) -> None:
    """Save the layout of the window. Write errors are ignored."""
    _remember("layout.json", json.dumps(to_json(layout)))


def looks_folder() -> Path:
    """Return the folder of the user's looks, .cube files."""
    return state_folder() / "looks"


def read_looks() -> tuple[tuple[str, str], ...]:
    """Return name and editor of each of the user's looks, in the order of their names.

    A .cube file whose comment has settings is a grade, as "grade:SETTINGS". Another one is "cube:FILE".
    """
    looks = []
    with contextlib.suppress(OSError):
        for path in sorted(looks_folder().glob(f"*{cube.SUFFIX}")):
            with contextlib.suppress(OSError, ProgdfError):
                settings = cube.read_settings(path)
                if settings:
                    parse_grade(settings)
                look = f"grade:{settings}" if settings else f"{CUBE_LOOK}{path}"
                looks.append((look_name(path.stem), look))
    return tuple(looks)


def read_outside() -> OutsideSettings:
    """Read the user's programs and servers, or return empty settings if they are unreadable."""
    try:
        return read_json(state_folder() / "outside.json", OutsideSettings)
    except ProgdfError:
        return OutsideSettings()


def keep_outside(settings: OutsideSettings) -> None:
    """Save the user's programs and servers. Write errors are ignored."""
    _remember("outside.json", json.dumps(to_json(settings)))


def read_keys() -> dict[str, Any]:
    """Read the user's key bindings, see `keys.bind`. Empty if there is no file.

    Raises:
        ProgdfError: the file cannot be read; one line.
    """
    path = keys_file()
    return read_json(path, dict[str, Any]) if path.is_file() else {}


def keys_file() -> Path:
    """Return the path of the key bindings."""
    return state_folder() / "keys.json"


def write_keys(keys: Mapping[str, Sequence[str]]) -> Path:
    """Write the file of key bindings with all current keys, unless it exists. Return its path.

    Raises:
        ProgdfError: the file cannot be written; one line.
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
    """Save the thumbnail [H,W,3] of a file. Write errors are ignored."""
    file = _thumbnail(path)
    with contextlib.suppress(OSError, ProgdfError):
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(file) as temporary_file:
            Image.fromarray(pixels).save(temporary_file)
        thumbnails = sorted(file.parent.glob("*.png"), key=lambda path: path.stat().st_mtime)
        for old in thumbnails[:-MAX_THUMBNAILS]:
            old.unlink(missing_ok=True)


def thumbnail_time(path: Path) -> float:
    """Return the time at which a file's thumbnail was saved, seconds since 1970, or 0 if there is none."""
    with contextlib.suppress(OSError):
        return _thumbnail(path).stat().st_mtime
    return 0.0


def load_thumbnail(path: Path) -> NDArray[np.uint8] | None:
    """Load the thumbnail of a file, or None if it is missing or damaged and must be made again. [H,W,3]"""
    return read_thumbnail(_thumbnail(path))


def read_thumbnail(file: Path) -> NDArray[np.uint8] | None:
    """Read a picture at thumbnail size, or None if it is missing or damaged. [H,W,3]"""
    try:
        return np.asarray(flatten_onto(open_picture(file), "white", THUMBNAIL_SIZE))
    except ProgdfError:
        return None


def _thumbnail(path: Path) -> Path:
    digest = hashlib.sha256(str(path.resolve()).encode("utf-8", "surrogateescape")).hexdigest()[:24]
    return state_folder() / "thumbnails" / f"{digest}.png"


def parse_path(text: str) -> Path:
    """Parse a typed path and expand `~`. The `~USER` of an unknown user stays as it is.

    Raises:
        ProgdfError: the text is not a valid file name.
    """
    try:
        possible = b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        possible = False
    if not possible:
        raise ProgdfError(f"{text} cannot be a file name; type another name")
    return Path(os.path.expanduser(text))  # Path.expanduser raises for an unknown user


MAX_COMPLETIONS = 200
"""Maximum number of completions of a path."""


def path_completions(typed: str) -> tuple[str, ...]:
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
    return _list_paths(typed, name, folder, changed) if typed.strip() else ()


def complete_path(typed: str) -> str:
    """Return a typed path with the longest part that all its completions share; unchanged without one."""
    found = path_completions(typed)
    if not found:
        return typed
    lower = [path.lower() for path in found]
    low = min(lower)
    high = max(lower)
    size = next((i for i, (a, b) in enumerate(zip(low, high, strict=False)) if a != b), len(low))
    return found[0][:size]


@lru_cache(maxsize=1)  # called in every frame of the dialog
def _list_paths(typed: str, name: str, folder: str, changed: int) -> tuple[str, ...]:
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
        start + entry_name + ("" if is_file else os.sep) for is_file, entry_name in found[:MAX_COMPLETIONS]
    )
