"""The stack of edits in the panel: one card per layer, and the rule by which they blend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from imgui_bundle import imgui

from progdf.compose import BLENDS

from . import strength_slider
from .layer_rows import LayerRow
from .state import LayerState, ViewState
from .ui_context import PALETTE, Icon, Rgba, UiContext, u32
from .widgets import elided, grouped, icon_button, right_edge, section, small, tip

BLEND_HELP = {
    "normalised": "Overlapping edits share a Gaussian by their weights; never more than a full edit.",
    "sum": "Overlapping edits add up.",
    "over": "A later edit covers the ones above it in the list, as far as its strength goes.",
}


def heading(state: ViewState, ui: UiContext) -> ViewState:
    """The heading of the stack, with the blend rule where there is something to blend."""
    right = right_edge()
    section("Edits", ui)
    if len(state.layers) < 2:
        return state
    combo = 118.0 * ui.scale
    imgui.same_line(right - combo)
    imgui.set_next_item_width(combo)
    if imgui.begin_combo("##blend", state.blend.capitalize()):
        for blend in BLENDS:
            if imgui.selectable(blend.capitalize(), blend == state.blend)[0]:
                state = replace(state, blend=blend)
            tip(BLEND_HELP[blend])
        imgui.end_combo()
    else:
        tip("Where edits overlap: " + BLEND_HELP[state.blend])
    return state


def draw(
    state: ViewState, rows: Sequence[LayerRow], focus: int | None, reveal: bool, ui: UiContext
) -> tuple[ViewState, int | None]:
    """All cards; the changed state and the focused layer.

    Args:
        state: what the cards show
        rows: one per .gdf, indexed by `LayerState.gdf`
        focus: the focused layer, an index into `state.layers`, or None
        reveal: scroll to it
        ui: fonts and scale
    """
    if not state.layers:
        imgui.push_text_wrap_pos(0.0)
        imgui.text_disabled("No edits are loaded. Drop a .gdf file on the window.")
        imgui.pop_text_wrap_pos()
    layers = list(state.layers)
    for i, layer in enumerate(layers):
        layers[i], touched = _card(i, layer, rows[layer.gdf], focus == i, ui)
        if reveal and focus == i:
            imgui.set_scroll_here_y(0.5)
        focus = i if touched else focus
    return replace(state, layers=tuple(layers)), focus


def _card(
    index: int, layer: LayerState, row: LayerRow, focused: bool, ui: UiContext
) -> tuple[LayerState, bool]:
    """One card: eye, swatch, name and value; the slider; count and instruction."""
    scale, p = ui.scale, PALETTE
    imgui.push_id(index)
    canvas = imgui.get_window_draw_list()
    clip = canvas.get_clip_rect_min(), canvas.get_clip_rect_max()
    imgui.push_style_color(imgui.Col_.child_bg, imgui.ImVec4(*(p.card_focused if focused else p.card)))
    imgui.push_style_var(imgui.StyleVar_.window_padding, imgui.ImVec2(10 * scale, 8 * scale))
    child = imgui.ChildFlags_
    imgui.begin_child(
        "card",
        imgui.ImVec2(0.0, 0.0),
        child.auto_resize_y.value | child.always_use_window_padding.value,
        imgui.WindowFlags_.no_nav.value,
    )
    layer = _head(layer, row, ui)
    strength = strength_slider.draw(
        "##strength",
        layer.strength,
        row.recorded,
        imgui.get_content_region_avail().x,
        scale,
        p.accent if focused else p.accent_dark,
        layer.enabled,
    )
    touched = imgui.is_item_active()
    layer = replace(layer, strength=strength)
    note = f"{grouped(row.count)} splats" + (f"  ·  {row.instruction}" if row.instruction else "")
    small(note, p.dim)
    pressed = imgui.is_window_hovered() and imgui.is_mouse_clicked(imgui.MouseButton_.left.value)
    if focused:
        _focus_bar(clip, scale)
    imgui.end_child()
    imgui.pop_style_var()
    imgui.pop_style_color()
    imgui.pop_id()
    return layer, touched or pressed


def _focus_bar(clip: tuple[imgui.ImVec2, imgui.ImVec2], scale: float) -> None:
    """A stripe along the left edge of the card that is being drawn, in the panel's clip."""
    canvas, corner = imgui.get_window_draw_list(), imgui.get_window_pos()
    edge = imgui.ImVec2(corner.x + 3 * scale, corner.y + imgui.get_window_size().y)
    canvas.push_clip_rect(*clip, False)
    canvas.add_rect_filled(corner, edge, u32(PALETTE.accent), 3 * scale)
    canvas.pop_clip_rect()


def _head(layer: LayerState, row: LayerRow, ui: UiContext) -> LayerState:
    scale, p = ui.scale, PALETTE
    right = right_edge()
    if icon_button("eye", Icon.SHOWN if layer.enabled else Icon.HIDDEN, ui, dim=not layer.enabled):
        layer = replace(layer, enabled=not layer.enabled)
    tip("Show or hide this edit (H)")
    imgui.same_line()
    _swatch(row.swatch, layer.enabled, ui)
    imgui.same_line()
    number = f"{layer.strength:.3f}"
    number_width = imgui.calc_text_size(number).x
    imgui.align_text_to_frame_padding()
    room = right - number_width - 10 * scale - imgui.get_cursor_pos_x()
    imgui.push_style_color(imgui.Col_.text, imgui.ImVec4(*(p.text if layer.enabled else p.dim)))
    imgui.text(elided(layer.name, room))
    imgui.same_line(right - number_width)
    imgui.text(number)
    imgui.pop_style_color()
    if imgui.is_item_clicked():
        strength_slider.start_typing("##strength")
    tip("Click, or Ctrl+click the slider, to type a value")
    return layer


def _swatch(colour: tuple[float, float, float], enabled: bool, ui: UiContext) -> None:
    side = 12.0 * ui.scale
    x, y = imgui.get_cursor_screen_pos()
    top = y + (imgui.get_frame_height() - side) / 2
    imgui.dummy(imgui.ImVec2(side, imgui.get_frame_height()))
    rgba: Rgba = (*colour, 1.0 if enabled else 0.35)
    canvas = imgui.get_window_draw_list()
    corners = imgui.ImVec2(x, top), imgui.ImVec2(x + side, top + side)
    canvas.add_rect_filled(*corners, u32(rgba), 3 * ui.scale)
    canvas.add_rect(*corners, u32(PALETTE.line), 3 * ui.scale)
