"""Consent of the user to run a program or to send pictures, given in a dialog and kept in the user's folder.

The order of a run lies beside its scene, where somebody else may have written it. An edit file names its
editor, too. Therefore neither starts a program or sends a picture until the user has agreed to exactly that
program or server. A name of a file in the current folder is another file elsewhere, so the folder is part of
the action.
"""

from __future__ import annotations

import hashlib
import json
import os
import shlex
from pathlib import Path

from progdf.errors import ProgdfError
from progdf.io.atomic import make_folder, state_folder, write_file
from progdf.io.json_values import read_json

OUTSIDE = ("command", "api", "comfy")
"""Kinds of editors that run a program or send pictures."""

_FILE = "allowed.json"  # digests of the actions that the user has allowed


def outside_action(editor: str, url: str) -> str:
    """Return the action of an editor outside of this program, as an imperative; "" for none.

    Args:
        editor: value of `progdf train --editor`
        url: value of `--api-url`
    """
    kind, _, text = editor.partition(":")
    if kind == "command":
        place = f"\nin the folder {Path.cwd()}" if _names_local_files(text) else ""
        return f"Run this program on pictures of the scene:\n{text}{place}"
    if kind == "api":
        return f"Send pictures of the scene to this server:\n{url}"
    if kind == "comfy":
        path = Path(text).absolute()
        return f"Send pictures of the scene to this server, and run a workflow on it:\n{url}\n{path}"
    return ""


def is_allowed(action: str) -> bool:
    """Return True if the user has allowed this action, or if there is none."""
    return not action or _digest(action) in _read()


def allow(action: str) -> None:
    """Remember that the user allows this action.

    Raises:
        ProgdfError: the user's folder cannot be written.
    """
    known = _read()
    known.add(_digest(action))
    make_folder(state_folder())
    write_file(state_folder() / _FILE, json.dumps(sorted(known)).encode())


def check_allowed(editor: str, url: str) -> None:
    """Check that the user has allowed the action of an editor.

    Raises:
        ProgdfError: they have not.
    """
    action = outside_action(editor, url)
    if not is_allowed(action):
        line = " ".join(action.split("\n"))
        raise ProgdfError(f"not allowed yet: {line}; train it from the form of a new edit")


def _names_local_files(command: str) -> bool:
    """Return True if a word of a command is the relative path of a file, such as `python edit.py {input}`."""
    try:
        words = shlex.split(command)
    except ValueError:  # a quote is not closed: the command does not run
        return False
    paths = [Path(word.rpartition("=")[2]) for word in words]
    return any(not path.is_absolute() and os.path.isfile(path) for path in paths)


def _digest(action: str) -> str:
    return hashlib.sha256(action.encode("utf-8", "surrogateescape")).hexdigest()


def _read() -> set[str]:
    """Return the digests of all allowed actions; none if the file cannot be read."""
    try:
        return set(read_json(state_folder() / _FILE, list[str]))
    except ProgdfError:
        return set()
