"""Saved pictures: names that overwrite nothing, files that are whole or absent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from progdf.io.atomic import atomic_write


def save_picture(folder: Path, stem: str, image: NDArray[np.uint8], info: PngInfo | None = None) -> Path:
    """Write `image` [H,W,3] as STEM_001.png, or the next free number; returns the path.

    Args:
        folder, stem: where, and how it is named
        image: pixels
        info: what the file carries, see `camera_chunk`

    Raises:
        ProgdfError: the folder does not exist.
        OSError: it cannot be written.
    """
    path = free_path(folder, stem, ".png")
    with atomic_write(path) as temporary_file:
        Image.fromarray(image).save(temporary_file, pnginfo=info)
    return path


def free_path(folder: Path, stem: str, suffix: str) -> Path:
    """STEM_001 with `suffix`, or the next number that no file has."""
    number = 1
    while (path := folder / f"{stem}_{number:03d}{suffix}").exists():
        number += 1
    return path
