"""Colour edits as pure functions of colours and strength, the same for pixels and for Gaussians.

Every function takes sRGB as it is stored (0..1, not linear) in any shape [...,3], returns the same shape,
gives the input back bit for bit where the strength is 0, and moves continuously with it. Hue, chroma and
lightness are those of OKLCh (Ottosson 2020, https://bottosson.github.io/posts/oklab/): scaling the lightness
there is scaling the light, so shading survives, and turning the hue does not pass through grey.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from progdf.errors import ProgdfError

Strength = float | Tensor
"""How far the edit has gone, 0..1: one number, or a tensor with the colours' shape less the last axis."""

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
_GREY_CHROMA = 0.03  # below this chroma a hue is mostly noise
_LARGEST_GAIN = 3.0  # a dark part that becomes bright is lifted instead of amplifying its noise further
_OPPOSITE = math.radians(140.0)  # hues further apart than this have no "shorter way" worth the name
_GREEN = math.radians(142.5)
_GAMUT_SLACK = 1e-3  # less than a third of an 8-bit step


def parse_color(text: str) -> Tensor:
    """The colour of `#rrggbb` or `#rgb`, the `#` optional, as sRGB. [3] float32; else a ProgdfError."""
    digits = text.strip().removeprefix("#")
    if len(digits) == 3:
        digits = "".join(2 * digit for digit in digits)
    if len(digits) != 6 or any(digit not in "0123456789abcdefABCDEF" for digit in digits):
        raise ProgdfError(f"'{text}' is not a colour; write it as #rrggbb, for example #d4af37")
    return torch.tensor([int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)])


def srgb_to_oklab(rgb: Tensor) -> Tensor:
    """Lightness 0..1 and the two opponent axes a, b of sRGB colours. [...,3] -> [...,3]"""
    linear = torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)
    lms = linear @ rgb.new_tensor(_LMS_FROM_LINEAR).T
    return (lms.sign() * lms.abs() ** (1 / 3)) @ rgb.new_tensor(_LAB_FROM_LMS).T


def oklab_to_srgb(lab: Tensor) -> Tensor:
    """The inverse of `srgb_to_oklab`; colours that sRGB cannot show leave 0..1. [...,3] -> [...,3]"""
    lms = (lab @ torch.linalg.inv(lab.new_tensor(_LAB_FROM_LMS)).T) ** 3
    linear = lms @ torch.linalg.inv(lab.new_tensor(_LMS_FROM_LINEAR)).T
    return torch.where(
        linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    )


def typical_color(rgb: Tensor, weights: Tensor | None = None) -> Tensor:
    """The weighted mean colour, averaged in OKLab. [...,3], [...] or None -> [3]

    Take it once over the whole region (all views, all members) and pass it to every `recolor` of that region:
    the edit is then the same function of colour in each view.
    """
    lab = srgb_to_oklab(rgb.clamp(0, 1)).reshape(-1, 3)
    w = torch.ones_like(lab[:, 0]) if weights is None else weights.reshape(-1).to(lab.dtype)
    total = w.sum()
    mean = (lab * w[:, None]).sum(0) / total if float(total) > 0 else lab.new_tensor([0.5, 0.0, 0.0])
    return oklab_to_srgb(mean).clamp(0, 1)


