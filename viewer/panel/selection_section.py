"""The panel's parts "Select" and "Regions": the tools, what is done with the selection, and kept ones."""

from __future__ import annotations

from dataclasses import replace

from imgui_bundle import imgui

from viewer.state.selection import NamedRegion
from viewer.state.view_state import LARGEST_PX, SELECT_MODES, SMALLEST_PX, SelectTool, ViewState
from viewer.state.workspace import Pointed
from viewer.ui.context import PALETTE, SMALL_PX, Icon, UiContext, u32
from viewer.ui.keys import shortcut
from viewer.ui.widgets import (
    choice,
    elide,
    group_digits,
    icon_button,
    label,
    menu,
    right_edge,
    section,
    small,
    tip,
    typed_name,
    value_slider,
)

_TOOLS = (
    ("box", Icon.BOX, "Box", ""),
    ("lasso", Icon.LASSO, "Lasso", ""),
    ("polygon", Icon.POLYGON, "Polygon", ": click its corners; Enter or a double click closes it"),
    ("brush", Icon.SELECT_BRUSH, "Brush", ""),
    ("sphere", Icon.SPHERE, "Sphere", ": drag from its center on a surface"),
    ("flood", Icon.FLOOD, "Flood", ": click a surface; what is connected and alike in color"),
    ("color", Icon.COLOR, "Color", ": click; everything that is alike in color"),
)
_MODES = "Shift adds, Ctrl subtracts, both intersect"
_OPERATIONS = (
    (
        ("Grow", "select_grow", "Add the neighbors"),
        ("Shrink", "select_shrink", "Drop what borders on others"),
        ("Smooth", "select_smooth", "Straighten the border, drop strays, fill holes"),
        ("Largest", "select_largest", "Keep only the largest connected part"),
    ),
    (
        ("Invert", "select_invert", f"Select everything else ({shortcut('invert')})"),
        ("None", "select_none", "Select nothing"),
        ("Hide", "hide_selected", "Hide the selection"),
        ("Isolate", "isolate", "Hide everything else"),
    ),
)
_MENU = "menu of a region"
_ITEMS = ("Select", "Add to selection", "Subtract from selection", "Rename…", "Delete")


def draw(state: ViewState, ui: UiContext, actions: list[str]) -> tuple[ViewState, Pointed | None]:
    """The section; the changed state and what the mouse rests on. What was asked for goes into `actions`."""
    imgui.dummy(imgui.ImVec2(0.0, 4.0 * ui.scale))
    right = right_edge()
    section("Select", ui)
    side, gap = imgui.get_frame_height(), 1.0 * ui.scale
    imgui.same_line(right - len(_TOOLS) * (side + gap) + gap)
    for tool, icon, name, how in _TOOLS:
        if _lit_button(tool, icon, state.select.tool == tool, ui):
            actions.append(f"select_tool:{tool}")
        tip(f"{name} ({shortcut(f'select_tool:{tool}')}){how}\n{_MODES}")
        imgui.same_line(0.0, gap)
    imgui.new_line()
    held, count = state.select, state.selection.count
    if held.tool:
        state = replace(state, select=_options(held, ui))
    _hidden(state, ui, actions)
    pointed: Pointed | None = None
    if not (held.tool or count):
        return state, pointed
    small(f"{group_digits(count)} splats selected" if count else "Nothing selected", PALETTE.dim)
    if count and imgui.is_item_hovered(imgui.HoveredFlags_.for_tooltip.value):
        pointed = ("selection", 0)
    imgui.begin_disabled(not count)
    gap, columns = 4.0 * ui.scale, len(_OPERATIONS[0])
    each = (imgui.get_content_region_avail().x - (columns - 1) * gap) / columns
    imgui.push_style_var(imgui.StyleVar_.frame_padding, imgui.ImVec2(0.0, 4.0 * ui.scale))
    for row in _OPERATIONS:
        for i, (name, action, help_) in enumerate(row):
            if i:
                imgui.same_line(0.0, gap)
            if imgui.button(f"{name}##{action}", imgui.ImVec2(each, 0.0)):
                actions.append(action)
            tip(help_, action)
    imgui.pop_style_var()
    _save(len(state.selection.regions), ui, actions)
    imgui.end_disabled()
    return state, pointed


