"""Warps of a region: control points that shift, turn and stretch, and members that follow those near them.

Embedded deformation (Sumner, Schmid and Pauly 2007). Control point k takes what lies at x to
A_k (x − c_k) + c_k + t_k with A_k = R_k exp(S_k); a member blends its nearest control points' maps by smooth
weights, which do not change while it moves. So each member has one affine map of its own, x → J x + b, and
what it learns besides is carried along and can be carried back.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.gaussians import BASE_CHANNELS, attribute_slices, normalize_quats

from .control_points import ControlPoints
from .similarity import (
    Motion,
    Parts,
    matrix_turns,
    multiply_quats,
    quat_matrices,
    quat_turns,
    rotate,
    turn_quats,
)

_COLUMNS = attribute_slices(BASE_CHANNELS)
_MOVING = slice(0, _COLUMNS["quats"].stop)  # means, log-scales and quaternions come first in a packed row
_SYMMETRIC = (0, 3, 4, 3, 1, 5, 4, 5, 2)  # where a stretch's numbers stand in its matrix, row by row


@dataclass(frozen=True)
class WarpMotion:
    """What each of P control points does.

    Args:
        shift: world units. [P,3]
        turn: rotation vector, axis times angle in radians. [P,3]
        stretch: logarithm of the stretch, applied before the turn: xx yy zz xy xz yz. [P,6]
    """

    shift: Tensor
    turn: Tensor
    stretch: Tensor


@dataclass(frozen=True)
class MemberMaps:
    """Each member's own map x → J x + b, and how it turns and grows.

    Args:
        matrix: J. [M,3,3]
        shift: b. [M,3]
        turn: unit quaternion. [M,4]
        growth: of its log-scales, along its own axes. [M,3]
    """

    matrix: Tensor
    shift: Tensor
    turn: Tensor
    growth: Tensor

    def carry(self, original: Tensor, offsets: Tensor) -> Tensor:
        """Offsets within the moved frames -> offsets from the original; differentiable.

        Args:
            original: raw member rows. [M,C]
            offsets: what each member does besides following. [M,C]

        Returns:
            Raw-space offsets; opacity's and color's are the given ones. [M,C]
        """
        rows = original[:, _MOVING]
        means, log_scales, quats = _split(rows + offsets[:, _MOVING])
        moved = [
            (self.matrix @ means[..., None])[..., 0] + self.shift,
            log_scales + self.growth,
            multiply_quats(self.turn, quats),
        ]
        return torch.cat([torch.cat(moved, dim=1) - rows, offsets[:, _MOVING.stop :]], dim=1)

    def carry_back(self, original: Tensor, offsets: Tensor) -> Tensor:
        """The inverse of `carry`. [M,C] -> [M,C]"""
        rows = original[:, _MOVING]
        means, log_scales, quats = _split(rows + offsets[:, _MOVING])
        back = self.turn * self.turn.new_tensor([1.0, -1.0, -1.0, -1.0])
        own = [
            torch.linalg.solve(self.matrix, (means - self.shift)[..., None])[..., 0],
            log_scales - self.growth,
            multiply_quats(back, quats),
        ]
        return torch.cat([torch.cat(own, dim=1) - rows, offsets[:, _MOVING.stop :]], dim=1)


def rest_warp(control: ControlPoints) -> WarpMotion:
    """Nothing has moved."""
    nothing = torch.zeros_like(control.points)
    return WarpMotion(nothing, nothing, nothing.new_zeros(len(nothing), 6))


def warp_of_parts(control: ControlPoints, parts: Parts, motion: Motion) -> WarpMotion:
    """Every control point does what its part does: exactly the motion of the parts."""
    part = control.part
    size, turn = motion.log_scale[part, None], motion.turn[part]
    arm = control.points - parts.centers[part]
    moved = parts.centers[part] + motion.shift[part] + size.exp() * rotate(arm, turn_quats(turn))
    nothing = torch.zeros_like(size)
    return WarpMotion(moved - control.points, turn, torch.cat([size] * 3 + [nothing] * 3, dim=1))


def transfer_warp(control: ControlPoints, motion: WarpMotion, other: ControlPoints) -> WarpMotion:
    """A motion of the same region, held at other control points: what it does there."""
    affine, shift = affine_maps(control, motion)
    maps = torch.cat([affine.flatten(1), shift], dim=1)
    blended = (control.weights[other.rows, :, None] * maps[control.nearest[other.rows]]).sum(dim=1)
    matrix = blended[:, :9].reshape(-1, 3, 3)
    left, sizes, right = torch.linalg.svd(matrix)
    log = right.mT @ torch.diag_embed(sizes.clamp_min(1e-3).log()) @ right
    moved = (matrix @ other.points[..., None])[..., 0] + blended[:, 9:]
    stretch = log.flatten(1)[:, [0, 4, 8, 1, 2, 5]]
    return WarpMotion(moved - other.points, matrix_turns(left @ right), stretch)


def affine_maps(control: ControlPoints, motion: WarpMotion) -> tuple[Tensor, Tensor]:
    """Each control point's own map x → A x + b: A [P,3,3], b [P,3]; differentiable."""
    affine = quat_matrices(turn_quats(motion.turn)) @ _stretches(motion)
    return affine, motion.shift + control.points - (affine @ control.points[..., None])[..., 0]


