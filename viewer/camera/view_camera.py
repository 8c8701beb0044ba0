"""Geometry of the viewing camera: eye position, picture axes, framing.

Plain float64 arithmetic on tuples. It is exact at the poles, as the right axis of the picture comes from the
azimuth and not from a cross product with the view direction.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from msgspec import Meta

from progdf.camera import Camera, intrinsics
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.io.json_values import one_of
from progdf.scene.bounds import front_direction, scene_sphere
from progdf.scene.orbit_rig import detailed_side
from progdf.scene.subject import fit_eye, is_room, room_viewpoint, subject_rows
from progdf.scene.up_axis import find_up, up_from_json

Vec3 = tuple[float, float, float]

LARGEST_SIDE = 16_384
"""Largest width and height of a requested picture, px."""


@dataclass(frozen=True)
class SceneUp:
    """Up axis of a scene in world coordinates, unit length, and its certainty."""

    direction: Vec3
    certain: bool
    reason: str = ""  # text for the user; "" if the axis comes from an edit


def find_scene_up(
    scene: Gaussians,
    gdfs: Sequence[Gdf] = (),
    axis: str = "auto",
    cameras: Sequence[Camera] = (),
    path: Path | None = None,
) -> SceneUp:
    """Find the up axis of a scene. It comes from the training of an edit if possible, else from `find_up`.

    Args:
        scene: the original
        gdfs: its edits, whose training may have stored the up axis
        axis: an axis, or "auto"
        cameras: cameras of the scene
        path: file of the scene
    """
    stored_axes = (up_from_json(gdf.report.get("up")) for gdf in gdfs) if axis == "auto" else ()
    known = next((up for up in stored_axes if up is not None), None)
    guess = find_up(scene, cameras, axis, path) if known is None and len(scene) else None
    if guess is not None:
        known = guess.direction
    x, y, z = (0.0, 1.0, 0.0) if known is None else (float(c) for c in known)
    reason = "" if guess is None else f"{guess.name}, {guess.reason}"
    return SceneUp((x, y, z), guess is None or guess.certain, reason)


FARTHEST = 1e9  # largest coordinate, world units, well within the finite range of float32 matrices

_Number = Annotated[float, Meta(ge=-FARTHEST, le=FARTHEST)]


@dataclass(frozen=True)
class ViewCamera:
    """Viewing camera: a turntable around `pivot`, or a free camera (fly mode) with the same parameters."""

    pivot: tuple[_Number, _Number, _Number] = (0.0, 0.0, 0.0)  # center of orbits, world units
    distance: Annotated[float, Meta(gt=0.0, le=FARTHEST)] = 5.0  # from the pivot to the eye, world units, > 0
    azimuth: _Number = 0.0  # degrees around `up`
    # degrees above the plane normal to `up`, −90 to 90
    elevation: Annotated[float, Meta(ge=-90.0, le=90.0)] = 15.0
    fov_y: Annotated[float, Meta(ge=1.0, le=179.0)] = 45.0  # vertical field of view, degrees
    up: tuple[_Number, _Number, _Number] = (0.0, 1.0, 0.0)  # unit vector that is up in the picture
    mode: Annotated[str, one_of(("orbit", "fly"))] = "orbit"  # "orbit" or "fly"


FILL = 0.72
"""Share of the picture's tighter side that the framed object fills."""

INSIDE_FOV = 60.0
"""Smallest vertical field of view inside a room, in degrees, wide enough for orientation."""


@dataclass(frozen=True)
class Bounds:
    """Bounding sphere of the bulk of a scene or region, world units, radius > 0."""

    center: Vec3 = (0.0, 0.0, 0.0)
    radius: float = 1.0


@dataclass(frozen=True)
class Axes:
    """Picture axes as unit vectors in world coordinates: right, up, and back (from the pivot to the eye)."""

    right: Vec3
    up: Vec3
    back: Vec3


Fit = Callable[[ViewCamera, float], ViewCamera]
"""Function from a camera and an aspect (width / height) to the camera that frames a subject.

The direction is unchanged.
"""


