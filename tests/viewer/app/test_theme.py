"""Colors of the theme: text and controls contrast with their background (WCAG 2.1)."""

from __future__ import annotations

import pytest
from imgui_bundle import imgui

from viewer.ui.context import PALETTE, Rgba, UiContext

GROUNDS = ("panel", "card", "card_focused", "scrim")
FIELDS = ("field", "field_hovered")
TEXT = 4.5
ICON = 3.0
TICK = 4.0
"""Minimum contrast ratios of text, icons and slider ticks."""
PAIRS = (
    *[("text", ground, TEXT) for ground in (*GROUNDS, *FIELDS, "field_active", "chosen")],
    *[("dim", ground, TEXT) for ground in (*GROUNDS, "field")],
    *[(color, ground, TEXT) for color in ("error", "warning", "success") for ground in GROUNDS],
    *[("handle", ground, TEXT) for ground in ("chosen", "field")],
    ("ink", "accent", TEXT),
    ("ink", "handle", TEXT),
    *[("dim", ground, TICK) for ground in ("card", "card_focused")],
    *[(color, ground, ICON) for color in ("faint", "accent") for ground in GROUNDS],
)


def luminance(color: Rgba) -> float:
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in color[:3]]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(color: Rgba, ground: Rgba) -> float:
    light, dark = sorted((luminance(color), luminance(ground)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def over(color: Rgba, ground: Rgba, alpha: float) -> Rgba:
    red, green, blue = (alpha * a + (1.0 - alpha) * b for a, b in zip(color[:3], ground[:3], strict=True))
    return red, green, blue, 1.0


@pytest.mark.parametrize(("color", "ground", "least"), PAIRS)
def test_text_and_controls_have_enough_contrast(color: str, ground: str, least: float) -> None:
    found = contrast(getattr(PALETTE, color), getattr(PALETTE, ground))
    assert found >= least, f"{color} on {ground}: {found:.2f}"


@pytest.mark.parametrize("ground", GROUNDS)
def test_disabled_text_is_darker_than_all_enabled_colors(ground: str) -> None:
    ui = UiContext()
    alpha = imgui.get_style().disabled_alpha
    ui.close()
    below = getattr(PALETTE, ground)
    disabled = contrast(over(PALETTE.text, below, alpha), below)
    assert disabled < min(contrast(color, below) for color in (PALETTE.faint, PALETTE.dim, PALETTE.text))


def test_accent_is_the_only_color_besides_warnings() -> None:
    colored = {
        name
        for name, color in vars(PALETTE).items()
        if max(color[:3]) - min(color[:3]) > 0.09 and not name.startswith(("warning", "error", "success"))
    }
    assert colored == {"accent"}
