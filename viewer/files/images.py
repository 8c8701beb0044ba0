"""Saved pictures: names that overwrite nothing, files that are whole or absent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from progdf.camera import Camera
from progdf.io.atomic import atomic_write
from progdf.io.picture_camera import camera_chunk


def save_picture(folder: Path, stem: str, image: NDArray[np.uint8], camera: Camera | None = None) -> Path:
    """Write `image` [H,W,3] as STEM_001.png, or the next free number; returns the path.

    The file carries the camera, where there is one.

    Raises:
        ProgdfError: the folder does not exist.
        OSError: it cannot be written.
    """
    path = free_path(folder, stem, ".png")
    with atomic_write(path) as temporary_file:
        carried = None if camera is None else camera_chunk(camera)
        Image.fromarray(image).save(temporary_file, pnginfo=carried)
    return path


def free_path(folder: Path, stem: str, suffix: str) -> Path:
    """STEM_001 with `suffix`, or the next number that no file has."""
    number = 1
    while (path := folder / f"{stem}_{number:03d}{suffix}").exists():
        number += 1
    return path
