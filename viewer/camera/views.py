"""Named views, glides between cameras, and interpolation of keyed numbers and cameras."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .view_camera import Vec3, ViewCamera, axes, dot, look_along

with warnings.catch_warnings():
    warnings.simplefilter("ignore", SyntaxWarning)  # of a docstring of pyrr, since Python 3.12
    from pyrr import matrix33, quaternion

_SAME_ORIENTATION = 1e-6  # radians; below, the sines are as their angles

EASINGS = ("smooth", "linear", "hold")
"""Interpolations between keys.

"smooth" is the monotone cubic of Fritsch and Carlson (SIAM J. Numer. Anal. 17, 1980). It starts and ends
gently, passes through the other keys without stopping, and has zero slope at turning points. It never leaves
the range of the two neighboring keys, so a strength stays within 0 to 1.
"""
Point = tuple[int, str, float]
"""Key of a number: frame, easing to the next key (one of `EASINGS`), value."""


def value_between(points: Sequence[Point], frame: float) -> float:
    """Interpolate a track at a frame. It is exact at its points and constant before the first and after the
    last.

    Args:
        points: at least one point, by ascending frame
        frame: the frame, which may lie between whole frames
    """
    i, share = _find_segment([point[0] for point in points], frame)
    _, easing, start = points[i]
    if share == 0.0 or easing == "hold":
        return start
    end = points[i + 1][2]
    if easing == "linear":
        return start + share * (end - start)
    span = points[i + 1][0] - points[i][0]
    start_slope = _slope(points, i) * span
    end_slope = _slope(points, i + 1) * span
    eased = share * share * (3.0 - 2.0 * share)
    bend = share * (1.0 - share) * ((1.0 - share) * start_slope - share * end_slope)
    value = start + eased * (end - start) + bend
    return min(max(value, min(start, end)), max(start, end))  # clamps rounding errors


def camera_between(keys: Sequence[tuple[int, str, ViewCamera]], frame: float) -> ViewCamera:
    """Interpolate the camera at a frame.

    `value_between` interpolates the pivot, the angles and the logarithm of the distance. The azimuth takes
    the shorter way around. Between keys with different up axes, slerp interpolates the whole orientation.

    Args:
        keys: frame, easing and camera; at least one, by ascending frame
        frame: the frame, which may lie between whole frames
    """
    frames = [key[0] for key in keys]
    i, share = _find_segment(frames, frame)
    here = keys[i][2]
    if share == 0.0 or keys[i][1] == "hold":
        return here
    there = keys[i + 1][2]

    def track(values: Sequence[float]) -> float:
        points = [(key[0], key[1], number) for key, number in zip(keys, values, strict=True)]
        return value_between(points, frame)

    cameras = [key[2] for key in keys]
    x, y, z = (track([c.pivot[axis] for c in cameras]) for axis in range(3))
    placed = replace(
        here,
        pivot=(x, y, z),
        distance=math.exp(track([math.log(max(c.distance, 1e-300)) for c in cameras])),
        fov_y=track([c.fov_y for c in cameras]),
    )
    if here.up != there.up:
        eased = value_between([(0, keys[i][1], 0.0), (1, keys[i][1], 1.0)], share)
        return _slerp(placed, here, there, eased)
    azimuth = track(unwrap([c.azimuth for c in cameras]))
    return replace(
        placed,
        azimuth=(azimuth + 180.0) % 360.0 - 180.0,
        elevation=track([c.elevation for c in cameras]),
    )


def unwrap(degrees: Sequence[float]) -> list[float]:
    """Unwrap angles so that each is within 180° of the previous one."""
    angles = list(degrees[:1])
    for angle in degrees[1:]:
        angles.append(angles[-1] + (angle - angles[-1] + 180.0) % 360.0 - 180.0)
    return angles


def _slerp(placed: ViewCamera, here: ViewCamera, there: ViewCamera, share: float) -> ViewCamera:
    """Return `placed` with the interpolated orientation of two cameras. Its up axis is the picture's up.

    pyrr's own slerp does half of a turn of 20° after a quarter of the way.
    """
    start, end = _orientation(here), _orientation(there)
    cosine = float(start @ end)
    angle = math.acos(min(1.0, abs(cosine)))
    shares = np.array([1.0 - share, share])
    if angle > _SAME_ORIENTATION:
        shares = np.sin(shares * angle)
    # q and −q are the same orientation; the nearer one takes the shorter way
    between = shares[0] * start + math.copysign(shares[1], cosine) * end
    _, up, back = matrix33.create_from_quaternion(quaternion.normalize(between))
    return look_along(replace(placed, up=_vec3(up)), _vec3(back))


def _orientation(camera: ViewCamera) -> NDArray[np.float64]:
    """Return the picture's axes as a unit quaternion, xyzw as in pyrr. [4]"""
    picture = axes(camera)
    rows = np.array([picture.right, picture.up, picture.back], dtype=np.float64)
    orientation: NDArray[np.float64] = quaternion.normalize(quaternion.create_from_matrix(rows))
    return orientation


