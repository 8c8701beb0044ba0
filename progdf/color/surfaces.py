"""Surfaces of a region: its main colors by k-means, with the shades of one surface grouped.

Two main colors have one paint if the lighter one in less light, with all of OKLab scaled, is the darker one
up to the color of the light. A paint is one surface as long as its colors continue through all lightness
between light and shadow, and several if its lightness falls into groups, as of white paper and black ink. The
region's own distribution decides, by the first of two measures that finds groups:

- Between two peaks, the area per lightness falls below half of the lower one. This finds a small group.
- The division into two groups explains more of the variance (Otsu 1979) than it does for evenly distributed
  lightness. This finds two groups although pixels on their edges mix both. Their mean light differs by more
  than between the lit and the shaded side of one surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.system.equality import equal_fields
from progdf.threads import one_thread

from .oklab import srgb_to_oklab
from .shading import JND, weighted_quantiles

COLORS = 5
"""Default number of main colors."""
MIN_SOURCE_DISTANCE = 0.02
"""Smallest kernel distance of two sources; closer sources count as one color."""
WHITE_CHROMA = 0.04
"""Chroma up to which a surface may be white in colored light.

White in CIE daylight of 5 200 to 8 500 K, from direct sun to an overcast sky, has it in a picture that is
balanced for 6 500 K.
"""
EVEN_SEPARATION = 0.75
"""Share of the variance that the best division into two explains for evenly distributed values."""
LIGHTING_RATIO = 4.0
"""Largest ratio of the light on the lit and the shaded side of one surface.

It is two stops, the contrast of a portrait with one lamp and fill light. A larger step within one paint is
seen as another surface.
"""

_LIGHTNESS_FACTOR = 0.5  # factor on lightness differences, because shading is not another color
_ITERATIONS = 20  # iterations of k-means
_CELL_SIDE = 0.04  # side of the cells in which colors are counted
_MIN_SHARE = 0.003  # smallest share of the visible area for a main color
_LEVEL_HEIGHT = 0.04  # lightness of a level in which area is counted
_HALF_MAXIMUM = 0.5  # share of the lower of two peaks at which they are resolved


@dataclass(frozen=True)
class Surface:
    """Surface of a region, in all light."""

    __eq__ = equal_fields

    shades: Tensor  # main colors; OKLab. [s,3]
    areas: Tensor  # visible area nearest to each, in the unit of the weights. [s]

    @property
    def color(self) -> Tensor:
        """Shade at the median lightness by area. [3]"""
        (median,) = weighted_quantiles(self.shades[:, 0], self.areas, (0.5,))
        return self.shades[int((self.shades[:, 0] - median).abs().argmin())]


def kernel_space(lab: Tensor) -> Tensor:
    """Convert OKLab to the space of kernel distances, with scaled lightness. [...,3] -> [...,3]"""
    return lab * lab.new_tensor([_LIGHTNESS_FACTOR, 1.0, 1.0])


@one_thread()  # the order of a large sum, and so its rounding, depends on the number of threads
def find_surfaces(rgb: Tensor, weights: Tensor, count: int = COLORS) -> list[Surface]:
    """Return the surfaces of a region, in descending order of area.

    Args:
        rgb: sRGB colors, 0 to 1. [N,3]
        weights: visible area of each color, ≥ 0. [N]
        count: largest number of main colors
    """
    is_visible = weights > 0
    lab = srgb_to_oklab(rgb[is_visible].clamp(0, 1).double())
    weights = weights[is_visible].double()
    if not len(lab):
        return []
    centers, nearest = _main_colors(kernel_space(lab), weights, count)
    covered = weights.new_zeros(len(centers)).index_add_(0, nearest, weights)
    main: list[int] = []
    for i in covered.argsort(descending=True).tolist():
        is_distinct = all(float((centers[i] - centers[j]).norm()) >= 2 * MIN_SOURCE_DISTANCE for j in main)
        if is_distinct and float(covered[i]) >= _MIN_SHARE * float(weights.sum()):
            main.append(i)
    if not main:
        return []
    # the colors of a dropped center belong to the nearest main one, so that they leave no gap
    owner = torch.tensor(main)[torch.cdist(centers, centers[main]).argmin(dim=1)]
    nearest = owner[nearest]
    covered = weights.new_zeros(len(centers)).index_add_(0, nearest, weights)
    colors = centers / kernel_space(centers.new_ones(3))
    surfaces: list[Surface] = []
    for paint in _group_paints(colors, main):
        own = torch.isin(nearest, torch.tensor(paint))
        borders = lightness_borders(lab[own, 0], weights[own])
        side = torch.bucketize(colors[paint, 0].contiguous(), colors.new_tensor(borders))
        for part in torch.unique(side).tolist():
            shades = [paint[i] for i in (side == part).nonzero()[:, 0].tolist()]
            surfaces.append(Surface(colors[shades], covered[shades]))
    return sorted(surfaces, key=lambda surface: -float(surface.areas.sum()))


def _main_colors(colors: Tensor, weights: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the centers of k-means and the nearest one of each color. Kernel space [N,3] -> [k,3], [N]"""
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
    return centers, nearest[own]


