"""pictures.txt: which pictures in a folder are the run's own, so that it deletes no others.

One path a line, relative to the folder. Where there is no list, or a line is lost, nothing is deleted.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable
from pathlib import Path, PurePosixPath

from progdf.io.atomic import atomic_write

NAME = "pictures.txt"


def read_list(folder: Path) -> list[str]:
    """The lines of the folder's list."""
    try:
        return (folder / NAME).read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return []


def add_pictures(folder: Path, paths: Iterable[Path]) -> None:
    """Put files in the folder on its list."""
    lines = read_list(folder)
    new = dict.fromkeys(path.relative_to(folder).as_posix() for path in paths)
    if added := [line for line in new if line not in set(lines)]:
        _write(folder, [*lines, *added])


def remove_pictures_but_of(folder: Path, views: Collection[str]) -> None:
    """Delete the listed files that are not of one of these views; nothing behind a link is touched."""
    kept = []
    for line in read_list(folder):
        path = folder / line
        if path.stem in views or not _is_inside(folder, line):
            kept.append(line)
        elif os.path.isfile(path):  # pathlib's raises where a name is too long
            path.unlink()
    if read_list(folder) != kept:
        _write(folder, kept)


def _is_inside(folder: Path, line: str) -> bool:
    """Whether a line leads to a place in the folder, through no link."""
    parts = PurePosixPath(line)
    if parts.is_absolute() or ".." in parts.parts or not parts.parts:
        return False
    places = [folder / part for part in (parts, *parts.parents)]  # the last is the folder itself
    return not any(place.is_symlink() for place in places)


def _write(folder: Path, lines: Iterable[str]) -> None:
    with atomic_write(folder / NAME) as temporary_file:
        temporary_file.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
