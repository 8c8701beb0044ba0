"""What stands over and under the cards of a long stack: the search, and what selected layers share."""

from __future__ import annotations

from collections.abc import Sequence

from imgui_bundle import imgui

from viewer.panel import strength_slider
from viewer.state.layer_selection import master_strength
from viewer.state.layers import largest_strength
from viewer.state.view_state import ViewState
from viewer.state.workspace import Workspace, is_compact
from viewer.ui.context import PALETTE, SMALL_PX, Icon, UiContext, u32
from viewer.ui.keys import shortcut
from viewer.ui.widgets import icon_button, right_edge, section, tip

MASTER_PX = 20.0  # of its slider, at 1×
UNSEARCHED = 6
"""Layers that one finds without a search."""
_BUTTONS = (
    ("Group", "group", "Put them into a group with a switch and a strength of its own"),
    ("Copy", "copy_values", "Copy their strengths and gains, as text"),
    ("Paste", "paste_values", "Paste copied strengths and gains"),
    ("Reset", "reset", "Strengths to 0, gains to 1"),
)


def search(work: Workspace, ui: UiContext, actions: list[str]) -> str:
    """The field of the search and the switch of compact rows, where there are many layers; what is typed."""
    if not (len(work.view.layers) > UNSEARCHED or work.searching or work.search):
        return work.search
    compact = is_compact(work)
    side, gap = imgui.get_frame_height(), 4.0 * ui.scale
    buttons = 1 + bool(work.search)
    imgui.set_next_item_width(imgui.get_content_region_avail().x - buttons * (side + gap))
    if work.searching:
        imgui.set_keyboard_focus_here()
    flags = imgui.InputTextFlags_.escape_clears_all.value | imgui.InputTextFlags_.auto_select_all.value
    _, text = imgui.input_text_with_hint("##search", "Search by name, region, group", work.search, flags)
    tip(f"Only layers with all these words ({shortcut('search')}). Esc: show all")
    if work.search:
        imgui.same_line(0.0, gap)
        if icon_button("clear", Icon.CLOSE, ui):
            text = ""
        tip("Show all layers")
    imgui.same_line(0.0, gap)
    if icon_button("cards", Icon.FULL if compact else Icon.COMPACT, ui, dim=False):
        actions.append("cards")
    tip("Whole cards" if compact else "Compact rows", "cards")
    return str(text)


def selection_height(chosen: Sequence[int], ui: UiContext) -> float:
    """Of `selection`, window pixels; 0 where it is not shown."""
    if len(chosen) < 2:
        return 0.0
    spacing = imgui.get_style().item_spacing.y
    return (SMALL_PX + 6.0 + MASTER_PX) * ui.scale + 3 * spacing


def selection(state: ViewState, chosen: Sequence[int], ui: UiContext, actions: list[str]) -> None:
    """The strength of several selected layers and what is done with all of them, under the cards."""
    if len(chosen) < 2:
        return
    imgui.separator()
    right = right_edge()
    imgui.push_style_var(imgui.StyleVar_.frame_padding, imgui.ImVec2(6.0 * ui.scale, 3.0 * ui.scale))
    section(f"{len(chosen)} layers", ui)
    imgui.push_font(None, SMALL_PX)
    gap = 4.0 * ui.scale
    wide = [imgui.calc_text_size(name).x + 12.0 * ui.scale for name, _, _ in _BUTTONS]
    imgui.same_line(right - sum(wide) - gap * (len(wide) - 1))
    for i, (name, action, help_) in enumerate(_BUTTONS):
        if i:
            imgui.same_line(0.0, gap)
        if imgui.button(f"{name}##layers", imgui.ImVec2(wide[i], 0.0)):
            actions.append(action)
        tip(help_, action)
    imgui.pop_font()
    imgui.pop_style_var()
    value, most = master_strength(state, chosen), largest_strength(state)
    number = imgui.calc_text_size(f"{value:.3f}").x
    imgui.begin_disabled(all(state.layers[i].locked for i in chosen))
    at = imgui.get_cursor_screen_pos()
    room = imgui.get_content_region_avail().x - number - 8.0 * ui.scale
    help_ = "Strength of all selected layers: that of the strongest; the others keep their proportion to it"
    new = strength_slider.draw(
        "##master", value, (), room, ui.scale, PALETTE.accent, True, most, MASTER_PX, help_=help_
    )
    imgui.end_disabled()
    corner = imgui.ImVec2(at.x + room + 8.0 * ui.scale, at.y)
    imgui.get_window_draw_list().add_text(corner, u32(PALETTE.text), f"{new:.3f}")
    if new != value:
        actions.append(f"master:{new!r}")
