"""Paths as a person types them."""

from __future__ import annotations

import os
from pathlib import Path

from progdf.errors import ProgdfError
from progdf.io.session import SUFFIX


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


def session_file(path: Path) -> Path:
    """A path as a session's file is called.

    Raises:
        ProgdfError: it has no name.
    """
    if not path.name:
        raise ProgdfError(f"{path} is a folder; add the name of the session")
    return path if path.suffix == ".json" else path.with_name(path.name + SUFFIX)
