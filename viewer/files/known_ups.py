"""Which way is up where a scene does not tell, as its person said: JSON in the user's program state."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

from progdf.io.atomic import atomic_write
from progdf.io.json_values import decode_json
from progdf.io.user_folders import state_folder
from progdf.scene.up_axis import up_from_json
from viewer.camera.up_axis import Vec3

from .document import Document

MOST = 200
"""Files that are remembered; the oldest go."""


def up_of(opened: Document, folder: Path | None = None) -> Vec3:
    """What is up where a scene is opened: as it tells, else as was said of its file, else as most have it."""
    found = opened.found_up
    said = None if found.certain or opened.path is None else find(opened.path, folder)
    return said or found.direction


def find(path: Path, folder: Path | None = None) -> Vec3 | None:
    """What was said of a file, None where nothing was."""
    up = up_from_json({"direction": _read(folder).get(_key(path))})
    return None if up is None else (float(up[0]), float(up[1]), float(up[2]))


def remember(path: Path, up: Vec3, folder: Path | None = None) -> None:
    """Keep what was said of a file; what cannot be written is not remembered."""
    kept = {name: known for name, known in _read(folder).items() if name != _key(path)}
    kept[_key(path)] = list(up)
    place = _place(folder)
    with contextlib.suppress(OSError):
        place.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(place) as temporary_file:
            temporary_file.write_text(json.dumps(dict([*kept.items()][-MOST:])), encoding="utf-8")


def _read(folder: Path | None) -> dict[str, object]:
    try:
        found = decode_json(_place(folder).read_bytes())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _key(path: Path) -> str:
    return ascii(str(path.resolve()))


def _place(folder: Path | None) -> Path:
    return (folder or state_folder()) / "up_axes.json"
