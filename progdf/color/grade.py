"""Color grade: the settings of a photographer's color panel, their text, and their effect on colors.

Without clarity, a grade is a function of color alone, the same for pixels, Gaussians and the lattice of a
.cube file. Neutral settings return the colors bit for bit. Colors pass the controls in this order, see
`progdf.color.tone`:

0. clarity, where the detail of each color is known (`progdf.color.clarity`)
1. palette: each source color becomes its target (`shift_palette`), before anything else changes colors
2. whites, blacks, highlights, shadows on the lightness, then exposure; nothing clips before exposure
3. temperature and tint
4. contrast, and the curve of lightness
5. wheels
6. vibrance, saturation
7. the curves of red, green and blue, on sRGB values
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import torch
from torch import Tensor

from progdf.errors import ProgdfError

from . import tone
from .clarity import clarify
from .edits import ColorFunction, hex_color, number_of, parse_color
from .oklab import STRAIGHT, color_path, fit_gamut, srgb_to_oklab
from .palette import (
    Curve,
    are_alike,
    bend_lightness,
    chroma_factor,
    find_shades,
    measure_palette,
    shift_palette,
)
from .shading import Shading
from .tone import WHEELS, Wheel

GRADE_RANGES: dict[str, tuple[float, float, float]] = {
    "exposure": (-5.0, 5.0, 0.0),
    "contrast": (-1.0, 1.0, 0.0),
    "highlights": (-1.0, 1.0, 0.0),
    "shadows": (-1.0, 1.0, 0.0),
    "whites": (-1.0, 1.0, 0.0),
    "blacks": (-1.0, 1.0, 0.0),
    "temperature": (-1.0, 1.0, 0.0),
    "tint": (-1.0, 1.0, 0.0),
    "vibrance": (-1.0, 1.0, 0.0),
    "saturation": (-1.0, 1.0, 0.0),
    "clarity": (-1.0, 1.0, 0.0),
    "balance": (-1.0, 1.0, 0.0),
}
"""Smallest, largest and neutral value of each slider of a grade. Exposure is in stops."""

CURVES = ("curve", "curve_red", "curve_green", "curve_blue")
"""Names of the curves: of lightness, and of the channels of sRGB."""

RANGE_LIMITS = (0.25, 4.0)
"""Smallest and largest range of a source color, as a factor on its reach."""

MAX_PAIRS = 16
"""Largest number of colors that a grade changes or holds."""


@dataclass(frozen=True)
class ColorGrade:
    """Settings of a color grade."""

    values: Mapping[str, float] = field(
        default_factory=dict
    )  # by names of `GRADE_RANGES`; others are neutral
    palette: tuple[tuple[Tensor, Tensor], ...] = ()  # source and target colors, sRGB [3], see `shift_palette`
    palette_curves: tuple[Curve, ...] = ()  # lightness curves near each source; empty, or one per source
    palette_ranges: tuple[float, ...] = ()  # factor on each source's reach; empty, or one per source
    curve: Curve = ()  # lightness curve for all colors
    channels: tuple[Curve, Curve, Curve] = ((), (), ())  # curves of red, green and blue
    wheels: tuple[Wheel, Wheel, Wheel] = (Wheel(), Wheel(), Wheel())  # in the order of `WHEELS`
    # measured shading of each source, see `measure_grade`; empty: without highlights
    palette_shadings: tuple[Shading, ...] = ()
    palette_shades: tuple[
        Tensor, ...
    ] = ()  # OKLab colors that move with each source; empty, or one per source

    @property
    def is_neutral(self) -> bool:
        """True if the grade changes nothing."""
        has_neutral_values = all(
            name == "balance" or self.values.get(name, neutral) == neutral
            for name, (*_, neutral) in GRADE_RANGES.items()
        )
        curves = (*self.palette_curves, self.curve, *self.channels)
        return (
            has_neutral_values
            and not self.has_wheels
            and all(torch.equal(source, target) for source, target in self.palette)
            and all(x == y for curve in curves for x, y in curve)
        )

    @property
    def clarity(self) -> float:
        """Share of each color's detail to add, −1 to 1."""
        return self.values.get("clarity", 0.0)

    @property
    def has_wheels(self) -> bool:
        """True if a wheel changes colors."""
        return any(wheel.amount or wheel.light for wheel in self.wheels)


