"""Main colors of a region, and a color map that moves source colors to target colors.

The map moves a color x by Σ_i w_i(x) f_i(x) (t_i(x) − p_i(x)), in OKLab, for sources p_i and targets t_i. The
weights w_i are an interpolation by Gaussian kernels (Chang et al., Palette-based Photo Recoloring, SIGGRAPH
2015). A weight is 1 at its own source and 0 at the others. So every source becomes its target exactly, and a
source whose target is itself is unchanged. The weights of several sources sum to 1, so each color follows the
sources near it. With a single source, colors far from it are unchanged. A source moves all shades of its
surface that are not sources themselves: w_i is the sum of their weights.

A color that is lighter or darker than the source shifts like new paint in the same light, see `shading`. f_i
is 1 for diffuse colors. For highlights it falls to the share of the source's own color in them. With a single
source it is this share for all colors. The curve of each source bends the lightness by the same weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from .oklab import oklab_to_srgb, smoothstep, srgb_to_oklab
from .shading import JND, Shading, measure_shading, relight
from .surfaces import COLORS, MIN_SOURCE_DISTANCE, WHITE_CHROMA, find_surfaces, kernel_space

_KERNEL_WIDTH_SHARE = (
    0.5  # standard deviation of the kernel, as a share of the mean distance to the nearest source
)
_MIN_KERNEL_WIDTH = 0.04  # smallest standard deviation of the kernel
_SINGLE_KERNEL_WIDTH = 0.055  # standard deviation of the kernel of a single gray source, in hue and chroma
_CHROMA_WIDTH_SHARE = 0.3  # further deviation for colored sources, as a share of the source's chroma
_SHADOW_WIDTH = 0.08  # deviation of the kernel of a single source in lightness, below its shading
_SHADING_REACH = 0.16  # lightness below a single source within which its shading is measured
# chroma from which a surface has a color of its own: in a picture that is balanced for daylight, white has
# 0.11 under a clear blue sky (20 000 K) and 0.12 under a lamp (3 400 K)
_COLORED_CHROMA = 0.12
_CURVE_STEPS = 1024  # linear pieces of a tabulated curve

Curve = tuple[tuple[float, float], ...]
"""Points (input, output) of a lightness curve, 0 to 1, in ascending order of input; see `bend_lightness`.

