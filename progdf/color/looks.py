"""Looks: named grades, as text of `progdf train --editor grade:…`."""

from __future__ import annotations

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
