"""Small pictures of files that were open, for the start page: one .png a file in the user's program state."""

from __future__ import annotations

import contextlib
import hashlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from progdf.errors import ProgdfError
from progdf.io.atomic import atomic_write, state_folder
from progdf.io.images import flatten_onto, open_picture

SIZE = (336, 252)
"""Pixels."""
MOST = 64
"""Files in the folder; the oldest go."""


def keep(path: Path, pixels: NDArray[np.uint8], folder: Path | None = None) -> None:
    """Keep the picture [H,W,3] of a file; where that cannot be, there is none."""
    place = _place(path, folder)
    with contextlib.suppress(OSError, ProgdfError):
        place.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(place) as temporary_file:
            Image.fromarray(pixels).save(temporary_file)
        kept = sorted(place.parent.glob("*.png"), key=lambda file: file.stat().st_mtime)
        for old in kept[:-MOST]:
            old.unlink(missing_ok=True)


def load(path: Path, folder: Path | None = None) -> NDArray[np.uint8] | None:
    """The picture of a file, None where there is none or it is damaged: `keep` makes it again. [H,W,3]"""
    try:
        return np.asarray(flatten_onto(open_picture(_place(path, folder)), "white", SIZE))
    except ProgdfError:
        return None


def _place(path: Path, folder: Path | None) -> Path:
    digest = hashlib.sha256(str(path.resolve()).encode("utf-8", "surrogateescape")).hexdigest()[:24]
    return (folder or state_folder()) / "thumbnails" / f"{digest}.png"
