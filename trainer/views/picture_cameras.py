"""Cameras of changed pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Origin
from progdf.io.images import picture_size
from progdf.io.picture_camera import find_picture_camera

_MAX_ASPECT_ERROR = 0.02  # relative difference in proportions allowed between a picture and its camera


def picture_cameras(paths: Sequence[Path], given: Sequence[Camera], origin: Origin = ZERO) -> list[Camera]:
    """Return the cameras of the pictures, at the pictures' sizes.

    Args:
        paths: the pictures
        given: cameras to choose from
        origin: origin of the scene; the cameras are relative to it

    Raises:
        ProgdfError: a picture has no camera (see `find_picture_camera`), or its proportions are different.
    """
    sizes = [picture_size(path) for path in paths]
    cameras = rendered_cameras(paths, given, origin)
    return [camera.resize(*size) for camera, size in zip(cameras, sizes, strict=True)]


def rendered_cameras(paths: Sequence[Path], given: Sequence[Camera], origin: Origin = ZERO) -> list[Camera]:
    """Return the cameras of the pictures at the sizes of their renders (see `picture_cameras`)."""
    cameras = []
    for path in paths:
        camera = find_picture_camera(path, given, origin)
        width, height = picture_size(path)
        if abs(width * camera.height / (height * camera.width) - 1) > _MAX_ASPECT_ERROR:
            raise ProgdfError(
                f"{path} is {width}x{height} pixels, it was rendered with {camera.width}x{camera.height}; "
                "keep the proportions and do not crop it"
            )
        cameras.append(camera)
    return cameras