def parse_grade(what: str) -> ColorGrade:
    """Parse a grade from a text of parts between commas.

    - NAME=NUMBER sets a value of `GRADE_RANGES`.
    - curve=FROM:TO+FROM:TO sets a curve of `CURVES`.
    - wheel_shadows=HUE:AMOUNT:LIGHT sets a wheel of `WHEELS`: degrees, 0 to 1, −1 to 1.
    - #rrggbb=#rrggbb changes a color into another, and #rrggbb holds one.
    - #rrggbb=#rrggbb~RANGE/FROM:TO+FROM:TO also sets the reach of a color and its lightness curve.

    Raises:
        ProgdfError: a part cannot be read, or the grade changes nothing.
    """
    values: dict[str, float] = {}
    pairs: list[tuple[Tensor, Tensor]] = []
    pair_curves: list[Curve] = []
    ranges: list[float] = []
    curves: dict[str, Curve] = {}
    wheels: dict[str, Wheel] = {}
    for part in what.split(","):
        name, equals, number = (word.strip() for word in part.partition("="))
        wheel = name.removeprefix("wheel_")
        if name.startswith("#"):
            colors, bends, points = (number if equals else name).partition("/")
            target, ranged, reach = colors.partition("~")
            source = name.partition("/")[0].partition("~")[0]
            pair = parse_color(source), parse_color(target)
            if any(are_alike(pair[0], source) for source, _ in pairs):
                raise ProgdfError(f"grade:{what:.80} has two colors close to {name}; remove one of them")
            pairs.append(pair)
            pair_curves.append(_curve_of(what, points) if bends else ())
            ranges.append(_number_within(what, "a color's range", reach, RANGE_LIMITS) if ranged else 1.0)
        elif name in CURVES and name not in curves:
            curves[name] = _curve_of(what, number)
        elif name.startswith("wheel_") and wheel in WHEELS and wheel not in wheels:
            wheels[wheel] = _wheel_of(what, name, number)
        elif name not in GRADE_RANGES or name in values:
            names = ", ".join(GRADE_RANGES)
            raise ProgdfError(
                f"grade:{what:.80} has '{part:.40}'; write NAME=NUMBER, each name once: {names}; "
                "#rrggbb=#rrggbb; curve=0.3:0.2; or wheel_shadows=210:0.3:0"
            )
        else:
            low, high, _ = GRADE_RANGES[name]
            values[name] = _number_within(what, name, number, (low, high))
    if len(pairs) > MAX_PAIRS:
        raise ProgdfError(f"grade:{what:.80} has {len(pairs)} colors; at most {MAX_PAIRS} are possible")
    lightness, red, green, blue = (curves.get(name, ()) for name in CURVES)
    shadows, midtones, highlights = (wheels.get(name, Wheel()) for name in WHEELS)
    grade = ColorGrade(
        values,
        tuple(pairs),
        tuple(pair_curves),
        tuple(ranges),
        lightness,
        (red, green, blue),
        (shadows, midtones, highlights),
    )
    if grade.is_neutral:
        raise ProgdfError(f"grade:{what:.80} changes nothing; write, for example, grade:exposure=0.7")
    return grade


def format_grade(grade: ColorGrade) -> str:
    """Return the text that `parse_grade` reads, to 2 decimals; "" for a neutral grade without a palette."""
    parts = []
    for name, (*_, neutral) in GRADE_RANGES.items():
        value = round(grade.values.get(name, neutral), 2)
        if value != neutral:
            parts.append(f"{name}={value:.2f}")
    for name, wheel in zip(WHEELS, grade.wheels, strict=True):
        if wheel.amount or wheel.light:
            parts.append(f"wheel_{name}={format_wheel(wheel)}")
    for i, (source, target) in enumerate(grade.palette):
        words = hex_color(source.tolist())
        reach = grade.palette_ranges[i] if grade.palette_ranges else 1.0
        curve = grade.palette_curves[i] if grade.palette_curves else ()
        if not torch.equal(source, target) or curve or reach != 1.0:
            words += f"={hex_color(target.tolist())}"
            words += f"~{reach:.2f}" if reach != 1.0 else ""
            words += f"/{format_curve(curve)}" if curve else ""
        parts.append(words)
    for name, curve in zip(CURVES, (grade.curve, *grade.channels), strict=True):
        if curve:
            parts.append(f"{name}={format_curve(curve)}")
    return ",".join(parts)


def format_wheel(wheel: Wheel) -> str:
    """Return a wheel as text, such as `210.0:0.30:-0.10`."""
    return f"{wheel.hue:.1f}:{wheel.amount:.2f}:{wheel.light:.2f}"


def format_curve(curve: Curve) -> str:
    """Return a curve as text, such as `0.30:0.20+0.70:0.80`."""
    return "+".join(f"{x:.2f}:{y:.2f}" for x, y in curve)


def _number_within(what: str, name: str, text: str, limits: tuple[float, float]) -> float:
    """Return the number in a text. Raises ProgdfError if there is none, or it is outside of the limits."""
    low, high = limits
    value = number_of(text)
    if not low <= value <= high:
        raise ProgdfError(f"in grade:{what:.80} {name} is '{text:.40}'; write {low:g} to {high:g}")
    return value


def _wheel_of(what: str, name: str, text: str) -> Wheel:
    """Return the wheel of a text such as `210:0.3:-0.1`."""
    numbers = [number_of(word) for word in text.split(":")]
    limits = ((-360.0, 360.0), (0.0, 1.0), (-1.0, 1.0))
    is_valid = 2 <= len(numbers) <= 3 and all(
        low <= number <= high for number, (low, high) in zip(numbers, limits, strict=False)
    )
    if not is_valid:
        raise ProgdfError(
            f"in grade:{what:.80} {name} is '{text:.40}'; write HUE:AMOUNT:LIGHT: degrees, 0 to 1, -1 to 1"
        )
    return Wheel(*numbers)


