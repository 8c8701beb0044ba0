"""The camera of a picture: written into the .png that is rendered, found again for one that was changed.

Any program may change the picture in between. Many keep the text in which the camera stands; for one that
drops it, or writes another format, a file beside the picture or the camera of that name tells.
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

from .cameras import PICTURE_KEY, camera_in_picture, cameras_to_json, load_cameras
from .images import picture_text
from .json_values import decode_json
from .picture_files import name_key, split_path

UP_KEY = "progdf:up"
EDITS_KEY = "progdf:edits"
"""Of the text in a .png that names the edits which it shows."""


def camera_chunk(
    camera: Camera,
    edits: Sequence[str] = (),
    origin: Origin = ZERO,
    up: tuple[float, float, float] | None = None,
) -> PngInfo:
    """What `Image.save(…, pnginfo=)` takes for a .png to carry the camera from which it was rendered, the
    names of the edits that it shows, and which direction counted as up. `origin`: of the scene, which the
    camera is relative to."""
    info = PngInfo()
    info.add_text(PICTURE_KEY, cameras_to_json([camera], origin=origin))
    if up is not None:
        info.add_text(UP_KEY, json.dumps({"direction": up}))
    if edits:
        info.add_itxt(EDITS_KEY, ", ".join(edits))
    return info


def edits_in_picture(path: str | os.PathLike[str]) -> str:
    """The edits that a .png says it shows, "" for none. Raises ProgdfError: it is no picture."""
    return picture_text(path, EDITS_KEY) or ""


def up_in_picture(path: str | os.PathLike[str]) -> object:
    """What a picture says was up when it was rendered, for `up_from_json`; None where it says nothing.

    Raises ProgdfError: it is no picture.
    """
    text = picture_text(path, UP_KEY)
    with contextlib.suppress(ValueError):
        return decode_json(text) if text is not None and len(text) < 1000 else None
    return None


def find_picture_camera(
    path: str | os.PathLike[str], given: Sequence[Camera] = (), origin: Origin = ZERO
) -> Camera:
    """The camera of a picture: the one that it carries; else of A.camera.json beside A.png; else of the given
    ones the one that is named as the picture is.

    Args:
        path: the picture, of any format
        given: as of --cameras
        origin: of the scene, which the camera is relative to, and the given ones are

    Returns:
        The camera, named as the picture is, of the size at which the picture was rendered.

    Raises:
        ProgdfError: no picture, a camera that cannot be used, or none is found.
    """
    path = Path(path)
    camera = camera_in_picture(path, origin)
    beside = path.with_name(f"{path.stem}.camera.json")
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
            raise ProgdfError(
                f"{path} does not say from where it was rendered; put {beside.name} beside it, or give a "
                f"camera named {path.stem} with --cameras (the .png that progdf render wrote is one)"
            )
        camera = named[0]
    return replace(camera, name=path.stem, lens=None)  # what was rendered is straight


def _named_cameras(path: Path, cameras: Sequence[Camera]) -> list[Camera]:
    """Return the cameras named as a picture; of several those whose folders are the picture's too."""
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