def _vec3(row: NDArray[np.float64]) -> Vec3:
    return float(row[0]), float(row[1]), float(row[2])


def _find_segment(frames: Sequence[int], frame: float) -> tuple[int, float]:
    """Return the index of the last point up to a frame, and the share of the interval covered, 0 to 1."""
    if frame <= frames[0]:
        return 0, 0.0
    for i, (start, end) in enumerate(pairwise(frames)):
        if start <= frame < end:
            return i, (frame - start) / (end - start)
    return len(frames) - 1, 0.0


def _slope(points: Sequence[Point], i: int) -> float:
    """Return the slope per frame at a point: 0 at the ends, at turning points and next to other easings."""
    if not 0 < i < len(points) - 1 or points[i - 1][1] != "smooth" or points[i][1] != "smooth":
        return 0.0
    (a, _, x), (b, _, y), (c, _, z) = points[i - 1 : i + 2]
    slope_before = (y - x) / (b - a)
    slope_after = (z - y) / (c - b)
    if slope_before * slope_after <= 0.0:
        return 0.0
    left = 2 * (c - b) + (b - a)
    right = (c - b) + 2 * (b - a)
    return (left + right) / (
        left / slope_before + right / slope_after
    )  # Fritsch and Butland's mean: never overshoots


NAMED_VIEWS = {
    "front": (0.0, 0.0),
    "back": (180.0, 0.0),
    "right": (90.0, 0.0),
    "left": (-90.0, 0.0),
    "top": (0.0, 90.0),
    "bottom": (0.0, -90.0),
}
"""Azimuth and elevation in degrees, relative to the scene's up axis."""

AXES: dict[str, Vec3] = {
    "+X": (1.0, 0.0, 0.0),
    "+Y": (0.0, 1.0, 0.0),
    "+Z": (0.0, 0.0, 1.0),
    "-X": (-1.0, 0.0, 0.0),
    "-Y": (0.0, -1.0, 0.0),
    "-Z": (0.0, 0.0, -1.0),
}
"""World directions in the coordinates of the scene's file."""

GLIDE_S = 0.25  # duration of a glide, s
_GLIDE_STEPS = 1000  # time steps of a glide, fine enough for smooth motion
_PARALLEL_COSINE = 1.0 - 1e-6  # cosine above which an axis counts as the up axis


def look_at_view(camera: ViewCamera, name: str) -> ViewCamera:
    """Look from a side of `NAMED_VIEWS` or an axis of `AXES`. Pivot and distance are unchanged."""
    if name in NAMED_VIEWS:
        azimuth, elevation = NAMED_VIEWS[name]
        return replace(camera, azimuth=azimuth, elevation=elevation)
    upright = dot(AXES[name], camera.up)
    if abs(upright) > _PARALLEL_COSINE:
        return look_at_view(camera, "top" if upright > 0.0 else "bottom")
    return look_along(camera, AXES[name])


@dataclass(frozen=True)
class Glide:
    """Animation from one camera to another."""

    start: ViewCamera
    end: ViewCamera
    seconds: float = 0.0  # elapsed time

    @property
    def camera(self) -> ViewCamera:
        """Current camera, exact at both ends."""
        if self.is_over:
            return self.end
        step = round(_GLIDE_STEPS * self.seconds / GLIDE_S)
        return camera_between([(0, "smooth", self.start), (_GLIDE_STEPS, "smooth", self.end)], step)

    @property
    def is_over(self) -> bool:
        return self.seconds >= GLIDE_S


def glide_on(glide: Glide, current: ViewCamera, seconds: float) -> Glide | None:
    """Advance a glide. Return None if it has ended or the user has moved the camera.

    Args:
        glide: the glide
        current: the camera on screen
        seconds: time since the last call
    """
    if glide.is_over or current != glide.camera:
        return None
    return replace(glide, seconds=glide.seconds + seconds)
