"""Cameras of rendered pictures: in the .png and in a file beside it, recovered after external editing.

Many programs keep the text chunk with the camera when they save a picture. If a program drops it, or writes
another format, the camera comes from the file beside the picture, or from a given camera of the same name.
The visible layers are stored in both places too.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import msgspec
from PIL.PngImagePlugin import PngInfo

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Origin

from .atomic import read_file, write_file
from .cameras import (
    PICTURE_KEY,
    camera_in_picture,
    cameras_to_json,
    kind_of_cameras,
    load_cameras,
)
from .images import picture_text
from .json_values import convert_json, decode_json, to_json
from .picture_files import name_key, split_path

UP_KEY = "progdf:up"
"""Key of the .png text chunk with the up axis of the scene."""
CAMERA_SUFFIX = ".camera.json"
"""Suffix of the file with the camera of a picture, after the picture's stem."""
EDITS_KEY = "progdf:edits"
"""Key of the .png text chunk with the names of the visible edits."""
LAYERS_KEY = "progdf:layers"
"""Key of the .png text chunk with the visible layers, see `PictureLayers`."""
_LAYERS = "layers"  # key of the same in the camera file

_Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class PictureLayer(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Layer that a picture shows."""

    name: str
    file: str  # its .gdf file, relative to the folder of the scene, with forward slashes
    sha256: str  # hash of that file, lower-case hexadecimal
    strength: float  # slider value times that of its group
    geometry: _Share = 1.0  # gains
    opacity: _Share = 1.0
    color: _Share = 1.0
    texture: Annotated[float, msgspec.Meta(ge=0.0, le=2.0)] = 1.0
    paint: str = ""  # painted weights, see `progdf.compose.layer_paint`
    blend: str = ""  # its own blend rule; "" for that of the stack


class PictureLayers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Layers that a picture shows, from which the picture can be rendered again."""

    blend: str  # blend rule, see `progdf.compose.layers.BLENDS`
    layers: tuple[PictureLayer, ...]  # the lowest first

    def __str__(self) -> str:
        return ", ".join(f"{layer.name} {layer.strength:g}" for layer in self.layers)


def camera_chunk(
    camera: Camera,
    edits: Sequence[str] = (),
    origin: Origin = ZERO,
    up: tuple[float, float, float] | None = None,
    layers: PictureLayers | None = None,
) -> PngInfo:
    """Return the .png metadata of a rendering, for `Image.save(…, pnginfo=)`.

    Args:
        camera: camera of the rendering, relative to `origin`
        edits: names of the visible edits
        origin: origin of the scene
        up: up axis of the scene
        layers: the visible edits as layers, None if not all of them have a file
    """
    info = PngInfo()
    info.add_text(PICTURE_KEY, cameras_to_json([camera], origin=origin))
    if up is not None:
        info.add_text(UP_KEY, json.dumps({"direction": up}))
    if edits:
        info.add_itxt(EDITS_KEY, ", ".join(edits))
    if layers is not None and layers.layers:
        info.add_itxt(LAYERS_KEY, json.dumps(to_json(layers), ensure_ascii=False))
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


def save_picture_camera(
    path: str | os.PathLike[str],
    camera: Camera,
    origin: Origin = ZERO,
    layers: PictureLayers | None = None,
) -> None:
    """Write the camera of a picture A.png to A.camera.json beside it. A pipe or a device gets none.

    Args:
        path: the picture
        camera: its camera, relative to `origin`
        origin: origin of the scene; the file stores the camera in the world
        layers: see `camera_chunk`

    Raises:
        ProgdfError: see `check_camera_file`, or the file cannot be written.
    """
    if not Path(path).is_file():
        return
    check_camera_file(path)
    content = json.loads(cameras_to_json([camera], origin=origin))
    if layers is not None and layers.layers:
        content[_LAYERS] = to_json(layers)
    write_file(camera_file(path), json.dumps(content, indent=1))


def layers_in_picture(path: str | os.PathLike[str]) -> PictureLayers | None:
    """Return the layers that a picture shows; None for a picture of the original.

    They are stored where the picture's camera is: in the picture, or in A.camera.json beside A.png.

    Raises:
        ProgdfError: the file is not a picture, the layers are damaged, or the picture shows edits whose files
            are unknown.
    """
    where = f"the text {LAYERS_KEY} in {os.fspath(path)}"
    beside = camera_file(path)
    text = picture_text(path, LAYERS_KEY)
    edits = edits_in_picture(path)
    try:
        content = None if text is None else decode_json(text)
        if text is None and not edits and picture_text(path, PICTURE_KEY) is None and beside.is_file():
            where = f"{_LAYERS} in {beside}"
            stored = decode_json(read_file(beside))
            content = stored.get(_LAYERS) if isinstance(stored, dict) else None
        if content is not None:
            return convert_json(content, PictureLayers, closed=True)
    except ValueError as error:
        raise ProgdfError(f"{where} is damaged ({error}); take the view again") from None
    if edits:
        raise ProgdfError(
            f"{os.fspath(path)} shows edits ({edits}) without naming their files; save them, and take the "
            "view again"
        )
    return None


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