def _group_paints(colors: Tensor, main: Sequence[int]) -> list[list[int]]:
    """Group main colors of one paint, also through others of it. OKLab [k,3] -> indices, in order"""
    groups: list[list[int]] = []
    for i in main:
        joined = [group for group in groups if any(is_one_paint(colors[i], colors[j]) for j in group)]
        groups = [group for group in groups if group not in joined]
        merged = {i, *(j for group in joined for j in group)}
        groups.append([j for j in main if j in merged])
    return groups


def is_one_paint(a: Tensor, b: Tensor) -> bool:
    """Return whether two colors differ by the strength and the color of the light alone. OKLab [3], [3]"""
    light, dark = (a, b) if a[0] > b[0] else (b, a)
    share = float(dark[0]) / max(float(light[0]), 1e-6)
    return float((share * light - dark)[1:].norm()) <= max(WHITE_CHROMA * float(dark[0]), JND)


def lightness_borders(lightness: Tensor, weights: Tensor) -> list[float]:
    """Return the borders between the groups of lightness of one paint, in ascending order; empty for one.

    Args:
        lightness: OKLab lightness, 0 to 1. [N]
        weights: visible area, ≥ 0. [N]
    """
    valleys = _valleys(lightness, weights)
    if valleys:
        return valleys
    border, explained = best_division(lightness, weights)
    if explained <= EVEN_SEPARATION:
        return []
    dark, light = (
        float((lightness * weights)[side].sum() / weights[side].sum())
        for side in (lightness < border, lightness >= border)
    )
    return [border] if light**3 > LIGHTING_RATIO * dark**3 else []


def best_division(values: Tensor, weights: Tensor) -> tuple[float, float]:
    """Return the border of the two groups that explain most of the variance, and the explained share.

    Args:
        values: any values. [N]
        weights: ≥ 0. [N]
    """
    order = values.argsort()
    ordered = values[order].double()
    parts = weights[order].double() / weights.sum()
    mean = (parts * ordered).sum()
    variance = float((parts * (ordered - mean).square()).sum())
    below = parts.cumsum(dim=0)[:-1]
    sums = (parts * ordered).cumsum(dim=0)[:-1]
    explained = (mean * below - sums).square() / (below * (1.0 - below)).clamp_min(1e-12)
    if not len(explained) or variance <= 1e-12:
        return float(mean), 0.0
    best = int(explained.argmax())
    return float(ordered[best : best + 2].mean()), float(explained[best]) / variance


def _valleys(lightness: Tensor, weights: Tensor) -> list[float]:
    """Return the lightness of all valleys, in ascending order; see `_deepest_valley`."""
    valley = _deepest_valley(lightness, weights)
    if valley is None:
        return []
    is_below = lightness < valley
    below = _valleys(lightness[is_below], weights[is_below])
    above = _valleys(lightness[~is_below], weights[~is_below])
    return [*below, valley, *above]


def _deepest_valley(lightness: Tensor, weights: Tensor) -> float | None:
    """Return the lightness at which the area is lowest relative to peaks on both sides; None above half."""
    levels = (lightness / _LEVEL_HEIGHT).long().clamp_min(0)
    area = weights.new_zeros(int(1.0 / _LEVEL_HEIGHT) + 2).index_add_(0, levels, weights)
    outside = area.new_zeros(1)
    area = 0.25 * torch.cat([outside, area[:-1]]) + 0.5 * area + 0.25 * torch.cat([area[1:], outside])
    lower_peak = torch.minimum(area.cummax(dim=0).values, area.flip(0).cummax(dim=0).values.flip(0))
    share = torch.where(lower_peak > 0, area / lower_peak.clamp_min(1e-12), 1.0)
    lowest = (share == share.amin()).nonzero()[:, 0].double().mean()
    return None if float(share.amin()) >= _HALF_MAXIMUM else float((lowest + 0.5) * _LEVEL_HEIGHT)
