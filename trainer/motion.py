"""Similarity motions of a region's parts: each is shifted, turned and scaled about its own centre.

Members' raw rows follow: centres move, log-scales gain the part's, quaternions are turned. Opacity and colour
stay, the higher SH bands too: what they show is mostly light that stays where it is when a part turns.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.gaussians import attribute_slices


@dataclass(frozen=True)
class Motion:
    """Where each of P parts has gone.

    Args:
        shift: of the part's centre, world units. [P,3]
        log_scale: log of the part's growth. [P]
        turn: rotation vector, axis times angle in radians. [P,3]
    """

    shift: Tensor
    log_scale: Tensor
    turn: Tensor

    def detached(self) -> Motion:
        """The same numbers without their history."""
        return Motion(self.shift.detach(), self.log_scale.detach(), self.turn.detach())


@dataclass(frozen=True)
class Parts:
    """A region taken apart.

    Args:
        part: which part each member belongs to. [M] int64
        centres: mean of each part's centres, about which it turns and grows. [P,3]
        sizes: root mean square distance from it, world units, > 0. [P]
    """

    part: Tensor
    centres: Tensor
    sizes: Tensor

    def __len__(self) -> int:
        return len(self.centres)

    def still(self) -> Motion:
        """No part has moved."""
        nothing = torch.zeros_like(self.centres)
        return Motion(nothing, nothing[:, 0], nothing)


def make_parts(rows: Tensor, part: Tensor) -> Parts:
    """Centres and sizes of the parts. `rows`: packed members [M,C]; `part`: [M] int64, each below P used"""
    means = rows[:, attribute_slices(rows.shape[1])["means"]]
    counts = torch.bincount(part).to(means)
    nothing = means.new_zeros(len(counts), 3)
    centres = nothing.index_add(0, part, means) / counts[:, None]
    squares = (means - centres[part]).square().sum(dim=1)
    sizes = (nothing[:, 0].index_add(0, part, squares) / counts).sqrt()
    log_scales = rows[:, attribute_slices(rows.shape[1])["log_scales"]]
    own = log_scales.exp().amax(dim=1).mean()  # a part of one Gaussian has its size
    return Parts(part, centres, torch.maximum(sizes, 1e-3 * own).clamp_min(1e-9))


def moved(rows: Tensor, parts: Parts, motion: Motion) -> Tensor:
    """The members' raw rows where the motion takes them; differentiable in both. [M,C] -> [M,C]"""
    columns = attribute_slices(rows.shape[1])
    turn = _quaternion(motion.turn)[parts.part]
    arm = rows[:, columns["means"]] - parts.centres[parts.part]
    size = motion.log_scale[parts.part, None]
    means = parts.centres[parts.part] + motion.shift[parts.part] + size.exp() * _turned(arm, turn)
    log_scales = rows[:, columns["log_scales"]] + size
    quats = _product(turn, rows[:, columns["quats"]])
    return torch.cat([means, log_scales, quats, rows[:, columns["logit_opacities"].start :]], dim=1)


def unmoved(rows: Tensor, parts: Parts, motion: Motion) -> Tensor:
    """The inverse of `moved`. [M,C] -> [M,C]"""
    columns = attribute_slices(rows.shape[1])
    back = _quaternion(-motion.turn)[parts.part]
    size = motion.log_scale[parts.part, None]
    arm = rows[:, columns["means"]] - parts.centres[parts.part] - motion.shift[parts.part]
    means = parts.centres[parts.part] + _turned(arm, back) * (-size).exp()
    log_scales = rows[:, columns["log_scales"]] - size
    quats = _product(back, rows[:, columns["quats"]])
    return torch.cat([means, log_scales, quats, rows[:, columns["logit_opacities"].start :]], dim=1)


def between(a: Motion, b: Motion, share: float) -> Motion:
    """The way from one motion to another: shift and log-scale straight, the turn along the great circle."""
    start = _quaternion(a.turn)
    rest = _rotation_vector(_product(_quaternion(-a.turn), _quaternion(b.turn)))
    return Motion(
        torch.lerp(a.shift, b.shift, share),
        torch.lerp(a.log_scale, b.log_scale, share),
        _rotation_vector(_product(start, _quaternion(share * rest))),
    )


def _quaternion(turn: Tensor) -> Tensor:
    """Unit quaternion wxyz of a rotation vector, smooth at zero. [P,3] -> [P,4]"""
    half = 0.5 * (turn.square().sum(dim=1, keepdim=True) + 1e-12).sqrt()
    return torch.cat([half.cos(), 0.5 * turn * half.sin() / half], dim=1)


def _rotation_vector(quaternion: Tensor) -> Tensor:
    """Of at most half a turn. [P,4] -> [P,3]"""
    quaternion = torch.where(quaternion[:, :1] < 0, -quaternion, quaternion)
    sine = quaternion[:, 1:].norm(dim=1, keepdim=True)
    angle = 2.0 * torch.atan2(sine, quaternion[:, :1])
    return torch.where(sine > 1e-9, quaternion[:, 1:] * angle / sine.clamp_min(1e-9), 2.0 * quaternion[:, 1:])


def _turned(vectors: Tensor, turn: Tensor) -> Tensor:
    """Vectors turned by unit quaternions. [M,3], [M,4] -> [M,3]"""
    axis = turn[:, 1:]
    twice = 2.0 * torch.linalg.cross(axis, vectors)
    spun: Tensor = vectors + turn[:, :1] * twice + torch.linalg.cross(axis, twice)
    return spun


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton's product, wxyz. [M,4], [M,4] -> [M,4]"""
    w = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(dim=1, keepdim=True)
    xyz = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + torch.linalg.cross(a[:, 1:], b[:, 1:])
    return torch.cat([w, xyz], dim=1)
