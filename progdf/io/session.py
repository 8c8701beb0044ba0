"""Session file: the open scene and edits, and the state of the window, as readable JSON.

    {
      "progdf_session": 1,
      "scene": {"file": "robot.ply", "sha256": "…"},
      "edits": [{"file": "shirt/shirt.gdf", "sha256": "…"}],
      "view": {…},
      "snapshots": […]
    }

Paths are relative to the session's folder, or absolute on another Windows drive. Hashes cover whole files.
The viewer defines the contents of `view` and `snapshots`. Nothing in the file is executed. A changed file, a
newer version and an unknown key are each refused with a one-line error.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from functools import lru_cache
from pathlib import Path, PureWindowsPath
from typing import Any, TypeVar

import msgspec

from progdf.errors import ProgdfError

from . import atomic
from .atomic import check_regular, open_error, read_file
from .json_values import check_text, convert_json, decode_json, to_json

VERSION = 1
MARK = "progdf_session"
"""First key of every session file, which identifies the file type."""
SUFFIX = ".session.json"
_MAX_BYTES = 64 << 20  # a session takes a few kB, painted strengths a few MB


class FileRef(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Reference to a file that a session needs."""

    file: str  # as written, with forward slashes; relative to the session's folder
    sha256: str  # hash of the file's bytes, lower-case hexadecimal

    def __post_init__(self) -> None:
        if not self.file or "\0" in self.file:
            raise ValueError("a file has no name")

    def path(self, folder: Path) -> Path:
        """Return the path of the file for a session in `folder`."""
        return Path(os.path.normpath(folder / self.file))


class EditRef(FileRef, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Reference to an edit that a session needs."""

    scene: int = 0  # index of its scene: 0 is `SessionFile.scene`, then `SessionFile.added`
    region: str = ""  # name of the region that its grade is applied to
    members: bytes = b""  # Gaussians of that region, stored like a selection; empty: the edit's own


class SessionFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Contents of a session file, with the state as plain JSON values."""

    scene: FileRef  # the scene file
    edits: tuple[EditRef, ...] = ()  # the .gdf files, in the order of the layers' indices
    view: dict[str, Any] = {}  # state of the window
    snapshots: tuple[dict[str, Any], ...] = ()  # saved states
    added: tuple[FileRef, ...] = ()  # further scenes of the view


File = TypeVar("File", bound=SessionFile)


def is_session(start: bytes) -> bool:
    """Return whether a file that starts with these bytes claims to be a session.

    Args:
        start: the first 64 bytes, or more
    """
    return start.lstrip()[:1] == b"{" and f'"{MARK}"'.encode() in start


def relative_name(path: Path, folder: Path) -> str:
    """Return the name of a file in a session in `folder`: forward slashes, absolute on another drive.

    Raises:
        ProgdfError: the name is not UTF-8, so JSON cannot store it.
    """
    resolved = path.resolve()
    try:
        name = os.path.relpath(resolved, folder.resolve())
    except ValueError:  # another drive
        name = str(resolved)
    check_text(name, "a session")
    return Path(name).as_posix()


def reference(path: Path, folder: Path) -> FileRef:
    """Return the reference to a file for a session in `folder`, with its hash.

    Raises:
        ProgdfError: the file cannot be read; see also `relative_name`.
    """
    return FileRef(relative_name(path, folder), sha256(path.resolve()))


def write_session(path: Path, session: SessionFile) -> None:
    """Write a session file, complete or not at all.

    Raises:
        ProgdfError: the folder does not exist.
    """
    table = to_json(session)
    if not session.added:  # most sessions have one scene
        del table["added"]
    text = json.dumps({MARK: VERSION} | table, indent=2, ensure_ascii=False, allow_nan=False)
    # put lists of numbers on one line; JSON strings contain no line breaks, so the pattern matches none
    text = re.sub(r"\[\n\s+([^\[\]{}\"]*?)\n\s+\]", lambda match: f"[{' '.join(match[1].split())}]", text)
    atomic.write_file(path, text + "\n")


def read_session(path: str | os.PathLike[str], kind: type[File]) -> File:
    """Read a session file as `kind`. The files that it names are not opened, see `verify_files`.

    Raises:
        ProgdfError: the file cannot be read, is not a session, has a newer version, or has invalid contents.
    """
    name = Path(path).name
    content = read_file(path, _MAX_BYTES + 1)
    if len(content) > _MAX_BYTES:
        raise ProgdfError(
            f"{name} is larger than {_MAX_BYTES >> 20} MB, too large for a session; "
            "give one saved with Ctrl+S"
        )
    try:
        table = decode_json(content)
    except ValueError as error:
        raise ProgdfError(f"{name} is not valid JSON ({error}); save the session again") from None
    if not isinstance(table, dict) or MARK not in table:
        raise ProgdfError(f"{name} is not a session; give a file that progdf view saved with Ctrl+S")
    version = table.pop(MARK)
    if version != VERSION:
        raise ProgdfError(
            f"{name} is a session of version {version!r:.40}; this progdf reads {VERSION}, update it"
        )
    _add_texture_gains(table)
    try:
        return convert_json(table, kind, closed=True)
    except ValueError as error:
        raise ProgdfError(f"{name} is a damaged session ({error}); save it again or update progdf") from None


def _add_texture_gains(value: object) -> None:
    """Add the gain of texture to layers saved before it existed; their gain of color covered both."""
    if isinstance(value, list):
        for item in value:
            _add_texture_gains(item)
    if isinstance(value, dict):
        gains = value.get("gains")
        if isinstance(gains, dict) and "color" in gains:
            gains.setdefault("texture", gains["color"])
        for item in value.values():
            _add_texture_gains(item)


def verify_files(path: Path, session: SessionFile) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Find the scenes and the edits of the session at `path`, and verify that they have not changed.

    A file that is missing at its path, as on another computer, is looked up beside the session.

    Returns:
        The files of the scenes, the first one first, and those of the edits.

    Raises:
        ProgdfError: a file is missing or has changed.
    """
    files = []
    scenes = (session.scene, *session.added)
    for ref in (*scenes, *session.edits):
        folder = path.resolve().parent
        file = ref.path(folder)
        beside = folder / PureWindowsPath(ref.file).name
        if not os.path.isfile(file) and os.path.isfile(beside):
            file = beside
        if not os.path.isfile(file):  # Path.is_file raises for a name that is too long
            state = "is not a regular file" if os.path.exists(file) else "does not exist"
            raise ProgdfError(f"{path.name} needs {file}, which {state}; put it back, or beside the session")
        if sha256(file) != ref.sha256.lower():
            raise ProgdfError(
                f"{path.name} was saved with another version of {file.name} than {file}; "
                "put the original file back or save a new session"
            )
        files.append(file)
    return tuple(files[: len(scenes)]), tuple(files[len(scenes) :])


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal. It is cached until the file changes.

    Raises:
        ProgdfError: the file cannot be read.
    """
    check_regular(path)
    try:
        state = path.stat()
        return _sha256(str(path), state.st_size, state.st_mtime_ns, state.st_ino)
    except OSError as error:
        raise open_error(path, error) from None


@lru_cache(maxsize=256)
def _sha256(path: str, *_: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
