"""How a scene lies in space: where its bulk and its front are, whether it can be seen from outside."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from progdf.camera import NEAR
from progdf.gaussians import Gaussians
from progdf.quaternions import rotate_vectors

_SAMPLE = 100_000
"""Rows that are looked at; a scene with more is sampled evenly."""


_LONG_TAIL = 5.0
_CEILING_COVER = 0.8
_DENSER = 2.0
"""Times as many Gaussians as under it has a ceiling: five where a room's walls go on below, one in a head."""
_MIN_CELLS = 16
_ENOUGH = 64
"""Fewer Gaussians tell nothing about the shape of a scene."""

_SOLID = 0.1
_CORE = 2.5
"""Haze is less opaque; background lies farther, in median distances from the middle."""


def scene_sphere(scene: Gaussians) -> tuple[Tensor, float]:
    """Center [3] and radius (> 0) of the bulk of a scene, world units.

    The median of the means, and the distance within which 97 % of them lie: far strays do not count. A scene
    of one or a few Gaussians is as large as these are: twice the median of their longest axes at least.
    """
    scene = _sample(scene)
    means = scene.means
    center = means.median(dim=0).values
    distances = (means - center).norm(dim=1)
    nearest = max(round(0.97 * len(means)), 1)
    size = 2 * float(scene.log_scales.amax(dim=1).median().exp())
    return center, max(float(distances.kthvalue(nearest).values), size, 1e-6)


def near_plane(radius: float) -> float:
    """Least depth at which a scene is drawn whose bulk has this radius, both in world units.

    `NEAR` down to a radius of 1, as trainings draw; smaller scenes would vanish before it.
    """
    return NEAR * min(1.0, radius)


def front_direction(up: Tensor) -> Tensor:
    """The level direction from a scene to someone who looks at its front. [3] -> [3], unit length

    +z for y up, −z for y down (the side the cameras of a COLMAP scene mostly look from), −y for z up; the
    same as azimuth 0 in the viewer.
    """
    largest = int(up.abs().argmax())
    towards = torch.zeros_like(up)
    towards[1 if largest == 2 else 2] = math.copysign(1.0, float(up[largest])) * (
        -1.0 if largest == 2 else 1.0
    )
    level = towards - (towards @ up) * up
    return torch.nn.functional.normalize(level, dim=0)


def is_surrounding(scene: Gaussians, up: Tensor) -> bool:
    """Whether the scene is probably one to stand inside, which no ring of cameras around it can show.

    Two signs: a ceiling (a slab at the top that covers most of the ground plan), or a long tail (the
    far 3 % begin more than five times as far out as the middle, as in outdoor captures with a background).
    """
    sample = _sample(scene)
    return len(sample) >= _ENOUGH and (has_long_tail(sample.means) or has_ceiling(sample, up))


def has_long_tail(means: Tensor) -> bool:
    """Whether the far 3 % begin more than five times as far out as the middle. [N,3], N ≥ 1"""
    distances = (means - means.median(dim=0).values).norm(dim=1)
    return float(quantile(distances, 0.97)) > _LONG_TAIL * float(distances.median())


def has_ceiling(scene: Gaussians, up: Tensor) -> bool:
    """Whether a slab at the top covers most of the ground plan, so that all is hidden from above."""
    sample = _sample(scene)
    if len(sample) < _ENOUGH:
        return False
    height = sample.means @ up
    low, high = (quantile(height, q) for q in (0.02, 0.98))
    cells = plan_cells(sample, up)
    covered = len(torch.unique(cells))
    slab = 0.06 * (high - low)
    top = height > high - slab
    next_to_top = (height <= high - slab) & (height > high - 2 * slab)
    # thin and dense, as the top of a head is not
    dense = int(top.sum()) >= _DENSER * int(next_to_top.sum())
    ceiling = len(torch.unique(cells[top]))
    return dense and covered >= _MIN_CELLS and ceiling >= _CEILING_COVER * covered


def plan_cells(scene: Gaussians, up: Tensor, per_side: int = 8) -> Tensor:
    """The cell of a square grid over the ground plan that each Gaussian's mean falls in. [N] int64"""
    ahead = front_direction(up)
    plan = scene.means @ torch.stack([ahead, torch.linalg.cross(up, ahead)], dim=1)
    low, high = (torch.stack([quantile(c, q) for c in plan.unbind(1)]) for q in (0.02, 0.98))
    cell = ((plan - low) / (high - low).clamp_min(1e-12) * per_side).long().clamp(0, per_side - 1)
    return cell[:, 0] * per_side + cell[:, 1]


def drop_background(scene: Gaussians) -> Gaussians | None:
    """An even sample of what is visible and near the middle; None where that tells nothing of a shape."""
    sample = _sample(scene)
    sample = sample[(sample.opacities > _SOLID).nonzero()[:, 0]]
    if len(sample) < _ENOUGH:
        return None
    distances = (sample.means - sample.means.median(dim=0).values).norm(dim=1)
    return sample[(distances <= _CORE * distances.median()).nonzero()[:, 0]]


def quantile(values: Tensor, share: float) -> Tensor:
    """The value that so large a share of them, 0..1, does not exceed. [N] -> []"""
    return values.kthvalue(min(max(round(share * len(values)), 1), len(values))).values


def _sample(scene: Gaussians) -> Gaussians:
    return scene[:: -(-len(scene) // _SAMPLE)] if len(scene) > _SAMPLE else scene


def normals_of(scene: Gaussians) -> Tensor:
    """The shortest axis of each Gaussian in the world, of either sign. [N,3], unit length"""
    return _turned_axes(scene, scene.log_scales.argmin(dim=1))


def long_axes(scene: Gaussians) -> Tensor:
    """The longest axis of each Gaussian in the world, of either sign. [N,3], unit length"""
    return _turned_axes(scene, scene.log_scales.argmax(dim=1))


def _turned_axes(scene: Gaussians, which: Tensor) -> Tensor:
    return rotate_vectors(torch.eye(3)[which], scene.unit_quats)
