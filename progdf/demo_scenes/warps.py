"""Edits that bend space: where each point goes at every strength, and how Gaussians turn and grow with it.

No similarity and no part that moves as a whole explains them, so they show what a search for motions can do.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from progdf.gaussians import Gaussians

from .edits import AnalyticEdit

Warp = Callable[[Tensor, float], Tensor]
"""Points [M,3] float64 and a strength in (0, 1] -> where they are then. [M,3]"""

_FACTOR, _DEGREES = 1.35, 40.0
_STEP = 1e-4  # of a central difference, share of the region's size


def warp_edit(name: str, warp: Warp) -> AnalyticEdit:
    """Centers go where the warp takes them, covariances follow its Jacobian: Σ' = J Σ Jᵀ."""

    def change(part: Gaussians, strength: float) -> Gaussians:
        points = part.means.double()
        step = _STEP * float((points.amax(dim=0) - points.amin(dim=0)).max().clamp_min(1e-6))
        columns = [
            (warp(points + step * axis, strength) - warp(points - step * axis, strength)) / (2 * step)
            for axis in torch.eye(3, dtype=torch.float64)
        ]
        jacobian = torch.stack(columns, dim=2)
        turned = torch.from_numpy(
            Rotation.from_quat(part.unit_quats.double().numpy()[:, [1, 2, 3, 0]]).as_matrix()
        )
        axes, scales, _ = torch.linalg.svd(jacobian @ turned * part.scales.double()[:, None, :])
        axes[:, :, 2] *= torch.linalg.det(axes).sign()[:, None]
        quats = torch.from_numpy(Rotation.from_matrix(axes.numpy()).as_quat()[:, [3, 0, 1, 2]])
        return Gaussians(
            warp(points, strength).to(part.means),
            quats.to(part.quats),
            scales.clamp_min(1e-12).log().to(part.log_scales),
            part.logit_opacities,
            part.sh0,
            part.shN,
        )

    return AnalyticEdit(name, change)


def stretch_warp(base: Tensor, up: Tensor, factor: float) -> Warp:
    """Lengths along `up` ([3], of length 1) grow by `factor` from `base` [3]; widths shrink, volume stays."""

    def warp(points: Tensor, strength: float) -> Tensor:
        size = 1 + strength * (factor - 1)
        axis = up.to(points)
        arm = points - base.to(points)
        along = (arm @ axis)[:, None] * axis
        return base.to(points) + size * along + (arm - along) / math.sqrt(size)

    return warp


def bend_warp(base: Tensor, up: Tensor, towards: Tensor, length: float, degrees: float) -> Warp:
    """A column of this `length` that stands at `base` along `up` becomes an arc of so many degrees.

    What lies below the base stays. `up` and `towards`: of length 1, at right angles. [3]
    """

    def warp(points: Tensor, strength: float) -> Tensor:
        curvature = math.radians(degrees) * strength / length
        axis, side = up.to(points), towards.to(points)
        arm = points - base.to(points)
        height, out = arm @ axis, arm @ side
        angle = curvature * height.clamp_min(0.0)
        radius = 1 / curvature - out
        lifted = radius * angle.sin() + height.clamp_max(0.0)
        moved = 1 / curvature - radius * angle.cos()
        return points + (lifted - height)[:, None] * axis + (moved - out)[:, None] * side

    return warp


def pull_warp(handles: Tensor, pulls: Tensor, radius: float) -> Warp:
    """What lies around `handles` [P,3] is pulled by `pulls` [P,3], less and less over a `radius`."""

    def warp(points: Tensor, strength: float) -> Tensor:
        weights = (-0.5 * (torch.cdist(points, handles.to(points)) / radius).square()).exp()
        return points + strength * weights @ pulls.to(points)

    return warp


def chain_warps(first: Warp, second: Warp) -> Warp:
    """One after the other."""
    return lambda points, strength: second(first(points, strength), strength)


def column_warps(means: Tensor, up: Tensor) -> dict[str, AnalyticEdit]:
    """Stretch, bend, and both, of what stands on its base.

    Args:
        means: centers of the members. [M,3]
        up: a coordinate axis, up or down it. [3]
    """
    axis = int(up.abs().argmax())
    side = torch.zeros(3)
    side[(axis + 1) % 3 if axis != 1 else 0] = 1.0
    along = means @ up
    base = means.median(dim=0).values * (1 - up.abs()) + float(along.min()) * up
    length = float(along.max() - along.min())
    stretch = stretch_warp(base, up, _FACTOR)
    bend = bend_warp(base, up, side, length, _DEGREES)
    both = chain_warps(stretch, bend_warp(base, up, side, _FACTOR * length, _DEGREES))
    warps = {"stretch": stretch, "bend": bend, "stretch and bend": both}
    return {name: warp_edit(name, warp) for name, warp in warps.items()}


def smile_warp(corners: Tensor, up: Tensor, pull: float, radius: float) -> AnalyticEdit:
    """The two corners of a mouth [2,3] are drawn up and apart by `pull`."""
    apart = corners - corners.mean(dim=0)
    directions = torch.nn.functional.normalize(apart, dim=1) + up
    return warp_edit("smile", pull_warp(corners, pull * directions, radius))
