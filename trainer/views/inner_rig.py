"""Cameras around a region of a scene that surrounds the viewer and has no cameras of its own.

1. Measure the free distance from the region's center in all directions, in six depth pictures.
2. Place a candidate in each direction, before the first obstacle and inside the bulk of the scene.
3. Measure how much of the region each candidate shows, and keep those that show most of it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from progdf.camera import Camera, intrinsics, look_at
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.rasterize import render
from progdf.region import Region
from progdf.scene.bounds import front_direction, near_plane, quantile, scene_sphere
from progdf.scene.orbit_rig import rig_directions
from progdf.threads import map_threads

NO_FREE_PLACE = (
    "the scene surrounds the viewer, and no free place shows the region '{name}'; give cameras with "
    "--cameras (cameras.json, transforms.json or a COLMAP folder), or make some: open progdf view, look "
    "around, and press F4 to keep each view"
)
"""Message for a region that no camera can be placed for."""

DISTANCE = 2.2
"""Distance of a camera from the region's center where nothing is in the way, radii of the region."""

_FREE_SHARE = 0.8  # share of the way to the first obstacle that a camera may go
_MIN_DISTANCE = 0.35  # smallest distance from the center if few places are outside the region, radii of it
_BULK = 0.02  # share of the Gaussians outside the box of the scene along each axis, at either side
_MAX_HALF_FOV_SINE = 0.7  # sine of half the widest field of view
_SIDE_PX = 64  # size of the pictures that measure distances and visibility
_PER_CAMERA = 4  # candidates per requested camera
_CANDIDATES = (64, 128)  # smallest and largest number
_CLOSE = 0.2  # Gaussians within this share of the way to the region are in the camera's face
_KEPT_SHARE = 0.5  # smallest visible share of the region, as a share of the best candidate's
_ELEVATIONS = (-75.0, 75.0)  # degrees above the horizon
_OPAQUE = 0.5  # coverage from which a pixel has an obstacle


