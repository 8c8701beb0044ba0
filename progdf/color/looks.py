"""Looks: named grades, as text of `progdf train --editor grade:…`."""

from __future__ import annotations

from .grade import GRADE_RANGES, ColorGrade

BUILT_IN: dict[str, str] = {
    "Soft film": "contrast=-0.10,highlights=-0.25,blacks=0.25,saturation=-0.12,wheel_shadows=220:0.10:0,"
    "wheel_highlights=75:0.12:0",
    "Punch": "contrast=0.25,shadows=0.15,blacks=-0.20,vibrance=0.35",
    "Open shadows": "shadows=0.60,highlights=-0.30,contrast=0.05",
    "Teal & orange": "contrast=0.12,vibrance=0.15,wheel_shadows=205:0.35:-0.05,wheel_highlights=65:0.30:0.03",
    "Golden hour": "exposure=0.15,temperature=0.35,tint=0.08,highlights=-0.20,wheel_highlights=80:0.15:0",
    "Blue hour": "exposure=-0.50,temperature=-0.40,saturation=-0.15,wheel_shadows=265:0.30:0",
    "Bleach": "contrast=0.45,saturation=-0.55,highlights=-0.20,whites=0.10",
    "Mono": "saturation=-1.00,contrast=0.20,blacks=-0.10,whites=0.10",
}
"""Name → settings of the looks that come with the program."""


def look_name(file_stem: str) -> str:
    """Return the name of a look by its file's name."""
    return file_stem.replace("_", " ").strip() or "Look"


_EFFECTS = {
    "exposure": ("Darker", "Brighter"),
    "contrast": ("Low contrast", "High contrast"),
    "highlights": ("Soft highlights", "Bright highlights"),
    "shadows": ("Deep shadows", "Open shadows"),
    "whites": ("Dim whites", "Bright whites"),
    "blacks": ("Deep blacks", "Lifted blacks"),
    "temperature": ("Cool", "Warm"),
    "tint": ("Green", "Magenta"),
    "vibrance": ("Muted", "Vivid"),
    "saturation": ("Pale", "Saturated"),
    "clarity": ("Smooth", "Crisp"),
}
"""Names of the effect of each slider of a grade, below and above its neutral value."""


def describe_look(grade: ColorGrade) -> str:
    """Return a name for a grade: its two strongest effects, such as "Warm, open shadows"."""
    strengths = dict[str, float]()
    for name, words in _EFFECTS.items():
        low, high, neutral = GRADE_RANGES[name]
        value = grade.values.get(name, neutral) - neutral
        strengths[words[value > 0.0]] = abs(value) / (high if value > 0.0 else -low)
    strengths["Toned"] = max(max(wheel.amount, abs(wheel.light)) for wheel in grade.wheels)
    changed = [float((target - source).abs().max()) for source, target in grade.palette]
    strengths["Recolored"] = max(changed, default=0.0)
    curves = (*grade.palette_curves, grade.curve, *grade.channels)
    strengths["Curve"] = max((abs(y - x) for curve in curves for x, y in curve), default=0.0)
    effects = sorted((name for name in strengths if strengths[name] > 0.0), key=lambda name: -strengths[name])
    return ", ".join(effects[:2]).capitalize()
