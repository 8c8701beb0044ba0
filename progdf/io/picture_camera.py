"""Cameras of rendered pictures: in the .png and in a file beside it, recovered after external editing.

Many programs keep the text chunk with the camera when they save a picture. If a program drops it, or writes
another format, the camera comes from the file beside the picture, or from a given camera of the same name.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from PIL.PngImagePlugin import PngInfo

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Origin

from .cameras import (
    PICTURE_KEY,
    camera_in_picture,
    cameras_to_json,
    kind_of_cameras,
    load_cameras,
    save_cameras,
)
from .images import picture_text
from .json_values import decode_json
from .picture_files import name_key, split_path

UP_KEY = "progdf:up"
"""Key of the .png text chunk with the up axis of the scene."""
CAMERA_SUFFIX = ".camera.json"
"""Suffix of the file with the camera of a picture, after the picture's stem."""
EDITS_KEY = "progdf:edits"
"""Key of the .png text chunk with the names of the visible edits."""


def camera_chunk(
    camera: Camera,
    edits: Sequence[str] = (),
    origin: Origin = ZERO,
    up: tuple[float, float, float] | None = None,
) -> PngInfo:
    """Return the .png metadata of a rendering, for `Image.save(…, pnginfo=)`.

    Args:
        camera: camera of the rendering, relative to `origin`
        edits: names of the visible edits
        origin: origin of the scene
        up: up axis of the scene
    """
    info = PngInfo()
    info.add_text(PICTURE_KEY, cameras_to_json([camera], origin=origin))
    if up is not None:
        info.add_text(UP_KEY, json.dumps({"direction": up}))
    if edits:
        info.add_itxt(EDITS_KEY, ", ".join(edits))
    return info


def camera_file(path: str | os.PathLike[str]) -> Path:
    """Return the path of A.camera.json beside a picture A.png."""
    return Path(path).with_name(f"{Path(path).stem}{CAMERA_SUFFIX}")


def check_camera_file(path: str | os.PathLike[str]) -> None:
    """Raise ProgdfError if `save_picture_camera` would overwrite anything but one saved camera."""
    beside = camera_file(path)
    if not beside.exists():
        return
    if kind_of_cameras(beside) != "own":
        raise ProgdfError(f"{beside} is not a saved camera; move it, or choose another name for the picture")
    count = len(load_cameras(beside, ZERO))
    if count != 1:
        raise ProgdfError(f"{beside} holds {count} cameras; move it, or choose another name for the picture")


def save_picture_camera(path: str | os.PathLike[str], camera: Camera, origin: Origin = ZERO) -> None:
    """Write the camera of a picture A.png to A.camera.json beside it. A pipe or a device gets none.

    Args:
        path: the picture
        camera: its camera, relative to `origin`
        origin: origin of the scene; the file stores the camera in the world

    Raises:
        ProgdfError: see `check_camera_file`, or the file cannot be written.
    """
    if Path(path).is_file():
        check_camera_file(path)
        save_cameras(camera_file(path), [camera], origin)


def edits_in_picture(path: str | os.PathLike[str]) -> str:
    """Return the names of the edits stored in a .png, or ""; raise ProgdfError if it is not a picture."""
    return picture_text(path, EDITS_KEY) or ""


def up_in_picture(path: str | os.PathLike[str]) -> object:
    """Return the up axis stored in a picture as decoded JSON, for `up_from_json`; None if there is none.

    Raises:
        ProgdfError: the file is not a picture.
    """
    text = picture_text(path, UP_KEY)
    with contextlib.suppress(ValueError):
        return decode_json(text) if text is not None and len(text) < 1000 else None
    return None


def find_picture_camera(
    path: str | os.PathLike[str], given: Sequence[Camera] = (), origin: Origin = ZERO
) -> Camera:
    """Return the camera of a picture, see `stored_picture_camera`.

    Raises:
        ProgdfError: the file is not a picture, the camera is invalid, or no camera or several are found.
    """
    path = Path(path)
    camera = stored_picture_camera(path, given, origin)
    if camera is None:
        raise ProgdfError(
            f"{path} has no stored camera; put {camera_file(path).name} beside it, or give a camera named "
            f"{path.stem} with --cameras (such as the .png written by progdf render)"
        )
    return camera


def stored_picture_camera(
    path: str | os.PathLike[str], given: Sequence[Camera] = (), origin: Origin = ZERO
) -> Camera | None:
    """Return the camera of a picture, None if there is none.

    The first of these is used: the camera embedded in the picture, the camera in A.camera.json beside A.png,
    or the given camera with the name of the picture.

    Args:
        path: the picture, of any format
        given: cameras from --cameras, relative to `origin`
        origin: origin of the scene; the result is relative to it

    Returns:
        The camera, named like the picture, with the size of the rendering and without a lens.

    Raises:
        ProgdfError: the file is not a picture, the camera is invalid, or several cameras are found.
    """
    path = Path(path)
    camera = camera_in_picture(path, origin)
    beside = camera_file(path)
    if camera is None and beside.is_file():
        cameras = load_cameras(beside, origin)
        if len(cameras) != 1:
            raise ProgdfError(f"{beside} holds {len(cameras)} cameras; keep the one of {path.name}")
        camera = cameras[0]
    if camera is None:
        named = _named_cameras(path, given)
        if len(named) > 1:
            raise ProgdfError(f"{len(named)} cameras are named {path.stem}; give {beside.name} beside {path}")
        if not named:
            return None
        camera = named[0]
    return replace(camera, name=path.stem, lens=None)  # renderings are undistorted


def _named_cameras(path: Path, cameras: Sequence[Camera]) -> list[Camera]:
    """Return the cameras named like a picture, of these the ones with the most folders in common with it."""
    parts = [name_key(part) for part in split_path(path.absolute().as_posix())]
    named: list[Camera] = []
    longest = 1
    for camera in cameras:
        own = [name_key(part) for part in split_path(camera.name)]
        if not own or own[-1] != parts[-1]:
            continue
        shared = len(own) if parts[-len(own) :] == own else 1
        if shared > longest:
            named = []
            longest = shared
        if shared == longest:
            named.append(camera)
    return named