def recolor(rgb: Tensor, target: Tensor, strength: Strength = 1.0, reference: Tensor | None = None) -> Tensor:
    """Give a thing another colour and keep its shading.

    Lightness is scaled so that `reference` becomes `target`; chroma follows the lightness; the hue turns
    along the hue circle, in one direction for the whole region (the shorter way; between nearly opposite
    hues the way over green). The three move together with the strength. A source too grey to have a hue
    takes the target's; a dark source is lifted.

    Args:
        rgb: sRGB colours, 0..1; what lies outside (SH colours may) fades with the strength. [...,3]
        target: the colour that `reference` has at strength 1, sRGB 0..1. [3]
        strength: 0..1
        reference: the region's own colour, `typical_color` of `rgb` by default. [3]
    """
    inside = rgb.clamp(0, 1)
    lab = srgb_to_oklab(inside)
    ref_l, _, ref_hue, ref_grey = _polar(
        srgb_to_oklab(_like(typical_color(rgb) if reference is None else reference, rgb))
    )
    new_l, new_c, new_hue, new_grey = _polar(srgb_to_oklab(_like(target, rgb)))
    lightness, chroma, hue, _ = _polar(lab)
    s = torch.as_tensor(strength, dtype=rgb.dtype, device=rgb.device).expand(lightness.shape).clamp(0, 1)

    out_l = _relight(lightness, ref_l.clamp(0.02, 0.98), (ref_l + s * (new_l - ref_l)).clamp(0.02, 0.98))
    # chroma in proportion to lightness is the same surface in less light; towards white the gamut narrows it
    end_l = _relight(lightness, ref_l.clamp(0.02, 0.98), new_l.clamp(0.02, 0.98))
    fade = (end_l / new_l.clamp_min(0.02)).clamp(0, 1)
    out_c = chroma + s * (new_c * fade - chroma)

    turn = _turn(ref_hue, new_hue) if not (ref_grey or new_grey) else torch.zeros_like(ref_hue)
    way = turn + _wrap(new_hue - hue - turn)
    certain = (chroma / _GREY_CHROMA).clamp(1e-4, 1.0) if not new_grey else torch.ones_like(chroma)
    progress = s / (s + (1 - s) * certain)
    out_hue = hue if new_grey else hue + way * progress
    edited = _fit_gamut(out_l, out_c, out_hue) + (1 - s)[..., None] * (rgb - inside)
    return torch.where((s == 0)[..., None], rgb, edited)


def tint(rgb: Tensor, target: Tensor, strength: Strength = 1.0, share: float = 0.7) -> Tensor:
    """Wash with a colour: lightness stays, hue and chroma go `share` of the way to the target's. [...,3]"""
    inside = rgb.clamp(0, 1)
    lab = srgb_to_oklab(inside)
    goal = srgb_to_oklab(_like(target, rgb))
    s = torch.as_tensor(strength, dtype=rgb.dtype, device=rgb.device).expand(lab.shape[:-1]).clamp(0, 1)
    lightness = lab[..., 0]
    fade = torch.minimum(
        lightness / goal[0].clamp_min(0.02), (1 - lightness) / (1 - goal[0]).clamp_min(0.02)
    ).clamp(0, 1)
    ab = lab[..., 1:] + (share * s)[..., None] * (goal[1:] * fade[..., None] - lab[..., 1:])
    edited = _fit_gamut(lightness, ab.norm(dim=-1), torch.atan2(ab[..., 1], ab[..., 0]))
    return torch.where((s == 0)[..., None], rgb, edited + (1 - s)[..., None] * (rgb - inside))


def darken(rgb: Tensor, strength: Strength = 1.0, stops: float = 3.0) -> Tensor:
    """Take light away: 2^(−stops·strength) of the light is left, hue and contrast stay. [...,3] -> [...,3]"""
    inside = rgb.clamp(0, 1)
    s = torch.as_tensor(strength, dtype=rgb.dtype, device=rgb.device).expand(rgb.shape[:-1]).clamp(0, 1)
    # OKLab is homogeneous of degree 1/3 in linear light
    edited = oklab_to_srgb(srgb_to_oklab(inside) * torch.exp2(-stops / 3 * s)[..., None]).clamp(0, 1)
    return torch.where((s == 0)[..., None], rgb, edited + (1 - s)[..., None] * (rgb - inside))


def night(rgb: Tensor, strength: Strength = 1.0, stops: float = 3.0) -> Tensor:
    """Moonlight: `darken`, with colours fading to a cool blue as they do in scarce light. [...,3]"""
    return darken(tint(rgb, rgb.new_tensor([0.35, 0.50, 0.85]), strength, share=0.75), strength, stops)


def stripe_pattern(
    points: Tensor,
    axis: Tensor,
    period: float,
    phase: float = 0.0,
    width: float = 0.5,
    softness: float = 0.08,
) -> Tensor:
    """How much each 3D point lies in a stripe; a function of place, so every view sees the same stripes.

    Args:
        points: world positions. [...,3]
        axis: direction across the stripes, any length but 0. [3]
        period: distance from stripe to stripe, world units, > 0
        phase: shift in periods
        width: share of the period that is stripe, 0..1
        softness: width of the edge in periods

    Returns:
        0 (between) to 1 (in a stripe). [...]
    """
    along = points @ (axis / axis.norm()).to(points) / period + phase
    return stripe_profile(along, width, softness)


