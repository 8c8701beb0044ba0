"""Scene of a box on a floor, and an edit that paints a square on the front of the box."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.field.separable import course_field, opacity_course
from progdf.gaussians import Gaussians, attribute_slices, concatenate
from progdf.gdf.anchors import PUSHED_SHAPE
from progdf.gdf.file import ADDED_LOGIT, Gdf, anchor_added, fingerprint
from progdf.region import Region, from_mask
from progdf.sh import rgb_to_sh0

SIDE = 9  # Gaussians along an edge of the box
DISCS = 7  # discs along an edge of the painted square
OPAQUE = 6.0  # opacity logit
PUSH = 0.03  # how far paint moves Gaussians inwards, world units
FRONT = -1.0  # y of the painted side


@dataclass(frozen=True)
class PaintedBox:
    """Scene with a painted box."""

    scene: Gaussians  # gray box on a white floor
    box: Region  # Gaussians of the box
    paint: Gdf  # red square on its front


def painted_box() -> PaintedBox:
    """Return a box of edge 2 around the origin, on a floor, and its paint."""
    line = torch.linspace(-1.0, 1.0, SIDE)
    plane = torch.cartesian_prod(line, line)
    sides = []
    for axis in range(3):
        halves = torch.cat([plane, plane])
        across = torch.tensor([-1.0, 1.0]).repeat_interleave(len(plane))[:, None]
        sides.append(torch.cat([halves[:, :axis], across, halves[:, axis:]], dim=1))
    box = torch.cat(sides).unique(dim=0)
    ground = torch.cartesian_prod(*[torch.linspace(-4.0, 4.0, 17)] * 2)
    floor = torch.cat([ground, torch.full((len(ground), 1), 1.3)], dim=1)
    box_rows = _rows(box, 0.14, (0.5, 0.5, 0.5))
    floor_rows = _rows(floor, 0.25, (0.95, 0.95, 0.95))
    scene = concatenate([box_rows, floor_rows])
    members = torch.arange(len(scene)) < len(box)
    return PaintedBox(scene, from_mask("box", members), _paint(scene))


def _rows(means: Tensor, size: float, color: tuple[float, float, float]) -> Gaussians:
    count = len(means)
    sh0 = rgb_to_sh0(torch.tensor(color))
    return Gaussians(
        means,
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        torch.full((count, 3), size).log(),
        torch.full((count,), OPAQUE),
        sh0.repeat(count, 1),
        torch.zeros(count, 0, 3),
    )


def _paint(scene: Gaussians) -> Gdf:
    """Return red discs on the front, which push the Gaussians below them inwards."""
    line = torch.linspace(-0.6, 0.6, DISCS)
    plane = torch.cartesian_prod(line, line)
    # in front of the Gaussians of the side, whose standard deviation is 0.14
    means = torch.stack([plane[:, 0], torch.full((len(plane),), FRONT - 0.2), plane[:, 1]], dim=1)
    discs = _rows(means, 0.1, (0.9, 0.1, 0.1))
    discs = replace(
        discs,
        log_scales=torch.tensor([0.1, 0.005, 0.1]).log().repeat(len(means), 1),
        logit_opacities=torch.full((len(means),), ADDED_LOGIT),
    )
    below = (scene.means[:, 1] == FRONT) & (scene.means[:, [0, 2]].abs().amax(dim=1) < 0.7)
    members = below.nonzero()[:, 0]
    start = torch.cat([scene.logit_opacities[members], discs.logit_opacities])
    end = torch.cat([start[: len(members)], torch.full((len(means),), OPAQUE)])
    knots, opacity = opacity_course(start, end)
    columns = attribute_slices(14)
    offsets = torch.zeros(len(knots), len(start), 14)
    offsets[:, :, columns["logit_opacities"]] = opacity[..., None]
    offsets[:, : len(members), 1] = knots[:, None] * PUSH
    field = course_field(knots, offsets)
    region = from_mask("logo", below)
    return anchor_added(Gdf("logo", region, field, fingerprint(scene), added=discs), scene, PUSHED_SHAPE)


def six_cameras(size: int = 72) -> list[Camera]:
    """Return cameras that look at the box from six sides."""
    eyes = [(0.0, -7.0, 0.5), (7.0, 0.0, 0.5), (0.0, 7.0, 0.5), (-7.0, 0.0, 0.5), (0.5, -1.0, -7.0)]
    eyes.append((3.0, -6.0, -3.0))
    K = intrinsics(0.8, size, size)
    up = (0.0, 0.0, -1.0)
    return [
        Camera(look_at(torch.tensor(eye), torch.zeros(3), torch.tensor(up)), K, size, size) for eye in eyes
    ]
