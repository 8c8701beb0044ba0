"""Views that have a name, and what lies between two views: glides, and numbers and cameras of keys."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pyrr import matrix33, quaternion

from .view_camera import Vec3, ViewCamera, axes, dot, look_along

EASINGS = ("smooth", "linear", "hold")
"""Between keys. "smooth" is the monotone cubic of Fritsch and Carlson (SIAM J. Numer. Anal. 17, 1980): it
leaves the first key and comes to the last gently, passes through the others without a halt, rests at every
turning point, and never leaves the range of its neighbors, so a strength of 0..1 stays in 0..1.
"""
Point = tuple[int, str, float]
"""Frame, how it goes on from there (of `EASINGS`), and the value."""


def value_between(points: Sequence[Point], frame: float) -> float:
    """A track's value at a frame, exact at its points; it rests before the first and after the last.

    Args:
        points: at least one, by rising frames
    """
    i, share = _find_segment([point[0] for point in points], frame)
    _, easing, start = points[i]
    if share == 0.0 or easing == "hold":
        return start
    end = points[i + 1][2]
    if easing == "linear":
        return start + share * (end - start)
    span = points[i + 1][0] - points[i][0]
    leave = _slope(points, i) * span
    come = _slope(points, i + 1) * span
    eased = share * share * (3.0 - 2.0 * share)
    bend = share * (1.0 - share) * ((1.0 - share) * leave - share * come)
    reached = start + eased * (end - start) + bend
    return min(max(reached, min(start, end)), max(start, end))  # the last bits of a sum


def camera_between(keys: Sequence[tuple[int, str, ViewCamera]], frame: float) -> ViewCamera:
    """The camera at a frame: a path of pivots, distances in proportion, the shortest way around.

    Where two keys have different up axes the whole orientation turns along the shortest arc instead.

    Args:
        keys: frame, easing, camera; at least one, by rising frames
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
    """The same angles, each within half a turn of the one before it."""
    angles = list(degrees[:1])
    for angle in degrees[1:]:
        angles.append(angles[-1] + (angle - angles[-1] + 180.0) % 360.0 - 180.0)
    return angles


def _slerp(placed: ViewCamera, here: ViewCamera, there: ViewCamera, share: float) -> ViewCamera:
    """`placed` with an orientation between two others; its up axis is what is up in the picture then."""
    between = quaternion.normalize(quaternion.slerp(_orientation(here), _orientation(there), share))
    _, up, back = matrix33.create_from_quaternion(between)
    return look_along(replace(placed, up=_vec3(up)), _vec3(back))


def _orientation(camera: ViewCamera) -> NDArray[np.float64]:
    """The picture's axes as a unit quaternion, xyzw as pyrr has them. [4]"""
    picture = axes(camera)
    rows = np.array([picture.right, picture.up, picture.back], dtype=np.float64)
    turned: NDArray[np.float64] = quaternion.create_from_matrix(rows)
    return turned


def _vec3(row: NDArray[np.float64]) -> Vec3:
    return float(row[0]), float(row[1]), float(row[2])


def _find_segment(frames: Sequence[int], frame: float) -> tuple[int, float]:
    """Which point comes before a frame, and how much of the way to the next one lies behind, 0..1."""
    if frame <= frames[0]:
        return 0, 0.0
    for i, (start, end) in enumerate(pairwise(frames)):
        if start <= frame < end:
            return i, (frame - start) / (end - start)
    return len(frames) - 1, 0.0


def _slope(points: Sequence[Point], i: int) -> float:
    """Change per frame at a point: none at the ends, at turning points, and beside what is not smooth."""
    if not 0 < i < len(points) - 1 or points[i - 1][1] != "smooth" or points[i][1] != "smooth":
        return 0.0
    (a, _, x), (b, _, y), (c, _, z) = points[i - 1 : i + 2]
    into = (y - x) / (b - a)
    out = (z - y) / (c - b)
    if into * out <= 0.0:
        return 0.0
    left = 2 * (c - b) + (b - a)
    right = (c - b) + 2 * (b - a)
    return (left + right) / (left / into + right / out)  # Fritsch and Butland's mean: never overshoots


NAMED_VIEWS = {
    "front": (0.0, 0.0),
    "back": (180.0, 0.0),
    "right": (90.0, 0.0),
    "left": (-90.0, 0.0),
    "top": (0.0, 90.0),
    "bottom": (0.0, -90.0),
}
"""Azimuth and elevation, degrees, in the scene's own frame: whatever axis is up in its file."""

AXES: dict[str, Vec3] = {
    "+X": (1.0, 0.0, 0.0),
    "+Y": (0.0, 1.0, 0.0),
    "+Z": (0.0, 0.0, 1.0),
    "-X": (-1.0, 0.0, 0.0),
    "-Y": (0.0, -1.0, 0.0),
    "-Z": (0.0, 0.0, -1.0),
}
"""Directions of the world, as the scene's file has them."""

GLIDE_S = 0.25
_STEPS = 1000  # of a glide, between which nothing is rounded away
_ALONG = 1.0 - 1e-6


def look_at_view(camera: ViewCamera, name: str) -> ViewCamera:
    """The same pivot and distance from a side of `NAMED_VIEWS`, or from an end of `AXES`."""
    if name in NAMED_VIEWS:
        azimuth, elevation = NAMED_VIEWS[name]
        return replace(camera, azimuth=azimuth, elevation=elevation)
    upright = dot(AXES[name], camera.up)
    if abs(upright) > _ALONG:
        return look_at_view(camera, "top" if upright > 0.0 else "bottom")
    return look_along(camera, AXES[name])


@dataclass(frozen=True)
class Glide:
    """A camera on its way."""

    start: ViewCamera  # start, end: where from and where to
    end: ViewCamera
    seconds: float = 0.0  # under way so far

    @property
    def camera(self) -> ViewCamera:
        """Where it is; exact at its ends."""
        if self.is_over:
            return self.end
        step = round(_STEPS * self.seconds / GLIDE_S)
        return camera_between([(0, "smooth", self.start), (_STEPS, "smooth", self.end)], step)

    @property
    def is_over(self) -> bool:
        return self.seconds >= GLIDE_S


def glide_on(glide: Glide, current: ViewCamera, seconds: float) -> Glide | None:
    """So much later; None where it is over, or the hand has taken the camera elsewhere.

    Args:
        current: the camera on screen
    """
    if glide.is_over or current != glide.camera:
        return None
    return replace(glide, seconds=glide.seconds + seconds)
