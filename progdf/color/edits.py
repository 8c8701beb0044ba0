"""Color edits as pure functions of colors and strength, the same for pixels and for Gaussians.

Every function takes sRGB as it is stored (0..1, not linear) in any shape [...,3], returns the same shape,
gives the input back bit for bit where the strength is 0, and moves continuously with it. Hue, chroma and
lightness are those of `progdf.color.oklab`; what lies between the original and the finished edit is said in
`progdf.color.oklab`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.threads import one_thread

from .oklab import (
    STRAIGHT,
    ColorPath,
    Strength,
    bend_of,
    color_course,
    fit_gamut,
    hue_of,
    oklab_to_srgb,
    smoothstep,
    srgb_to_oklab,
)
from .palette import Curve, are_alike, bend_lightness, less_light, shift_palette

Course = Callable[[Strength], Tensor]
"""Some colors [...,3] at a strength."""

_MIN_CHROMA = 0.015  # of a target that has a hue
_CAST = 0.1  # of lightness: the chroma of white under the bluest and the most amber light
_MIDDLE = 0.5646  # lightness of 18 % gray, which contrast leaves where it is
_LARGEST_GAIN = 3.0  # a dark part that becomes bright is lifted instead of amplifying its noise further


def parse_color(text: str) -> Tensor:
    """The color of `#rrggbb` or `#rgb`, the `#` optional, as sRGB. [3] float32; else a ProgdfError."""
    digits = text.strip().removeprefix("#")
    if len(digits) == 3:
        digits = "".join(2 * digit for digit in digits)
    if len(digits) != 6 or any(digit not in "0123456789abcdefABCDEF" for digit in digits):
        raise ProgdfError(f"'{text}' is not a color; write it as #rrggbb, for example #d4af37")
    return torch.tensor([int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)])


def hex_color(color: Sequence[float]) -> str:
    """`#rrggbb` of a color 0..1."""
    return "#" + "".join(f"{round(255 * min(max(channel, 0.0), 1.0)):02x}" for channel in color)


@one_thread()  # sums of many are added in an order that depends on the number of threads
def typical_color(rgb: Tensor, weights: Tensor | None = None) -> Tensor:
    """The weighted mean color, averaged in OKLab. [...,3], [...] or None -> [3]

    Take it once over the whole region (all views, all members) and pass it to every `recolor_course` there:
    the edit is then the same function of color in each view.
    """
    lab = srgb_to_oklab(rgb.clamp(0, 1)).reshape(-1, 3)
    w = torch.ones_like(lab[:, 0]) if weights is None else weights.reshape(-1).to(lab.dtype)
    total = w.sum()
    mean = (lab * w[:, None]).sum(0) / total if float(total) > 0 else lab.new_tensor([0.5, 0.0, 0.0])
    return oklab_to_srgb(mean).clamp(0, 1)


def recolor_course(rgb: Tensor, target: Tensor, reference: Tensor, path: ColorPath = "bowed") -> Course:
    """Give a thing another color and keep its shading: all of `recolor_fully`, or a part of the way there.

    Args:
        rgb: sRGB colors, 0..1; what lies outside (SH colors may) fades with the strength. [...,3]
        target: the color that `reference` has at strength 1, sRGB 0..1. [3]
        reference: the region's own color, see `typical_color`. [3]
        path: see `bend_of`
    """
    bend = bend_of(_as_tensor(reference, rgb), _as_tensor(target, rgb), path)
    return color_course(rgb, recolor_fully(rgb, target, reference), bend)


def recolor_fully(rgb: Tensor, target: Tensor, reference: Tensor) -> Tensor:
    """The end of a `recolor_course`. [...,3] -> [...,3] 0..1

    Lightness is scaled so that `reference` becomes `target`; chroma follows the lightness; the hue is the
    target's, or stays where the target is too gray to have one. A dark source is lifted.
    """
    lab, (new_l, new_a, new_b) = srgb_to_oklab(rgb.clamp(0, 1)), srgb_to_oklab(_as_tensor(target, rgb))
    new_c = torch.hypot(new_a, new_b)
    ref_l = srgb_to_oklab(_as_tensor(reference, rgb))[0]
    lightness = _relight(lab[..., 0], ref_l.clamp(0.02, 0.98), new_l.clamp(0.02, 0.98))
    # chroma in proportion to lightness is the same surface in less light; towards white the gamut narrows it
    chroma = new_c * (lightness / new_l.clamp_min(0.02)).clamp(0, 1)
    hue = torch.atan2(new_b, new_a) if new_c >= _MIN_CHROMA else hue_of(lab)
    return fit_gamut(torch.stack([lightness, chroma * torch.cos(hue), chroma * torch.sin(hue)], dim=-1))


def tint_course(rgb: Tensor, target: Tensor, reference: Tensor, path: ColorPath = "bowed") -> Course:
    """Wash with a color: lightness stays, hue and chroma go most of the way to the target's.

    See `recolor_course` for the arguments; here `reference` decides nothing but the bend.
    """
    bend = bend_of(_as_tensor(reference, rgb), _as_tensor(target, rgb), path)
    return color_course(rgb, tint_fully(rgb, target), bend)


def tint_fully(rgb: Tensor, target: Tensor, share: float = 0.7) -> Tensor:
    """The end of a `tint_course`; `share`: how far hue and chroma go. [...,3] -> [...,3] 0..1"""
    lab = srgb_to_oklab(rgb.clamp(0, 1))
    goal = srgb_to_oklab(_as_tensor(target, rgb))
    lightness = lab[..., :1]
    fade = torch.minimum(
        lightness / goal[0].clamp_min(0.02), (1 - lightness) / (1 - goal[0]).clamp_min(0.02)
    ).clamp(0, 1)
    return fit_gamut(torch.cat([lightness, torch.lerp(lab[..., 1:], goal[1:] * fade, share)], dim=-1))


def darken(rgb: Tensor, strength: Strength = 1.0, stops: float = 3.0) -> Tensor:
    """Take light away: 2^(−stops·strength) of the light is left, hue and contrast stay. [...,3] -> [...,3]"""
    inside = rgb.clamp(0, 1)
    s = torch.as_tensor(strength, dtype=rgb.dtype, device=rgb.device).expand(rgb.shape[:-1]).clamp(0, 1)
    # OKLab is homogeneous of degree 1/3 in linear light
    edited = oklab_to_srgb(srgb_to_oklab(inside) * torch.exp2(-stops / 3 * s)[..., None]).clamp(0, 1)
    return torch.where((s == 0)[..., None], rgb, edited + (1 - s)[..., None] * (rgb - inside))


def night_course(rgb: Tensor, stops: float = 3.0) -> Course:
    """Moonlight: `darken`, with colors fading to a cool blue as they do in scarce light."""
    bluer = color_course(rgb, tint_fully(rgb, rgb.new_tensor([0.35, 0.50, 0.85]), share=0.75), STRAIGHT)
    return lambda strength: darken(bluer(strength), strength, stops)


GRADE_RANGES: dict[str, tuple[float, float, float]] = {
    "exposure": (-5.0, 5.0, 0.0),
    "temperature": (-1.0, 1.0, 0.0),
    "tint": (-1.0, 1.0, 0.0),
    "contrast": (-1.0, 1.0, 0.0),
    "saturation": (-1.0, 1.0, 0.0),
    "black": (0.0, 0.5, 0.0),
    "white": (0.5, 1.0, 1.0),
}
"""What a grade takes: the least, the largest, and what changes nothing. Exposure is in stops; temperature
goes from blue to amber, tint from green to magenta, saturation from gray to twice; black and white are the
sRGB values that become 0 and 1."""


@dataclass(frozen=True)
class ColorGrade:
    """What a person asks of colors."""

    values: Mapping[str, float] = field(default_factory=dict)  # of some of `GRADE_RANGES`
    palette: tuple[tuple[Tensor, Tensor], ...] = ()  # sources and targets, sRGB [3]; see `shift_palette`
    palette_curves: tuple[Curve, ...] = ()  # of the lightness near each source; none at all, or one of each
    curve: Curve = ()  # of lightness

    @property
    def is_neutral(self) -> bool:
        """Whether it changes nothing."""
        still = all(self.values.get(name, neutral) == neutral for name, (*_, neutral) in GRADE_RANGES.items())
        stays = all(torch.equal(source, target) for source, target in self.palette)
        curves = (*self.palette_curves, self.curve)
        return still and stays and all(x == y for curve in curves for x, y in curve)


def parse_grade(what: str) -> ColorGrade:
    """The grade that a text says: values of `GRADE_RANGES` as NAME=NUMBER; colors that become others as
    #rrggbb=#rrggbb, or one alone that stays; a curve of lightness as curve=FROM:TO+FROM:TO, of what is near a
    color as #rrggbb=#rrggbb/FROM:TO+FROM:TO.

    Raises:
        ProgdfError: it says something else, or nothing.
    """
    values: dict[str, float] = {}
    pairs: list[tuple[Tensor, Tensor]] = []
    curves: list[Curve] = []
    curve: Curve = ()
    for part in what.split(","):
        name, equals, number = (word.strip() for word in part.partition("="))
        if name.startswith("#"):
            target, bends, points = number.partition("/")
            pair = parse_color(name), parse_color(target if equals else name)
            if any(are_alike(pair[0], source) for source, _ in pairs):
                raise ProgdfError(f"grade:{what:.80} has two colors as near as {name}; leave one of them out")
            pairs.append(pair)
            curves.append(_curve_of(what, points) if bends else ())
        elif name == "curve" and not curve:
            curve = _curve_of(what, number)
        elif name not in GRADE_RANGES or name in values:
            names = ", ".join(GRADE_RANGES)
            raise ProgdfError(
                f"grade:{what:.80} has '{part:.40}'; write NAME=NUMBER, each name once: {names}; "
                "#rrggbb=#rrggbb; or curve=0.3:0.2"
            )
        else:
            low, high, _ = GRADE_RANGES[name]
            values[name] = number_of(number)
            if not low <= values[name] <= high:
                raise ProgdfError(f"in grade:{what:.80} {name} is '{number:.40}'; write {low:g} to {high:g}")
    if len(pairs) > MAX_PAIRS:
        raise ProgdfError(f"grade:{what:.80} has {len(pairs)} colors; the most are {MAX_PAIRS}")
    asked = ColorGrade(values, tuple(pairs), tuple(curves), curve)
    if asked.is_neutral:
        raise ProgdfError(f"grade:{what:.80} changes nothing; write, for example, grade:exposure=0.7")
    return asked


MAX_PAIRS = 16
"""Colors that a grade moves or holds."""


def _curve_of(what: str, text: str) -> Curve:
    """The points of `0.3:0.2+0.7:0.8`."""
    points = [tuple(number_of(n) for n in point.split(":")) for point in text.split("+")]
    curve = tuple((p[0], p[1]) for p in points if len(p) == 2 and all(0.0 <= x <= 1.0 for x in p))
    rises = all(a[0] < b[0] for a, b in pairwise(curve))
    if len(curve) < len(points) or not rises:
        raise ProgdfError(
            f"in grade:{what:.80} the curve is '{text:.40}'; write FROM:TO+FROM:TO, each 0 to 1, FROM rising"
        )
    return curve


def number_of(text: str) -> float:
    """NaN where it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def grade_course(rgb: Tensor, grade: ColorGrade) -> Course:
    """`grade_fully` at many strengths, straight in OKLab."""
    return color_course(rgb, grade_fully(rgb, grade), STRAIGHT)


