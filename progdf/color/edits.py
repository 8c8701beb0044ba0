"""Color edits as pure functions of colors and strength, for pixels and Gaussians alike.

Every function maps encoded (not linear) sRGB colors, 0 to 1, of any shape [...,3] to the same shape. At
strength 0 it returns the input bit for bit, and the result is continuous in the strength.
`progdf.color.oklab` defines hue, chroma and lightness, and the path of a color from the original to the full
edit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.system.equality import equal_fields
from progdf.threads import one_thread

from .oklab import (
    STRAIGHT,
    ColorPath,
    Strength,
    bend_of,
    color_path,
    fit_gamut,
    hue_of,
    oklab_to_srgb,
    smoothstep,
    srgb_to_oklab,
)
from .shading import Shading, measure_shading, nearest_lightness, relight, weighted_quantiles

ColorFunction = Callable[[Strength], Tensor]
"""Function from a strength to colors [...,3]: the path of an edit."""

_MIN_CHROMA = 0.015  # smallest chroma of a target with a hue
_TINT_SHARE = 0.7  # share of hue and chroma that a tint takes from its color
_MOON_SHARE = 0.75  # share of hue and chroma that night takes from the moonlight
_MOONLIGHT = (0.35, 0.50, 0.85)  # sRGB


def parse_color(text: str) -> Tensor:
    """Return the sRGB color of `#rrggbb` or `#rgb`, the `#` optional. [3] float32

    Raises:
        ProgdfError: the text is not a color.
    """
    digits = text.strip().removeprefix("#")
    if len(digits) == 3:
        digits = "".join(2 * digit for digit in digits)
    if len(digits) != 6 or any(digit not in "0123456789abcdefABCDEF" for digit in digits):
        raise ProgdfError(f"'{text}' is not a color; write it as #rrggbb, for example #d4af37")
    return torch.tensor([int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)])


def hex_color(color: Sequence[float]) -> str:
    """Return `#rrggbb` for a color, 0 to 1."""
    return "#" + "".join(f"{round(255 * min(max(channel, 0.0), 1.0)):02x}" for channel in color)


@one_thread()  # the order of a large sum, and so its rounding, depends on the number of threads
def typical_color(rgb: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return the weighted mean color, averaged in OKLab. [...,3], [...] or None -> [3]"""
    lab = srgb_to_oklab(rgb.clamp(0, 1)).reshape(-1, 3)
    w = torch.ones_like(lab[:, 0]) if weights is None else weights.reshape(-1).to(lab.dtype)
    total = w.sum()
    mean = (lab * w[:, None]).sum(0) / total if float(total) > 0 else lab.new_tensor([0.5, 0.0, 0.0])
    return oklab_to_srgb(mean).clamp(0, 1)


@dataclass(frozen=True)
class RegionColor:
    """Measured color of a region. Color edits of the region are relative to it."""

    __eq__ = equal_fields

    color: Tensor  # typical color, sRGB 0 to 1. [3]
    shading: Shading  # lightness range of all colors of the region

    def describe(self) -> str:
        """Return the color and the limit of its highlights as words for the log."""
        return f"typical color {hex_color(self.color.tolist())}, {self.shading.describe()}"


def measure_color(rgb: Tensor, weights: Tensor | None = None) -> RegionColor:
    """Measure the typical color and the shading of a region.

    The typical color is the median in OKLab. Compute it once over the whole region (all views, all members)
    and pass it to every edit there. The edit is then the same function of color in each view.

    Args:
        rgb: colors of the region, sRGB 0 to 1. [...,3]
        weights: visible area of each color, ≥ 0; None if all are equal. [...]
    """
    lab = srgb_to_oklab(rgb.clamp(0, 1)).reshape(-1, 3)
    shares = torch.ones_like(lab[:, 0]) if weights is None else weights.reshape(-1).to(lab)
    shading = measure_shading(lab[:, 0], shares)
    if not float(shares.sum()) > 0:
        return RegionColor(oklab_to_srgb(lab.new_tensor([shading.typical, 0.0, 0.0])).clamp(0, 1), shading)
    a = weighted_quantiles(lab[:, 1], shares, (0.5,))[0]
    b = weighted_quantiles(lab[:, 2], shares, (0.5,))[0]
    return RegionColor(oklab_to_srgb(lab.new_tensor([shading.typical, a, b])).clamp(0, 1), shading)


def recolor_course(
    rgb: Tensor, target: Tensor, source: RegionColor, path: ColorPath = "bowed"
) -> ColorFunction:
    """Return the path from colors to those of `recolor_fully`, which keeps the shading.

    Args:
        rgb: sRGB colors, 0 to 1. A part outside, possible for SH colors, fades with the strength. [...,3]
        target: color of `source` at strength 1, sRGB 0 to 1. [3]
        source: measured color of the region, see `measure_color`
        path: shape of the path, see `bend_of`
    """
    bend = bend_of(_as_tensor(source.color, rgb), _as_tensor(target, rgb), path)
    return color_path(rgb, recolor_fully(rgb, target, source), bend)


