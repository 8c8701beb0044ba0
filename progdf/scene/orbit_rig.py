"""Cameras around a scene that has none, and the side that shows most detail."""

from __future__ import annotations

import logging
import math

import torch
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.rasterize import activate, render

from .bounds import front_direction, is_surrounding, quantile, scene_sphere
from .up_axis import guess_up

_log = logging.getLogger(__name__)


_GOLDEN = (math.sqrt(5) - 1) / 2


ELEVATIONS = (5.0, 60.0)
"""Usual range of camera elevations, degrees above the horizon."""
HALF_SPHERE = (0.0, 89.0)
"""Elevations of the whole upper half of the sphere, degrees above the horizon."""

MIN_GAUSSIANS = 64  # Gaussians; fewer do not define a shape
OCCLUSION_SAMPLE = 8_000  # Gaussians that are tested for occlusion
_DRAWN_SAMPLE = 12_000  # Gaussians that are drawn to measure the detail of a side
_SIDE_PX = 64  # width and height of these pictures, pixels
_GRAY = (0.5, 0.5, 0.5)
_SIDE_FOV = math.radians(45.0)
_TURNS = 16  # pictures around the subject; every second one is a side, between two others

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


def detailed_side(subject: Gaussians, up: Tensor, azimuth: float, elevation: float) -> float:
    """Return the angle from an azimuth to the side that shows most detail, degrees.

    The detail of a picture is the sum of its color differences between neighboring pixels, times the share of
    the subject's Gaussians that it shows. Each of eight sides has three pictures, 22.5° apart, and counts by
    the one with least detail. The front (0) is left only if every picture of the other side shows more
    detail than every picture of the front.

    Args:
        subject: Gaussians of the subject
        up: world direction that is up. [3]
        azimuth, elevation: direction of the eye, degrees, see `front_direction`
    """
    if len(subject) < MIN_GAUSSIANS:
        return 0.0
    details = _details(subject, up, math.radians(azimuth), math.radians(elevation))
    sides = [(details[k - 1], details[k], details[(k + 1) % _TURNS]) for k in range(0, _TURNS, 2)]
    best = max(range(len(sides)), key=lambda side: min(sides[side]))
    least = min(sides[best])
    front = max(sides[0])
    if not least > front:
        _log.info("first view: the front; no other side shows more detail in each of its pictures")
        return 0.0
    turn = 360.0 * ((best / len(sides) + 0.5) % 1.0 - 0.5)
    _log.info(
        "first view: %+.0f° from the front, where detail is at least %.2f times as much", turn, least / front
    )
    return turn


def _details(subject: Gaussians, up: Tensor, azimuth: float, elevation: float) -> list[float]:
    """Return the detail of pictures around a subject, see `detailed_side`; angles in radians. [_TURNS]"""
    step = -(-len(subject) // _DRAWN_SAMPLE)
    drawn = activate(subject[::step])
    drawn = drawn._replace(scales=drawn.scales * math.sqrt(step))  # they cover the area of all
    means = subject.means[:: -(-len(subject) // OCCLUSION_SAMPLE)]
    middle = means.median(dim=0).values
    ahead = front_direction(up)
    points = (means - middle) @ torch.stack([ahead, torch.linalg.cross(up, ahead), up]).T
    distance = float(quantile(points.norm(dim=1), 0.95)) / math.sin(0.5 * _SIDE_FOV)
    K = intrinsics(_SIDE_FOV, _SIDE_PX, _SIDE_PX)
    details = []
    for turn in range(_TURNS):
        around = azimuth + math.tau * turn / _TURNS
        level = math.cos(elevation)
        back = torch.tensor([level * math.cos(around), level * math.sin(around), math.sin(elevation)])
        eye = middle + distance * (back @ torch.stack([ahead, torch.linalg.cross(up, ahead), up]))
        with torch.no_grad():
            image = render(drawn, Camera(look_at(eye, middle, up), K, _SIDE_PX, _SIDE_PX), _GRAY).image
        image = image.clamp(0.0, 1.0)
        changes = image.diff(dim=0).abs().sum() + image.diff(dim=1).abs().sum()
        details.append(float(changes * visible_points(points, back).float().mean()))
    return details


def visible_points(places: Tensor, back: Tensor, wide: float = 0.0) -> Tensor:
    """Return the points that are not occluded in a picture of 24 x 24 cells. [P,3] -> [P] bool

    Args:
        places: points with z up, relative to the eye, or to the middle for an orthographic picture
        back: unit vector from the scene to the eye, not straight up. [3]
        wide: tangent of half the field of view; 0 for an orthographic picture
    """
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), back), dim=0)
    x, y, depth = (places @ torch.stack([right, torch.linalg.cross(back, right), -back]).T).unbind(1)
    size = float(quantile(places.norm(dim=1), 0.95).clamp_min(1e-12))
    unit = wide * depth.clamp_min(1e-6 * size) if wide else torch.full_like(depth, size)
    cells = [((c / unit + 1) * 12).floor() for c in (x, y)]
    within = (depth > 0) if wide else torch.ones_like(depth, dtype=torch.bool)
    for cell in cells:
        within &= (cell >= 0) & (cell < 24)
    index = (cells[0] * 24 + cells[1]).clamp(0, 575).long()
    masked_depth = torch.where(within, depth, math.inf)
    nearest = torch.full((576,), math.inf).scatter_reduce(0, index, masked_depth, "amin")
    return within & (depth <= nearest[index] + 0.08 * size)