def inner_rig(
    scene: Gaussians, region: Region, count: int, image_size: int, up: Tensor, sphere: tuple[Tensor, float]
) -> list[Camera]:
    """Return cameras at free places that look at the region, spread over the directions around it.

    Args:
        scene: a scene that surrounds its cameras
        region: the region to look at
        count: largest number of cameras, ≥ 1
        image_size: both sides in pixels
        up: world direction that is up. [3]
        sphere: center [3] and radius of the region, world units

    Returns:
        Cameras, fewer than `count` where fewer places are free.

    Raises:
        ProgdfError: there is no free place from which the region can be seen.
    """
    center, radius = sphere
    candidates = min(max(_PER_CAMERA * count, _CANDIDATES[0]), _CANDIDATES[1])
    directions = torch.stack(rig_directions(candidates, up, _ELEVATIONS))
    free = _free_distances(scene, region, center, radius, directions, up)
    free = torch.minimum(free, _exit_distances(scene, center, directions))
    distance = (_FREE_SHARE * free).clamp_max(DISTANCE * radius)
    usable = distance >= radius  # outside the region
    if int(usable.sum()) < count:
        usable = distance >= _MIN_DISTANCE * radius
    cameras = []
    for k in usable.nonzero()[:, 0].tolist():
        half = math.asin(min(_MAX_HALF_FOV_SINE, radius / float(distance[k])))
        K = intrinsics(2.0 * half, image_size, image_size)
        viewmat = look_at(center + distance[k] * directions[k], center, up)
        cameras.append(Camera(viewmat, K, image_size, image_size, name=f"inner_{k:03d}"))
    member = torch.zeros(len(scene), 3)
    member[region.members] = 1.0
    alone = scene[region.members]
    shares = map_threads(lambda camera: _visible_share(scene, alone, member, camera, center), cameras)
    best = max(shares, default=0.0)
    if best <= 0.0:
        raise ProgdfError(NO_FREE_PLACE.format(name=region.name))
    chosen = [camera for camera, share in zip(cameras, shares, strict=True) if share >= _KEPT_SHARE * best]
    if len(chosen) <= count:
        return chosen
    return [chosen[k * len(chosen) // count] for k in range(count)]


def _free_distances(
    scene: Gaussians, region: Region, center: Tensor, radius: float, directions: Tensor, up: Tensor
) -> Tensor:
    """Return the distance from the center to the first obstacle in each direction, ∞ without one. [D]

    Obstacles are the Gaussians outside the region and its sphere.
    """
    is_obstacle = (scene.means - center).norm(dim=1) > radius
    is_obstacle[region.members] = False
    obstacles = scene[is_obstacle.nonzero()[:, 0]]
    result = torch.full((len(directions),), math.inf)
    if not len(obstacles):
        return result
    ahead = front_direction(up)
    side = torch.linalg.cross(up, ahead)
    K = intrinsics(math.radians(90.0), _SIDE_PX, _SIDE_PX)
    for face, above in ((ahead, up), (-ahead, up), (side, up), (-side, up), (up, ahead), (-up, ahead)):
        viewmat = look_at(center, center + face, above)
        camera = Camera(viewmat, K, _SIDE_PX, _SIDE_PX, near=near_plane(radius))
        depth = _distances(obstacles, camera)
        nearest = -max_pool2d(-depth[None, None], 3, stride=1, padding=1)[0, 0]
        x, y, z = (directions @ viewmat[:3, :3].T).unbind(1)
        inside = (z > 0.0) & (x.abs() <= z) & (y.abs() <= z)
        columns = ((x / z + 1.0) / 2.0 * _SIDE_PX).nan_to_num().long().clamp(0, _SIDE_PX - 1)
        rows = ((y / z + 1.0) / 2.0 * _SIDE_PX).nan_to_num().long().clamp(0, _SIDE_PX - 1)
        result = torch.where(inside, nearest[rows, columns], result)
    return result


def _distances(scene: Gaussians, camera: Camera) -> Tensor:
    """Return the mean distance of each pixel's Gaussians from the camera, ∞ where they are faint. [H,W]"""
    away = (scene.means - camera.position).norm(dim=1, keepdim=True)
    with torch.no_grad():
        drawn = render(scene, camera, (0.0, 0.0, 0.0), colors=away.expand(-1, 3).contiguous())
    coverage = 1.0 - drawn.transmittance
    distance = drawn.image[..., 0] / coverage.clamp_min(1e-6)
    return torch.where(coverage >= _OPAQUE, distance, torch.full_like(distance, math.inf))


def _exit_distances(scene: Gaussians, center: Tensor, directions: Tensor) -> Tensor:
    """Return the distance from the center to the side of the scene's bulk in each direction. [D]"""
    low, high = (
        torch.stack([quantile(axis, share) for axis in scene.means.unbind(1)])
        for share in (_BULK, 1.0 - _BULK)
    )
    sides = torch.where(directions > 0.0, high, low)
    return ((sides - center) / directions).nan_to_num(nan=math.inf).clamp_min(0.0).amin(dim=1)


def _visible_share(
    scene: Gaussians, alone: Gaussians, member: Tensor, camera: Camera, center: Tensor
) -> float:
    """Return the visible share of the region, less by the share of the picture that close clutter covers."""
    small = replace(camera.resize(_SIDE_PX, _SIDE_PX), near=near_plane(scene_sphere(scene)[1]))
    with torch.no_grad():
        shown = render(scene, small, (0.0, 0.0, 0.0), colors=member).image[..., 0]
        whole = 1.0 - render(alone, small, (0.0, 0.0, 0.0)).transmittance
    close = _distances(scene, small) < _CLOSE * float((camera.position - center).norm())
    share = float(shown.sum() / whole.sum().clamp_min(1e-6))
    return share * (1.0 - float(close.float().mean()))
