"""Shading of a surface: its lightness range, measured from its colors, and another paint in the same light.

A color is the surface's own color in more or less light, plus highlights in the color of the light (the
dichromatic reflection model, Shafer 1985). New paint keeps both parts:

- Diffuse lightness is scaled, as in the same light. The scale of lighter parts is smaller if the region's
  range of lightness would otherwise exceed white, or the gamut at the paint's chroma.
- Highlights start above the region's range of diffuse lightness. They add the same light to the new color.
  Paint with less distance to white gets less: a highlight covers at most the same share of this distance. So
  a pale patch of the surface stays pale, and only white becomes white.

The range of white paint reaches white. It therefore has no highlights that would stay white.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.system.equality import equal_fields
from progdf.threads import one_thread

from .oklab import oklab_to_srgb, srgb_to_oklab

BLACK_PAINT = 16 / 255
"""sRGB value of the darkest paint: its shading remains visible in 8 bits."""
JND = 0.02
"""Just noticeable difference in OKLab (CSS Color 4)."""
MAX_SLOPE_RATIO = 2.5
"""Largest ratio of the slopes below and above the typical lightness.

Of normally distributed lightness, a kink of this ratio keeps a correlation of 0.97.
"""

_FENCE = 1.5  # interquartile ranges above the upper quartile at which outliers begin (Tukey's fence)
_EPSILON = 1e-3  # smallest lightness and lightness range, against division by 0
_BISECTIONS = 12  # steps to an accuracy of 2e-4 in lightness
_GAMUT_TOLERANCE = 1e-3  # accepted excess over the sRGB range


@dataclass(frozen=True)
class Shading:
    """Range of a surface's diffuse lightness in the light of the scene; OKLab, 0 to 1."""

    typical: float  # lightness that becomes the lightness of new paint
    highlight: float = 1.0  # largest diffuse lightness, ≥ typical; lighter colors are highlights
    knee: float = 0.0  # width of the transition above `highlight`, in lightness
    shadow: float = 0.0  # smallest diffuse lightness, ≤ typical; darker colors are other surfaces

    def describe(self) -> str:
        """Return the range as words for the log."""
        return f"lightness {self.typical:.2f}, highlights above {self.highlight:.2f}"


@dataclass(frozen=True)
class Relit:
    """Lightness of new paint in the same light, and its chroma as a share of the paint's."""

    __eq__ = equal_fields

    lightness: Tensor  # 0 to 1. [...]
    chroma: Tensor  # ≥ 0. [...]


@one_thread()  # the order of a large sum, and so its rounding, depends on the number of threads
def weighted_quantiles(values: Tensor, weights: Tensor, shares: tuple[float, ...]) -> list[float]:
    """Return the values below which these shares, 0 to 1, of the total weight lie. [N], [N]"""
    order = values.argsort()
    totals = weights[order].double().cumsum(dim=0)
    places = torch.searchsorted(totals, totals[-1] * totals.new_tensor(shares))
    return [float(value) for value in values[order][places.clamp_max(len(values) - 1)]]


def measure_shading(lightness: Tensor, weights: Tensor, typical: float | None = None) -> Shading:
    """Measure the shading of a surface from its colors.

    The range of diffuse lightness ends at the outliers of the lightness, by Tukey's inner fences. From the
    upper outer fence on, all further light is a highlight.

    Args:
        lightness: OKLab lightness of the colors, 0 to 1. [N]
        weights: visible area of each color, ≥ 0. [N]
        typical: typical lightness; None for the median
    """
    is_visible = weights > 0
    if not bool(is_visible.any()):
        return Shading(0.5 if typical is None else typical)
    lightness = lightness[is_visible]
    lower, median, upper = weighted_quantiles(lightness, weights[is_visible], (0.25, 0.5, 0.75))
    reach = _FENCE * (upper - lower) + _EPSILON
    largest = float(lightness[lightness <= upper + reach].amax())
    smallest = float(lightness[lightness >= lower - reach].amin())
    center = median if typical is None else typical
    return Shading(
        center,
        highlight=min(max(largest, center), 1.0),
        knee=reach,
        shadow=max(min(smallest, center), 0.0),
    )


def relight(lightness: Tensor, shading: Shading, paint: Tensor) -> Relit:
    """Return lightness and chroma of new paint on a surface, in the same light. [...]

    The result rises with the lightness, less in lighter parts if sRGB has no lighter color of this chroma.
    Gray paint with the surface's typical lightness keeps the lightness.

    Args:
        lightness: OKLab lightness of the surface, 0 to 1. [...]
        shading: measured range of the surface
        paint: OKLab color that the typical lightness becomes. [3]
    """
    goal = paint_lightness(shading, float(paint[0]))
    below, above = _slopes(shading, goal, paint)
    diffuse = _diffuse_part(lightness, shading)
    offset = diffuse - shading.typical
    painted = goal + torch.where(offset < 0, below, above) * offset
    painted = torch.where(offset > 0, torch.minimum(painted, _towards_white(offset, shading, goal)), painted)
    # light adds up in linear light, of which the lightness is the cube root
    added = (lightness**3 - diffuse**3).clamp_min(0.0)
    added *= ((1.0 - painted**3) / (1.0 - diffuse**3).clamp_min(_EPSILON)).clamp(0.0, 1.0)
    total = (painted.clamp_min(0.0) ** 3 + added) ** (1 / 3)
    chroma = painted.clamp_min(0.0) / goal * (painted / total.clamp_min(_EPSILON)).clamp(0, 1) ** 2
    is_highlight = added > 0
    total = torch.where(is_highlight, total, painted).clamp(0, 1)
    return Relit(total, torch.where(is_highlight, chroma, (painted / goal).clamp_min(0.0)))


