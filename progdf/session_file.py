"""The session file: which scene and edits were open, and the state of the window, as JSON one can read.

    {
      "progdf_session": 1,
      "scene": {"file": "robot.ply", "sha256": "…"},
      "edits": [{"file": "shirt/shirt.gdf", "sha256": "…"}],
      "view": {…},
      "snapshots": […]
    }

Paths are relative to the session's folder (absolute where they share no folder with it, as on another
Windows drive), hashes are of whole files. What `view` and `snapshots` hold is the viewer's. Nothing in the
file is ever executed; a file that changed since, a newer version and an unknown key are refused in one line.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

from progdf.errors import ProgdfError
from progdf.files import open_failure, written_whole

VERSION = 1
MARK = "progdf_session"
"""The first key of every session file, by which its kind is told."""
SUFFIX = ".session.json"
_LARGEST = 64 << 20  # bytes; a session is a few kilobytes, painted strengths a few megabytes


@dataclass(frozen=True)
class FileRef:
    """A file that a session needs.

    Args:
        file: as written, with forward slashes; relative to the session's folder
        sha256: of the file's bytes, lower-case hexadecimal
    """

    file: str
    sha256: str

    def path(self, folder: Path) -> Path:
        """Where it is, for a session in `folder`."""
        return Path(os.path.normpath(folder / self.file))


@dataclass(frozen=True)
class SessionFile:
    """What a session file holds, its state as plain JSON values.

    Args:
        scene: the .ply
        edits: the .gdf files, in the order in which layers count them
        view: the state on screen
        snapshots: states that were kept
    """

    scene: FileRef
    edits: tuple[FileRef, ...] = ()
    view: Mapping[str, Any] = field(default_factory=dict)
    snapshots: Sequence[Mapping[str, Any]] = ()


def reference(path: Path, folder: Path) -> FileRef:
    """A file as a session in `folder` names it.

    Raises:
        ProgdfError: it cannot be read.
    """
    whole = path.resolve()
    try:
        name = os.path.relpath(whole, folder.resolve())
    except ValueError:  # another drive
        name = str(whole)
    return FileRef(str(PurePosixPath(Path(name))), sha256(whole))


def write_session(path: Path, session: SessionFile) -> None:
    """Write it whole or not at all.

    Raises:
        ProgdfError: the folder does not exist.
    """
    table = {
        MARK: VERSION,
        "scene": _plain(session.scene),
        "edits": [_plain(edit) for edit in session.edits],
        "view": session.view,
        "snapshots": list(session.snapshots),
    }
    text = json.dumps(table, indent=2, ensure_ascii=False, allow_nan=False)
    # short lists of numbers on one line; a text holds no line break of its own, so none is hit
    text = re.sub(r"\[\n\s+([^\[\]{}\"]*?)\n\s+\]", lambda found: f"[{' '.join(found[1].split())}]", text)
    with written_whole(path) as beside:
        beside.write_text(text + "\n", encoding="utf-8")


def read_session(path: str | os.PathLike[str]) -> SessionFile:
    """Read it; the files it names are not touched, see `verified`.

    Raises:
        ProgdfError: it cannot be read, is no session, of a newer version, or holds what no session holds.
    """
    name = Path(path).name
    try:
        size = Path(path).stat().st_size
        text = "" if size > _LARGEST else Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise open_failure(path, error) from None
    except UnicodeDecodeError:
        raise ProgdfError(f"{name} is no session: it is not text; give a file saved with Ctrl+S") from None
    if size > _LARGEST:
        raise ProgdfError(f"{name} has {size >> 20} MB, too much for a session; give one saved with Ctrl+S")
    try:
        table = json.loads(text, parse_constant=_no_constant, object_pairs_hook=_without_repeats)
    except (ValueError, RecursionError) as error:
        raise ProgdfError(f"{name} is not valid JSON ({error}); save the session anew") from None
    if not isinstance(table, dict) or MARK not in table:
        raise ProgdfError(f"{name} is no session; give a file that progdf view saved with Ctrl+S")
    if not isinstance(table[MARK], int) or isinstance(table[MARK], bool) or table[MARK] < 1:
        raise ProgdfError(f"{name} is a damaged session: its version is {table[MARK]!r}; save it anew")
    if table[MARK] > VERSION:
        raise ProgdfError(
            f"{name} is a session of version {table[MARK]}; this progdf reads up to {VERSION}, update it"
        )
    unknown = set(table) - {MARK, "scene", "edits", "view", "snapshots"}
    if unknown:
        raise ProgdfError(f"{name} holds '{min(unknown)}', which is unknown here; remove it or update progdf")
    edits, snapshots, view = table.get("edits", []), table.get("snapshots", []), table.get("view", {})
    if not isinstance(view, dict) or not _all(edits, dict) or not _all(snapshots, dict):
        raise ProgdfError(f"{name} is a damaged session: a part of it has the wrong form; save it anew")
    return SessionFile(
        _reference(name, "scene", table.get("scene")),
        tuple(_reference(name, f"edit {i + 1}", edit) for i, edit in enumerate(edits)),
        view,
        tuple(snapshots),
    )


def verified(path: Path, session: SessionFile) -> tuple[Path, tuple[Path, ...]]:
    """The scene and the edits of the session at `path`, each found and with the content it had then.

    Raises:
        ProgdfError: one is missing or has changed.
    """
    found = []
    for ref in (session.scene, *session.edits):
        file = ref.path(path.resolve().parent)
        if not file.is_file():
            raise ProgdfError(f"{path.name} needs {file}, which is not there; put it back or save anew")
        if sha256(file) != ref.sha256:
            raise ProgdfError(
                f"{path.name} was saved with another {file.name} than {file} holds now; "
                "put that file back or save a new session"
            )
        found.append(file)
    return found[0], tuple(found[1:])


def sha256(path: Path) -> str:
    """Of the file's bytes; read once as long as the file does not change.

    Raises:
        ProgdfError: it cannot be read.
    """
    try:
        state = path.stat()
        return _sha256(str(path), state.st_size, state.st_mtime_ns, state.st_ino)
    except OSError as error:
        raise open_failure(path, error) from None


@lru_cache(maxsize=256)
def _sha256(path: str, *_: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _plain(ref: FileRef) -> dict[str, str]:
    return {"file": ref.file, "sha256": ref.sha256}


def _reference(name: str, what: str, entry: object) -> FileRef:
    table = entry if isinstance(entry, dict) and set(entry) == {"file", "sha256"} else {}
    if _all(list(table.values()), str) and table.get("file") and "\0" not in table["file"]:
        return FileRef(table["file"], table["sha256"].lower())
    raise ProgdfError(f"{name} is a damaged session: its {what} is no file with a sha256; save it anew")


def _all(values: object, kind: type) -> bool:
    return isinstance(values, list) and all(isinstance(value, kind) for value in values)


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no number")


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        raise ValueError("a key is there twice")
    return table
