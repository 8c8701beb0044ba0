"""Views that were taken in the window, remembered per scene: thumbnail, camera and visible edits.

Each view is one small .png with its camera in the metadata, in the program's state folder. A damaged file is
ignored. The last `MAX_VIEWS` of a scene are kept, and the last `MAX_SCENES` scenes.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Origin
from progdf.io.atomic import atomic_write, state_folder
from progdf.io.cameras import camera_in_picture
from progdf.io.images import flatten_onto, open_picture, picture_size
from progdf.io.picture_camera import (
    PictureLayers,
    camera_chunk,
    edits_in_picture,
    layers_in_picture,
    save_picture_camera,
)
from progdf.system.equality import equal_fields

from .match_views import ViewMatch, match_views, matched_camera, view_thumbnail

MAX_VIEWS = 50
"""Number of remembered views of a scene."""
MAX_SCENES = 12
"""Number of scenes with remembered views."""


@dataclass(frozen=True)
class TakenView:
    """Picture that was taken of a scene."""

    __eq__ = equal_fields

    image: NDArray[np.uint8]  # thumbnail. [H,W,3]
    camera: Camera  # at the size of the taken picture
    edits: str = ""  # names of the visible edits, "" for the original
    layers: PictureLayers | None = None  # the visible edits as layers; None if a file is unknown

    def checked_layers(self, picture: str) -> PictureLayers | None:
        """Return the layers for the metadata of a picture that shows this view; None for the original.

        Raises:
            ProgdfError: the view shows edits whose files are unknown; the message names the picture.
        """
        if self.edits and self.layers is None:
            raise ProgdfError(
                f"{picture} shows edits ({self.edits}) whose files are unknown; take a view without them"
            )
        return self.layers


@dataclass(frozen=True)
class FoundView:
    """View that a picture without a camera shows."""

    view: TakenView
    match: ViewMatch
    camera: Camera  # camera of the picture

    @property
    def agreement(self) -> str:
        """One-line description of the agreement."""
        return f"{100 * self.match.agreement:.0f} % of its detail agrees"


def remember_view(
    scene: Path,
    image: NDArray[np.uint8],
    camera: Camera,
    edits: Sequence[str] = (),
    origin: Origin = ZERO,
    layers: PictureLayers | None = None,
) -> None:
    """Remember a view that was taken of a scene. Write errors are ignored.

    Args:
        scene: file of the scene
        image: the picture. [H,W,3]
        camera: its camera, relative to `origin`
        edits: names of the visible edits
        origin: origin of the scene
        layers: see `TakenView.layers`
    """
    folder = _folder(scene)
    with contextlib.suppress(OSError, ProgdfError):
        folder.mkdir(parents=True, exist_ok=True)
        files = _files(folder)
        number = int(files[-1].stem) + 1 if files else 1
        path = folder / f"{number:06d}.png"
        with atomic_write(path) as temporary_file:
            chunk = camera_chunk(camera, edits, origin, layers=layers)
            Image.fromarray(view_thumbnail(image)).save(temporary_file, "PNG", pnginfo=chunk)
        for old in [*files, path][:-MAX_VIEWS]:
            old.unlink(missing_ok=True)
        os.utime(folder)
        folders = sorted(folder.parent.iterdir(), key=lambda place: place.stat().st_mtime_ns)
        for other in folders[:-MAX_SCENES]:
            shutil.rmtree(other, ignore_errors=True)


def taken_views(scene: Path, origin: Origin = ZERO) -> list[TakenView]:
    """Return the remembered views of a scene, the newest first, with cameras relative to `origin`."""
    views = []
    for path in reversed(_files(_folder(scene))):
        with contextlib.suppress(ProgdfError):
            camera = camera_in_picture(path, origin)
            if camera is not None:
                image = np.asarray(flatten_onto(open_picture(path), "white"))
                edits = edits_in_picture(path)
                layers = None
                with contextlib.suppress(ProgdfError):
                    layers = layers_in_picture(path)
                views.append(TakenView(image, camera, edits, layers))
    return views


def find_view(path: Path, views: Sequence[TakenView]) -> FoundView | None:
    """Return the view that a picture shows, else the nearest one (see `match_views`); None without views.

    Raises:
        ProgdfError: the file is not a picture.
    """
    picture = np.asarray(flatten_onto(open_picture(path), "white"))
    match = match_views(picture, [view.image for view in views])
    if match is None:
        return None
    view = views[match.index]
    return FoundView(view, match, matched_camera(match, view.camera, picture_size(path)))


def find_taken_view(path: Path, scene: Path) -> FoundView | None:
    """Find a picture without a camera among the remembered views, and write its camera beside it.

    Args:
        path: the picture
        scene: file of the scene

    Returns:
        The view; None if the picture shows none of them for certain.

    Raises:
        ProgdfError: the file is not a picture, its camera cannot be written, or the view shows edits
            whose files are unknown.
    """
    found = find_view(path, taken_views(scene, ZERO))
    if found is None or not found.match.certain:
        return None
    save_picture_camera(path, found.camera, ZERO, found.view.checked_layers(str(path)))
    return found


def _files(folder: Path) -> list[Path]:
    """Return the files of remembered views, the oldest first."""
    return sorted(path for path in folder.glob("*.png") if path.stem.isdecimal() and path.stem.isascii())


def _folder(scene: Path) -> Path:
    digest = hashlib.sha256(str(scene.resolve()).encode("utf-8", "surrogateescape")).hexdigest()[:24]
    return state_folder() / "views" / digest
