"""Camera of a rendered picture from its options, the session or the scene."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.io.cameras import read_camera
from viewer.camera import view_camera
from viewer.camera.view_camera import FARTHEST, LARGEST_SIDE, Vec3, ViewCamera, bounds_of

from .open_stack import check_edit
from .options import ViewpointOptions

DEFAULT_SIZE = (640, 480)


def choose_camera(
    viewpoint: ViewpointOptions,
    scene: Gaussians,
    gdfs: Sequence[Gdf],
    saved: ViewCamera | None,
    up: Vec3 | None = None,
    stored: Camera | None = None,
    framed: Gaussians | None = None,
) -> Camera:
    """Return the requested camera, the session's, the one stored in the scene's file, or a frame of the
    scene.

    Args:
        viewpoint: the requested viewpoint
        scene: the original
        gdfs: its edits, which --frame may name
        saved: camera of a session
        up: unit vector that is up in the scene; None estimates it
        stored: camera stored in the scene's file
        framed: Gaussians that a frame of the whole view shows; None: the scene

    Raises:
        ProgdfError: options that contradict each other or name nothing.
    """
    size = None if viewpoint.size is None else parse_size(viewpoint.size)
    if viewpoint.camera is not None and viewpoint.orbit is not None:
        raise ProgdfError("--camera and --orbit cannot be combined; give only one of them")
    if viewpoint.camera is not None:
        if viewpoint.frame is not None:
            raise ProgdfError("--camera and --frame cannot be combined; give only one of them")
        camera = read_camera(viewpoint.camera, scene.origin)
        return camera if size is None else fit_camera(camera, size)
    width, height = size or DEFAULT_SIZE
    aspect = width / height
    whole = scene if framed is None else framed
    view = saved or view_camera.first_camera(whole, aspect=aspect, up=up, stored=stored)
    if viewpoint.orbit is not None:
        view = parse_orbit(viewpoint.orbit, view)
    if viewpoint.frame is not None or (viewpoint.orbit is not None and saved is None):
        view = _frame_on(view, viewpoint.frame, whole if viewpoint.frame is None else scene, gdfs, aspect)
        if viewpoint.orbit is not None:  # an explicit distance overrides the fit
            view = parse_orbit(viewpoint.orbit, view)
    return view_camera.to_camera(view, width, height)


def _frame_on(
    view: ViewCamera, name: str | None, scene: Gaussians, gdfs: Sequence[Gdf], aspect: float
) -> ViewCamera:
    """Return a camera with the same direction, fitted to the subject of --frame."""
    if name is None:
        return view_camera.fit_subject(view, scene, aspect)
    if name == "all" and name not in [gdf.name for gdf in gdfs]:
        return view_camera.frame(view, bounds_of(scene), aspect)
    check_edit(name, gdfs, "--frame")
    (members,) = (gdf.region.members for gdf in gdfs if gdf.name == name)
    return view_camera.fit(view, scene[members], aspect)


def parse_size(text: str) -> tuple[int, int]:
    """Return width and height of `WxH` in pixels.

    Raises:
        ProgdfError: it is not a size, or a side is not 1 to `LARGEST_SIDE`.
    """
    width, cross, height = text.lower().partition("x")
    if not cross or not all(re.fullmatch(r"[0-9]{1,9}", side) for side in (width, height)):
        raise ProgdfError(f"--size {text} is not a size; write it as WIDTHxHEIGHT, for example 640x480")
    size = int(width), int(height)
    if not all(1 <= side <= LARGEST_SIDE for side in size):
        raise ProgdfError(f"--size {text} cannot be drawn; each side may be 1 to {LARGEST_SIDE} pixels")
    return size


def parse_orbit(text: str, framed: ViewCamera) -> ViewCamera:
    """Return the camera of `AZIMUTH,ELEVATION[,DISTANCE]`: degrees, degrees above the horizon, world units.

    Args:
        text: the option's value
        framed: shows the scene; gives the pivot, the up axis, and the default distance

    Raises:
        ProgdfError: it is not two or three finite numbers, or a number is outside its range.
    """
    right = "write AZIMUTH,ELEVATION or AZIMUTH,ELEVATION,DISTANCE, for example --orbit 30,15"
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise ProgdfError(f"--orbit {text} is not a list of numbers; {right}") from None
    if len(numbers) not in (2, 3) or not all(math.isfinite(number) for number in numbers):
        raise ProgdfError(f"--orbit {text} is not two or three numbers; {right}")
    if not -90 <= numbers[1] <= 90:
        raise ProgdfError(
            f"--orbit {text}: the elevation must be between -90 and 90 degrees, got {numbers[1]:g}"
        )
    distance = numbers[2] if len(numbers) == 3 else framed.distance
    if not 0 < distance <= FARTHEST:
        raise ProgdfError(
            f"--orbit {text}: the distance must be above 0 and at most {FARTHEST:g}, got {distance:g}"
        )
    return replace(framed, azimuth=numbers[0], elevation=numbers[1], distance=distance)


def fit_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """Return the same view in another size, undistorted: same height of the scene, sides cut or widened."""
    width, height = size
    scale = height / camera.height
    K = camera.K * scale
    K[2, 2] = 1.0
    K[0, 2] = width / 2 + (camera.K[0, 2] - camera.width / 2) * scale
    return replace(camera, K=K, width=width, height=height)