An empty curve changes nothing.
"""


def find_palette(rgb: Tensor, weights: Tensor, count: int = COLORS) -> Tensor:
    """Return the main color of each surface, in descending order of area; see `progdf.color.surfaces`.

    Args:
        rgb: sRGB colors, 0 to 1. [N,3]
        weights: visible area of each color, ≥ 0. [N]
        count: largest number of main colors, shades of one surface included

    Returns:
        sRGB colors [k,3], k ≤ `count`; [0,3] if all weights are 0.
    """
    surfaces = find_surfaces(rgb, weights, count)
    if not surfaces:
        return rgb.new_zeros(0, 3)
    colors = torch.stack([surface.color for surface in surfaces])
    return oklab_to_srgb(colors).clamp(0, 1).to(rgb)


def are_alike(a: Tensor, b: Tensor) -> bool:
    """Return whether two sRGB colors [3] are too close to be separate sources."""
    return (
        float((kernel_space(srgb_to_oklab(a)) - kernel_space(srgb_to_oklab(b))).norm()) < MIN_SOURCE_DISTANCE
    )


def shift_palette(
    lab: Tensor,
    sources: Tensor,
    targets: Tensor,
    curves: Sequence[Curve] = (),
    shadings: Sequence[Shading] = (),
    shades: Sequence[Tensor] = (),
    ranges: Sequence[float] = (),
) -> Tensor:
    """Map colors so that sources become targets, all in OKLab. [...,3], [k,3], [k,3] -> [...,3]

    The result may lie outside the gamut.

    Args:
        lab: colors. [...,3]
        sources: source colors, at least `MIN_SOURCE_DISTANCE` apart. [k,3]
        targets: target colors. [k,3]
        curves: lightness curve near each source, applied after the shift; empty, or k
        shadings: measured shading of each source, see `measure_palette`; empty: without highlights
        shades: colors that move with each source, see `find_shades`; empty, or k. [s,3] each
        ranges: factor on the reach of each source; empty, or k. Sources stay exact for any range
    """
    colors = lab.reshape(-1, 3).double()
    shadings = shadings or [Shading(float(source[0])) for source in sources]
    weights = source_weights(colors, sources.double(), shadings, shades, ranges)
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


def source_weights(
    colors: Tensor,
    sources: Tensor,
    shadings: Sequence[Shading] = (),
    shades: Sequence[Tensor] = (),
    ranges: Sequence[float] = (),
) -> Tensor:
    """Return the weight of each source at each color, ≥ 0. OKLab [N,3], [k,3] -> [N,k]

    Args:
        colors: OKLab colors. [N,3]
        sources: source colors, OKLab. [k,3]
        shadings: measured shading of each source; only used for a single source
        shades: further colors at which the weight of each source is 1; empty, or k. [s,3] each
        ranges: factor on the reach of each source; empty, or k. A factor moves the borders to its neighbors
    """
    squared_ranges = colors.new_tensor(ranges).square() if ranges else colors.new_ones(len(sources))
    if len(sources) == 1:
        shading = shadings[0] if shadings else Shading(float(sources[0, 0]))
        # a power of a Gaussian kernel is one of another width
        return _single_weight(colors, sources[0], shading).pow(1.0 / squared_ranges)
    owners = torch.tensor([*range(len(sources)), *(i for i, own in enumerate(shades) for _ in own)])
    kernel_sources = kernel_space(torch.cat([sources, *(own.to(sources) for own in shades)]))
    source_distances = torch.cdist(kernel_sources, kernel_sources)
    squared = torch.cdist(kernel_space(colors), kernel_sources).square()
    squared = squared - squared.amin(dim=1, keepdim=True)  # a common factor, which cancels
    nearest = (source_distances + torch.eye(len(kernel_sources)) * source_distances.max()).amin(dim=1)
    width = max(_MIN_KERNEL_WIDTH, _KERNEL_WIDTH_SHARE * float(nearest.mean()))
    kernel = torch.exp(-0.5 * squared / width**2)
    source_kernel = torch.exp(-0.5 * (source_distances / width).square())
    parts: Tensor = (kernel @ torch.linalg.inv(source_kernel)).clamp_min(0.0)
    weights = torch.zeros_like(parts[:, : len(sources)]).index_add_(1, owners, parts)
    weights = weights * squared_ranges
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


def find_shades(rgb: Tensor, weights: Tensor, sources: Tensor) -> tuple[Tensor, ...]:
    """Return the shades that move with each source: main colors of its surface that are no sources.

    A single source has none, because it changes its surface in any light.

    Args:
        rgb: sRGB colors of the region, 0 to 1. [N,3]
        weights: visible area of each color, ≥ 0. [N]
        sources: source colors, OKLab. [k,3]

    Returns:
        OKLab colors of each source. [s,3] each, s ≥ 0
    """
    shades = [sources[:0] for _ in sources]
    if len(sources) == 1:
        return tuple(shades)
    for surface in find_surfaces(rgb, weights):
        colors = surface.shades.to(sources)
        distances = torch.cdist(kernel_space(colors), kernel_space(sources))
        is_same = distances < 2 * MIN_SOURCE_DISTANCE
        owners = is_same.any(dim=0)  # the sources on this surface
        if not bool(owners.any()):
            continue
        nearest = torch.where(owners, distances, torch.inf).argmin(dim=1)
        for i in owners.nonzero()[:, 0].tolist():
            shades[i] = torch.cat([shades[i], colors[(nearest == i) & ~is_same.any(dim=1)]])
    return tuple(shades)


def measure_palette(
    lab: Tensor, weights: Tensor, sources: Tensor, shades: Sequence[Tensor] = ()
) -> tuple[Shading, ...]:
    """Measure the shading of each source from the colors of a region.

    Each color counts by its visible area times its weight for the source, see `source_weights`.

    Args:
        lab: OKLab colors of the region. [N,3]
        weights: visible area of each color, ≥ 0. [N]
        sources: source colors, OKLab. [k,3]
        shades: colors that move with each source, see `find_shades`; empty, or k. [s,3] each

    Returns:
        One shading per source; its typical lightness is the source's.
    """
    near = [
        Shading(float(lightness), shadow=float(lightness) - _SHADING_REACH) for lightness in sources[:, 0]
    ]
    shares = source_weights(lab.double(), sources.double(), near, shades) * weights[:, None].double()
    return tuple(
        measure_shading(lab[:, 0], shares[:, i], float(source[0])) for i, source in enumerate(sources)
    )


def _paint_shift(colors: Tensor, source: Tensor, target: Tensor, shading: Shading, is_single: bool) -> Tensor:
    """Return the shift of colors if the paint of one source becomes the target. OKLab [N,3] -> [N,3]

    The difference of a color from the source's hue stays. On a nearly white source it is the color of the
    light, so darker paint has less of it. Paint of another hue has none of it, as in a recolor: it would
    change the hue, and white in cool light would become salmon instead of orange.
    """
    lightness = colors[:, 0]
    old = relight(lightness, shading, source)
    new = relight(lightness, shading, target)
    own_ab = old.chroma[:, None] * source[1:]
    is_white = 1.0 - smoothstep(own_ab.norm(dim=1), WHITE_CHROMA, _COLORED_CHROMA)
    is_repainted = smoothstep((target - source)[1:].norm(), JND, WHITE_CHROMA)
    dimming = chroma_factor(old.lightness, new.lightness)
    lost = is_white * (1.0 - (1.0 - is_repainted) * dimming)
    light_ab = lost[:, None] * (colors[:, 1:] - own_ab)
    shift_ab = new.chroma[:, None] * target[1:] - own_ab - light_ab
    shift = torch.cat([(new.lightness - old.lightness)[:, None], shift_ab], dim=1)
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
    is_colored = smoothstep(energy.sqrt(), WHITE_CHROMA, _COLORED_CHROMA)
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
    steps = torch.from_numpy(_curve_table(tuple(curve))).to(lightness).clamp(0, 1)
    position = lightness.clamp(0, 1) * _CURVE_STEPS
    below = position.floor().long().clamp_max(_CURVE_STEPS - 1)
    return torch.lerp(steps[below], steps[below + 1], position - below)


@lru_cache(maxsize=64)
def _curve_table(curve: Curve) -> NDArray[np.float64]:
    """Return the outputs of a curve for inputs from 0 to 1. [`_CURVE_STEPS` + 1]"""
    points = dict([(0.0, 0.0), (1.0, 1.0), *curve])
    inputs = sorted(points)
    table: NDArray[np.float64] = PchipInterpolator(inputs, [points[x] for x in inputs])(
        np.linspace(0.0, 1.0, _CURVE_STEPS + 1)
    )
    return table
