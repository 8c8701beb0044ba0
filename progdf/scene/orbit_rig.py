"""Cameras around a scene that has none."""

from __future__ import annotations

import logging
import math

import torch
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians

from .bounds import front_direction, is_surrounding, scene_sphere
from .up_axis import guess_up

_log = logging.getLogger(__name__)


_GOLDEN = (math.sqrt(5) - 1) / 2


ELEVATIONS = (5.0, 60.0)
"""Usual range of camera elevations, degrees above the horizon."""
HALF_SPHERE = (0.0, 89.0)
"""Elevations of the whole upper half of the sphere, degrees above the horizon."""

_RIG_FOV = math.radians(60)
"""Field of view at which a distance of 2.2 radii leaves a margin of 10 %: sin 30° = 1.1 / 2.2."""


def orbit_rig(
    scene: Gaussians,
    count: int,
    width: int,
    height: int,
    fov_y: float = _RIG_FOV,
    up: Tensor | None = None,
    elevations: tuple[float, float] = ELEVATIONS,
    distance: float = 2.2,
) -> list[Camera]:
    """Return cameras on a sphere around a scene, in order of azimuth.

    Azimuths are evenly spaced and begin at `bounds.front_direction`. Elevations follow the golden ratio over
    the band, evenly by area, so every n-th camera of the list is spread as evenly as the whole list.

    Args:
        scene: the scene to frame, by its median center and 97th-percentile radius, see `scene_sphere`
        count: number of cameras, ≥ 1
        width, height: image size in pixels
        fov_y: vertical field of view, radians
        up: world direction that is up, [3]; None estimates it, see `guess_up`
        elevations: lowest and highest, −89 to 89 degrees above the horizon; negative ones are below it
        distance: distance from the center in radii, for a field of view of 60° along the image's shorter
            side. Other fields of view move the cameras so that the scene keeps its size in the image

    Raises:
        ProgdfError: `count` is below 1, or the elevations do not ascend within ±89 degrees.
    """
    lowest, highest = elevations
    if count < 1:
        raise ProgdfError(f"the rig needs at least 1 camera, got {count}")
    if not -89 <= lowest <= highest <= 89:
        raise ProgdfError(
            f"the rig's elevations must ascend within -89 to 89 degrees, got {lowest:g} to {highest:g}"
        )
    up = guess_up(scene) if up is None else up.float() / up.float().norm()
    if is_surrounding(scene, up):
        _log.warning(
            "the scene seems to surround its cameras, so cameras around it cannot frame it; "
            "give its own cameras, or save views with F4 in progdf view"
        )
    center, radius = scene_sphere(scene)
    K = intrinsics(fov_y, width, height)
    half = math.atan(0.5 * min(width, height) / float(K[1, 1]))
    eye_distance = distance * radius * math.sin(_RIG_FOV / 2) / math.sin(half)
    cameras = []
    for i, back in enumerate(rig_directions(count, up, elevations)):
        viewmat = look_at(center + eye_distance * back, center, up)
        cameras.append(Camera(viewmat, K, width, height, name=f"orbit_{i:03d}"))
    return cameras


def rig_directions(count: int, up: Tensor, elevations: tuple[float, float]) -> list[Tensor]:
    """Return the directions from the middle of a rig to its cameras, see `orbit_rig`. Unit vectors [3]"""
    ahead = front_direction(up)
    side = torch.linalg.cross(up, ahead)
    low, high = (math.sin(math.radians(elevation)) for elevation in elevations)
    directions = []
    for i in range(count):
        azimuth = 2 * math.pi * i / count
        sine = low + (high - low) * ((0.5 + i * _GOLDEN) % 1.0)
        cosine = math.sqrt(1 - sine * sine)
        directions.append(cosine * (math.cos(azimuth) * ahead + math.sin(azimuth) * side) + sine * up)
    return directions
