"""Clarity of a grade: local contrast of a region, per Gaussian.

The detail of a Gaussian is its lightness minus the mean lightness of its neighborhood, weighted by opacity
times area. Clarity adds a share of the detail to the lightness, so the local contrast becomes 1 + clarity
times as large. Hues stay, and chroma follows the light as for the tone controls.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.sh import C0

from .oklab import fit_gamut, srgb_to_oklab
from .palette import chroma_factor

NEIGHBORHOOD_SHARE = 0.04
"""Size of a neighborhood, as a share of the extent of the region's middle."""

_MIDDLE = (0.02, 0.98)  # quantiles of the positions between which the extent is measured
_MAX_CELLS = 64  # cells along each side of the grid; farther Gaussians share the outermost ones


def local_detail(scene: Gaussians, rows: Tensor) -> Tensor:
    """Return the lightness of each row minus that of its neighborhood, OKLab. [M] float32

    The mean is taken on a grid of cells as large as a neighborhood, with linear weights.

    Args:
        scene: the scene
        rows: region. [M] int64
    """
    if not len(rows):
        return torch.zeros(0)
    colors = (scene.sh0[rows].float() * C0 + 0.5).nan_to_num(0.0).clamp(0, 1)
    lightness = srgb_to_oklab(colors)[:, 0].double().numpy()
    scales = scene.log_scales[rows].float().exp().sort(dim=1).values.double()
    areas = (_limit_scales(scales[:, 1]) * _limit_scales(scales[:, 2])).numpy()
    weights = areas * scene.logit_opacities[rows].float().sigmoid().nan_to_num(0.0).double().numpy() + 1e-30
    points = scene.means[rows].double().nan_to_num(0.0, 0.0, 0.0).numpy()
    low, high = np.quantile(points, _MIDDLE, axis=0)
    cell = max(NEIGHBORHOOD_SHARE * float((high - low).max()), 1e-12)
    count = np.minimum(np.ceil((high - low) / cell).astype(np.int64) + 3, _MAX_CELLS)
    positions = np.clip((points - low) / cell + 1.0, 0.0, count - 1.001)
    base = positions.astype(np.int64)
    shares = positions - base
    total = np.zeros(int(count.prod()))
    sums = np.zeros_like(total)
    corners = []
    for corner in range(8):
        bits = np.array([corner & 1, corner >> 1 & 1, corner >> 2])
        at = np.ravel_multi_index(tuple((base + bits).T), tuple(count))
        share = np.abs(1 - bits - shares).prod(axis=1)
        corners.append((at, share))
        total += np.bincount(at, weights * share, len(total))
        sums += np.bincount(at, weights * share * lightness, len(total))
    means = sums / np.maximum(total, 1e-300)
    smooth = sum(share * means[at] for at, share in corners)
    return torch.from_numpy((lightness - smooth).astype(np.float32))


def _limit_scales(scales: Tensor) -> Tensor:
    """Return scales up to 100 times their median, so that no single Gaussian is the neighborhood. [M]"""
    finite = scales.nan_to_num(0.0, 0.0, 0.0)
    return finite.clamp_max(100.0 * float(finite.median()))


def clarify(rgb: Tensor, detail: Tensor, value: float) -> Tensor:
    """Add a share of the detail to the lightness of sRGB colors. [...,3] -> [...,3]

    Args:
        rgb: sRGB colors, 0 to 1
        detail: see `local_detail`. [...]
        value: −1 (smooth) to 1 (twice the contrast); 0 returns the colors bit for bit
    """
    if value == 0.0:
        return rgb
    lab = srgb_to_oklab(rgb)
    before = lab[..., 0]
    after = (before + value * detail.to(before)).clamp(0, 1)
    toned = torch.cat([after[..., None], lab[..., 1:] * chroma_factor(before, after)[..., None]], dim=-1)
    return torch.where((detail == 0.0)[..., None], rgb, fit_gamut(toned))
