"""Files that the window makes by itself: picture, window, timeline, cameras; and where they went."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Origin
from progdf.io.atomic import atomic_write, pictures_folder
from progdf.io.cameras import kind_of_cameras, load_cameras, save_cameras
from progdf.io.session import SUFFIX
from viewer.jobs.run_files import takes_files
from viewer.state.view_state import ViewState

from . import timeline_file

CAMERAS = ".cameras.json"

REQUESTS = ("picture", "take_view", "window_picture", "timeline_file")
"""Those of `workspace.REQUESTS` that end here."""


def folder_of(scene: Path | None) -> Path:
    """Where files made of a scene go: beside it, or where that is read-only to the user's pictures."""
    beside = scene.resolve().parent if scene is not None else None
    return beside if beside is not None and takes_files(beside) else pictures_folder()


def picture(folder: Path, title: str, image: NDArray[np.uint8], info: PngInfo | None = None) -> str:
    """Save `image` [H,W,3] under the scene's name; the line that says where.

    Args:
        folder, title: where, and the scene's name
        image: pixels
        info: what the file carries: with a camera, what is changed in it can be trained on

    Raises:
        ProgdfError: it cannot be written.
    """

    def save() -> str:
        return f"Saved {save_picture(folder, Path(title).stem, image, info).resolve()}"

    return _try_save("picture", folder, save)


def timeline(folder: Path, title: str, view: ViewState, origin: Origin = ZERO) -> str:
    """Save the keys of `view` under the scene's name; the line that says where, and what for.

    Raises:
        ProgdfError: it cannot be written.
    """
    path = free_path(folder, f"{Path(title).stem}_timeline", ".json")

    def save() -> str:
        timeline_file.save(path, view.timeline, view.layers, origin)
        return f"Saved {path.resolve()}; render it with progdf render … --timeline {path.name}"

    return _try_save("timeline", folder, save)


def camera(place: Path, seen: Camera, origin: Origin = ZERO) -> tuple[Path, int]:
    """Add a camera to NAME.cameras.json beside a scene or session NAME; where that is, and how many it holds.

    Args:
        place: the scene or session
        seen: the camera
        origin: of the scene, which it is relative to

    Raises:
        ProgdfError: it cannot be written, or holds something else.
    """
    name = place.name.removesuffix(SUFFIX) if place.name.endswith(SUFFIX) else place.stem
    path = place.with_name(f"{name}{CAMERAS}")
    if path.exists() and kind_of_cameras(path) != "own":
        raise ProgdfError(f"{path} was not made with F4; move it elsewhere, as it would be overwritten")
    kept = load_cameras(path, origin) if path.exists() else []
    number = 1 + max((int(c.name[5:]) for c in kept if re.fullmatch(r"view_\d{1,9}", c.name)), default=-1)
    save_cameras(path, [*kept, replace(seen, name=f"view_{number:03d}")], origin)
    return path, len(kept) + 1


def _try_save(what: str, folder: Path, save: Callable[[], str]) -> str:
    try:
        folder.mkdir(parents=True, exist_ok=True)  # a user may have had no pictures so far
        return save()
    except OSError as error:
        raise ProgdfError(f"no {what} was saved in {folder.resolve()}: {error.strerror}") from None


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
