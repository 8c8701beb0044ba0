"""Names of views, and the search for their pictures in a folder.

The name of a view is the path of its photograph without ending, such as cam0/IMG. Its pictures may have any
case and any ending in `ENDINGS`. They have the same path below the given folder. Leading folders may be
missing (IMG.JPG) if the remaining path belongs to one view only. COLMAP's masks keep the photograph's ending:
IMG.JPG.png.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from progdf.errors import ProgdfError

from .atomic import is_portable
from .file_rules import unsupported_error

ENDINGS = (
    ".png", ".apng", ".jpg", ".jpeg", ".jpe", ".jfif", ".webp", ".tif", ".tiff", ".bmp", ".gif",
)  # fmt: skip
"""Endings of the pictures that `progdf.io.images` reads, in lower case."""

_UNREAD_ENDINGS = (
    ".heic", ".heif", ".avif", ".jp2", ".jxl", ".exr", ".hdr", ".tga", ".psd", ".dib", ".ppm", ".pgm", ".svg",
    ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2",
)  # fmt: skip
"""Endings of unsupported picture formats. If a view only has such a file, the error names it."""

_MAX_PART_LENGTH = 60  # characters of up to 4 bytes; file systems allow 255 bytes with the ending
_MAX_NAME_LENGTH = 120  # characters of a whole view name; Windows allows 260 with the folder


def without_ending(name: str) -> str:
    """Return a file name without its picture ending or endings (COLMAP names masks a.jpg.png)."""
    for _ in range(2):
        stem, dot, ending = name.rpartition(".")
        if not stem or f"{dot}{ending}".lower() not in ENDINGS:
            return name
        name = stem
    return name


def split_path(name: str) -> tuple[str, ...]:
    """Return the parts of a picture's path, split at / or \\, without root, drive, `.` and ending."""
    parts = [part for part in re.split(r"[/\\]", name) if part not in ("", ".")]
    if parts and re.fullmatch("[A-Za-z]:", parts[0]):
        parts = parts[1:]
    if not parts:
        return ()
    return (*parts[:-1], without_ending(parts[-1]))


def without_common_folder(names: Sequence[str]) -> list[str]:
    """Return paths relative to their common folder, as nerfstudio names its renders."""
    parts = [name.replace("\\", "/").split("/") for name in names]
    shared = 0
    for level in zip(*(path[:-1] for path in parts), strict=False):
        if len(set(level)) > 1:
            break
        shared += 1
    return ["/".join(path[shared:]) for path in parts]


def view_name(name: str) -> str | None:
    """Return the view name of a picture: a relative path with / that is safe on every system, no ending.

    Parts `..` are left out. Letters, digits, `-`, `_` and `.` stay, and other characters become `_`. Dots in
    folder names become `_` too, as such folders would be taken for strengths (`0.5`).

    Returns:
        The name, or None if no usable name remains.
    """
    parts = [part for part in split_path(name) if part != ".."]
    if not parts:
        return None
    folders = [_clean(part).replace(".", "_") for part in parts[:-1]]
    cleaned = [*folders, _clean(parts[-1])]
    path = "/".join(cleaned)
    if len(path) > _MAX_NAME_LENGTH or any(not part.strip("._") or not is_portable(part) for part in cleaned):
        return None
    return path


def is_view_name(name: str) -> bool:
    """Return whether files of a view with this name stay in their folder, on every system."""
    parts = name.split("/")
    return all(part not in ("", ".", "..") and is_portable(part) for part in parts)


def _clean(part: str) -> str:
    composed = unicodedata.normalize("NFC", part)  # macOS stores letters and accents separately
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in composed)[:_MAX_PART_LENGTH]


def name_twin(name: str) -> str:
    """Return a normal form that is equal for names that Windows or macOS treat as the same."""
    return unicodedata.normalize("NFC", name).casefold()


def name_key(part: str) -> str:
    """Return a normal form that is equal for a file or folder and for the view named after it."""
    return name_twin(_clean(part)).replace(".", "_")


