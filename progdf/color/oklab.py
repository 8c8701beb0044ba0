"""OKLab, a perceptually uniform color space (Ottosson 2020, https://bottosson.github.io/posts/oklab/).

Its polar form OKLCh has lightness, chroma and hue. Scaling OKLab colors scales the light.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal, get_args

import torch
from torch import Tensor

from progdf.errors import ProgdfError

_LMS_FROM_LINEAR = (
    (0.4122214708, 0.5363325363, 0.0514459929),
    (0.2119034982, 0.6806995451, 0.1073969566),
    (0.0883024619, 0.2817188376, 0.6299787005),
)
_LAB_FROM_LMS = (
    (0.2104542553, 0.7936177850, -0.0040720468),
    (1.9779984951, -2.4285922050, 0.4505937099),
    (0.0259040371, 0.7827717662, -0.8086757660),
)
_GAMUT_SLACK = 1e-3  # accepted excess over the sRGB range; less than a third of an 8-bit step
_GAMUT_LOW = -_GAMUT_SLACK / 12.92  # the accepted range in linear light
_GAMUT_HIGH = ((1.0 + _GAMUT_SLACK + 0.055) / 1.055) ** 2.4
_GAMUT_MIDDLE = 0.5 * (_GAMUT_LOW + _GAMUT_HIGH)
_GAMUT_HALF = 0.5 * (_GAMUT_HIGH - _GAMUT_LOW)
_SHARE_STEPS = tuple(0.5**k for k in range(1, 11))  # steps of a bisection


@cache
def _matrices(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the matrices linear to LMS and LMS to Lab, and their inverses, transposed for colors in rows."""
    to_lms, to_lab = (torch.tensor(m, dtype=dtype, device=device) for m in (_LMS_FROM_LINEAR, _LAB_FROM_LMS))
    return to_lms.T, to_lab.T, torch.linalg.inv(to_lms).T, torch.linalg.inv(to_lab).T


def srgb_to_oklab(rgb: Tensor) -> Tensor:
    """Convert sRGB to OKLab: lightness, 0 to 1, and the opponent axes a and b. [...,3] -> [...,3]"""
    to_lms, to_lab, *_ = _matrices(rgb.dtype, rgb.device)
    lms = linear_from_srgb(rgb) @ to_lms
    return (lms.sign() * lms.abs() ** (1 / 3)) @ to_lab


def oklab_to_srgb(lab: Tensor) -> Tensor:
    """Convert OKLab to sRGB; colors outside the sRGB gamut exceed 0 to 1. [...,3] -> [...,3]"""
    *_, to_linear, to_lms = _matrices(lab.dtype, lab.device)
    return srgb_from_linear((lab @ to_lms) ** 3 @ to_linear)


def linear_from_srgb(rgb: Tensor) -> Tensor:
    """Convert sRGB, 0 to 1, to linear light. [...,3] -> [...,3]"""
    return torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: Tensor) -> Tensor:
    """Convert linear light to sRGB. [...,3] -> [...,3]"""
    curved = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, linear * 12.92, curved)


def fit_gamut(lab: Tensor) -> Tensor:
    """Convert OKLab to sRGB, reducing chroma at constant lightness and hue. [...,3] -> [...,3]"""
    rgb = oklab_to_srgb(lab)
    outside = (rgb - 0.5).abs().amax(dim=-1) > 0.5 + _GAMUT_SLACK
    if bool(outside.any()):
        beyond = lab[outside]
        rgb[outside] = oklab_to_srgb(torch.cat([beyond[:, :1], _chroma_share(beyond) * beyond[:, 1:]], dim=1))
    return rgb.clamp(0, 1)


def _chroma_share(lab: Tensor) -> Tensor:
    """Return the largest share of the chroma that fits the sRGB range, to a thousandth. [M,3] -> [M,1]

    Colors are compared in linear light, which takes a third of the time of a conversion to sRGB.
    """
    *_, to_linear, to_lms = _matrices(lab.dtype, lab.device)
    gray = lab[:, :1] * to_lms[0]
    hue = lab[:, 1:] @ to_lms[1:]
    share = torch.zeros_like(lab[:, :1])
    for step in _SHARE_STEPS:
        linear = torch.addcmul(gray, share + step, hue) ** 3 @ to_linear
        fits = (linear - _GAMUT_MIDDLE).abs().amax(dim=1, keepdim=True) <= _GAMUT_HALF
        share = share + step * fits
    return share


def hue_of(lab: Tensor) -> Tensor:
    """Return the hue of OKLab colors in radians, −π to π. [...,3] -> [...]"""
    return torch.atan2(lab[..., 2], lab[..., 1])


Strength = float | Tensor
"""Strength of an edit, 0 to 1: one number, or a tensor with the colors' shape without the last axis."""

_GREEN = math.radians(142.5)  # hue of sRGB's green

ColorPath = Literal["bowed", "hue", "straight", "srgb"]
"""Shape of the path of colors from the original to the full edit, see `bend_of`."""


@dataclass(frozen=True)
class Bend:
    """Bend of the path between two colors from the straight line in OKLab towards the hue circle."""

    bow: float  # weight of the path along the hue circle, 0 (straight) to 1
    direction: float  # 1 or −1: sense of rotation of nearly opposite hues, the same for the whole region
    # Limits on the arc of a color in `direction`, as its excess over π, radians. Up to `whole` the color
    # rotates in `direction`. From `none` on it takes the shorter arc. Between them the two paths mix.
    whole: float
    none: float
    fade: bool = False  # straight in sRGB instead, like a cross-fade of pictures


