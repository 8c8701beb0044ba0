"""Real spherical harmonics with the signs and order of the 3DGS .ply file: values and rotation."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor

from progdf.quaternions import rotate_vectors

Signs = tuple[float, float, float]
"""Factors ±1 of x, y and z."""

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
_FIT_DIRECTIONS = 96  # directions of the fit in `map_colors`
_CHUNK = 1 << 14  # Gaussians that are processed at once


def sh0_to_rgb(sh0: Tensor) -> Tensor:
    """Convert band 0 to a color, without the clamp at 0. [...,3] -> [...,3]"""
    return sh0 * C0 + 0.5


def rgb_to_sh0(rgb: Tensor) -> Tensor:
    """Convert a color, 0 to 1, to band 0. [...,3] -> [...,3]"""
    return (rgb - 0.5) / C0


def basis(degree: int, directions: Tensor) -> Tensor:
    """Return the values of the (degree+1)² real basis functions. [N,(degree+1)²]

    Args:
        degree: 0 to 3; band 4 of a file is preserved but never drawn
        directions: unit vectors from the camera center to the Gaussian, world axes. [N,3]

    Raises:
        ValueError: the degree is out of range.
    """
    if not 0 <= degree <= 3:
        raise ValueError(f"SH degree {degree} is not supported, expected 0 to 3")
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, C0)]
    if degree >= 1:
        values += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        xx = x * x
        yy = y * y
        zz = z * z
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
    """Return the color along `directions`: max(0, Σ basis·sh + 0.5). [N,3], [N,≥(degree+1)²,3] -> [N,3]"""
    weights = basis(degree, directions)
    return ((weights[..., None] * sh[:, : weights.shape[-1]]).sum(dim=1) + 0.5).clamp_min(0.0)


def rotation_change(shN: Tensor, quats: Tensor, part: Tensor | None = None) -> Tensor:
    """Return the change of higher bands by a rotation, so that the color along d moves to the rotated d.

    The change is exactly 0 for the identity. It has no gradient with respect to the rotation.

    Args:
        shN: bands 1 to d; band 4, which is never drawn, is unchanged. [N,K,3]
        quats: unit quaternions wxyz, one per Gaussian [N,4] or one per part [P,4]
        part: index of each Gaussian's part. [N] int64

    Returns:
        Offset of shN. [N,K,3]
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


def half_turn(shN: Tensor, signs: Signs) -> Tensor:
    """Return the higher bands after a half turn about an axis, by exact sign changes.

    Args:
        shN: bands 1 to d. [N,K,3]
        signs: factors of x, y and z; (1, −1, −1) is a half turn about x
    """
    degree = math.isqrt(shN.shape[1] + 1) - 1
    x, y, z = signs
    factors = []
    for l in range(1, degree + 1):
        for m in range(-l, l + 1):
            # odd in y: m < 0; odd in z: l + m odd; odd in x: m odd and ≥ 0, or m even and < 0
            odd_x = (m % 2 == 1) != (m < 0)
            sign_x = x if odd_x else 1.0
            sign_y = y if m < 0 else 1.0
            sign_z = z if (l + m) % 2 else 1.0
            factors.append(sign_x * sign_y * sign_z)
    return shN * torch.tensor(factors, dtype=shN.dtype)[:, None]


def map_colors(sh: Tensor, function: Callable[[Tensor], Tensor]) -> Tensor:
    """Return the SH whose colors are a function of the colors of other SH.

    The result is exact for band 0 alone. Otherwise it is a least-squares fit over evenly spread directions,
    because a function of a band-limited color is not band-limited.

    Args:
        sh: all bands. [N,K+1,3]
        function: maps colors ≥ 0 to colors, elementwise. [...,3] -> [...,3]
    """
    if sh.shape[1] == 1:
        return rgb_to_sh0(function(sh0_to_rgb(sh.double()).clamp_min(0.0))).to(sh.dtype)
    degree = math.isqrt(sh.shape[1]) - 1
    values = basis(degree, spread_directions(_FIT_DIRECTIONS))
    inverse = torch.linalg.pinv(values)
    fitted = []
    for chunk in torch.split(sh, _CHUNK):
        colors = (values @ chunk.double() + 0.5).clamp_min(0.0)
        fitted.append((inverse @ (function(colors) - 0.5)).to(sh.dtype))
    return torch.cat(fitted)


def spread_directions(count: int) -> Tensor:
    """Return unit vectors on a Fibonacci lattice. [count,3] float64"""
    z = 1.0 - (2.0 * torch.arange(count, dtype=torch.float64) + 1.0) / count
    angle = torch.arange(count, dtype=torch.float64) * math.pi * (3.0 - math.sqrt(5.0))
    radius = (1.0 - z * z).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=1)


def _wigner_change(degree: int, quats: Tensor) -> Tensor:
    """Return the Wigner matrices of bands 1 to `degree` minus the identity. [N,4] -> [N,K,K] float64"""
    directions, inverse = _samples(degree, quats.device)
    back = quats.double() * quats.new_tensor([1.0, -1.0, -1.0, -1.0], dtype=torch.float64)
    turned = rotate_vectors(directions[None], back[:, None])
    seen = basis(degree, turned) - basis(degree, directions)
    return inverse @ seen[..., 1:]


@cache
def _samples(degree: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return directions [J,3], and the matrix from their colors to bands 1 to `degree` [K,J]; float64."""
    directions = spread_directions(_SAMPLES)
    return directions.to(device), torch.linalg.pinv(basis(degree, directions))[1:].to(device)
