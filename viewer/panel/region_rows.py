"""The panel's part "Regions": a row for each kept selection; a click selects it again."""

from __future__ import annotations

from imgui_bundle import imgui

from viewer.state.selection import NamedRegion
from viewer.state.workspace import Pointed
from viewer.ui.context import PALETTE, SMALL_PX, Icon, UiContext, u32
from viewer.ui.widgets import elide, group_digits, icon_button, menu, right_edge, section, tip, typed_name

_MENU = "menu of a region"
_ITEMS = ("Select", "Add to selection", "Subtract from selection", "Rename…", "Delete")


def draw(regions: tuple[NamedRegion, ...], ui: UiContext, actions: list[str]) -> Pointed | None:
    """Draw the section where there are regions; the row the mouse rests on. Wishes go into `actions`."""
    if not regions:
        return None
    imgui.dummy(imgui.ImVec2(0.0, 4.0 * ui.scale))
    section("Regions", ui)
    pointed: Pointed | None = None
    for i, region in enumerate(regions):
        imgui.push_id(f"region {i}")
        if _row(i, region, ui, actions):
            pointed = ("region", i)
        imgui.pop_id()
    return pointed


def _row(index: int, region: NamedRegion, ui: UiContext, actions: list[str]) -> bool:
    """Eye, swatch, name and count; whether the mouse rests on it."""
    right, scale = right_edge(), ui.scale
    icon = Icon.SHOWN if region.visible else Icon.HIDDEN
    if icon_button("eye", icon, ui, dim=not region.visible):
        actions.append(f"show_region:{index}")
    tip("Tint this region in the picture")
    imgui.same_line()
    x, y = imgui.get_cursor_screen_pos()
    side, tall = 12.0 * scale, imgui.get_frame_height()
    top = y + (tall - side) / 2
    corners = imgui.ImVec2(x, top), imgui.ImVec2(x + side, top + side)
    canvas = imgui.get_window_draw_list()
    canvas.add_rect_filled(*corners, u32((*region.color, 1.0)), 3 * scale)
    imgui.dummy(imgui.ImVec2(side, tall))
    imgui.same_line()
    count = group_digits(region.count)
    imgui.push_font(None, SMALL_PX)
    wide = imgui.calc_text_size(count).x
    imgui.pop_font()
    room = right - wide - 10.0 * scale - imgui.get_cursor_pos_x()
    naming, storage = imgui.get_id("naming"), imgui.get_state_storage()
    if storage.get_bool(naming):
        name = typed_name(region.name, room)
        storage.set_bool(naming, name is None)
        actions += [f"rename_region:{index}:{name}"] if name else []
        return False
    x, y = imgui.get_cursor_screen_pos()
    io, mouse = imgui.get_io(), imgui.MouseButton_
    if imgui.invisible_button("select", imgui.ImVec2(max(right - imgui.get_cursor_pos_x(), 1.0), tall)):
        mode = "add" if io.key_shift else "subtract" if io.key_ctrl else "new"
        actions.append(f"region:{index}:{mode}")
    resting = imgui.is_item_hovered(imgui.HoveredFlags_.for_tooltip.value)
    color = u32(PALETTE.text if imgui.is_item_hovered() else PALETTE.dim)
    tip(f"{region.path}\nClick to select; Shift adds, Ctrl subtracts. Right-click: rename, delete")
    if imgui.is_item_clicked(mouse.right.value):
        imgui.open_popup(_MENU)
    above = imgui.get_style().frame_padding.y
    canvas.add_text(imgui.ImVec2(x, y + above), u32(PALETTE.text), elide(region.name, room))
    at = imgui.ImVec2(imgui.get_item_rect_max().x - wide, y + above + 1.0 * scale)
    canvas.add_text(ui.fonts.regular, SMALL_PX * scale, at, color, count)
    match _chosen(ui):
        case "Rename…":
            storage.set_bool(naming, True)
        case "Delete":
            actions.append(f"forget_region:{index}")
        case "Select":
            actions.append(f"region:{index}:new")
        case "Add to selection":
            actions.append(f"region:{index}:add")
        case "Subtract from selection":
            actions.append(f"region:{index}:subtract")
    return bool(resting)


def _chosen(ui: UiContext) -> str:
    """The item of the menu that was chosen, "" for none."""
    with menu(_MENU, ui) as is_open:
        chosen = [name for name in _ITEMS if is_open and imgui.menu_item(name, "", False)[0]]
    return chosen[0] if chosen else ""
