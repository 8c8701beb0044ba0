"""What a layer's card unfolds: the curve of its visible change over the strength, and its gains."""

from __future__ import annotations

from collections.abc import Sequence

from imgui_bundle import imgui

from viewer.state.layer_facts import STEPS, LayerRow
from viewer.state.layers import SLIDERS, slider_value, with_slider_value
from viewer.state.view_state import LayerState
from viewer.ui.context import PALETTE, SMALL_PX, UiContext, u32
from viewer.ui.widgets import label, tip, value_slider

CURVE_PX = 52.0  # at 1×
GAINS = SLIDERS[1:]


def draw(
    layer: LayerState, row: LayerRow, active_slider: str | None, most: float, ui: UiContext
) -> LayerState:
    """Draw the curve and the gains.

    Args:
        layer: what they show
        row: of its .gdf
        active_slider: what the arrow keys move; None where they move another layer
        most: the upper end of the strength
        ui: fonts and scale
    """
    _curve(row, layer.strength, most, ui)
    imgui.begin_disabled(layer.locked)
    for kind in GAINS:
        layer = _gain(layer, kind, kind in row.kinds, kind == active_slider, ui)
    imgui.end_disabled()
    return layer


def _gain(layer: LayerState, kind: str, moves: bool, active: bool, ui: UiContext) -> LayerState:
    """One gain: a slider as the others of the panel."""
    if active:
        imgui.push_style_color(imgui.Col_.text_disabled, imgui.ImVec4(*PALETTE.accent))
    label(kind.capitalize(), 84.0 * ui.scale)
    if active:
        imgui.pop_style_color()
    imgui.begin_disabled(not moves)
    value = slider_value(layer, kind)
    new = value_slider(f"##{kind}", value, (0.0, 1.0), "%.2f", 1.0, ui)
    imgui.end_disabled()
    if moves:
        tip(f"How much of the {kind} change is applied (Tab, then arrow keys). Double-click: reset to 1")
    else:
        tip(f"This edit does not change the {kind}")
    return layer if new == value else with_slider_value(layer, kind, new)


def value_at(curve: Sequence[float], strength: float) -> float:
    """The curve at a strength, linear between its points; its last value beyond them."""
    place = max(strength, 0.0) * STEPS
    low = min(int(place), len(curve) - 1)
    high = min(low + 1, len(curve) - 1)
    return curve[low] + (curve[high] - curve[low]) * min(place - low, 1.0)


def _curve(row: LayerRow, strength: float, most: float, ui: UiContext) -> None:
    """Visible change over the strength, under the slider's track and to its measure."""
    curve = row.curve()[: round(most * STEPS) + 1]
    if not curve:
        return
    scale, p = ui.scale, PALETTE
    left, top = imgui.get_cursor_screen_pos()
    width, height = imgui.get_content_region_avail().x, CURVE_PX * scale
    imgui.dummy(imgui.ImVec2(width, height))
    tip(
        "Visible change against strength, measured in small renders of this region; 1 is the full edit."
        f"\nTicks: {len(row.recorded)} recorded snapshots."
    )
    canvas, radius = imgui.get_window_draw_list(), 7.0 * scale
    start, span = left + radius, (width - 2 * radius) / most
    foot, rise = top + height - 4.0 * scale, (height - 10.0 * scale) / max(1.0, *curve)
    canvas.add_rect_filled(
        imgui.ImVec2(left, top), imgui.ImVec2(left + width, top + height), u32(p.panel), 4 * scale
    )
    if most > 1.0:
        beyond = imgui.ImVec2(start + span, top), imgui.ImVec2(left + width, top + height)
        canvas.add_rect_filled(*beyond, u32((*p.warning_dark[:3], 0.35)), 4 * scale)
    for tick in row.recorded:
        x = round(start + tick * span) + 0.5
        ends = imgui.ImVec2(x, foot - 6 * scale), imgui.ImVec2(x, foot)
        canvas.add_line(*ends, u32(p.faint), max(1.0, scale))
    canvas.add_line(imgui.ImVec2(start, foot), imgui.ImVec2(start + most * span, foot), u32(p.line), scale)
    for i in range(len(curve) - 1):
        a, b = (imgui.ImVec2(start + j / STEPS * span, foot - curve[j] * rise) for j in (i, i + 1))
        canvas.add_line(a, b, u32(p.warning if i >= STEPS else p.accent), 1.5 * scale)
    share = value_at(curve, strength)
    at = imgui.ImVec2(start + strength * span, foot - share * rise)
    canvas.add_circle_filled(at, 4.5 * scale, u32(p.panel))
    canvas.add_circle_filled(at, 3.0 * scale, u32(p.handle))
    corner = imgui.ImVec2(round(left + 6 * scale), round(top + 3 * scale))
    canvas.add_text(ui.fonts.regular, SMALL_PX * scale, corner, u32(p.dim), f"change {100 * share:.0f} %")
