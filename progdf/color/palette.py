"""Main colors of a region, and a color map that moves source colors to target colors.

The map moves a color x by Σ_i w_i(x) f_i(x) (t_i − p_i), in OKLab, for sources p_i and targets t_i. The
weights w_i are an interpolation by Gaussian kernels (Chang et al., Palette-based Photo Recoloring, SIGGRAPH
2015). A weight is 1 at its own source and 0 at the others. So every source becomes its target exactly, and a
source whose target is itself is unchanged. The weights of several sources sum to 1, so each color follows the
sources near it. With a single source, colors far from it are unchanged.

f_i reduces the shift of colors darker than the source, as in less light, and of nearly white colors. The
curve of each source bends the lightness by the same weights.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from .oklab import oklab_to_srgb, srgb_to_oklab

COLORS = 5
"""Default number of main colors."""
MIN_SOURCE_DISTANCE = 0.02
"""Smallest kernel distance of two sources; closer sources count as one color."""

_LIGHTNESS_FACTOR = 0.5  # factor on lightness differences, because shading is not another color
_WHITE_MARGIN = 0.15  # distance from white, in lightness, at which the shift of a color begins to fade
_KERNEL_WIDTH_SHARE = (
    0.5  # standard deviation of the kernel, as a share of the mean distance to the nearest source
)
_MIN_KERNEL_WIDTH = 0.04  # smallest standard deviation of the kernel
_SINGLE_KERNEL_WIDTH = 0.08  # standard deviation of the kernel of a single source
_ITERATIONS = 20  # iterations of k-means
_CELL_SIDE = 0.04  # side of the cells in which colors are counted
_MIN_SHARE = 0.003  # smallest share of the visible area for a main color
_CURVE_STEPS = 1024  # linear pieces of a tabulated curve

Curve = tuple[tuple[float, float], ...]
"""Points (input, output) of a lightness curve, 0 to 1, in ascending order of input; see `bend_lightness`.

