"""The row over the layers of a group: fold, eye, name, the factor of its strengths."""

from __future__ import annotations

from dataclasses import replace

from imgui_bundle import imgui

from viewer.panel import strength_slider
from viewer.panel.layer_card import COMPACT_PX, SLIDER_PX, SLIM_PX
from viewer.state.layers import change_group, toggle_collapsed
from viewer.state.view_state import LayerGroup, ViewState
from viewer.ui.context import PALETTE, Icon, UiContext, u32
from viewer.ui.keys import shortcut
from viewer.ui.widgets import elide, grip, icon_button, menu, right_edge, tip, typed_name

_MENU = "menu of a group"
_ITEMS = (("Rename…", ""), ("Select layers", ""), ("Ungroup", "ungroup"))


def draw(
    state: ViewState, group: LayerGroup, count: int, ui: UiContext, actions: list[str]
) -> tuple[ViewState, str]:
    """The row of a group of `count` layers; the changed state, and what the hand does with it, see `grip`.

    What was asked for goes into `actions`.
    """
    scale, folded = ui.scale, group.name in state.collapsed
    imgui.push_id(f"group {group.name}")
    imgui.begin_group()
    right = right_edge() - COMPACT_PX * scale
    if _fold(folded, ui):
        state = toggle_collapsed(state, group.name)
    tip("List its layers, or not")
    imgui.same_line(0.0, 0.0)
    if icon_button("eye", Icon.SHOWN if group.enabled else Icon.HIDDEN, ui, dim=not group.enabled):
        state = change_group(state, group.name, lambda old: replace(old, enabled=not old.enabled))
    tip("Show or hide the group")
    imgui.same_line(0.0, 4.0 * scale)
    number = f"{group.strength:.2f}"
    wide = imgui.calc_text_size(number).x
    slider_at = right - wide - (SLIDER_PX + 6.0) * scale
    corner, gesture = _name(
        state, group, count, slider_at - 6.0 * scale - imgui.get_cursor_pos_x(), ui, actions
    )
    imgui.same_line(slider_at)
    imgui.set_cursor_pos_y(imgui.get_cursor_pos_y() + (imgui.get_frame_height() - SLIM_PX * scale) / 2)
    strength = strength_slider.draw(
        "##factor",
        group.strength,
        (),
        SLIDER_PX * scale,
        scale,
        PALETTE.accent_dark,
        group.enabled,
        height=SLIM_PX,
        default=LayerGroup.strength,
        help_="What the strengths of its layers are multiplied by. Double-click: reset to 1",
    )
    number_at = imgui.ImVec2(imgui.get_item_rect_max().x + 6.0 * scale, corner.y)
    color = u32(PALETTE.text if group.enabled else PALETTE.dim)
    imgui.get_window_draw_list().add_text(number_at, color, f"{strength:.2f}")
    imgui.end_group()
    imgui.pop_id()
    if strength == group.strength:
        return state, gesture
    return change_group(state, group.name, lambda old: replace(old, strength=strength)), gesture


def _fold(folded: bool, ui: UiContext) -> bool:
    """The arrow at the left; True when it was pressed."""
    wide, tall = 16.0 * ui.scale, imgui.get_frame_height()
    x, y = imgui.get_cursor_screen_pos()
    pressed = imgui.invisible_button("fold", imgui.ImVec2(wide, tall))
    arrow = Icon.FOLDED if folded else Icon.UNFOLDED
    size = imgui.calc_text_size(arrow)
    at = imgui.ImVec2(round(x + (wide - size.x) / 2), round(y + (tall - size.y) / 2))
    color = PALETTE.text if imgui.is_item_hovered() else PALETTE.dim
    imgui.get_window_draw_list().add_text(at, u32(color), arrow)
    return bool(pressed)


def _name(
    state: ViewState, group: LayerGroup, count: int, room: float, ui: UiContext, actions: list[str]
) -> tuple[imgui.ImVec2, str]:
    """The name and its menu; the corner of its text, and what the hand does with it.

    A click selects the layers, a second one renames, a drag moves them.
    """
    storage, naming = imgui.get_state_storage(), imgui.get_id("naming")
    x, y = imgui.get_cursor_screen_pos()
    corner = imgui.ImVec2(x, y + imgui.get_style().frame_padding.y)
    if storage.get_bool(naming):
        name = typed_name(group.name, room)
        storage.set_bool(naming, name is None)
        actions += [f"rename_group:{state.groups.index(group)}:{name}"] if name else []
        return corner, ""
    imgui.invisible_button("name", imgui.ImVec2(max(room, 1.0), imgui.get_frame_height()))
    gesture = grip(ui)
    if gesture == "clicked":
        actions.append(f"select_layers:{group.name}")
    hovered = imgui.is_item_hovered()
    tip(f"{group.name}, {count} layers\nClick to select them, drag to reorder, double-click to rename")
    if hovered and imgui.is_mouse_double_clicked(imgui.MouseButton_.left.value):
        storage.set_bool(naming, True)
    if imgui.is_item_clicked(imgui.MouseButton_.right.value):
        imgui.open_popup(_MENU)
    imgui.push_font(ui.fonts.bold, 0.0)
    color = PALETTE.handle if hovered else PALETTE.text if group.enabled else PALETTE.dim
    imgui.get_window_draw_list().add_text(corner, u32(color), elide(group.name, room))
    imgui.pop_font()
    with menu(_MENU, ui) as is_open:
        chosen = [
            name for name, action in _ITEMS if is_open and imgui.menu_item(name, shortcut(action), False)[0]
        ]
    if chosen == ["Rename…"]:
        storage.set_bool(naming, True)
    elif chosen:
        actions.append(f"{'ungroup' if chosen == ['Ungroup'] else 'select_layers'}:{group.name}")
    return corner, gesture