def grade_fully(rgb: Tensor, grade: ColorGrade) -> Tensor:
    """Palette, levels, exposure, white balance, contrast, curve and saturation, in this order.

    Args:
        rgb: sRGB colors, 0..1. [...,3]
        grade: what is asked

    Returns:
        [...,3] 0..1
    """
    of = {name: grade.values.get(name, neutral) for name, (_, _, neutral) in GRADE_RANGES.items()}
    if grade.palette:
        sources, targets = (srgb_to_oklab(torch.stack(colors)) for colors in zip(*grade.palette, strict=True))
        lab = srgb_to_oklab(rgb.clamp(0, 1))
        rgb = fit_gamut(shift_palette(lab, sources, targets, grade.palette_curves))
    levels = ((rgb.clamp(0, 1) - of["black"]) / (of["white"] - of["black"])).clamp(0, 1)
    lab = srgb_to_oklab(levels) * 2.0 ** (of["exposure"] / 3)  # homogeneous of degree 1/3 in linear light
    lightness = lab[..., 0].clamp(0, 1)
    cast = _CAST * lightness[..., None] * lab.new_tensor([of["tint"], of["temperature"]])
    power = 2.0 ** of["contrast"]
    low = _MIDDLE * (lightness / _MIDDLE).clamp_max(1).pow(power)
    high = (1 - _MIDDLE) * ((1 - lightness) / (1 - _MIDDLE)).clamp_max(1).pow(power)
    steeper = torch.where(lightness < _MIDDLE, low, 1 - high)
    if grade.curve:
        steeper = bend_lightness(steeper, grade.curve)
    chroma = (lab[..., 1:] + cast) * (1 + of["saturation"]) * less_light(lightness, steeper)[..., None]
    return fit_gamut(torch.cat([steeper[..., None], chroma], dim=-1))