def stripe_profile(turns: Tensor, width: float = 0.5, softness: float = 0.08) -> Tensor:
    """Stripes along any coordinate counted in periods, centred on whole numbers. [...] -> [...] in 0..1"""
    distance = (turns - turns.round()).abs()
    edge = ((0.5 * width - distance) / max(softness, 1e-6) + 0.5).clamp(0, 1)
    return edge * edge * (3 - 2 * edge)


def stripes(
    rgb: Tensor, pattern: Tensor, target: Tensor, strength: Strength = 1.0, reference: Tensor | None = None
) -> Tensor:
    """`recolor` where `pattern` ([...], 0..1) is 1, nothing where it is 0. [...,3] -> [...,3]"""
    return recolor(rgb, target, torch.as_tensor(strength).to(pattern) * pattern, reference)


def _like(color: Tensor, rgb: Tensor) -> Tensor:
    return color.to(rgb).clamp(0, 1)


def _polar(lab: Tensor) -> tuple[Tensor, Tensor, Tensor, bool]:
    """Lightness, chroma, hue in radians, and (of a single colour) whether it is too grey to have a hue."""
    lightness, a, b = lab.unbind(-1)
    chroma = torch.hypot(a, b)
    return lightness, chroma, torch.atan2(b, a), lab.ndim == 1 and float(chroma) < 0.5 * _GREY_CHROMA


def _wrap(angle: Tensor) -> Tensor:
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def _turn(start: Tensor, end: Tensor) -> Tensor:
    """The signed way from hue to hue: the shorter, or between nearly opposite hues the one over green."""
    short = _wrap(end - start)
    if float(short.abs()) < _OPPOSITE:
        return short
    to_green = _wrap(_GREEN - start)
    over_green = float(to_green * short) > 0 and float(to_green.abs()) <= float(short.abs())
    return short if over_green else short - 2 * math.pi * short.sign()


def _relight(lightness: Tensor, reference: Tensor, goal: Tensor) -> Tensor:
    """Scale lightness so that `reference` becomes `goal`; brightening bends towards white, never clips."""
    gain = goal / reference
    below = (goal + (lightness - reference) * gain.clamp_max(_LARGEST_GAIN)).clamp_min(0)
    slope = gain.clamp(1.0, _LARGEST_GAIN) * (1 - reference) / (1 - goal)
    x = ((lightness - reference) / (1 - reference)).clamp(0, 1)
    # a hyperbola that leaves (reference, goal) with the gain as slope and ends at (1, 1)
    above = goal + (1 - goal) * slope * x / (1 + (slope - 1) * x)
    return torch.where((lightness > reference) & (gain > 1), above, below).clamp(0, 1)


def _fit_gamut(lightness: Tensor, chroma: Tensor, hue: Tensor) -> Tensor:
    """sRGB of OKLCh colours; chroma that sRGB cannot show is reduced, lightness and hue stay. [...,3]"""
    lab = torch.stack([lightness, chroma * torch.cos(hue), chroma * torch.sin(hue)], dim=-1)
    rgb = oklab_to_srgb(lab)
    outside = (rgb - 0.5).abs().amax(dim=-1) > 0.5 + _GAMUT_SLACK
    if bool(outside.any()):
        beyond = lab[outside]
        low, high = torch.zeros_like(beyond[:, :1]), torch.ones_like(beyond[:, :1])
        for _ in range(10):  # to a thousandth of the chroma
            middle = 0.5 * (low + high)
            tried = oklab_to_srgb(torch.cat([beyond[:, :1], middle * beyond[:, 1:]], dim=1))
            fits = (tried - 0.5).abs().amax(dim=1, keepdim=True) <= 0.5 + _GAMUT_SLACK
            low, high = torch.where(fits, middle, low), torch.where(fits, high, middle)
        rgb[outside] = oklab_to_srgb(torch.cat([beyond[:, :1], low * beyond[:, 1:]], dim=1))
    return rgb.clamp(0, 1)