def keep_camera(camera: ViewCamera, aspect: float) -> ViewCamera:
    """Return the camera unchanged: the fit of an unknown subject."""
    return camera


def dot(a: Vec3, b: Vec3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vec3, b: Vec3) -> Vec3:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def add_scaled(origin: Vec3, *steps: tuple[float, Vec3]) -> Vec3:
    """Return origin + Σ length · direction."""
    x, y, z = origin
    for length, direction in steps:
        x = x + length * direction[0]
        y = y + length * direction[1]
        z = z + length * direction[2]
    return x, y, z


def unit(v: Vec3, otherwise: Vec3) -> Vec3:
    """Normalize `v`. Return `otherwise` if it is zero or not finite."""
    largest = max(abs(c) for c in v)
    if not (0.0 < largest < math.inf) or any(math.isnan(c) for c in v):
        return otherwise
    x, y, z = (c / largest for c in v)
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@cache
def front(up: Vec3) -> Vec3:
    """Return the direction of the eye at azimuth 0 and elevation 0, see `front_direction`."""
    x, y, z = front_direction(torch.tensor(up, dtype=torch.float64)).tolist()
    return x, y, z


def axes(camera: ViewCamera) -> Axes:
    """Return the picture's axes. An invalid `up` counts as +Y."""
    up = unit(camera.up, (0.0, 1.0, 0.0))
    ahead = front(up)
    side = cross(up, ahead)
    azimuth = math.radians(camera.azimuth)
    elevation = math.radians(camera.elevation)
    cos_a = math.cos(azimuth)
    sin_a = math.sin(azimuth)
    cos_e = math.cos(elevation)
    sin_e = math.sin(elevation)
    level = add_scaled((0.0, 0.0, 0.0), (cos_a, ahead), (sin_a, side))
    zero = (0.0, 0.0, 0.0)
    return Axes(
        right=add_scaled(zero, (cos_a, side), (-sin_a, ahead)),
        up=add_scaled(zero, (cos_e, up), (-sin_e, level)),
        back=add_scaled(zero, (sin_e, up), (cos_e, level)),
    )


def eye(camera: ViewCamera) -> Vec3:
    """Return the position of the eye, world units."""
    return add_scaled(camera.pivot, (camera.distance, axes(camera).back))


def to_camera(camera: ViewCamera, width: int, height: int) -> Camera:
    """Convert to a pinhole camera for a picture of this size in pixels (at least 1 × 1)."""
    width = max(width, 1)
    height = max(height, 1)
    picture = axes(camera)
    position = eye(camera)
    rows = np.array([picture.right, picture.up, picture.back], dtype=np.float64)
    rows[1:] *= -1.0  # OpenCV axes: y down, z forward
    viewmat = np.eye(4)
    viewmat[:3, :3] = rows
    viewmat[:3, 3] = -rows @ np.array(position)
    return Camera(
        torch.from_numpy(viewmat).float(),
        intrinsics(math.radians(camera.fov_y), width, height),
        width,
        height,
    )


SHAPES = {"16:9": 16 / 9, "1:1": 1.0, "9:16": 9 / 16}
"""Aspect ratios (width / height) of films and of the window's safe frame."""


def widen(camera: ViewCamera, scale: float) -> ViewCamera:
    """Widen the field of view: the former picture height fills the share `scale` (0 to 1) of the new one."""
    half = math.atan(math.tan(math.radians(camera.fov_y) / 2) / scale)
    return camera if scale == 1.0 else replace(camera, fov_y=2 * math.degrees(half))


