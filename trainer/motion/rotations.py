"""Rotations of many things at once: rotation vectors (axis times radians) and quaternions wxyz."""

from __future__ import annotations

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor


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
