"""Real spherical harmonics with the signs and order of the 3DGS .ply file: values and rotation."""

from __future__ import annotations

import math
from functools import cache

import torch
from torch import Tensor

from progdf.quaternions import rotate_vectors

C0 = 0.28209479177387814
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)

_SAMPLES = 20  # directions, at least as many as basis functions
_CHUNK = 1 << 14  # Gaussians that are turned at once


def sh0_to_rgb(sh0: Tensor) -> Tensor:
    """Color of band 0 alone, before the clamp at 0. [...,3] -> [...,3]"""
    return sh0 * C0 + 0.5


def rgb_to_sh0(rgb: Tensor) -> Tensor:
    """Band 0 that shows `rgb` (0..1). [...,3] -> [...,3]"""
    return (rgb - 0.5) / C0


def basis(degree: int, directions: Tensor) -> Tensor:
    """Values of the (degree+1)² real basis functions.

    Args:
        degree: 0..3 (band 4, where a file has it, is carried along and not shown)
        directions: unit vectors from the camera center to the Gaussian, world axes. [N,3]

    Returns:
        [N,(degree+1)²]
    """
    if not 0 <= degree <= 3:
        raise ValueError(f"SH degree {degree} is not supported, expected 0 to 3")
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, C0)]
    if degree >= 1:
        values += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        values += [
            _C2[0] * x * y,
            _C2[1] * y * z,
            _C2[2] * (2 * zz - xx - yy),
            _C2[3] * x * z,
            _C2[4] * (xx - yy),
        ]
    if degree >= 3:
        values += [
            _C3[0] * y * (3 * xx - yy),
            _C3[1] * x * y * z,
            _C3[2] * y * (4 * zz - xx - yy),
            _C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            _C3[4] * x * (4 * zz - xx - yy),
            _C3[5] * z * (xx - yy),
            _C3[6] * x * (xx - 3 * yy),
        ]
    return torch.stack(values, dim=-1)


def shade(degree: int, directions: Tensor, sh: Tensor) -> Tensor:
    """Color seen along `directions`: max(0, Σ basis·sh + 0.5). [N,3], [N,≥(degree+1)²,3] -> [N,3]"""
    weights = basis(degree, directions)
    return ((weights[..., None] * sh[:, : weights.shape[-1]]).sum(dim=1) + 0.5).clamp_min(0.0)


def rotation_change(shN: Tensor, quats: Tensor, part: Tensor | None = None) -> Tensor:
    """What a turn adds to higher bands: what was seen along d is then seen along the turned d.

    Exactly 0 where nothing turns; no gradient of the turn.

    Args:
        shN: bands 1 to d; band 4, which is not shown, stays. [N,K,3]
        quats: unit quaternions, [N,4], or [P,4] of parts
        part: which part each Gaussian belongs to. [N] int64

    Returns:
        [N,K,3]
    """
    degree = min(3, math.isqrt(shN.shape[1] + 1) - 1)
    change = torch.zeros_like(shN)
    if not degree:
        return change
    count = (degree + 1) ** 2 - 1
    matrices = torch.cat([_wigner_change(degree, chunk) for chunk in torch.split(quats.detach(), _CHUNK)]).to(
        shN
    )
    matrices = matrices if part is None else matrices[part]
    return torch.cat([matrices @ shN[:, :count], change[:, count:]], dim=1)


def rotate_about_x(shN: Tensor) -> Tensor:
    """Higher bands after half a turn about x, bit for bit but for signs. [N,K,3]"""
    degree = math.isqrt(shN.shape[1] + 1) - 1
    # a basis function of order m changes its sign with y for m < 0, and with z for l + m odd
    signs = [(-1.0) ** (l + m + (m < 0)) for l in range(1, degree + 1) for m in range(-l, l + 1)]
    return shN * torch.tensor(signs)[:, None]


def _wigner_change(degree: int, quats: Tensor) -> Tensor:
    """The Wigner matrices of bands 1 to `degree`, less the identity. [N,4] -> [N,K,K] float64"""
    directions, inverse = _samples(degree, quats.device)
    back = quats.double() * quats.new_tensor([1.0, -1.0, -1.0, -1.0], dtype=torch.float64)
    turned = rotate_vectors(directions[None], back[:, None])
    seen = basis(degree, turned) - basis(degree, directions)
    return inverse @ seen[..., 1:]


@cache
def _samples(degree: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Directions, and the bands from the colors seen along them. [J,3], [K,J] float64"""
    z = 1.0 - (2.0 * torch.arange(_SAMPLES, dtype=torch.float64) + 1.0) / _SAMPLES
    angle = torch.arange(_SAMPLES, dtype=torch.float64) * math.pi * (3.0 - math.sqrt(5.0))
    radius = (1.0 - z * z).sqrt()
    directions = torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=1)
    return directions.to(device), torch.linalg.pinv(basis(degree, directions))[1:].to(device)
