"""Quaternions wxyz, rotation vectors and rotation matrices."""

from __future__ import annotations

import torch
from torch import Tensor


def normalize_quats(quats: Tensor) -> Tensor:
    """Normalize quaternions; zero or non-finite ones become the identity. [N,4] -> [N,4]"""
    largest = quats.abs().amax(dim=-1, keepdim=True)
    usable = (largest > 0) & largest.isfinite()
    # divide by the largest component first, so that the squares of 1e-30 and 1e30 stay in range
    safe = torch.where(usable, quats / torch.where(usable, largest, torch.ones_like(largest)), 0.0)
    identity = torch.zeros_like(quats)
    identity[..., 0] = 1.0
    length = safe.norm(dim=-1, keepdim=True)
    return torch.where(usable, safe / torch.where(usable, length, torch.ones_like(length)), identity)


def multiply_quats(a: Tensor, b: Tensor) -> Tensor:
    """Return the Hamilton product of quaternions wxyz. [M,4], [M,4] -> [M,4]"""
    w = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(dim=1, keepdim=True)
    xyz = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + torch.linalg.cross(a[:, 1:], b[:, 1:])
    return torch.cat([w, xyz], dim=1)


def rotate_vectors(vectors: Tensor, quats: Tensor) -> Tensor:
    """Rotate vectors by unit quaternions. [...,3], [...,4] -> [...,3]"""
    axis = quats[..., 1:]
    twice = 2.0 * torch.linalg.cross(axis, vectors)
    rotated: Tensor = vectors + quats[..., :1] * twice + torch.linalg.cross(axis, twice)
    return rotated


def turn_quats(turn: Tensor) -> Tensor:
    """Convert rotation vectors to unit quaternions wxyz; smooth at zero. [P,3] -> [P,4]"""
    half = 0.5 * (turn.square().sum(dim=1, keepdim=True) + 1e-12).sqrt()
    return torch.cat([half.cos(), 0.5 * turn * half.sin() / half], dim=1)


def quat_turns(quats: Tensor) -> Tensor:
    """Convert unit quaternions to rotation vectors of at most 180°. [P,4] -> [P,3]"""
    quats = torch.where(quats[:, :1] < 0, -quats, quats)
    sine = quats[:, 1:].norm(dim=1, keepdim=True)
    angle = 2.0 * torch.atan2(sine, quats[:, :1])
    return torch.where(sine > 1e-9, quats[:, 1:] * angle / sine.clamp_min(1e-9), 2.0 * quats[:, 1:])


def rotation_matrices(unit_quats: Tensor) -> Tensor:
    """Convert unit quaternions wxyz to rotation matrices. [N,4] -> [N,3,3]"""
    w, x, y, z = unit_quats.unbind(1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, dim=1).reshape(-1, 3, 3)


def matrix_quats(matrices: Tensor) -> Tensor:
    """Convert rotation matrices to unit quaternions, by the largest component. [N,3,3] -> [N,4]"""
    m = matrices
    x = m[:, 0, 0]
    y = m[:, 1, 1]
    z = m[:, 2, 2]
    a = m[:, 2, 1]
    b = m[:, 0, 2]
    c = m[:, 1, 0]
    d = m[:, 1, 2]
    e = m[:, 2, 0]
    f = m[:, 0, 1]
    candidates = torch.stack(
        [
            torch.stack([1 + x + y + z, a - d, b - e, c - f], 1),
            torch.stack([a - d, 1 + x - y - z, c + f, b + e], 1),
            torch.stack([b - e, c + f, 1 - x + y - z, a + d], 1),
            torch.stack([c - f, b + e, a + d, 1 - x - y + z], 1),
        ],
        dim=1,
    )
    best = torch.stack([1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z], 1).argmax(1)
    quats = candidates[torch.arange(len(m)), best]
    return normalize_quats(quats)


def matrix_turns(matrices: Tensor) -> Tensor:
    """Convert rotation matrices to rotation vectors, without a gradient. [P,3,3] -> [P,3]"""
    from scipy.spatial.transform import Rotation  # takes 0.5 s to import; only this function needs it

    turns = Rotation.from_matrix(matrices.detach().double().cpu().numpy()).as_rotvec()
    return torch.from_numpy(turns).to(matrices)
