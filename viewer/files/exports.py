"""Files that the window exports: pictures and cameras."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Origin
from progdf.io.atomic import atomic_write, make_folder, pictures_folder
from progdf.io.cameras import kind_of_cameras, load_cameras, save_cameras
from progdf.io.picture_camera import (
    CAMERA_SUFFIX,
    PictureLayer,
    PictureLayers,
    camera_chunk,
    save_picture_camera,
)
from progdf.io.session import SUFFIX, relative_name, sha256
from viewer.jobs.training import takes_files
from viewer.state.layers import visible_layers
from viewer.state.view_state import ViewState

from .document import Document

CAMERAS = ".cameras.json"  # suffix of a file of cameras

REQUESTS = ("picture", "take_view", "window_picture")
"""Names of the export requests that the main view handles."""


def folder_of(scene: Path | None) -> Path:
    """Return the export folder of a scene: its own folder, or the user's pictures folder if that is
    read-only."""
    beside = scene.resolve().parent if scene is not None else None
    return beside if beside is not None and takes_files(beside) else pictures_folder()


def picture(folder: Path, title: str, image: NDArray[np.uint8], info: PngInfo | None = None) -> Path:
    """Save a picture as NAME_001.png, or with the next free number.

    Args:
        folder: target folder
        title: name of the scene
        image: pixels. [H,W,3]
        info: PNG metadata, see `camera_chunk`; a picture with its camera can be edited and trained on

    Returns:
        Path of the file.

    Raises:
        ProgdfError: the file cannot be written.
    """
    with _writable(folder, "picture"):
        path = free_path(folder, Path(title).stem, ".png")
        with atomic_write(path) as temporary_file:
            Image.fromarray(image).save(temporary_file, pnginfo=info)
        return path.resolve()


def picture_layers(opened: Document, view: ViewState) -> PictureLayers | None:
    """Return the visible layers for the metadata of a picture; None for the original.

    Raises:
        ProgdfError: a layer has no file, or is a grade on a chosen region, which a picture cannot name.
    """
    scene = opened.path
    found = []
    for layer in visible_layers(view):
        if layer.strength == 0.0:
            continue
        if scene is None or not 0 <= layer.gdf < len(opened.gdf_paths):
            raise ProgdfError(f"{layer.name} has no file yet; hide it, or wait until it is trained")
        if opened.edits[layer.gdf].applied:
            raise ProgdfError(f"a picture cannot store {layer.name}, a grade on a chosen region; hide it")
        path = opened.gdf_paths[layer.gdf]
        gains = layer.gains
        found.append(
            PictureLayer(
                layer.name,
                relative_name(path, scene.resolve().parent),
                sha256(path.resolve()),
                layer.strength,
                geometry=gains.geometry,
                opacity=gains.opacity,
                color=gains.color,
                texture=gains.texture,
                paint=layer.paint,
                blend=layer.blend,
            )
        )
    return PictureLayers(view.blend, tuple(found)) if found else None


def camera(source: Path, viewpoint: Camera, origin: Origin = ZERO) -> tuple[Path, int]:
    """Add a camera to NAME.cameras.json beside a scene or session NAME.

    Args:
        source: file of the scene or session
        viewpoint: the camera
        origin: origin of the scene that the camera is relative to

    Returns:
        Path of the file, and the number of cameras in it.

    Raises:
        ProgdfError: the file cannot be written, or was not made by this function.
    """
    name = source.name.removesuffix(SUFFIX) if source.name.endswith(SUFFIX) else source.stem
    path = source.with_name(f"{name}{CAMERAS}")
    if path.exists() and kind_of_cameras(path) != "own":
        raise ProgdfError(f"{path} was not made with F4; move it elsewhere, as it would be overwritten")
    cameras = load_cameras(path, origin) if path.exists() else []
    number = 1 + max((int(c.name[5:]) for c in cameras if re.fullmatch(r"view_\d{1,9}", c.name)), default=-1)
    save_cameras(path, [*cameras, replace(viewpoint, name=f"view_{number:03d}")], origin)
    return path, len(cameras) + 1


def painted_picture(
    path: Path,
    pixels: NDArray[np.uint8],
    viewpoint: Camera,
    origin: Origin,
    layers: PictureLayers | None = None,
) -> None:
    """Save a painted picture with its camera, in the picture and beside it, so that an edit can follow it.

    Args:
        path: .png file
        pixels: the picture, with or without transparency. [H,W,3 or 4]
        viewpoint: its camera
        origin: origin of the scene that the camera is relative to
        layers: layers under the paint, see `picture_layers`

    Raises:
        ProgdfError: the file cannot be written.
    """
    make_folder(path.parent)
    info = camera_chunk(viewpoint, origin=origin, layers=layers)
    with atomic_write(path) as temporary_file:
        Image.fromarray(pixels).save(temporary_file, "PNG", pnginfo=info)
    save_picture_camera(path, viewpoint, origin, layers)


def single_camera(path: Path, viewpoint: Camera, origin: Origin) -> Path:
    """Save one camera as NAME.camera.json beside a file or run NAME; return its path.

    Raises:
        ProgdfError: the file cannot be written.
    """
    make_folder(path.parent)
    camera_file = path.with_name(f"{path.name}{CAMERA_SUFFIX}")
    save_cameras(camera_file, [viewpoint], origin)
    return camera_file


@contextmanager
def _writable(folder: Path, what: str) -> Iterator[None]:
    """Create the folder, and convert write errors to a one-line ProgdfError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)  # the user's pictures folder may not exist yet
        yield
    except OSError as error:
        raise ProgdfError(f"no {what} was saved in {folder.resolve()}: {error.strerror}") from None


def free_path(folder: Path, stem: str, suffix: str) -> Path:
    """Return the path STEM_001 with `suffix`, or with the next free number."""
    number = 1
    while True:
        path = folder / f"{stem}_{number:03d}{suffix}"
        if not path.exists():
            return path
        number += 1