def recolor_fully(rgb: Tensor, target: Tensor, source: RegionColor) -> Tensor:
    """Recolor at full strength. [...,3] -> [...,3], 0 to 1

    The typical color of `source` becomes `target`, as new paint in the same light (see `relight`). The hue is
    the target's, or unchanged if the target is gray.
    """
    lab = srgb_to_oklab(rgb.clamp(0, 1))
    goal = srgb_to_oklab(_as_tensor(target, rgb))
    new_chroma = torch.hypot(goal[1], goal[2])
    relit = relight(lab[..., 0], source.shading, goal)
    chroma = new_chroma * relit.chroma
    hue = torch.atan2(goal[2], goal[1]) if new_chroma >= _MIN_CHROMA else hue_of(lab)
    return fit_gamut(torch.stack([relit.lightness, chroma * torch.cos(hue), chroma * torch.sin(hue)], dim=-1))


def tint_course(rgb: Tensor, target: Tensor, source: RegionColor, path: ColorPath = "bowed") -> ColorFunction:
    """Return the path from colors to those of `tint_fully`, a wash with a color.

    For the arguments see `recolor_course`.
    """
    bend = bend_of(_as_tensor(source.color, rgb), _as_tensor(target, rgb), path)
    return color_path(rgb, tint_fully(rgb, target, source), bend)


def tint_fully(rgb: Tensor, target: Tensor, source: RegionColor) -> Tensor:
    """Tint at full strength: move hue and chroma most of the way to the target's. [...,3] -> [...,3], 0 to 1

    The lightness is unchanged where sRGB has the tint. If sRGB lacks the tinted typical color, as for white,
    the typical color moves to the nearest lightness at which sRGB has it. The other lightness follows it.
    """
    lab = srgb_to_oklab(rgb.clamp(0, 1))
    goal = srgb_to_oklab(_as_tensor(target, rgb))
    own = srgb_to_oklab(_as_tensor(source.color, rgb))
    washed = torch.lerp(own[1:], goal[1:], _TINT_SHARE)
    lightness = nearest_lightness(source.shading.typical, washed)
    relit = relight(lab[..., 0], source.shading, torch.cat([goal.new_tensor([lightness]), washed]))
    ab = torch.lerp(lab[..., 1:], goal[1:] * relit.chroma[..., None], _TINT_SHARE)
    return fit_gamut(torch.cat([relit.lightness[..., None], ab], dim=-1))


def darken(rgb: Tensor, strength: Strength = 1.0, stops: float = 3.0) -> Tensor:
    """Scale the light by 2^(−stops·strength), with unchanged hue and contrast. [...,3] -> [...,3]"""
    inside = rgb.clamp(0, 1)
    s = torch.as_tensor(strength, dtype=rgb.dtype, device=rgb.device).expand(rgb.shape[:-1]).clamp(0, 1)
    # OKLab is homogeneous of degree 1/3 in linear light
    edited = oklab_to_srgb(srgb_to_oklab(inside) * torch.exp2(-stops / 3 * s)[..., None]).clamp(0, 1)
    return torch.where((s == 0)[..., None], rgb, edited + (1 - s)[..., None] * (rgb - inside))


def night_course(rgb: Tensor, stops: float = 3.0) -> ColorFunction:
    """Return the path to moonlight: `darken`, with colors that fade to a cool blue as in dim light."""
    bluer = color_path(rgb, _in_moonlight(rgb), STRAIGHT)
    return lambda strength: darken(bluer(strength), strength, stops)


def _in_moonlight(rgb: Tensor) -> Tensor:
    """Shift colors to the blue of moonlight, less near black and white. [...,3] -> [...,3], 0 to 1"""
    lab = srgb_to_oklab(rgb.clamp(0, 1))
    moon = srgb_to_oklab(rgb.new_tensor(_MOONLIGHT))
    lightness = lab[..., :1]
    fade = torch.minimum(lightness / moon[0], (1 - lightness) / (1 - moon[0])).clamp(0, 1)
    return fit_gamut(torch.cat([lightness, torch.lerp(lab[..., 1:], moon[1:] * fade, _MOON_SHARE)], dim=-1))


def number_of(text: str) -> float:
    """Return the number in a text, or NaN if there is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def stripe_pattern(points: Tensor, axis: Tensor, period: float, phase: float = 0.0) -> Tensor:
    """Return the stripe coverage of each 3D point. Stripes depend on position, so all views agree.

    Args:
        points: world positions. [...,3]
        axis: direction across the stripes, of any nonzero length. [3]
        period: distance between stripes, world units, > 0
        phase: shift, in periods

    Returns:
        0 (between) to 1 (in a stripe). [...]
    """
    return stripe_profile(points @ (axis / axis.norm()).to(points) / period + phase)


def stripe_profile(turns: Tensor, width: float = 0.5, softness: float = 0.08) -> Tensor:
    """Return the profile of stripes centered on whole numbers of periods. [...] -> [...], 0 to 1

    Args:
        turns: coordinate, in periods. [...]
        width: width of a stripe as a share of the period, 0 to 1
        softness: width of the soft edge, in periods
    """
    distance = (turns - turns.round()).abs()
    return smoothstep((0.5 * width - distance) / max(softness, 1e-6) + 0.5)


def _as_tensor(color: Tensor, rgb: Tensor) -> Tensor:
    return color.to(rgb).clamp(0, 1)