def stripe_pattern(points: Tensor, axis: Tensor, period: float, phase: float = 0.0) -> Tensor:
    """How much each 3D point lies in a stripe; a function of place, so every view sees the same stripes.

    Args:
        points: world positions. [...,3]
        axis: direction across the stripes, any length but 0. [3]
        period: distance from stripe to stripe, world units, > 0
        phase: shift in periods

    Returns:
        0 (between) to 1 (in a stripe). [...]
    """
    return stripe_profile(points @ (axis / axis.norm()).to(points) / period + phase)


def stripe_profile(turns: Tensor, width: float = 0.5, softness: float = 0.08) -> Tensor:
    """Stripes along any coordinate counted in periods, centered on whole numbers. [...] -> [...] in 0..1

    `width`: share of the period that is stripe, 0..1; `softness`: width of the edge in periods
    """
    distance = (turns - turns.round()).abs()
    return smoothstep((0.5 * width - distance) / max(softness, 1e-6) + 0.5)


def _as_tensor(color: Tensor, rgb: Tensor) -> Tensor:
    return color.to(rgb).clamp(0, 1)


def _relight(lightness: Tensor, reference: Tensor, goal: Tensor) -> Tensor:
    """Scale lightness so that `reference` becomes `goal`; brightening bends towards white, never clips."""
    gain = goal / reference
    below = (goal + (lightness - reference) * gain.clamp_max(_LARGEST_GAIN)).clamp_min(0)
    slope = gain.clamp(1.0, _LARGEST_GAIN) * (1 - reference) / (1 - goal)
    x = ((lightness - reference) / (1 - reference)).clamp(0, 1)
    # a hyperbola that leaves (reference, goal) with the gain as slope and ends at (1, 1)
    above = goal + (1 - goal) * slope * x / (1 + (slope - 1) * x)
    return torch.where((lightness > reference) & (gain > 1), above, below).clamp(0, 1)
