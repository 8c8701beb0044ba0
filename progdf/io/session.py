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
from functools import lru_cache
from pathlib import Path, PureWindowsPath
from typing import Any, TypeVar

import msgspec

from progdf.errors import ProgdfError

from . import atomic
from .atomic import check_regular, open_error, read_file
from .json_values import check_text, convert_json, decode_json, plain

VERSION = 1
MARK = "progdf_session"
"""The first key of every session file, which identifies its kind."""
SUFFIX = ".session.json"
_LARGEST = 64 << 20  # bytes; a session is a few kilobytes, painted strengths a few megabytes


class FileRef(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file that a session needs."""

    file: str  # as written, with forward slashes; relative to the session's folder
    sha256: str  # of the file's bytes, lower-case hexadecimal

    def __post_init__(self) -> None:
        if not self.file or "\0" in self.file:
            raise ValueError("a file has no name")

    def path(self, folder: Path) -> Path:
        """Where it is, for a session in `folder`."""
        return Path(os.path.normpath(folder / self.file))


class EditRef(FileRef, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """An edit that a session needs."""

    region: str = ""  # name of the region that its grade is applied to
    members: bytes = b""  # which Gaussians that is, as a selection is stored; empty: the edit's own


class SessionFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a session file holds, its state as plain JSON values."""

    scene: FileRef  # the .ply
    edits: tuple[EditRef, ...] = ()  # the .gdf files, in the order in which layers count them
    view: dict[str, Any] = {}  # the state on screen
    snapshots: tuple[dict[str, Any], ...] = ()  # states that were kept


File = TypeVar("File", bound=SessionFile)


def is_session(start: bytes) -> bool:
    """Return True if a file that starts with these bytes claims to be a session.

    Args:
        start: the first 64 bytes, or more
    """
    return start.lstrip()[:1] == b"{" and f'"{MARK}"'.encode() in start


def relative_name(path: Path, folder: Path) -> str:
    """A file as a session in `folder` names it: with forward slashes, absolute where the two share no drive.

    Raises:
        ProgdfError: its name is not UTF-8, which JSON cannot hold.
    """
    resolved = path.resolve()
    try:
        name = os.path.relpath(resolved, folder.resolve())
    except ValueError:  # another drive
        name = str(resolved)
    check_text(name, "a session")
    return Path(name).as_posix()


def reference(path: Path, folder: Path) -> FileRef:
    """A file of a session in `folder`, with its hash.

    Raises:
        ProgdfError: it cannot be read; or as `relative_name`.
    """
    return FileRef(relative_name(path, folder), sha256(path.resolve()))


def write_session(path: Path, session: SessionFile) -> None:
    """Write it whole or not at all.

    Raises:
        ProgdfError: the folder does not exist.
    """
    text = json.dumps({MARK: VERSION} | plain(session), indent=2, ensure_ascii=False, allow_nan=False)
    # short lists of numbers on one line; a text holds no line break of its own, so none is hit
    text = re.sub(r"\[\n\s+([^\[\]{}\"]*?)\n\s+\]", lambda match: f"[{' '.join(match[1].split())}]", text)
    atomic.write_file(path, text + "\n")


def read_session(path: str | os.PathLike[str], kind: type[File]) -> File:
    """Read it, its state as `kind` has it; the files it names are not touched, see `verify_files`.

    Raises:
        ProgdfError: it cannot be read, is no session, of a newer version, or holds what no session holds.
    """
    name = Path(path).name
    content = read_file(path, _LARGEST + 1)
    if len(content) > _LARGEST:
        raise ProgdfError(
            f"{name} is larger than {_LARGEST >> 20} MB, too large for a session; give one saved with Ctrl+S"
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
    try:
        return convert_json(table, kind, closed=True)
    except ValueError as error:
        raise ProgdfError(f"{name} is a damaged session ({error}); save it again or update progdf") from None


def verify_files(path: Path, session: SessionFile) -> tuple[Path, tuple[Path, ...]]:
    """The scene and the edits of the session at `path`, each found and with the content it had then.

    A file that is not where it was, as on another computer or system, is taken from beside the session.

    Raises:
        ProgdfError: one is missing or has changed.
    """
    files = []
    for ref in (session.scene, *session.edits):
        folder = path.resolve().parent
        file = ref.path(folder)
        beside = folder / PureWindowsPath(ref.file).name
        if not os.path.isfile(file) and os.path.isfile(beside):
            file = beside
        if not os.path.isfile(file):  # pathlib's raises where a name is too long
            raise ProgdfError(
                f"{path.name} needs {file}, which does not exist; put it back, or beside the session"
            )
        if sha256(file) != ref.sha256.lower():
            raise ProgdfError(
                f"{path.name} was saved with another {file.name} than {file} holds now; "
                "put that file back or save a new session"
            )
        files.append(file)
    return files[0], tuple(files[1:])


def sha256(path: Path) -> str:
    """Of the file's bytes; read once as long as the file does not change.

    Raises:
        ProgdfError: it cannot be read.
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
