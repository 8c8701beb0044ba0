"""Properties of Gaussians as numbers on an axis, and their histograms."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.color.oklab import srgb_to_oklab
from progdf.gaussians import Gaussians
from progdf.scene.neighbors import SURFACE_NEIGHBORS, surface_distances
from progdf.sh import sh0_to_rgb
from progdf.system.equality import equal_fields

BINS = 64
_FALLOFF = 0.001  # share of the values that are left out at each end of the axis

Values = NDArray[np.float32]


@dataclass(frozen=True)
class Property:
    """Property of a Gaussian: its name, a function of a scene, and the text of a value."""

    name: str
    help: str  # definition, for a tooltip
    values: Callable[[Gaussians], Values]  # position on the axis, not finite where it is unknown. [N]
    text: Callable[[float, float], str]  # text of a position, given the true length of a world unit
    us: float = 0.3  # processor time per Gaussian, µs


@dataclass(frozen=True)
class Distribution:
    """Histogram of one property."""

    __eq__ = equal_fields

    values: Values  # of every Gaussian. [N]
    low: float  # ends of the axis
    high: float
    counts: NDArray[np.int64]  # Gaussians per bin. [BINS]


def distribution(scene: Gaussians, name: str) -> Distribution:
    """Return the histogram of a property over a scene. `name`: key of `PROPERTIES`"""
    values = PROPERTIES[name].values(scene)
    finite = values[np.isfinite(values)]
    if not len(finite):
        return Distribution(values, 0.0, 1.0, np.zeros(BINS, np.int64))
    low, high = (float(end) for end in np.quantile(finite, (_FALLOFF, 1.0 - _FALLOFF)))
    high = max(high, low + 1e-6)
    clipped = finite.clip(low, high)  # the first and last bin also count the values beyond
    counts = np.histogram(clipped, BINS, (low, high))[0]
    return Distribution(values, low, high, counts)


def rows_between(found: Distribution, low: float, high: float) -> NDArray[np.bool_]:
    """Return the Gaussians whose value is in a range; an end of the axis includes all beyond it. [N]"""
    lower = -np.inf if low <= found.low else low
    upper = np.inf if high >= found.high else high
    with np.errstate(invalid="ignore"):
        mask: NDArray[np.bool_] = (found.values >= lower) & (found.values <= upper)
    return mask & np.isfinite(found.values)


def _sorted_scales(scene: Gaussians) -> torch.Tensor:
    ascending: torch.Tensor = scene.log_scales.sort(dim=1).values
    return ascending / math.log(10.0)


def _size(scene: Gaussians) -> Values:
    return np.asarray(_sorted_scales(scene)[:, 2].numpy(), np.float32)


def _needle(scene: Gaussians) -> Values:
    scales = _sorted_scales(scene)
    return np.asarray((scales[:, 2] - scales[:, 1]).numpy(), np.float32)


def _flatness(scene: Gaussians) -> Values:
    scales = _sorted_scales(scene)
    return np.asarray((scales[:, 1] - scales[:, 0]).numpy(), np.float32)


def _opacity(scene: Gaussians) -> Values:
    return np.asarray(scene.opacities.numpy(), np.float32)


def _lab(scene: Gaussians) -> NDArray[np.float32]:
    return np.asarray(srgb_to_oklab(sh0_to_rgb(scene.sh0).clamp(0.0, 1.0)).numpy(), np.float32)


def _lightness(scene: Gaussians) -> Values:
    return _lab(scene)[:, 0]


def _chroma(scene: Gaussians) -> Values:
    lab = _lab(scene)
    return np.asarray(np.hypot(lab[:, 1], lab[:, 2]), np.float32)


def _hue(scene: Gaussians) -> Values:
    lab = _lab(scene)
    degrees = np.degrees(np.arctan2(lab[:, 2], lab[:, 1])) % 360.0
    gray = np.hypot(lab[:, 1], lab[:, 2]) < MIN_CHROMA
    return np.asarray(np.where(gray, np.nan, degrees), np.float32)


def _surface(scene: Gaussians) -> Values:
    distances = surface_distances(scene)
    # a smaller distance is the rounding of the positions
    finest = np.finfo(np.float32).eps * np.nan_to_num(scene.means.abs().numpy(), posinf=0.0).max(
        initial=1e-30
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(np.log10(np.maximum(distances, finest)), np.float32)


MIN_CHROMA = 0.02
"""OKLab chroma below which a color has no hue."""

PROPERTIES = {
    "size": Property("Size", "Longest standard deviation", _size, lambda at, unit: f"{unit * 10.0**at:.3g}"),
    "opacity": Property("Opacity", "Opacity at the center", _opacity, lambda at, _: f"{100.0 * at:.0f} %"),
    "needle": Property(
        "Needle", "Longest axis divided by the second one", _needle, lambda at, _: f"{10.0**at:.3g} : 1"
    ),
    "flatness": Property(
        "Flatness", "Second axis divided by the shortest one", _flatness, lambda at, _: f"{10.0**at:.3g} : 1"
    ),
    "surface": Property(
        "Surface",
        f"Distance of the center from the disc through its {SURFACE_NEIGHBORS} nearest opaque splats",
        _surface,
        lambda at, unit: f"{unit * 10.0**at:.3g}",
        us=10.0,
    ),
    "lightness": Property("Lightness", "OKLab lightness", _lightness, lambda at, _: f"{100.0 * at:.0f} %"),
    "chroma": Property("Chroma", "OKLab chroma: 0 is gray", _chroma, lambda at, _: f"{at:.2f}"),
    "hue": Property("Hue", "OKLab hue; gray splats have none", _hue, lambda at, _: f"{at:.0f}°"),
}
"""Properties by key. Colors are those without view dependence."""
