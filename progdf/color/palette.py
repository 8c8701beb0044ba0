"""The main colors of a region, and the map of color that takes some of them elsewhere.

The map moves a color x by Σ_i w_i(x) f_i(x) (t_i − p_i), in OKLab, for sources p_i and targets t_i. The
weights are a Gaussian kernel's interpolation (Chang et al., Palette-based Photo Recoloring, SIGGRAPH 2015):
1 at their own source and 0 at the others, so every source becomes its target exactly, and one whose target is
itself stays. Of several they are a partition: each color goes with those that are near. What is far from a
single one stays. f_i fades what is darker than its source, as in less light, and what is nearly white. By the
same weights each source's curve bends the lightness.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from .oklab import oklab_to_srgb, srgb_to_oklab

COLORS = 5
CLOSEST = 0.02
"""Two sources that are nearer than this, in the distance of the kernel, are one color."""

_LIGHTNESS = 0.5  # how much a difference of lightness counts: shading is not another color
_WHITE = 0.15  # of lightness below white: where a color begins to stay
# width of the kernel: share of the distance of the sources, the least, and with one source
_WIDTH = 0.5
_NARROWEST = 0.04
_ALONE = 0.08
_ROUNDS = 20  # of k-means
_CELL = 0.04  # side of the cells in which colors are counted
_MIN_SHARE = 0.003  # of what is seen, for a color to be a main one
_STEPS = 1024  # of a curve, linear between

Curve = tuple[tuple[float, float], ...]
"""Lightness from and to, 0..1, by rising from; see `bend_lightness`. An empty one bends nothing."""


def find_palette(rgb: Tensor, weights: Tensor, count: int = COLORS) -> Tensor:
    """The main colors by k-means in OKLab, the one that covers most first; fewer where fewer are there.

    Args:
        rgb: sRGB colors, 0..1. [N,3]
        weights: how much each is seen, ≥ 0. [N]

    Returns:
        [k,3] sRGB, k ≤ `count`; [0,3] where nothing is seen.
    """
    seen = weights > 0
    colors = _kernel_space(srgb_to_oklab(rgb[seen].clamp(0, 1)).double())
    weights = weights[seen].double()
    if not len(colors):
        return rgb.new_zeros(0, 3)
    cells, own = torch.unique((colors / _CELL).round(), dim=0, return_inverse=True)
    shares = weights.new_zeros(len(cells)).index_add_(0, own, weights)
    colors = torch.zeros_like(cells).index_add_(0, own, weights[:, None] * colors) / shares[:, None]
    roots = (
        shares.sqrt()
    )  # a color of its own counts for more than its area, or a scarf is none beside a lawn
    centers = colors[int(shares.argmax())][None]
    while len(centers) < min(count, len(colors)):  # the next one is where most is farthest from all
        missed = roots * torch.cdist(colors, centers).amin(dim=1).square()
        centers = torch.cat([centers, colors[int(missed.argmax())][None]])
    for _ in range(_ROUNDS):
        nearest = torch.cdist(colors, centers).argmin(dim=1)
        sums = torch.zeros_like(centers).index_add_(0, nearest, roots[:, None] * colors)
        totals = roots.new_zeros(len(centers)).index_add_(0, nearest, roots)[:, None]
        centers = torch.where(totals > 0, sums / totals.clamp_min(1e-12), centers)
    covered = shares.new_zeros(len(centers)).index_add_(0, nearest, shares)
    kept: list[int] = []
    for i in covered.argsort(descending=True).tolist():
        apart = all(float((centers[i] - centers[j]).norm()) >= 2 * CLOSEST for j in kept)
        if apart and float(covered[i]) >= _MIN_SHARE * float(shares.sum()):
            kept.append(i)
    return oklab_to_srgb(centers[kept] / _kernel_space(centers.new_ones(3))).clamp(0, 1).to(rgb)


def are_alike(a: Tensor, b: Tensor) -> bool:
    """Whether two sRGB colors [3] are too near to go different ways."""
    return float((_kernel_space(srgb_to_oklab(a)) - _kernel_space(srgb_to_oklab(b))).norm()) < CLOSEST


def shift_palette(lab: Tensor, sources: Tensor, targets: Tensor, curves: Sequence[Curve] = ()) -> Tensor:
    """What becomes of colors where sources become targets, all OKLab. [...,3], [k,3], [k,3] -> [...,3]

    The sources are at least `CLOSEST` apart. What comes out may lie outside of the gamut.

    Args:
        curves: of the lightness of what has become of each source; none at all, or k
    """
    places = _kernel_space(sources.double())
    colors = _kernel_space(lab.reshape(-1, 3).double())
    apart = torch.cdist(places, places)
    away = torch.cdist(colors, places)
    width = _ALONE
    if len(places) > 1:
        nearest = (apart + torch.eye(len(places)) * apart.max()).amin(dim=1)
        width = max(_NARROWEST, _WIDTH * float(nearest.mean()))
        away = (away.square() - away.square().amin(dim=1, keepdim=True)).sqrt()  # a factor, which cancels

    def kernel(distances: Tensor) -> Tensor:
        return torch.exp(-0.5 * (distances / width).square())

    weights = (kernel(away) @ torch.linalg.inv(kernel(apart))).clamp_min(0.0)
    if len(places) > 1:
        weights = weights / weights.sum(dim=1, keepdim=True)
    lightness = lab.reshape(-1, 3)[:, :1].double()
    own = sources[:, 0].double()
    dark = lightness / own.clamp_min(1e-3)
    bright = (1 - lightness) / (1 - own).clamp(1e-3, _WHITE)
    fade = torch.minimum(dark, bright)
    moved = (weights * fade.clamp(0, 1)) @ (targets - sources).double()
    shifted: Tensor = lab + moved.to(lab).reshape(lab.shape)
    if not any(curves):
        return shifted
    before = shifted[..., :1].clamp(0, 1)
    bent = torch.cat([bend_lightness(before, curve) - before for curve in curves], dim=-1)
    after = before + (weights.to(lab).reshape(bent.shape) * bent).sum(dim=-1, keepdim=True)
    return torch.cat([after, shifted[..., 1:] * less_light(before, after)], dim=-1)


def less_light(before: Tensor, after: Tensor) -> Tensor:
    """What is left of the chroma where lightness changes: all where it rises, else as in less light on the
    same surface. [...] -> [...]"""
    return (after / before.clamp_min(1e-6)).clamp_max(1)


def bend_lightness(lightness: Tensor, curve: Sequence[tuple[float, float]]) -> Tensor:
    """Lightness through a curve that passes its points, and (0, 0) and (1, 1) where it has none there.

    It is the monotone cubic of Fritsch and Carlson: between two points it never leaves their range.

    Args:
        lightness: 0..1. [...]
        curve: from and to, 0..1, by rising from
    """
    points = dict([(0.0, 0.0), (1.0, 1.0), *curve])
    at = sorted(points)
    table = PchipInterpolator(at, [points[x] for x in at])(np.linspace(0.0, 1.0, _STEPS + 1))
    steps = torch.from_numpy(table).to(lightness).clamp(0, 1)
    place = lightness.clamp(0, 1) * _STEPS
    below = place.floor().long().clamp_max(_STEPS - 1)
    return torch.lerp(steps[below], steps[below + 1], place - below)


def _kernel_space(lab: Tensor) -> Tensor:
    """OKLab in which distances are the kernel's."""
    return lab * lab.new_tensor([_LIGHTNESS, 1.0, 1.0])