def map_members(original: Tensor, control: ControlPoints, motion: WarpMotion) -> MemberMaps:
    """How the members follow; differentiable in the motion. `original`: raw rows [M,C]"""
    affine, shift = affine_maps(control, motion)
    numbers = torch.cat(
        [affine.flatten(1), shift, _stretches(motion).flatten(1), turn_quats(motion.turn)], dim=1
    )
    # not numbers[nearest], whose gradient is summed up by threads in any order
    followed = numbers.index_select(0, control.nearest.flatten()).view(*control.nearest.shape, -1)
    blended = (control.weights[..., None] * followed).sum(dim=1)
    axes = quat_matrices(normalize_quats(original[:, _COLUMNS["quats"]]))
    growth = (blended[:, 12:21].reshape(-1, 3, 3) @ axes).norm(dim=1).log()
    turn = torch.nn.functional.normalize(blended[:, 21:], dim=1)
    return MemberMaps(blended[:, :9].reshape(-1, 3, 3), blended[:, 9:12], turn, growth)


def warp_rows(original: Tensor, control: ControlPoints, motion: WarpMotion) -> Tensor:
    """Raw rows where the motion takes them; differentiable in the motion. [M,C] -> [M,C]"""
    maps = map_members(original, control, motion)
    return original + maps.carry(original, torch.zeros_like(original))


def interpolate_warp(a: WarpMotion, b: WarpMotion, share: float) -> WarpMotion:
    """The way from one motion to another: shift and stretch straight, turns along the great circle."""
    rest = quat_turns(multiply_quats(turn_quats(-a.turn), turn_quats(b.turn)))
    return WarpMotion(
        torch.lerp(a.shift, b.shift, share),
        quat_turns(multiply_quats(turn_quats(a.turn), turn_quats(share * rest))),
        torch.lerp(a.stretch, b.stretch, share),
    )


def extrapolate_warp(motion: WarpMotion, further: float) -> WarpMotion:
    """The same motion, so many times as far."""
    return WarpMotion(further * motion.shift, further * motion.turn, further * motion.stretch)


def _stretches(motion: WarpMotion) -> Tensor:
    """exp(S) of each control point. [P,3,3]"""
    stretches: Tensor = torch.linalg.matrix_exp(motion.stretch[:, _SYMMETRIC].reshape(-1, 3, 3))
    return stretches


def _split(rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Means [M,3], log-scales [M,3] and quaternions [M,4] of packed rows."""
    return rows[:, _COLUMNS["means"]], rows[:, _COLUMNS["log_scales"]], rows[:, _COLUMNS["quats"]]
