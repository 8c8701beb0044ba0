"""Main colors of a region, and a color map that moves source colors to target colors.

The map moves a color x by Σ_i w_i(x) f_i(x) (t_i(x) − p_i(x)), in OKLab, for sources p_i and targets t_i. The
weights w_i are an interpolation by Gaussian kernels (Chang et al., Palette-based Photo Recoloring, SIGGRAPH
2015). A weight is 1 at its own source and 0 at the others. So every source becomes its target exactly, and a
source whose target is itself is unchanged. The weights of several sources sum to 1, so each color follows the
sources near it. With a single source, colors far from it are unchanged.

A color that is lighter or darker than the source shifts like new paint in the same light, see `shading`. f_i
is 1 for diffuse colors. For highlights it falls to the share of the source's own color in them. With a single
source it is this share for all colors. The curve of each source bends the lightness by the same weights.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from .oklab import oklab_to_srgb, smoothstep, srgb_to_oklab
from .shading import Shading, measure_shading, relight

COLORS = 5
"""Default number of main colors."""
MIN_SOURCE_DISTANCE = 0.02
"""Smallest kernel distance of two sources; closer sources count as one color."""

_LIGHTNESS_FACTOR = 0.5  # factor on lightness differences, because shading is not another color
_KERNEL_WIDTH_SHARE = (
    0.5  # standard deviation of the kernel, as a share of the mean distance to the nearest source
)
_MIN_KERNEL_WIDTH = 0.04  # smallest standard deviation of the kernel
_SINGLE_KERNEL_WIDTH = 0.055  # standard deviation of the kernel of a single gray source, in hue and chroma
_CHROMA_WIDTH_SHARE = 0.3  # further deviation for colored sources, as a share of the source's chroma
_SHADOW_WIDTH = 0.08  # deviation of the kernel of a single source in lightness, below its shading
_SHADING_REACH = 0.16  # lightness below a single source within which its shading is measured
_WHITE_CHROMA = 0.04  # chroma up to which a surface may be white in colored light
_COLORED_CHROMA = 0.12  # chroma from which a surface is clearly colored
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


def shift_palette(
    lab: Tensor,
    sources: Tensor,
    targets: Tensor,
    curves: Sequence[Curve] = (),
    shadings: Sequence[Shading] = (),
) -> Tensor:
    """Map colors so that sources become targets, all in OKLab. [...,3], [k,3], [k,3] -> [...,3]

    The result may lie outside the gamut.

    Args:
        lab: colors. [...,3]
        sources: source colors, at least `MIN_SOURCE_DISTANCE` apart. [k,3]
        targets: target colors. [k,3]
        curves: lightness curve near each source, applied after the shift; empty, or k
        shadings: measured shading of each source, see `measure_palette`; empty: without highlights
    """
    colors = lab.reshape(-1, 3).double()
    shadings = shadings or [Shading(float(source[0])) for source in sources]
    weights = source_weights(colors, sources.double(), shadings)
    moved = torch.zeros_like(colors)
    for i, shading in enumerate(shadings):
        shift = _paint_shift(
            colors, sources[i].double(), targets[i].double(), shading, is_single=len(sources) == 1
        )
        moved += weights[:, i : i + 1] * shift
    shifted: Tensor = lab + moved.to(lab).reshape(lab.shape)
    if not any(curves):
        return shifted
    before = shifted[..., :1].clamp(0, 1)
    changes = torch.cat([bend_lightness(before, with_highlights(curve)) - before for curve in curves], dim=-1)
    after = before + (weights.to(lab).reshape(changes.shape) * changes).sum(dim=-1, keepdim=True)
    return torch.cat([after, shifted[..., 1:] * chroma_factor(before, after)], dim=-1)


def source_weights(colors: Tensor, sources: Tensor, shadings: Sequence[Shading] = ()) -> Tensor:
    """Return the weight of each source at each color, ≥ 0. OKLab [N,3], [k,3] -> [N,k]

    Args:
        colors: OKLab colors. [N,3]
        sources: source colors, OKLab. [k,3]
        shadings: measured shading of each source; only used for a single source
    """
    if len(sources) == 1:
        return _single_weight(colors, sources[0], shadings[0] if shadings else Shading(float(sources[0, 0])))
    kernel_sources = _kernel_space(sources)
    source_distances = torch.cdist(kernel_sources, kernel_sources)
    squared = torch.cdist(_kernel_space(colors), kernel_sources).square()
    squared = squared - squared.amin(dim=1, keepdim=True)  # a common factor, which cancels
    nearest = (source_distances + torch.eye(len(kernel_sources)) * source_distances.max()).amin(dim=1)
    width = max(_MIN_KERNEL_WIDTH, _KERNEL_WIDTH_SHARE * float(nearest.mean()))
    kernel = torch.exp(-0.5 * squared / width**2)
    source_kernel = torch.exp(-0.5 * (source_distances / width).square())
    weights: Tensor = (kernel @ torch.linalg.inv(source_kernel)).clamp_min(0.0)
    return weights / weights.sum(dim=1, keepdim=True)


def _single_weight(colors: Tensor, source: Tensor, shading: Shading) -> Tensor:
    """Return the weight of a single source: 1 on its surface in any light. OKLab [N,3], [3] -> [N,1]

    It falls with the distance from the source's hue and chroma, whose chroma is scaled to the color's
    lightness. It also falls with the distance below the range of the source's shading.
    """
    own_ab = relight(colors[:, 0], shading, source).chroma[:, None] * source[1:]
    aside = colors[:, 1:] - _presence(colors, own_ab)[:, None] * own_ab
    below = (shading.shadow - colors[:, 0]).clamp_min(0.0)
    variance = _SINGLE_KERNEL_WIDTH**2 + (_CHROMA_WIDTH_SHARE * float(source[1:].norm())) ** 2
    squared = aside.square().sum(dim=1) / variance + (below / _SHADOW_WIDTH).square()
    return torch.exp(-0.5 * squared)[:, None]


def measure_palette(lab: Tensor, weights: Tensor, sources: Tensor) -> tuple[Shading, ...]:
    """Measure the shading of each source from the colors of a region.

    Each color counts by its visible area times its weight for the source, see `source_weights`.

    Args:
        lab: OKLab colors of the region. [N,3]
        weights: visible area of each color, ≥ 0. [N]
        sources: source colors, OKLab. [k,3]

    Returns:
        One shading per source; its typical lightness is the source's.
    """
    near = [
        Shading(float(lightness), shadow=float(lightness) - _SHADING_REACH) for lightness in sources[:, 0]
    ]
    shares = source_weights(lab.double(), sources.double(), near) * weights[:, None].double()
    return tuple(
        measure_shading(lab[:, 0], shares[:, i], float(source[0])) for i, source in enumerate(sources)
    )


def _paint_shift(colors: Tensor, source: Tensor, target: Tensor, shading: Shading, is_single: bool) -> Tensor:
    """Return the shift of colors if the paint of one source becomes the target. OKLab [N,3] -> [N,3]"""
    lightness = colors[:, 0]
    old = relight(lightness, shading, source)
    new = relight(lightness, shading, target)
    own_ab = old.chroma[:, None] * source[1:]
    shift = torch.cat(
        [(new.lightness - old.lightness)[:, None], new.chroma[:, None] * target[1:] - own_ab], dim=1
    )
    presence = _presence(colors, own_ab)
    if is_single:
        return presence[:, None] * shift
    above = (lightness - shading.highlight) / max(1.0 - shading.highlight, 1e-6)
    fade = 1.0 - above.clamp(0, 1) * (1.0 - presence)
    return fade[:, None] * shift


def _presence(colors: Tensor, own_ab: Tensor) -> Tensor:
    """Return the share of a surface's own color in colors, 0 to 1. OKLab [N,3], [N,2] -> [N]

    It is 0 for a white highlight on a colored surface, and 1 for every gray on a nearly white surface.
    """
    energy = own_ab.square().sum(dim=1)
    share = (colors[:, 1:] * own_ab).sum(dim=1) / energy.clamp_min(1e-6)
    is_colored = smoothstep(energy.sqrt(), _WHITE_CHROMA, _COLORED_CHROMA)
    return 1.0 - is_colored * (1.0 - share.clamp(0, 1))


def with_highlights(curve: Curve) -> Curve:
    """Return the curve of a source color with an end for highlights.

    With the last point (x, y), the end maps white to y plus the linear light that white has above x. A curve
    with a point at 1, and an empty curve, are unchanged.
    """
    if not curve or curve[-1][0] >= 1.0:
        return curve
    x, y = curve[-1]
    return (*curve, (1.0, min(1.0, (y**3 + 1.0 - x**3) ** (1 / 3))))


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