STRAIGHT = Bend(0.0, 1.0, 0.0, 1.0)
"""Straight line in OKLab."""


def bend_of(reference: Tensor, target: Tensor, path: ColorPath = "bowed") -> Bend:
    """Return the bend for a region whose typical color `reference` becomes `target`; sRGB, [3] each.

    - "bowed": mostly straight, with a bow of 0.4 along the shorter hue arc. So strength 0.5 towards blue
      looks half blue, not gray. Hues within 10° of opposite avoid green, which would be unexpected.
    - "hue": along the shorter hue arc, or over green between nearly opposite hues.
    - "straight": straight in OKLab. "srgb": straight in sRGB. Both pass through gray between opposite hues.
    """
    if path in ("straight", "srgb"):
        return replace(STRAIGHT, fade=path == "srgb")
    start, end = (hue_of(srgb_to_oklab(color.clamp(0, 1))) for color in (reference, target))
    difference = _wrap(end - start)
    to_green = _wrap(_GREEN - start)
    over_green = bool(to_green * difference > 0) and bool(to_green.abs() <= difference.abs())
    opposite, green, bow, whole, none = {
        "bowed": (170.0, False, 0.4, 15.0, 60.0),
        "hue": (140.0, True, 1.0, 45.0, 120.0),
    }[path]
    is_reversed = float(difference.abs()) >= math.radians(opposite) and over_green is not green
    sense = 1.0 if bool(difference > 0) is not is_reversed else -1.0
    return Bend(bow, sense, math.radians(whole), math.radians(none))


def path_of(name: str) -> ColorPath:
    """Return the color path of a name.

    Raises:
        ProgdfError: the name is unknown.
    """
    for path in get_args(ColorPath):
        if path == name:
            return path  # type: ignore[no-any-return]
    raise ProgdfError(f"unknown color path '{name}'; use one of {', '.join(get_args(ColorPath))}")


def interpolate_colors(rgb: Tensor, end: Tensor, strength: Strength, bend: Bend) -> Tensor:
    """Interpolate between colors on a path in OKLab that is bowed towards the hue circle.

    The bow grows with the chroma of both colors. The hue of a gray is noise, and rotating it would give
    rainbow colors half way. Similar colors stay similar on their paths, see `Bend`.

    Args:
        rgb: sRGB colors at strength 0. A part outside 0 to 1, possible for SH colors, fades with the
            strength. [...,3]
        end: sRGB colors at strength 1, 0 to 1, returned bit for bit. [...,3]
        strength: 0 to 1
        bend: bend of the region
    """
    return color_path(rgb, end, bend)(strength)


def color_path(rgb: Tensor, end: Tensor, bend: Bend) -> Callable[[Strength], Tensor]:
    """Return `interpolate_colors` as a function of the strength; shared values are computed once."""
    inside = rgb.clamp(0, 1)
    mix = None if bend.fade else _oklab_course(srgb_to_oklab(inside), srgb_to_oklab(end), bend)

    def colors_at(strength: Strength) -> Tensor:
        s = torch.as_tensor(strength, dtype=rgb.dtype, device=rgb.device).expand(rgb.shape[:-1]).clamp(0, 1)
        interpolated = torch.lerp(inside, end, s[..., None]) if mix is None else mix(s)
        edited = interpolated + (1 - s)[..., None] * (rgb - inside)
        return torch.where((s == 0)[..., None], rgb, torch.where((s == 1)[..., None], end, edited))

    return colors_at


def _oklab_course(a: Tensor, b: Tensor, bend: Bend) -> Callable[[Tensor], Tensor]:
    """Return the path between OKLab colors as a function from strengths [...] to sRGB. [...,3], [...,3]"""
    chroma_a = a[..., 1:].norm(dim=-1)
    chroma_b = b[..., 1:].norm(dim=-1)
    hue = hue_of(a)
    rotation = bend.direction * _wrap(hue_of(b) - hue)  # −π to π, positive in the region's sense
    own_share = smoothstep(rotation + math.pi, bend.whole, bend.none)
    bow = bend.bow * 4 * chroma_a * chroma_b / (chroma_a + chroma_b).clamp_min(1e-6).square()

    def colors_at(s: Tensor) -> Tensor:
        chroma = torch.lerp(chroma_a, chroma_b, s)

        def rotate(angle: Tensor) -> Tensor:
            turned = hue + bend.direction * s * angle
            return torch.stack([chroma * torch.cos(turned), chroma * torch.sin(turned)], dim=-1)

        around = torch.lerp(rotate(rotation + 2 * math.pi), rotate(rotation), own_share[..., None])
        lab = torch.lerp(a, b, s[..., None])
        lab[..., 1:] += bow[..., None] * (around - lab[..., 1:])
        return fit_gamut(lab)

    return colors_at


def _wrap(angle: Tensor) -> Tensor:
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def smoothstep(values: Tensor, low: float = 0.0, high: float = 1.0) -> Tensor:
    """Return a smooth step: 0 up to `low`, 1 from `high`. [...] -> [...]"""
    x = ((values - low) / (high - low)).clamp(0, 1)
    return x * x * (3 - 2 * x)
