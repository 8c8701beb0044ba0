"""Views that have a name: from the front, from above, along an axis; and the glide from one to another."""

from __future__ import annotations

from dataclasses import dataclass, replace

from . import tween
from .up_axis import Vec3
from .view_camera import ViewCamera, dot, look_along

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
    """A camera on its way.

    Args:
        start, end: where from and where to
        seconds: under way so far
    """

    start: ViewCamera
    end: ViewCamera
    seconds: float = 0.0

    @property
    def camera(self) -> ViewCamera:
        """Where it is; exact at its ends."""
        if self.is_over:
            return self.end
        step = round(_STEPS * self.seconds / GLIDE_S)
        return tween.camera([(0, "smooth", self.start), (_STEPS, "smooth", self.end)], step)

    @property
    def is_over(self) -> bool:
        return self.seconds >= GLIDE_S


def glide_on(glide: Glide, shown: ViewCamera, seconds: float) -> Glide | None:
    """So much later; None where it is over, or the hand has taken the camera elsewhere.

    Args:
        shown: the camera on screen
    """
    if glide.is_over or shown != glide.camera:
        return None
    return replace(glide, seconds=glide.seconds + seconds)
