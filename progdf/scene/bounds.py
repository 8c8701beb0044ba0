"""Shape of a scene: its bulk, its front, and whether cameras around it can frame it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from progdf.camera import NEAR
from progdf.gaussians import Gaussians
from progdf.quaternions import rotate_vectors

_MAX_SAMPLED_ROWS = 100_000  # rows; a larger scene is sampled evenly

_LONG_TAIL_RATIO = 5.0  # ratio of the 97th percentile to the median of the distances from the middle
_CEILING_COVER = 0.8  # smallest share of the plan's occupied cells under a ceiling

# smallest ratio of Gaussians in a ceiling to those in the slab below it: 5 in a room whose walls continue
# below, 1 in a head
_CEILING_DENSITY_RATIO = 2.0
_MIN_CELLS = 16  # smallest number of occupied plan cells for a ceiling
_MIN_GAUSSIANS = 64  # Gaussians; fewer do not define a shape

_MIN_SOLID_OPACITY = 0.1  # opacity; less opaque Gaussians are haze
_CORE_RADIUS = 2.5  # median distances from the middle; Gaussians farther away are background


def scene_sphere(scene: Gaussians) -> tuple[Tensor, float]:
    """Return the center [3] and radius (> 0) of the bulk of a scene, world units.

    The center is the median of the means. The radius is the distance within which 97 % of them lie, so far
    floaters do not count. It is at least twice the median of the longest axes, for scenes of a few Gaussians.
    """
    scene = _sample(scene)
    means = scene.means
    center = means.median(dim=0).values
    distances = (means - center).norm(dim=1)
    nearest = max(round(0.97 * len(means)), 1)
    size = 2 * float(scene.log_scales.amax(dim=1).median().exp())
    return center, max(float(distances.kthvalue(nearest).values), size, 1e-6)


def near_plane(radius: float) -> float:
    """Return the near plane of a scene whose bulk has this radius, both in world units.

    It is `NEAR` for a radius of at least 1, as in training. It shrinks with smaller scenes, which would
    otherwise lie in front of it.
    """
    return NEAR * min(1.0, radius)


def front_direction(up: Tensor) -> Tensor:
    """Return the horizontal direction from a scene to a camera at its front. [3] -> [3], unit length

    It is azimuth 0 in the viewer: +z for y up, −y for z up, and −z for y down. Most cameras of a COLMAP scene
    are on the −z side.
    """
    largest = int(up.abs().argmax())
    front = torch.zeros_like(up)
    sign = math.copysign(1.0, float(up[largest]))
    if largest == 2:
        front[1] = -sign
    else:
        front[2] = sign
    level = front - (front @ up) * up
    return torch.nn.functional.normalize(level, dim=0)


def is_surrounding(scene: Gaussians, up: Tensor) -> bool:
    """Return whether a scene probably surrounds its cameras, so that cameras around it cannot frame it.

    It does if it has a ceiling (see `has_ceiling`) or a long tail (see `has_long_tail`), as outdoor captures
    with a background have.
    """
    sample = _sample(scene)
    return len(sample) >= _MIN_GAUSSIANS and (has_long_tail(sample.means) or has_ceiling(sample, up))


def has_long_tail(means: Tensor) -> bool:
    """Return whether the farthest 3 % of the means begin beyond 5 median distances. [N,3], N ≥ 1"""
    distances = (means - means.median(dim=0).values).norm(dim=1)
    return float(quantile(distances, 0.97)) > _LONG_TAIL_RATIO * float(distances.median())


def has_ceiling(scene: Gaussians, up: Tensor) -> bool:
    """Return whether a slab at the top covers most of the ground plan and hides the scene from above."""
    sample = _sample(scene)
    if len(sample) < _MIN_GAUSSIANS:
        return False
    height = sample.means @ up
    low, high = (quantile(height, q) for q in (0.02, 0.98))
    cells = plan_cells(sample, up)
    covered = len(torch.unique(cells))
    slab = 0.06 * (high - low)
    top = height > high - slab
    next_to_top = (height <= high - slab) & (height > high - 2 * slab)
    # a ceiling is thin and dense, unlike the top of a head
    dense = int(top.sum()) >= _CEILING_DENSITY_RATIO * int(next_to_top.sum())
    ceiling = len(torch.unique(cells[top]))
    return dense and covered >= _MIN_CELLS and ceiling >= _CEILING_COVER * covered


def plan_cells(scene: Gaussians, up: Tensor, per_side: int = 8) -> Tensor:
    """Return each mean's cell in a square grid over the ground plan, 0 to per_side² − 1. [N] int64"""
    ahead = front_direction(up)
    plan = scene.means @ torch.stack([ahead, torch.linalg.cross(up, ahead)], dim=1)
    low, high = (torch.stack([quantile(c, q) for c in plan.unbind(1)]) for q in (0.02, 0.98))
    cell = ((plan - low) / (high - low).clamp_min(1e-12) * per_side).long().clamp(0, per_side - 1)
    return cell[:, 0] * per_side + cell[:, 1]


def drop_background(scene: Gaussians) -> Gaussians | None:
    """Return an even sample of the solid Gaussians near the middle; None if too few are solid."""
    sample = _sample(scene)
    sample = sample[(sample.opacities > _MIN_SOLID_OPACITY).nonzero()[:, 0]]
    if len(sample) < _MIN_GAUSSIANS:
        return None
    distances = (sample.means - sample.means.median(dim=0).values).norm(dim=1)
    return sample[(distances <= _CORE_RADIUS * distances.median()).nonzero()[:, 0]]


def quantile(values: Tensor, share: float) -> Tensor:
    """Return the quantile of the values at a share, 0 to 1, without interpolation. [N] -> []"""
    return values.kthvalue(min(max(round(share * len(values)), 1), len(values))).values


def _sample(scene: Gaussians) -> Gaussians:
    return scene[:: -(-len(scene) // _MAX_SAMPLED_ROWS)] if len(scene) > _MAX_SAMPLED_ROWS else scene


def normals_of(scene: Gaussians) -> Tensor:
    """Return each Gaussian's shortest axis in the world, with arbitrary sign. [N,3], unit length"""
    return _world_axes(scene, scene.log_scales.argmin(dim=1))


def long_axes(scene: Gaussians) -> Tensor:
    """Return each Gaussian's longest axis in the world, with arbitrary sign. [N,3], unit length"""
    return _world_axes(scene, scene.log_scales.argmax(dim=1))


def _world_axes(scene: Gaussians, which: Tensor) -> Tensor:
    return rotate_vectors(torch.eye(3)[which], scene.unit_quats)
