"""How a scene lies in space: where its bulk is, which way is up, whether it can be seen from outside."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from progdf.gaussians import Gaussians

if TYPE_CHECKING:
    from progdf.camera import Camera

_SAMPLE = 100_000
"""Rows that are looked at; a scene with more is sampled evenly."""

NEAR = 0.01
"""Camera z at and below which nothing is drawn, world units; as `progdf.rasterize`."""

_LONG_TAIL = 5.0
_CEILING_COVER = 0.8
_LEAST_CELLS = 16
_ENOUGH = 64
"""Fewer Gaussians tell nothing about the shape of a scene."""


def scene_sphere(scene: Gaussians) -> tuple[Tensor, float]:
    """Centre [3] and radius (> 0) of the bulk of a scene, world units.

    The median of the means, and the distance within which 97 % of them lie: far strays do not count. A scene
    of one or a few Gaussians is as large as these are: twice the median of their longest axes at least.
    """
    scene = _sample(scene)
    means = scene.means
    centre = means.median(dim=0).values
    distances = (means - centre).norm(dim=1)
    nearest = max(round(0.97 * len(means)), 1)
    size = 2 * float(scene.log_scales.amax(dim=1).median().exp())
    return centre, max(float(distances.kthvalue(nearest).values), size, 1e-6)


def near_plane(radius: float) -> float:
    """Least depth at which a scene is drawn whose bulk has this radius, both in world units.

    `NEAR` down to a radius of 1, as trainings draw; smaller scenes would vanish before it.
    """
    return NEAR * min(1.0, radius)


def guess_up(scene: Gaussians, cameras: Sequence[Camera] = ()) -> Tensor:
    """The world direction that is up. [3] float32, unit length

    With cameras: the mean of their up directions, as people hold cameras level; if these agree.
    Without: the axis along which the flat Gaussians face most (floors, tables and the tops of things make the
    largest part of flat surfaces in a real scene), pointing from the densest plane across it to the side on
    which the rest stands. Where nothing decides: −y, the convention of COLMAP and so of most trained scenes.
    """
    if cameras:
        mean = torch.stack([-camera.viewmat[1, :3] for camera in cameras]).mean(dim=0)
        if float(mean.norm()) > 0.5:
            return torch.nn.functional.normalize(mean, dim=0)
    sample = _sample(scene)
    centre, radius = scene_sphere(sample)
    facing = _flatness(sample)[:, None] * normals_of(sample).abs() ** 4
    axis = int(facing.sum(dim=0).argmax())
    across = ((sample.means[:, axis] - centre[axis]) / radius).clamp(-1.5, 1.5)
    counts, edges = torch.histogram(across, bins=60, range=(-1.5, 1.5), weight=facing[:, axis])
    ground = float(edges[int(counts.argmax())]) + 0.025
    # by number, not by area: what stands on a ground is made of many small Gaussians, a lawn of few large
    lean = float((sample.opacities * (across - ground)).sum())
    up = torch.zeros(3)
    if len(sample) < _ENOUGH or lean == 0:
        up[1] = -1.0
    else:
        up[axis] = math.copysign(1.0, lean)
    return up


def front(up: Tensor) -> Tensor:
    """The level direction from a scene to someone who looks at its front. [3] -> [3], unit length

    +z for y up, −z for y down (the side the cameras of a COLMAP scene mostly look from), −y for z up; the
    same as azimuth 0 in the viewer.
    """
    largest = int(up.abs().argmax())
    towards = torch.zeros(3)
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
    centre, radius = scene_sphere(sample)
    typical = float((sample.means - centre).norm(dim=1).median())
    return len(sample) >= _ENOUGH and (radius > _LONG_TAIL * typical or has_ceiling(sample, up))


def has_ceiling(scene: Gaussians, up: Tensor) -> bool:
    """Whether a slab at the top covers most of the ground plan, so that all is hidden from above."""
    sample = _sample(scene)
    if len(sample) < _ENOUGH:
        return False
    ahead = front(up)
    plan = sample.means @ torch.stack([ahead, torch.linalg.cross(up, ahead)], dim=1)
    height = sample.means @ up
    low, high = (_quantile(height, q) for q in (0.02, 0.98))
    cells = _cells(plan)
    covered = len(torch.unique(cells))
    ceiling = len(torch.unique(cells[height > high - 0.06 * (high - low)]))
    return covered >= _LEAST_CELLS and ceiling >= _CEILING_COVER * covered


def _cells(plan: Tensor, per_side: int = 8) -> Tensor:
    """The cell of an 8 × 8 grid over the ground plan that each row falls in. [N,2] -> [N] int64"""
    low, high = (torch.stack([_quantile(c, q) for c in plan.unbind(1)]) for q in (0.02, 0.98))
    place = ((plan - low) / (high - low).clamp_min(1e-12) * per_side).long().clamp(0, per_side - 1)
    return place[:, 0] * per_side + place[:, 1]


def _quantile(values: Tensor, share: float) -> Tensor:
    return values.kthvalue(min(max(round(share * len(values)), 1), len(values))).values


def _sample(scene: Gaussians) -> Gaussians:
    return scene[:: -(-len(scene) // _SAMPLE)] if len(scene) > _SAMPLE else scene


def _areas(scene: Gaussians) -> Tensor:
    """Area of each Gaussian's two longer axes, the largest per cent cut off so that no giant decides. [N]"""
    areas = scene.log_scales.sort(dim=1).values[:, 1:].sum(dim=1).exp()
    return areas.clamp_max(float(_quantile(areas, 0.99)))


def _flatness(scene: Gaussians) -> Tensor:
    """Visible flat area of each Gaussian: nothing for needles and balls. [N]"""
    ordered = scene.log_scales.sort(dim=1).values
    flat = 1 - (ordered[:, 0] - ordered[:, 1]).exp()
    return _areas(scene) * scene.opacities * flat


def normals_of(scene: Gaussians) -> Tensor:
    """The shortest axis of each Gaussian in the world, of either sign. [N,3], unit length"""
    axes = torch.eye(3)[scene.log_scales.argmin(dim=1)]
    w, xyz = scene.unit_quats[:, :1], scene.unit_quats[:, 1:]
    twice = 2 * torch.linalg.cross(xyz, axes)
    normals: Tensor = axes + w * twice + torch.linalg.cross(xyz, twice)
    return normals
