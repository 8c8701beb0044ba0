"""Which way is up in a scene: as the user says, cameras are held, a ground lies, or COLMAP has it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import torch
from torch import Tensor

from progdf.gaussians import Gaussians

from .bounds import drop_background, has_ceiling, plan_cells, plane_facing

if TYPE_CHECKING:
    from progdf.camera import Camera

Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
UpChoice = Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"]

AXES: tuple[Axis, ...] = get_args(Axis)
CONVENTION: Axis = "-y"
"""COLMAP's, and so that of most trained scenes: the first camera is level, and y points down in a picture."""

_LEVEL = math.cos(math.radians(2.0))
"""Cameras' up within two degrees of an axis is that axis: nobody holds a camera straighter."""

_GROUND, _COVER, _UNDER, _STANDING, _COVERED, _WALL = 0.2, 0.75, 0.12, 0.05, 0.6, 0.1
"""A ground is a slab that holds a fifth of all flat area, all of it facing up, shows in three quarters of the
plan's cells, has at most 12 % of the scene under it and 5 % or more above. What is above covers at most 60 %
of the cells, unless there are walls (a tenth of the flat area each) and a ceiling. Slabs of 20 scenes: bear
.34, room .23, toy robot .58, all of them floors; flat backs and sides of things .27, .20, mostly under .1."""

_STRONGER = 3.0
"""Times as much flat area as a slab across the convention's axis: two slabs alike decide nothing."""


@dataclass(frozen=True)
class UpAxis:
    """Which way is up, and how that was decided.

    Args:
        direction: in the world, unit length. [3] float32
        reason: for a person, as "the cameras"
        certain: something in the scene or a person tells; else it is only what most scenes have
    """

    direction: Tensor
    reason: str
    certain: bool = True

    @property
    def name(self) -> str:
        """The axis, as "-y"; of another direction its three numbers."""
        axis = int(self.direction.abs().argmax())
        if float(self.direction.abs()[axis]) > 0.99999:
            return ("-" if float(self.direction[axis]) < 0 else "+") + "xyz"[axis]
        return " ".join(f"{round(float(x), 3) + 0.0:g}" for x in self.direction)  # + 0.0: not -0

    def to_json(self) -> dict[str, object]:
        """As JSON values, for reports and .gdf files."""
        return {"direction": [float(x) for x in self.direction], "reason": self.reason}


def axis_direction(axis: str) -> Tensor:
    """The unit vector of "+x" … "-z". [3] float32"""
    direction = torch.zeros(3)
    direction["xyz".index(axis[1])] = 1.0 if axis[0] == "+" else -1.0
    return direction


def find_up(scene: Gaussians, cameras: Sequence[Camera] = (), asked: str = "auto") -> UpAxis:
    """The world direction that is up.

    Args:
        scene: N Gaussians
        cameras: given with the scene; people hold them level, so their mean up is the scene's, if they agree
        asked: an axis decides all; "auto" leaves it to what follows
    """
    if asked != "auto":
        return UpAxis(axis_direction(asked), "as --up says")
    if cameras:
        mean = torch.stack([-camera.viewmat[1, :3] for camera in cameras]).mean(dim=0)
        if float(mean.norm()) > 0.5:
            direction = torch.nn.functional.normalize(mean, dim=0)
            axis = direction.abs().argmax()
            if float(direction.abs()[axis]) > _LEVEL:
                direction = torch.zeros(3).index_fill(0, axis, math.copysign(1.0, float(direction[axis])))
            return UpAxis(direction, "as the cameras are held")
    if (ground := _ground_axis(scene, CONVENTION)) is not None:
        return UpAxis(axis_direction(ground), "a ground lies across it")
    why = "by convention, as no ground tells; --up says otherwise"
    return UpAxis(axis_direction(CONVENTION), why, certain=False)


def guess_up(scene: Gaussians, cameras: Sequence[Camera] = ()) -> Tensor:
    """The direction of `find_up`. [3] float32, unit length"""
    return find_up(scene, cameras).direction


def up_from_json(saved: object) -> Tensor | None:
    """The direction that `UpAxis.to_json` wrote. [3] unit length; None for anything else."""
    numbers = saved.get("direction") if isinstance(saved, dict) else None
    if not isinstance(numbers, list) or len(numbers) != 3:
        return None
    if not all(isinstance(x, (int, float)) and math.isfinite(x) and abs(x) < 1e6 for x in numbers):
        return None
    direction = torch.tensor([float(x) for x in numbers])
    return direction / direction.norm() if float(direction.norm()) > 1e-6 else None


def _ground_axis(scene: Gaussians, convention: Axis) -> Axis | None:
    """The axis that stands on a ground, if one clearly does."""
    sample = drop_background(scene)
    if sample is None:
        return None
    slabs = [_slab(sample, axis) for axis in range(3)]
    walled = min(slab.share for slab in slabs) >= _WALL
    shares = {}
    for axis in AXES:
        slab = slabs["xyz".index(axis[1])]
        fits = _could_be_ground(sample, axis, slab, walled, axis == convention)
        shares[axis] = slab.share if fits else 0.0
    best = max(AXES, key=lambda axis: shares[axis])
    needed = _GROUND if best == convention else max(_GROUND, _STRONGER * shares[convention])
    return best if shares[best] >= needed else None


@dataclass(frozen=True)
class _Slab:
    """The plane across an axis with the most flat area in it.

    Args:
        above: height of each Gaussian over it along the axis, over the scene's radius. [Q]
        share: of the scene's flat area, what lies in it and faces along the axis. 0..1
    """

    above: Tensor
    share: float

    @property
    def held(self) -> Tensor:
        """Which Gaussians lie in it. [Q] bool"""
        return self.above.abs() < 0.06


def _slab(sample: Gaussians, axis: int) -> _Slab:
    height, facing = plane_facing(sample, axis)
    counts, edges = torch.histogram(height, bins=60, range=(-1.5, 1.5), weight=facing)
    above = height - float(edges[int(counts.argmax())]) - 0.025
    return _Slab(above, float(facing[above.abs() < 0.06].sum()))


def _could_be_ground(sample: Gaussians, axis: Axis, slab: _Slab, walled: bool, usual: bool) -> bool:
    """Whether the slab lies under the scene like a ground, where `axis` is up.

    Args:
        sample: Q Gaussians
        axis: that would be up
        slab: across it
        walled: there are slabs across all axes, as in a room
        usual: it is the convention's axis, of which it is not asked that the ground is the wider
    """
    up, above = axis_direction(axis), slab.above if axis[0] == "+" else -slab.above
    cells = plan_cells(sample, up, per_side=12)
    taken = len(torch.unique(cells))
    under, standing = (float((side > 0.08).float().mean()) for side in (-above, above))
    if len(torch.unique(cells[slab.held])) < _COVER * taken or under > _UNDER or standing < _STANDING:
        return False
    covered = len(torch.unique(cells[above > 0.12])) / taken
    return usual or covered <= _COVERED or (walled and has_ceiling(sample, up))