def _towards_white(offset: Tensor, shading: Shading, goal: float) -> Tensor:
    """Return the largest lightness of new paint at lightnesses above the typical one. [...] -> [...]

    It begins with the slope of the same light and bends so that only white becomes white. It is never below
    a straight line to white, so it bounds no paint that is darker than the surface.

    Args:
        offset: difference from the typical lightness, ≥ 0. [...]
        shading: measured range of the surface
        goal: lightness that the typical one becomes, 0 to 1
    """
    start = max(shading.typical, _EPSILON)
    share = offset / max(1.0 - start, _EPSILON)
    steepness = max(goal / start * (1.0 - start) / max(1.0 - goal, _EPSILON), 1.0)
    return goal + (1.0 - goal) * steepness * share / (1.0 + (steepness - 1.0) * share)


def _diffuse_part(lightness: Tensor, shading: Shading) -> Tensor:
    """Return the lightness without highlights, whose share grows from 0 to 1 over the knee. [...] -> [...]"""
    start = max(shading.highlight, shading.typical)
    width = max(shading.knee, _EPSILON)
    share = ((lightness - start) / width).clamp(0, 1)
    return torch.where(lightness <= start, lightness, start + width * (share - 0.5 * share.square()))


def paint_lightness(shading: Shading, lightness: float) -> float:
    """Return the lightness of a paint on a surface, within the range that leaves room for the shading.

    White paint is darkened so far that the surface's lighter parts stay distinct. Black paint is at least
    `BLACK_PAINT`, unless the surface is darker.

    Args:
        shading: measured range of the surface
        lightness: chosen OKLab lightness of the paint, 0 to 1

    """
    start = max(shading.typical, _EPSILON)
    room = max(shading.highlight, start) - start
    darkest = max(min(float(srgb_to_oklab(torch.full((3,), BLACK_PAINT))[0]), start), _EPSILON)
    gain = max(lightness / start, 1.0)
    return max(min(lightness, 1.0 - room / (MAX_SLOPE_RATIO * gain)), darkest)


def _slopes(shading: Shading, goal: float, paint: Tensor) -> tuple[float, float]:
    """Return the slopes of the new lightness over the old, below and above the typical lightness.

    Args:
        shading: measured range of the surface
        goal: lightness that the typical one becomes, 0 to 1
        paint: OKLab color of the paint. [3]
    """
    start = max(shading.typical, _EPSILON)
    gain = goal / start
    room = max(shading.highlight - start, _EPSILON)
    chroma = float(paint[1:].norm())
    paler = paint[1:] * (max(chroma - JND, 0.0) / max(chroma, _EPSILON))
    headroom = brightest_lightness(goal, paler) - goal
    above = min(gain, max(min(gain, 1.0 / gain) / MAX_SLOPE_RATIO, headroom / room))
    return min(gain, MAX_SLOPE_RATIO * above), above


def brightest_lightness(lightness: float, ab: Tensor) -> float:
    """Return the largest lightness from `lightness` on at which sRGB has the chroma and hue `ab`. [2]

    If sRGB does not have this color at `lightness`, the result is `lightness`.
    """
    return _last_inside(lightness, 1.0, ab)


def nearest_lightness(lightness: float, ab: Tensor) -> float:
    """Return the lightness nearest to `lightness` at which sRGB has the chroma and hue `ab`. [2]

    If there is none, the result is the lightness at which the color exceeds the sRGB range least.
    """
    steps = torch.linspace(0, 1, 512)
    excess = _excess(steps, ab)
    fits = excess <= _GAMUT_TOLERANCE
    if not bool(fits.any()):
        return float(steps[excess.argmin()])
    distance = torch.where(fits, (steps - lightness).abs(), math.inf)
    nearest = float(steps[distance.argmin()])
    return lightness if float(_excess(torch.tensor([lightness]), ab)) <= _GAMUT_TOLERANCE else nearest


def _last_inside(low: float, high: float, ab: Tensor) -> float:
    """Return the largest lightness from `low` to `high` at which sRGB has the chroma and hue `ab`. [2]"""
    if float(_excess(torch.tensor([high]), ab)) <= _GAMUT_TOLERANCE:
        return high
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if float(_excess(torch.tensor([middle]), ab)) <= _GAMUT_TOLERANCE:
            low = middle
        else:
            high = middle
    return low


def _excess(lightness: Tensor, ab: Tensor) -> Tensor:
    """Return the largest excess over the sRGB range at these lightnesses. [N], [2] -> [N]"""
    lab = torch.cat([lightness[:, None], ab.to(lightness).expand(len(lightness), 2)], dim=1)
    return (oklab_to_srgb(lab) - 0.5).abs().amax(dim=1) - 0.5