def _curve_of(what: str, text: str) -> Curve:
    """Return the points of a curve such as `0.3:0.2+0.7:0.8`."""
    points = [tuple(number_of(n) for n in point.split(":")) for point in text.split("+")]
    curve = tuple((p[0], p[1]) for p in points if len(p) == 2 and all(0.0 <= x <= 1.0 for x in p))
    is_ascending = all(a[0] < b[0] for a, b in pairwise(curve))
    if len(curve) < len(points) or not is_ascending:
        raise ProgdfError(
            f"in grade:{what:.80} the curve is '{text:.40}'; write FROM:TO+FROM:TO, each 0 to 1, FROM rising"
        )
    return curve


def measure_grade(grade: ColorGrade, rgb: Tensor, weights: Tensor) -> ColorGrade:
    """Return the grade with shading and shades of its source colors, measured in a region.

    Args:
        grade: the grade; without a palette, it is returned unchanged
        rgb: colors of the region, sRGB 0 to 1. [N,3]
        weights: visible area of each color, ≥ 0. [N]
    """
    if not grade.palette:
        return grade
    sources = srgb_to_oklab(torch.stack([source for source, _ in grade.palette]))
    lab = srgb_to_oklab(rgb.clamp(0, 1)).reshape(-1, 3)
    areas = weights.reshape(-1)
    shades = find_shades(rgb.reshape(-1, 3), areas, sources)
    shadings = measure_palette(lab, areas, sources, shades)
    return replace(grade, palette_shadings=shadings, palette_shades=shades)


def grade_course(rgb: Tensor, grade: ColorGrade, detail: Tensor | None = None) -> ColorFunction:
    """Return the path from colors to those of `grade_fully`, straight in OKLab."""
    return color_path(rgb, grade_fully(rgb, grade, detail), STRAIGHT)


def grade_fully(rgb: Tensor, grade: ColorGrade, detail: Tensor | None = None) -> Tensor:
    """Apply the controls of a grade, in the order of this module.

    Args:
        rgb: sRGB colors, 0 to 1. [...,3]
        grade: settings
        detail: see `local_detail`; None: without clarity. [...]

    Returns:
        Graded sRGB colors, 0 to 1; the colors themselves, clamped, for a neutral grade. [...,3]
    """
    inside = rgb.nan_to_num(0.0).clamp(0, 1)
    if grade.is_neutral:
        return inside
    if detail is not None:
        inside = clarify(inside, detail, grade.clarity)
    lab = srgb_to_oklab(inside)
    if any(not torch.equal(source, target) for source, target in grade.palette) or any(grade.palette_curves):
        sources, targets = (srgb_to_oklab(torch.stack(colors)) for colors in zip(*grade.palette, strict=True))
        shifted = shift_palette(
            lab,
            sources,
            targets,
            grade.palette_curves,
            grade.palette_shadings,
            grade.palette_shades,
            grade.palette_ranges,
        )
        lab = srgb_to_oklab(fit_gamut(shifted))
    value = {name: grade.values.get(name, neutral) for name, (_, _, neutral) in GRADE_RANGES.items()}
    lab = _expose_tones(lab, value)
    lightness = lab[..., 0].clamp(0, 1)
    ab = tone.balance_white(lab[..., 1:], lightness, value["temperature"], value["tint"])
    steeper = tone.contrast(lightness, value["contrast"]) if value["contrast"] else lightness
    if grade.curve:
        steeper = bend_lightness(steeper, grade.curve)
    lab = torch.cat([steeper[..., None], ab * chroma_factor(lightness, steeper)[..., None]], dim=-1)
    if grade.has_wheels:
        lab = tone.turn_wheels(lab, grade.wheels, value["balance"])
    ab = tone.vibrance(lab[..., 1:], value["vibrance"])
    ab = tone.saturate(ab, value["saturation"])
    graded = fit_gamut(torch.cat([lab[..., :1].clamp(0, 1), ab], dim=-1))
    if any(grade.channels):
        bent = [bend_lightness(graded[..., i], curve) for i, curve in enumerate(grade.channels)]
        graded = torch.stack(bent, dim=-1)
    return graded


_TONES: Mapping[str, Callable[[Tensor, float], Tensor]] = {
    "whites": tone.whites,
    "blacks": tone.blacks,
    "highlights": tone.highlights,
    "shadows": tone.shadows,
}
"""Controls of lightness before the exposure, in their order."""


def _expose_tones(lab: Tensor, value: Mapping[str, float]) -> Tensor:
    """Apply the controls of `_TONES` and the exposure; lightness may leave 0 to 1. [...,3] -> [...,3]"""
    before = lab[..., 0]
    lightness = before
    for name, control in _TONES.items():
        if value[name]:
            lightness = control(lightness, value[name])
    factor = chroma_factor(before, lightness.clamp_min(0.0))
    toned = torch.cat([lightness[..., None], lab[..., 1:] * factor[..., None]], dim=-1)
    return tone.expose(toned, value["exposure"])
