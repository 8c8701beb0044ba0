"""What the mouse and the keys do to the camera, as pure functions, and the table of bindings, as data.

Pixels are window coordinates at 1× (the caller divides by the UI scale), angles degrees, lengths world units.
No function ever returns a camera that is not finite: a move that would leave the numbers is not made.
"""

from __future__ import annotations

import math
from dataclasses import replace

from .view_camera import FARTHEST, Vec3, ViewCamera, add_scaled, axes, eye, look_from, unit

DEGREES_PER_PIXEL = 0.3
ZOOM_PER_STEP = 0.12  # of the distance, per wheel step
DOLLY_PER_PIXEL = 0.005
FLY_RADII_PER_SECOND = 0.6
# of the scene's radius: how near to and far from the pivot the eye goes
CLOSEST = 1e-4
WIDEST = 1e4


def orbit(camera: ViewCamera, dx: float, dy: float) -> ViewCamera:
    """Turn around the pivot so that the scene follows the mouse; stops at the poles."""
    elevation = max(-90.0, min(90.0, camera.elevation + DEGREES_PER_PIXEL * dy))
    azimuth = _wrap_degrees(camera.azimuth - DEGREES_PER_PIXEL * dx)
    return _keep_finite(replace(camera, azimuth=azimuth, elevation=elevation), camera)


def look(camera: ViewCamera, dx: float, dy: float) -> ViewCamera:
    """Turn the view with the eye fixed (fly mode): right looks right, down looks down."""
    turned = orbit(camera, dx, dy)
    position = eye(camera)
    return _keep_finite(
        replace(turned, pivot=add_scaled(position, (-camera.distance, axes(turned).back))), camera
    )


def pan(camera: ViewCamera, dx: float, dy: float, height: float) -> ViewCamera:
    """Slide the view so that what lies at the pivot's depth stays under the cursor.

    Args:
        height: of the picture in the same pixels as dx and dy
    """
    per_pixel = 2.0 * camera.distance * math.tan(math.radians(camera.fov_y) / 2) / max(height, 1.0)
    picture = axes(camera)
    pivot = add_scaled(camera.pivot, (-dx * per_pixel, picture.right), (dy * per_pixel, picture.up))
    return _keep_finite(replace(camera, pivot=pivot), camera)


def zoom(camera: ViewCamera, steps: float, radius: float) -> ViewCamera:
    """Wheel: steps > 0 goes nearer, in proportion to the distance.

    Args:
        radius: of the scene, world units; bounds the distance
    """
    factor = math.exp(max(-50.0, min(50.0, -ZOOM_PER_STEP * steps))) if math.isfinite(steps) else 1.0
    return _keep_finite(replace(camera, distance=_clamp_distance(camera.distance * factor, radius)), camera)


def dolly(camera: ViewCamera, dy: float, radius: float) -> ViewCamera:
    """Drag: down goes away, up goes nearer, in proportion to the distance."""
    return zoom(camera, -dy * DOLLY_PER_PIXEL / ZOOM_PER_STEP, radius)


def drag(camera: ViewCamera, does: str, dx: float, dy: float, height: float, radius: float) -> ViewCamera:
    """One step of a drag of `DRAGS`; see the function that it names."""
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
        right, up, ahead: −1, 0 or 1 from the keys; up is the scene's up, ahead is where one looks
        seconds: since the last step; a stall counts as a tenth of a second at most
        radius: of the scene, world units
        pace: 10 with Shift, 0.1 with Alt
    """
    wish = unit((right, up, ahead), (0.0, 0.0, 0.0))
    length = FLY_RADII_PER_SECOND * radius * pace * max(0.0, min(seconds, 0.1))
    picture = axes(camera)
    steps = (
        (length * wish[0], picture.right),
        (length * wish[1], unit(camera.up, (0.0, 1.0, 0.0))),
        (-length * wish[2], picture.back),
    )
    return _keep_finite(replace(camera, pivot=add_scaled(camera.pivot, *steps)), camera)


def pivot_on(camera: ViewCamera, point: Vec3, radius: float) -> ViewCamera:
    """Double click: the eye stays, the view turns to `point`, which becomes the pivot."""
    turned = look_from(camera, eye(camera), point)
    return _keep_finite(replace(turned, distance=_clamp_distance(turned.distance, radius)), camera)


def toggle_fly(camera: ViewCamera) -> ViewCamera:
    """Orbit ↔ fly; the picture does not move."""
    return replace(camera, mode="orbit" if camera.mode == "fly" else "fly")


def _clamp_distance(distance: float, radius: float) -> float:
    return max(CLOSEST * radius, min(WIDEST * radius, distance))


def _wrap_degrees(degrees: float) -> float:
    return (degrees + 180.0) % 360.0 - 180.0 if math.isfinite(degrees) else degrees


def _keep_finite(new: ViewCamera, old: ViewCamera) -> ViewCamera:
    numbers = (*new.pivot, new.distance, new.azimuth, new.elevation)
    fits = all(math.isfinite(v) and abs(v) <= FARTHEST for v in numbers) and new.distance > 0.0
    return new if fits else old
