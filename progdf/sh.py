"""Real spherical harmonics up to degree 4, with the signs and order of the 3DGS .ply file."""

from __future__ import annotations

import torch
from torch import Tensor

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
