"""Similarity motions of a region's parts: each is shifted, turned and scaled about its own center.

Members' raw rows follow: centers move, log-scales gain the part's, quaternions are turned. Opacity and color
stay, the higher SH bands too: what they show is mostly light that stays where it is when a part turns.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from progdf.gaussians import BASE_CHANNELS, attribute_slices

_COLUMNS = attribute_slices(BASE_CHANNELS)
_MOVING = slice(0, _COLUMNS["quats"].stop)  # means, log-scales and quaternions come first in a packed row


@dataclass(frozen=True)
class Motion:
    """Where each of P parts has gone.

    Args:
        shift: of the part's center, world units. [P,3]
        log_scale: log of the part's growth. [P]
        turn: rotation vector, axis times angle in radians. [P,3]
    """

    shift: Tensor
    log_scale: Tensor
    turn: Tensor


@dataclass(frozen=True)
class Parts:
    """A region taken apart.

    Args:
        part: which part each member belongs to. [M] int64
        centers: mean of each part's centers, about which it turns and grows. [P,3]
        sizes: root mean square distance from it, world units, > 0. [P]
    """

    part: Tensor
    centers: Tensor
    sizes: Tensor

    def __len__(self) -> int:
        return len(self.centers)

    def rest_motion(self) -> Motion:
        """No part has moved."""
        nothing = torch.zeros_like(self.centers)
        return Motion(nothing, nothing[:, 0], nothing)


def make_parts(rows: Tensor, part: Tensor) -> Parts:
    """Centers and sizes of the parts. `rows`: packed members [M,C]; `part`: [M] int64, each below P used"""
    means, log_scales, _ = _split(rows)
    counts = torch.bincount(part).to(means)
    nothing = means.new_zeros(len(counts), 3)
    centers = nothing.index_add(0, part, means) / counts[:, None]
    squares = (means - centers[part]).square().sum(dim=1)
    sizes = (nothing[:, 0].index_add(0, part, squares) / counts).sqrt()
    own = log_scales.exp().amax(dim=1).mean()  # a part of one Gaussian has its size
    return Parts(part, centers, torch.maximum(sizes, 1e-3 * own).clamp_min(1e-9))


def move_rows(rows: Tensor, parts: Parts, motion: Motion) -> Tensor:
    """Raw rows where the motion takes them; differentiable in both. [M,≥10] -> [M,≥10]"""
    part = parts.part
    means, log_scales, quats = _split(rows)
    turn, size = turn_quats(motion.turn)[part], motion.log_scale[part, None]
    arm = means - parts.centers[part]
    means = parts.centers[part] + motion.shift[part] + size.exp() * rotate(arm, turn)
    return torch.cat([means, log_scales + size, multiply_quats(turn, quats), rows[:, _MOVING.stop :]], dim=1)


def carry_offsets(original: Tensor, offsets: Tensor, parts: Parts, motion: Motion) -> Tensor:
    """Offsets within the parts' own frames -> offsets from the original, once the parts have moved.

    Args:
        original: raw member rows. [M,C]
        offsets: what each member does besides going with its part. [M,C]
        parts, motion: see there

    Returns:
        Raw-space offsets, differentiable. [M,C]; opacity's and color's are the given ones
    """
    moving = _MOVING
    rows = original[:, moving]
    return torch.cat(
        [move_rows(rows + offsets[:, moving], parts, motion) - rows, offsets[:, moving.stop :]], dim=1
    )


def local_offsets(original: Tensor, offsets: Tensor, parts: Parts, motion: Motion) -> Tensor:
    """The inverse of `carry_offsets`. [M,C] -> [M,C]"""
    moving, part = _MOVING, parts.part
    means, log_scales, quats = _split(original[:, moving] + offsets[:, moving])
    back, size = turn_quats(-motion.turn)[part], motion.log_scale[part, None]
    arm = means - parts.centers[part] - motion.shift[part]
    own = [
        parts.centers[part] + rotate(arm, back) * (-size).exp(),
        log_scales - size,
        multiply_quats(back, quats),
    ]
    return torch.cat([torch.cat(own, dim=1) - original[:, moving], offsets[:, moving.stop :]], dim=1)


def interpolate_motion(a: Motion, b: Motion, share: float) -> Motion:
    """The way from one motion to another: shift and log-scale straight, the turn along the great circle."""
    start = turn_quats(a.turn)
    rest = quat_turns(multiply_quats(turn_quats(-a.turn), turn_quats(b.turn)))
    return Motion(
        torch.lerp(a.shift, b.shift, share),
        torch.lerp(a.log_scale, b.log_scale, share),
        quat_turns(multiply_quats(start, turn_quats(share * rest))),
    )


def _split(rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Means [M,3], log-scales [M,3] and quaternions [M,4] of packed rows."""
    return rows[:, _COLUMNS["means"]], rows[:, _COLUMNS["log_scales"]], rows[:, _COLUMNS["quats"]]


def turn_quats(turn: Tensor) -> Tensor:
    """Unit quaternion wxyz of a rotation vector, smooth at zero. [P,3] -> [P,4]"""
    half = 0.5 * (turn.square().sum(dim=1, keepdim=True) + 1e-12).sqrt()
    return torch.cat([half.cos(), 0.5 * turn * half.sin() / half], dim=1)


def quat_turns(quaternion: Tensor) -> Tensor:
    """Of at most half a turn. [P,4] -> [P,3]"""
    quaternion = torch.where(quaternion[:, :1] < 0, -quaternion, quaternion)
    sine = quaternion[:, 1:].norm(dim=1, keepdim=True)
    angle = 2.0 * torch.atan2(sine, quaternion[:, :1])
    return torch.where(sine > 1e-9, quaternion[:, 1:] * angle / sine.clamp_min(1e-9), 2.0 * quaternion[:, 1:])


def rotate(vectors: Tensor, turn: Tensor) -> Tensor:
    """Vectors turned by unit quaternions. [M,3], [M,4] -> [M,3]"""
    axis = turn[:, 1:]
    twice = 2.0 * torch.linalg.cross(axis, vectors)
    spun: Tensor = vectors + turn[:, :1] * twice + torch.linalg.cross(axis, twice)
    return spun


def multiply_quats(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton's product, wxyz. [M,4], [M,4] -> [M,4]"""
    w = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(dim=1, keepdim=True)
    xyz = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + torch.linalg.cross(a[:, 1:], b[:, 1:])
    return torch.cat([w, xyz], dim=1)


def quat_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices of unit quaternions; the columns are the turned axes. [M,4] -> [M,3,3]"""
    axes = torch.eye(3).to(quats)
    return torch.stack([rotate(axis.expand(len(quats), 3), quats) for axis in axes], dim=2)


def matrix_turns(matrices: Tensor) -> Tensor:
    """Rotation vectors of rotation matrices; no gradient. [P,3,3] -> [P,3]"""
    turns = Rotation.from_matrix(matrices.detach().double().numpy()).as_rotvec()
    return torch.from_numpy(turns).to(matrices)