def half_camera(camera: Camera) -> Camera:
    """Return the camera of a picture of half the width in which the central square stays visible."""
    width = max(camera.width // 2, 1)
    shrink = half_scale(camera.width, camera.height)
    K = camera.K.clone()
    K[:2] *= shrink
    K[0, 2] += 0.5 * (width - shrink * camera.width)
    K[1, 2] += 0.5 * (1.0 - shrink) * camera.height
    return replace(camera, K=K, width=width)


def half_scale(width: int, height: int) -> float:
    """Return the scale of objects in the picture of `half_camera` relative to the full picture."""
    return min(max(width // 2, 1) / max(min(width, height), 1), 1.0)


def look_along(camera: ViewCamera, back: Vec3) -> ViewCamera:
    """Set azimuth and elevation to look along −`back` (any length). Pivot and distance are unchanged."""
    up = unit(camera.up, (0.0, 1.0, 0.0))
    direction = unit(back, axes(camera).back)
    ahead = front(up)
    height = max(-1.0, min(1.0, dot(direction, up)))
    level = add_scaled(direction, (-height, up))
    azimuth = camera.azimuth  # the azimuth is arbitrary for a vertical direction, so it stays
    if dot(level, level) > 1e-18:
        azimuth = math.degrees(math.atan2(dot(level, cross(up, ahead)), dot(level, ahead)))
    # atan2 is accurate near the poles, asin is not
    elevation = math.degrees(math.atan2(height, math.sqrt(dot(level, level))))
    return replace(camera, azimuth=azimuth, elevation=elevation)


def with_up(camera: ViewCamera, up: Vec3) -> ViewCamera:
    """Set the up axis. Eye and pivot are unchanged, so the picture only rolls upright."""
    back = axes(camera).back
    return look_along(replace(camera, up=unit(up, camera.up)), back)


def move_camera(camera: ViewCamera, by: Vec3) -> ViewCamera:
    """Translate the camera, to convert between scene and world coordinates of files (`Gaussians.origin`)."""
    return replace(camera, pivot=add_scaled(camera.pivot, (1.0, by)))


def look_from(camera: ViewCamera, position: Vec3, pivot: Vec3) -> ViewCamera:
    """Move the eye to `position` and look at `pivot`. If they coincide, the direction is unchanged."""
    back = (position[0] - pivot[0], position[1] - pivot[1], position[2] - pivot[2])
    turned = look_along(replace(camera, pivot=pivot), back)
    return replace(turned, distance=max(math.dist(position, pivot), 1e-9))


def bounds_of(scene: Gaussians) -> Bounds:
    """Return the bounding sphere of the bulk of a scene, without distant floaters."""
    if not len(scene):
        return Bounds()
    center, radius = scene_sphere(scene)
    x, y, z = (float(c) for c in center)
    return Bounds((x, y, z), radius) if math.isfinite(x + y + z + radius) else Bounds()


def frame(camera: ViewCamera, bounds: Bounds, aspect: float = 1.0) -> ViewCamera:
    """Frame the sphere `bounds` in the smaller side of the picture. The direction is unchanged.

    Args:
        camera: the camera
        bounds: sphere to frame, world units
        aspect: width / height of the picture
    """
    half = math.radians(camera.fov_y) / 2
    if 0.0 < aspect < 1.0:
        half = math.atan(math.tan(half) * aspect)
    return replace(camera, pivot=bounds.center, distance=1.05 * bounds.radius / math.sin(half))


def fit(camera: ViewCamera, scene: Gaussians, aspect: float = 1.0) -> ViewCamera:
    """Frame these Gaussians in the share `FILL` of the picture's tighter side. The direction is unchanged.

    Args:
        camera: the camera
        scene: Gaussians to frame; if empty, the unit sphere at the origin is framed
        aspect: width / height of the picture
    """
    if not len(scene):
        return frame(camera, bounds_of(scene), aspect)
    picture_axes = axes(camera)
    tangent = math.tan(math.radians(camera.fov_y) / 2)
    frame_axes = torch.tensor([picture_axes.right, picture_axes.up, picture_axes.back], dtype=torch.float64)
    radius = 2 * float(scene.log_scales.amax(dim=1).median().exp())
    position = fit_eye(scene.means, radius, frame_axes, (FILL * tangent * aspect, FILL * tangent))
    x, y, z = (float(c) for c in position)
    depth = dot((x, y, z), picture_axes.back) - float((scene.means.double() @ frame_axes[2]).median())
    if not (math.isfinite(x + y + z) and 0.0 < depth < FARTHEST):
        return frame(camera, bounds_of(scene), aspect)
    return replace(camera, pivot=add_scaled((x, y, z), (-depth, picture_axes.back)), distance=depth)


def fit_subject(camera: ViewCamera, scene: Gaussians, aspect: float = 1.0) -> ViewCamera:
    """Frame the scene's subject (`subject_rows`) from the same direction.

    In a room the camera is unchanged.
    """
    up = torch.tensor(camera.up)
    return camera if is_room(scene, up) else fit(camera, scene[subject_rows(scene, up)], aspect)


def fit_all(camera: ViewCamera, scene: Gaussians, aspect: float = 1.0) -> ViewCamera:
    """Frame the scene's subject from the same direction, or a whole room from outside."""
    up = torch.tensor(camera.up)
    if not len(scene) or is_room(scene, up):
        return frame(camera, bounds_of(scene), aspect)
    return fit(camera, scene[subject_rows(scene, up)], aspect)


def first_camera(
    scene: Gaussians,
    cameras: Sequence[Camera] = (),
    aspect: float = 1.5,
    fov_y: float = 45.0,
    up: Vec3 | None = None,
    stored: Camera | None = None,
) -> ViewCamera:
    """Return the first view: the view of the camera stored in the file, or a view of the scene's subject.

    The subject is upright, seen from the front and a little above. The camera of a room is inside, at a wall
    or a corner, with a field of view of at least `INSIDE_FOV` degrees.

    Args:
        scene: the original
        cameras: cameras of the scene
        aspect: width / height of the picture
        fov_y: vertical field of view, degrees
        up: unit vector; None estimates it from the cameras and the scene
        stored: the camera in the scene's file (`progdf.formats.ply_view`), whose picture fits into the view
    """
    up = find_scene_up(scene, cameras=cameras).direction if up is None else up
    camera = ViewCamera(up=up, azimuth=20.0, fov_y=fov_y)
    axis = torch.tensor(up)
    if not len(scene):
        return frame(camera, Bounds(), aspect)
    if stored is not None:
        view = from_camera(camera, stored, bounds_of(scene))
        half_width = stored.width / (2.0 * float(stored.K[0, 0]))
        half_height = max(math.tan(math.radians(view.fov_y) / 2.0), half_width / aspect)
        return replace(view, fov_y=min(2.0 * math.degrees(math.atan(half_height)), 179.0))
    if is_room(scene, axis):
        eye_at, target = (tuple(at.tolist()) for at in room_viewpoint(scene, axis))
        return look_from(replace(camera, fov_y=max(fov_y, INSIDE_FOV)), eye_at, target)
    subject = scene[subject_rows(scene, axis)]
    azimuth = camera.azimuth + detailed_side(subject, axis, camera.azimuth, camera.elevation)
    return fit(replace(camera, azimuth=azimuth), subject, aspect)


def from_camera(camera: ViewCamera, seen: Camera, bounds: Bounds) -> ViewCamera:
    """Convert a pinhole camera to an upright viewing camera with the same eye, direction and field of view.

    Args:
        camera: source of the up axis and the mode
        seen: the pinhole camera
        bounds: bounds of the scene; the pivot is at the depth of their center, or at their radius if it is
            behind
    """
    world = torch.linalg.inv(seen.viewmat.double()).tolist()
    position: Vec3 = (world[0][3], world[1][3], world[2][3])
    ahead: Vec3 = (world[0][2], world[1][2], world[2][2])
    depth = dot(add_scaled(bounds.center, (-1.0, position)), ahead)
    depth = depth if depth > 1e-3 * bounds.radius else bounds.radius
    fov_y = math.degrees(2.0 * math.atan(seen.height / (2.0 * float(seen.K[1, 1]))))
    return look_from(replace(camera, fov_y=fov_y), position, add_scaled(position, (depth, ahead)))
