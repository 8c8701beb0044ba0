"""Camera controls for mouse and keys as pure functions.

Pixels are window coordinates at 1× (the caller divides by the UI scale), angles are in degrees, lengths in
world units. Every returned camera is finite. A move beyond the numeric range returns the old camera.
"""

from __future__ import annotations

import math
from dataclasses import replace

from .view_camera import FARTHEST, Vec3, ViewCamera, add_scaled, axes, eye, look_from, unit

DEGREES_PER_PIXEL = 0.3
ZOOM_PER_STEP = 0.12  # relative change of the distance per wheel step
DOLLY_PER_PIXEL = 0.005  # relative change of the distance per pixel
FLY_RADII_PER_SECOND = 0.6  # speed, scene radii per second
MIN_DISTANCE_RADII = 1e-4  # smallest distance of the eye to the pivot, scene radii
MAX_DISTANCE_RADII = 1e4  # largest distance of the eye to the pivot, scene radii


def orbit(camera: ViewCamera, dx: float, dy: float) -> ViewCamera:
    """Orbit around the pivot so that the scene follows the mouse. The elevation stops at the poles."""
    elevation = max(-90.0, min(90.0, camera.elevation + DEGREES_PER_PIXEL * dy))
    azimuth = _wrap_degrees(camera.azimuth - DEGREES_PER_PIXEL * dx)
    return _keep_finite(replace(camera, azimuth=azimuth, elevation=elevation), camera)


def look(camera: ViewCamera, dx: float, dy: float) -> ViewCamera:
    """Rotate the view around the fixed eye (fly mode): right looks right, down looks down."""
    turned = orbit(camera, dx, dy)
    position = eye(camera)
    return _keep_finite(
        replace(turned, pivot=add_scaled(position, (-camera.distance, axes(turned).back))), camera
    )


def pan(camera: ViewCamera, dx: float, dy: float, height: float) -> ViewCamera:
    """Pan the view so that points at the pivot's depth follow the cursor.

    Args:
        camera: the camera
        dx, dy: movement of the cursor, px
        height: height of the picture, px
    """
    per_pixel = 2.0 * camera.distance * math.tan(math.radians(camera.fov_y) / 2) / max(height, 1.0)
    picture = axes(camera)
    pivot = add_scaled(camera.pivot, (-dx * per_pixel, picture.right), (dy * per_pixel, picture.up))
    return _keep_finite(replace(camera, pivot=pivot), camera)


def zoom(camera: ViewCamera, steps: float, radius: float) -> ViewCamera:
    """Zoom by wheel steps in proportion to the distance.

    Args:
        camera: the camera
        steps: wheel steps, > 0 to move nearer
        radius: radius of the scene, world units, which limits the distance
    """
    factor = math.exp(max(-50.0, min(50.0, -ZOOM_PER_STEP * steps))) if math.isfinite(steps) else 1.0
    return _keep_finite(replace(camera, distance=_clamp_distance(camera.distance * factor, radius)), camera)


def dolly(camera: ViewCamera, dy: float, radius: float) -> ViewCamera:
    """Dolly by dragging, in proportion to the distance: down moves away, up moves nearer."""
    return zoom(camera, -dy * DOLLY_PER_PIXEL / ZOOM_PER_STEP, radius)


def drag(camera: ViewCamera, does: str, dx: float, dy: float, height: float, radius: float) -> ViewCamera:
    """Apply one step of a drag: "orbit", "look", "pan" or "dolly". Raises KeyError for another name."""
    match does:
        case "orbit":
            return orbit(camera, dx, dy)
        case "look":
            return look(camera, dx, dy)
        case "pan":
            return pan(camera, dx, dy, height)
        case "dolly":
            return dolly(camera, dy, radius)
    raise KeyError(does)


def fly(
    camera: ViewCamera,
    right: float,
    up: float,
    ahead: float,
    seconds: float,
    radius: float,
    pace: float = 1.0,
) -> ViewCamera:
    """Move eye and pivot together, at a speed in proportion to the scene.

    Args:
        camera: the camera
        right, up, ahead: −1, 0 or 1 from the keys; up is the scene's up axis, ahead is the view direction
        seconds: time since the last step, clamped to 0.1 s so that a stall causes no jump
        radius: radius of the scene, world units
        pace: factor on the speed, 10 with Shift, 0.1 with Alt
    """
    direction = unit((right, up, ahead), (0.0, 0.0, 0.0))
    length = FLY_RADII_PER_SECOND * radius * pace * max(0.0, min(seconds, 0.1))
    picture = axes(camera)
    steps = (
        (length * direction[0], picture.right),
        (length * direction[1], unit(camera.up, (0.0, 1.0, 0.0))),
        (-length * direction[2], picture.back),
    )
    return _keep_finite(replace(camera, pivot=add_scaled(camera.pivot, *steps)), camera)


def pivot_on(camera: ViewCamera, point: Vec3, radius: float) -> ViewCamera:
    """Rotate the view to `point` with the eye fixed, and make the point the pivot (double click)."""
    turned = look_from(camera, eye(camera), point)
    return _keep_finite(replace(turned, distance=_clamp_distance(turned.distance, radius)), camera)


def toggle_fly(camera: ViewCamera) -> ViewCamera:
    """Switch between orbit and fly mode. The picture is unchanged."""
    return replace(camera, mode="orbit" if camera.mode == "fly" else "fly")


def _clamp_distance(distance: float, radius: float) -> float:
    return max(MIN_DISTANCE_RADII * radius, min(MAX_DISTANCE_RADII * radius, distance))


def _wrap_degrees(degrees: float) -> float:
    return (degrees + 180.0) % 360.0 - 180.0 if math.isfinite(degrees) else degrees


def _keep_finite(new: ViewCamera, old: ViewCamera) -> ViewCamera:
    numbers = (*new.pivot, new.distance, new.azimuth, new.elevation)
    fits = all(math.isfinite(v) and abs(v) <= FARTHEST for v in numbers) and new.distance > 0.0
    return new if fits else old