@dataclass
class PictureFolder:
    """Pictures of views in a folder. Each subfolder is listed once, on first use."""

    root: Path
    names: Sequence[str] = ()  # names of all views; a picture without folders must match only one of them
    _listings: dict[Path, list[os.DirEntry[str]]] = field(default_factory=dict, repr=False)
    _shares: Counter[tuple[str, ...]] | None = field(default=None, repr=False)

    def find(self, name: str) -> Path | None:
        """Return the picture of a view, or None.

        Raises:
            ProgdfError: two pictures have that name.
        """
        return self._search(name, ENDINGS)

    def require(self, name: str, advice: str) -> Path:
        """Return the picture of a view.

        Args:
            name: the view's name
            advice: the last part of the error, an imperative phrase

        Raises:
            ProgdfError: no picture or two pictures have that name, or its format is not supported.
        """
        found = self.find(name)
        if found is not None:
            return found
        self.check_unread(name)
        raise ProgdfError(f"{self.root} has no picture {name}.png; {advice}")

    def check_unread(self, name: str) -> None:
        """Raise ProgdfError if the view has a picture in an unsupported format."""
        unread = self._search(name, _UNREAD_ENDINGS)
        if unread is not None:
            kind = unread.suffix[1:].upper()
            raise unsupported_error(
                unread, f"the picture format {kind}", "save it as PNG, JPEG, TIFF or WebP"
            )

    def _search(self, name: str, endings: Sequence[str]) -> Path | None:
        parts = split_path(name)
        for first in range(len(parts)):
            rest = parts[first:]
            if first and self._count(rest) > 1:
                return None
            folder = self._subfolder(rest[:-1])
            found = None if folder is None else self._picture(folder, rest[-1], name, endings)
            if found is not None:
                return found
        return None

    def _count(self, parts: Sequence[str]) -> int:
        """Return the number of views whose names end with these parts."""
        if self._shares is None:
            self._shares = Counter()
            for name in self.names:
                keys = tuple(map(name_key, split_path(name)))
                self._shares.update(keys[first:] for first in range(len(keys)))
        return self._shares[tuple(map(name_key, parts))]

    def _subfolder(self, parts: Iterable[str]) -> Path | None:
        folder = self.root
        for part in parts:
            direct = folder / part
            if os.path.isdir(direct):  # also for `..`; Path.is_dir raises for a name that is too long
                folder = direct
                continue
            folders = [entry for entry in self._list(folder) if entry.is_dir()]
            chosen = _nearest({entry.name: entry.name for entry in folders}, part)
            if not chosen:
                return None
            if len(chosen) > 1:
                raise ProgdfError(
                    f"{folder / chosen[0]} and {folder / chosen[1]} are both folders of views in {part}; "
                    "keep one of them"
                )
            folder /= chosen[0]
        return folder

    def _picture(self, folder: Path, stem: str, view: str, endings: Sequence[str]) -> Path | None:
        stems = {}
        for entry in self._list(folder):
            base, dot, ending = entry.name.rpartition(".")
            if base and f"{dot}{ending}".lower() in endings and entry.is_file():
                stems[entry.name] = without_ending(base)
        chosen = _nearest(stems, stem)
        if len(chosen) > 1:
            raise ProgdfError(
                f"{folder / chosen[0]} and {folder / chosen[1]} are both pictures of the view {view}; "
                "keep one of them"
            )
        return folder / chosen[0] if chosen else None

    def _list(self, folder: Path) -> list[os.DirEntry[str]]:
        if folder not in self._listings:
            try:
                with os.scandir(folder) as entries:
                    found = sorted(entries, key=lambda entry: entry.name)
            except (OSError, ValueError):  # a name may be too long, or contain a NUL
                found = []
            self._listings[folder] = found
        return self._listings[folder]


def find_picture(folder: Path, name: str) -> Path | None:
    """Return the picture with a name in a folder, with any ending and case; see `PictureFolder.find`."""
    return PictureFolder(folder).find(name)


def _nearest(names: dict[str, str], wanted: str) -> list[str]:
    """Return the files with the closest name: exact, otherwise in another case, otherwise by `name_key`.

    Args:
        names: file name → the name to compare
        wanted: a part of a view's name
    """
    exact = [file for file, name in names.items() if name == wanted]
    if exact:
        return exact
    twins = [file for file, name in names.items() if name_twin(name) == name_twin(wanted)]
    if twins:
        return twins
    return [file for file, name in names.items() if name_key(name) == name_key(wanted)]
