"""The brush in the window: its controls in the panel, its ring at the cursor, what keeps it from painting."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

from imgui_bundle import imgui

from viewer.render import highlight
from viewer.state.layers import is_visible
from viewer.state.view_state import BRUSH_MODES, LARGEST_PX, SMALLEST_PX, Brush, ViewState
from viewer.ui.context import PALETTE, SMALL_PX, Icon, UiContext, u32
from viewer.ui.keys import shortcut
from viewer.ui.widgets import choice, icon_button, label, section, tip, value_slider

DRAG = "brush"
"""What a left drag does while the brush is active, beside those of `keys.DRAGS`."""

NAMES = {"add": "Add", "erase": "Erase", "smooth": "Smooth"}
WHOLE = (
    ("Clear", "paint_clear", "Set all weights to 0"),
    ("Fill", "paint_fill", "Set all weights to 1"),
    ("Invert", "paint_invert", f"Swap what is painted and what is not ({shortcut('invert')})"),
    ("Feather", "paint_feather", "Soften the edges of the paint; repeat for more"),
)
"""Buttons for all of a layer's paint: name, action of `keys.KEYS`, tip."""


def obstacle(view: ViewState, focus: int | None) -> str:
    """Why the brush cannot paint now, one line; empty where it can."""
    if focus is None or focus >= len(view.layers):
        return "no layer is selected; click one, or press 1–9"
    layer = view.layers[focus]
    if layer.locked:
        return f"{layer.name} is locked; press Shift+L to unlock it"
    if not is_visible(view, layer):
        return f"{layer.name} is hidden; press H to show it"
    return ""


def draw(view: ViewState, focus: int | None, ui: UiContext, actions: list[str]) -> ViewState:
    """The brush's controls."""
    column, brush = 82.0 * ui.scale, view.brush
    imgui.dummy(imgui.ImVec2(0.0, 4.0 * ui.scale))
    section("Paint", ui)
    label("Brush", column)
    mode = choice("brush mode", tuple(NAMES[m] for m in BRUSH_MODES), BRUSH_MODES.index(brush.mode), ui)
    tip(f"Brush mode ({shortcut('brush_mode')}). While painting, Ctrl inverts and Shift smooths")
    if mode is not None:
        brush = replace(brush, mode=BRUSH_MODES[mode])
    label("Radius", column)
    radius = value_slider("##radius", brush.radius, (SMALLEST_PX, LARGEST_PX), "%.0f px", Brush.radius, ui)
    tip(f"Brush radius ({shortcut('brush_radius:0.8')} and {shortcut('brush_radius:1.25')})")
    label("Softness", column)
    softness = value_slider("##softness", brush.softness, (0.0, 1.0), "%.2f", Brush.softness, ui)
    tip(f"Brush softness ({shortcut('brush_softness:-0.1')} and ])")
    label("Flow", column)
    flow = value_slider("##flow", brush.flow, (0.0, 1.0), "%.2f", Brush.flow, ui)
    tip("How far one stroke goes; strokes over each other go further")
    label("Value", column)
    imgui.begin_disabled(brush.mode != "add")
    value = value_slider("##value", brush.value, (0.0, 1.0), "%.2f", Brush.value, ui)
    imgui.end_disabled()
    tip("The share of the edit that Add paints")
    brush = replace(brush, radius=radius, softness=softness, flow=flow, value=value)
    label("Depth", column)
    depth = choice("depth", ("Front", "Through"), int(brush.through), ui)
    tip("Paint only the front surface, or everything under the brush", "brush_through")
    if depth is not None:
        brush = replace(brush, through=bool(depth))
    label("Weights", column)
    colors = choice("weights", ("Tint", "Colors"), int(brush.weights), ui)
    tip(
        "Tint lightly what has less than all of the edit, or show all weights from blue (0) to yellow (1)",
        "brush_weights",
    )
    if colors is not None:
        brush = replace(brush, weights=bool(colors))
    if brush.weights:
        _legend(column, ui)
    label("Layer", column)
    imgui.begin_disabled(focus is None or view.layers[focus].locked)
    texts = [imgui.calc_text_size(text).x for text, *_ in WHOLE]
    spare = imgui.get_content_region_avail().x - 4.0 * (len(WHOLE) - 1) * ui.scale - sum(texts)
    imgui.push_style_var(
        imgui.StyleVar_.frame_padding.value, imgui.ImVec2(0.0, imgui.get_style().frame_padding.y)
    )
    for wide, (text, action, help_) in zip(texts, WHOLE, strict=True):
        if imgui.button(f"{text}##{action}", imgui.ImVec2(wide + spare / len(WHOLE), 0.0)):
            actions.append(action)
        tip(help_, action)
        imgui.same_line(0.0, 4.0 * ui.scale)
    imgui.pop_style_var()
    imgui.end_disabled()
    imgui.new_line()
    return replace(view, brush=brush)


def _legend(column: float, ui: UiContext) -> None:
    """The ramp of the weights with its ends named."""
    imgui.set_cursor_pos_x(column)
    left, top = imgui.get_cursor_screen_pos()
    width, height, size = imgui.get_content_region_avail().x, 10.0 * ui.scale, SMALL_PX * ui.scale
    canvas = imgui.get_window_draw_list()
    for (start, a), (end, b) in pairwise(highlight.RAMP):
        low, high = (u32(highlight.rgba(color)) for color in (a, b))
        corners = imgui.ImVec2(left + start * width, top), imgui.ImVec2(left + end * width, top + height)
        canvas.add_rect_filled_multi_color(*corners, low, high, high, low)
    imgui.push_font(None, SMALL_PX)
    wide = imgui.calc_text_size("1").x
    imgui.pop_font()
    for x, text in ((left, "0"), (left + width - wide, "1")):
        at = imgui.ImVec2(round(x), round(top + height + 2.0 * ui.scale))
        canvas.add_text(ui.fonts.regular, size, at, u32(PALETTE.dim), text)
    imgui.dummy(imgui.ImVec2(width, height + size + 2.0 * ui.scale))


def toggle(view: ViewState, ui: UiContext) -> bool:
    """The button that takes the brush up and puts it down; True when pressed."""
    pressed = icon_button("brush", Icon.BRUSH, ui, dim=not view.brush.active)
    tip("Paint the strength of the selected layer", "brush")
    return pressed


def ring(view: ViewState, ui: UiContext) -> None:
    """The brush at the cursor: its edge, and inside which its touch is full."""
    brush, mouse = view.brush, imgui.get_mouse_pos()
    canvas, radius = imgui.get_background_draw_list(), brush.radius * ui.scale
    inner = radius * (1.0 - brush.softness)
    for size, alpha in ((radius, 1.0), (inner, 0.45)):
        if size > 2.0 * ui.scale:
            canvas.add_circle(mouse, size, u32((0.0, 0.0, 0.0, 0.5 * alpha)), 0, 3.0 * ui.scale)
            canvas.add_circle(mouse, size, u32((*PALETTE.handle[:3], alpha)), 0, 1.25 * ui.scale)