def _options(held: SelectTool, ui: UiContext) -> SelectTool:
    """How the tool selects."""
    column = 82.0 * ui.scale
    label("Mode", column)
    mode = choice("select mode", ("New", "Add", "Sub", "And"), SELECT_MODES.index(held.mode), ui)
    tip(f"What becomes of the present selection.\n{_MODES}")
    if mode is not None:
        held = replace(held, mode=SELECT_MODES[mode])
    if held.tool not in ("sphere", "flood"):
        label("Depth", column)
        through = choice("select depth", ("Front", "Through"), int(held.through), ui)
        tip("Select only the front surface, or everything behind it too", "select_through")
        if through is not None:
            held = replace(held, through=bool(through))
    if held.tool == "brush":
        label("Radius", column)
        ends = (SMALLEST_PX, LARGEST_PX)
        radius = value_slider("##select radius", held.radius, ends, "%.0f px", SelectTool.radius, ui)
        tip(f"Brush radius ({shortcut('brush_radius:0.8')} and {shortcut('brush_radius:1.25')})")
        held = replace(held, radius=radius)
    if held.tool in ("flood", "color"):
        label("Tolerance", column)
        ends = (0.01, 1.0)
        tolerance = value_slider("##tolerance", held.tolerance, ends, "%.2f", SelectTool.tolerance, ui)
        keys = f"{shortcut('brush_radius:0.8')} and {shortcut('brush_radius:1.25')}"
        tip(f"How unlike the clicked color a color may be ({keys}). The last click follows it")
        held = replace(held, tolerance=tolerance)
    return held


def _hidden(state: ViewState, ui: UiContext, actions: list[str]) -> None:
    """Where splats are hidden, that they are, and a way back."""
    if state.selection.hidden:
        right, name = right_edge(), "Show all"
        small("Some splats are hidden", PALETTE.warning)
        imgui.same_line(right - imgui.calc_text_size(name).x - 2 * imgui.get_style().frame_padding.x)
        if imgui.small_button(f"{name}##hidden"):
            actions.append("show_hidden")
        tip("Show all splats again", "show_all")


def _save(regions: int, ui: UiContext, actions: list[str]) -> None:
    """The button that keeps the selection, in its place the field for the name."""
    storage, naming = imgui.get_state_storage(), imgui.get_id("naming a region")
    if storage.get_bool(naming):
        name = typed_name(f"region-{regions + 1}", imgui.get_content_region_avail().x)
        storage.set_bool(naming, name is None)
        if name:
            actions.append(f"save_region:{name}")
    elif imgui.button("Save as region…", imgui.ImVec2(imgui.get_content_region_avail().x, 0.0)):
        storage.set_bool(naming, True)
    else:
        tip("Keep the selection as NAME.region.npy and as a row below")


def _lit_button(name: str, icon: str, lit: bool, ui: UiContext) -> bool:
    """An icon button with the accent behind it while it is on."""
    if lit:
        x, y = imgui.get_cursor_screen_pos()
        side = imgui.get_frame_height()
        corners = imgui.ImVec2(x, y), imgui.ImVec2(x + side, y + side)
        canvas = imgui.get_window_draw_list()
        canvas.add_rect_filled(
            *corners, imgui.get_color_u32(imgui.ImVec4(*PALETTE.accent_dark)), 4 * ui.scale
        )
    return icon_button(f"select {name}", icon, ui, dim=False)


def draw_regions(regions: tuple[NamedRegion, ...], ui: UiContext, actions: list[str]) -> Pointed | None:
    """The section "Regions", where there are some: a row for each; the one that the mouse rests on."""
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
