"""Warps of a standing object or a mouth, for measurements of moving parts."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from trainer.evaluate.suite.analytic_edits import AnalyticEdit, Warp, warp_edit

_COLUMN_STRETCH = 1.35  # factor of the column's length
_COLUMN_BEND_DEGREES = 40.0


def stretch_warp(base: Tensor, up: Tensor, factor: float) -> Warp:
    """Make a volume-preserving warp that stretches by `factor` from `base` [3] along unit vector `up` [3]."""

    def warp(points: Tensor, strength: float) -> Tensor:
        size = 1 + strength * (factor - 1)
        axis = up.to(points)
        arm = points - base.to(points)
        along = (arm @ axis)[:, None] * axis
        return base.to(points) + size * along + (arm - along) / math.sqrt(size)

    return warp


def bend_warp(base: Tensor, up: Tensor, towards: Tensor, length: float, degrees: float) -> Warp:
    """Make a warp that bends a column of `length` at `base` along `up` into an arc of `degrees`.

    Points below the base stay fixed. `up` and `towards`: orthogonal unit vectors. [3]
    """

    def warp(points: Tensor, strength: float) -> Tensor:
        curvature = math.radians(degrees) * strength / length
        axis = up.to(points)
        side = towards.to(points)
        arm = points - base.to(points)
        height = arm @ axis
        out = arm @ side
        above = height.clamp_min(0.0)  # below its base the column stays straight
        angle = curvature * above
        radius = 1 / curvature - out
        lifted = radius * angle.sin() + height - above
        moved = 1 / curvature - radius * angle.cos()
        return points + (lifted - height)[:, None] * axis + (moved - out)[:, None] * side

    return warp


def pull_warp(handles: Tensor, pulls: Tensor, radius: float) -> Warp:
    """Make a warp that moves `handles` [P,3] by `pulls` [P,3], with a Gaussian falloff of sigma `radius`."""

    def warp(points: Tensor, strength: float) -> Tensor:
        weights = (-0.5 * (points[:, None] - handles.to(points)).square().sum(dim=2) / radius**2).exp()
        return points + strength * weights @ pulls.to(points)

    return warp


def chain_warps(first: Warp, second: Warp) -> Warp:
    """Compose two warps."""
    return lambda points, strength: second(first(points, strength), strength)


def column_warps(means: Tensor, up: Tensor) -> dict[str, AnalyticEdit]:
    """Make a stretch, a bend, and both, of a standing object.

    Args:
        means: centers of the members. [M,3]
        up: positive or negative coordinate axis. [3]
    """
    axis = int(up.abs().argmax())
    side = torch.zeros(3)
    side[(axis + 1) % 3 if axis != 1 else 0] = 1.0
    along = means @ up
    base = means.median(dim=0).values * (1 - up.abs()) + float(along.min()) * up
    length = float(along.max() - along.min())
    stretch = stretch_warp(base, up, _COLUMN_STRETCH)
    bend = bend_warp(base, up, side, length, _COLUMN_BEND_DEGREES)
    both = chain_warps(stretch, bend_warp(base, up, side, _COLUMN_STRETCH * length, _COLUMN_BEND_DEGREES))
    warps = {"stretch": stretch, "bend": bend, "stretch and bend": both}
    return {name: warp_edit(name, warp) for name, warp in warps.items()}


def smile_warp(corners: Tensor, up: Tensor, pull: float, radius: float) -> AnalyticEdit:
    """Make an edit that moves the two corners of a mouth [2,3] up and apart by `pull` world units."""
    apart = corners - corners.mean(dim=0)
    directions = torch.nn.functional.normalize(apart, dim=1) + up
    return warp_edit("smile", pull_warp(corners, pull * directions, radius))