An empty curve changes nothing.
"""


def find_palette(rgb: Tensor, weights: Tensor, count: int = COLORS) -> Tensor:
    """Return the main colors by k-means in OKLab, in descending order of area.

    Args:
        rgb: sRGB colors, 0 to 1. [N,3]
        weights: visible area of each color, ≥ 0. [N]
        count: largest number of colors

    Returns:
        sRGB colors [k,3], k ≤ `count`; [0,3] if all weights are 0.
    """
    is_visible = weights > 0
    colors = _kernel_space(srgb_to_oklab(rgb[is_visible].clamp(0, 1)).double())
    weights = weights[is_visible].double()
    if not len(colors):
        return rgb.new_zeros(0, 3)
    cells, own = torch.unique((colors / _CELL_SIDE).round(), dim=0, return_inverse=True)
    shares = weights.new_zeros(len(cells)).index_add_(0, own, weights)
    colors = torch.zeros_like(cells).index_add_(0, own, weights[:, None] * colors) / shares[:, None]
    roots = shares.sqrt()  # distinct colors count for more than their area, such as a scarf beside a lawn
    centers = colors[int(shares.argmax())][None]
    while len(centers) < min(count, len(colors)):  # add the cell with the largest weighted error
        errors = roots * torch.cdist(colors, centers).amin(dim=1).square()
        centers = torch.cat([centers, colors[int(errors.argmax())][None]])
    for _ in range(_ITERATIONS):
        nearest = torch.cdist(colors, centers).argmin(dim=1)
        sums = torch.zeros_like(centers).index_add_(0, nearest, roots[:, None] * colors)
        totals = roots.new_zeros(len(centers)).index_add_(0, nearest, roots)[:, None]
        centers = torch.where(totals > 0, sums / totals.clamp_min(1e-12), centers)
    covered = shares.new_zeros(len(centers)).index_add_(0, nearest, shares)
    main: list[int] = []
    for i in covered.argsort(descending=True).tolist():
        is_distinct = all(float((centers[i] - centers[j]).norm()) >= 2 * MIN_SOURCE_DISTANCE for j in main)
        if is_distinct and float(covered[i]) >= _MIN_SHARE * float(shares.sum()):
            main.append(i)
    return oklab_to_srgb(centers[main] / _kernel_space(centers.new_ones(3))).clamp(0, 1).to(rgb)


def are_alike(a: Tensor, b: Tensor) -> bool:
    """Return whether two sRGB colors [3] are too close to be separate sources."""
    return (
        float((_kernel_space(srgb_to_oklab(a)) - _kernel_space(srgb_to_oklab(b))).norm())
        < MIN_SOURCE_DISTANCE
    )


def shift_palette(lab: Tensor, sources: Tensor, targets: Tensor, curves: Sequence[Curve] = ()) -> Tensor:
    """Map colors so that sources become targets, all in OKLab. [...,3], [k,3], [k,3] -> [...,3]

    The result may lie outside the gamut.

    Args:
        lab: colors. [...,3]
        sources: source colors, at least `MIN_SOURCE_DISTANCE` apart. [k,3]
        targets: target colors. [k,3]
        curves: lightness curve near each source, applied after the shift; empty, or k
    """
    kernel_sources = _kernel_space(sources.double())
    colors = _kernel_space(lab.reshape(-1, 3).double())
    source_distances = torch.cdist(kernel_sources, kernel_sources)
    color_distances = torch.cdist(colors, kernel_sources)
    width = _SINGLE_KERNEL_WIDTH
    if len(kernel_sources) > 1:
        nearest = (source_distances + torch.eye(len(kernel_sources)) * source_distances.max()).amin(dim=1)
        width = max(_MIN_KERNEL_WIDTH, _KERNEL_WIDTH_SHARE * float(nearest.mean()))
        color_distances = (
            color_distances.square() - color_distances.square().amin(dim=1, keepdim=True)
        ).sqrt()  # a common factor, which cancels

    def kernel(distances: Tensor) -> Tensor:
        return torch.exp(-0.5 * (distances / width).square())

    weights = (kernel(color_distances) @ torch.linalg.inv(kernel(source_distances))).clamp_min(0.0)
    if len(kernel_sources) > 1:
        weights = weights / weights.sum(dim=1, keepdim=True)
    lightness = lab.reshape(-1, 3)[:, :1].double()
    source_lightness = sources[:, 0].double()
    dark_fade = lightness / source_lightness.clamp_min(1e-3)
    bright_fade = (1 - lightness) / (1 - source_lightness).clamp(1e-3, _WHITE_MARGIN)
    fade = torch.minimum(dark_fade, bright_fade)
    moved = (weights * fade.clamp(0, 1)) @ (targets - sources).double()
    shifted: Tensor = lab + moved.to(lab).reshape(lab.shape)
    if not any(curves):
        return shifted
    before = shifted[..., :1].clamp(0, 1)
    changes = torch.cat([bend_lightness(before, curve) - before for curve in curves], dim=-1)
    after = before + (weights.to(lab).reshape(changes.shape) * changes).sum(dim=-1, keepdim=True)
    return torch.cat([after, shifted[..., 1:] * chroma_factor(before, after)], dim=-1)


def chroma_factor(before: Tensor, after: Tensor) -> Tensor:
    """Return the factor on chroma for a change of lightness. [...] -> [...]

    It is 1 if the lightness rises, and otherwise that of less light on the same surface.
    """
    return (after / before.clamp_min(1e-6)).clamp_max(1)


def bend_lightness(lightness: Tensor, curve: Sequence[tuple[float, float]]) -> Tensor:
    """Apply a curve through the given points, and through (0, 0) and (1, 1) unless it has points there.

    The curve is the monotone cubic of Fritsch and Carlson. Between two points it never leaves their range.

    Args:
        lightness: 0 to 1. [...]
        curve: points (input, output), 0 to 1, in ascending order of input
    """
    points = dict([(0.0, 0.0), (1.0, 1.0), *curve])
    inputs = sorted(points)
    table = PchipInterpolator(inputs, [points[x] for x in inputs])(np.linspace(0.0, 1.0, _CURVE_STEPS + 1))
    steps = torch.from_numpy(table).to(lightness).clamp(0, 1)
    position = lightness.clamp(0, 1) * _CURVE_STEPS
    below = position.floor().long().clamp_max(_CURVE_STEPS - 1)
    return torch.lerp(steps[below], steps[below + 1], position - below)


def _kernel_space(lab: Tensor) -> Tensor:
    """Convert OKLab to the space of kernel distances, with scaled lightness. [...,3] -> [...,3]"""
    return lab * lab.new_tensor([_LIGHTNESS_FACTOR, 1.0, 1.0])
