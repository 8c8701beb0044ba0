"""The panel's parts for selecting and painting: tools, operations, regions, and the brush."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

from imgui_bundle import imgui

from viewer.render import highlight
from viewer.state.layers import is_visible
from viewer.state.selection import NamedRegion
from viewer.state.view_state import (
    LARGEST_PX,
    SELECT_MODES,
    SMALLEST_PX,
    Brush,
    SelectTool,
    ViewState,
)
from viewer.state.workspace import Pointed
from viewer.ui.context import PALETTE, SMALL_PX, Icon, UiContext, u32
from viewer.ui.keys import shortcut
from viewer.ui.widgets import (
    choice_row,
    elide,
    group_digits,
    icon_button,
    label,
    menu,
    right_edge,
    section,
    slider_row,
    small,
    swatch,
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
    (
        ("Remove", "remove_selected", "A layer that lets the selection vanish along its slider"),
        ("Move", "move_selected", "A layer that moves, turns and scales the selection along its slider"),
        ("Copy", "duplicate_selected", "A layer with a copy of the selection, placed by hand"),
    ),
)
COLUMN_PX = 82.0  # at 1×: where what a row chooses begins
_DEPTHS = {False: "Front", True: "Through"}
_SIZE_KEYS = f"{shortcut('brush_radius:0.8')} and {shortcut('brush_radius:1.25')}"
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
    gap, wide = 4.0 * ui.scale, imgui.get_content_region_avail().x
    imgui.push_style_var(imgui.StyleVar_.frame_padding, imgui.ImVec2(0.0, 4.0 * ui.scale))
    for row in _OPERATIONS:
        for i, (name, action, help_) in enumerate(row):
            if i:
                imgui.same_line(0.0, gap)
            each = (wide - (len(row) - 1) * gap) / len(row)
            if imgui.button(f"{name}##{action}", imgui.ImVec2(each, 0.0)):
                actions.append(action)
            tip(help_, action)
    imgui.pop_style_var()
    _save(len(state.selection.regions), ui, actions)
    imgui.end_disabled()
    return state, pointed


def _options(tool: SelectTool, ui: UiContext) -> SelectTool:
    """How the tool selects."""
    column = COLUMN_PX * ui.scale
    modes = dict(zip(SELECT_MODES, ("New", "Add", "Sub", "And"), strict=True))
    help_ = f"What becomes of the present selection.\n{_MODES}"
    tool = replace(tool, mode=choice_row("Mode", modes, tool.mode, column, ui, help_))
    if tool.tool not in ("sphere", "flood"):
        help_ = "Select only the front surface, or everything behind it too"
        through = choice_row("Depth", _DEPTHS, tool.through, column, ui, help_, "select_through")
        tool = replace(tool, through=through)
    if tool.tool == "brush":
        ends, help_ = (SMALLEST_PX, LARGEST_PX), f"Brush radius ({_SIZE_KEYS})"
        radius = slider_row("Radius", tool.radius, ends, SelectTool.radius, column, ui, help_, "%.0f px")
        tool = replace(tool, radius=radius)
    if tool.tool in ("flood", "color"):
        ends = (0.01, 1.0)
        help_ = f"How unlike the clicked color a color may be ({_SIZE_KEYS}). The last click follows it"
        tolerance = slider_row("Tolerance", tool.tolerance, ends, SelectTool.tolerance, column, ui, help_)
        tool = replace(tool, tolerance=tolerance)
    return tool


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
    swatch(region.color, 1.0, False, ui)
    tall, canvas = imgui.get_frame_height(), imgui.get_window_draw_list()
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


PAINT_DRAG = "brush"
"""What a left drag does while the brush is active, beside those of `keys.DRAGS`."""

NAMES = {"add": "Add", "erase": "Erase", "smooth": "Smooth"}
WHOLE = (
    ("Clear", "paint_clear", "Set all weights to 0"),
    ("Fill", "paint_fill", "Set all weights to 1"),
    ("Invert", "paint_invert", f"Swap what is painted and what is not ({shortcut('invert')})"),
    ("Feather", "paint_feather", "Soften the edges of the paint; repeat for more"),
)
"""Buttons for all of a layer's paint: name, action of `keys.KEYS`, tip."""


def paint_obstacle(view: ViewState, focus: int | None) -> str:
    """Why the brush cannot paint now, one line; empty where it can."""
    if focus is None or focus >= len(view.layers):
        return "no layer is selected; click one, or press 1–9"
    layer = view.layers[focus]
    if layer.locked:
        return f"{layer.name} is locked; press Shift+L to unlock it"
    if not is_visible(view, layer):
        return f"{layer.name} is hidden; press H to show it"
    return ""


def draw_brush(view: ViewState, focus: int | None, ui: UiContext, actions: list[str]) -> ViewState:
    """The brush's controls."""
    column, brush = COLUMN_PX * ui.scale, view.brush
    imgui.push_id("brush")
    imgui.dummy(imgui.ImVec2(0.0, 4.0 * ui.scale))
    section("Paint", ui)
    help_ = f"Brush mode ({shortcut('brush_mode')}). While painting, Ctrl inverts and Shift smooths"
    brush = replace(brush, mode=choice_row("Brush", NAMES, brush.mode, column, ui, help_))
    ends, help_ = (SMALLEST_PX, LARGEST_PX), f"Brush radius ({_SIZE_KEYS})"
    radius = slider_row("Radius", brush.radius, ends, Brush.radius, column, ui, help_, "%.0f px")
    help_ = f"Brush softness ({shortcut('brush_softness:-0.1')} and ])"
    softness = slider_row("Softness", brush.softness, (0.0, 1.0), Brush.softness, column, ui, help_)
    help_ = "How far one stroke goes; strokes over each other go further"
    flow = slider_row("Flow", brush.flow, (0.0, 1.0), Brush.flow, column, ui, help_)
    label("Value", column)
    imgui.begin_disabled(brush.mode != "add")
    value = value_slider("##value", brush.value, (0.0, 1.0), "%.2f", Brush.value, ui)
    imgui.end_disabled()
    tip("The share of the edit that Add paints")
    help_ = "Paint only the front surface, or everything under the brush"
    through = choice_row("Depth", _DEPTHS, brush.through, column, ui, help_, "brush_through")
    help_ = "Tint lightly what has less than all of the edit, or show all weights from blue (0) to yellow (1)"
    weights = choice_row(
        "Weights", {False: "Tint", True: "Colors"}, brush.weights, column, ui, help_, "brush_weights"
    )
    brush = replace(
        brush, radius=radius, softness=softness, flow=flow, value=value, through=through, weights=weights
    )
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
    imgui.pop_id()
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


def brush_button(view: ViewState, ui: UiContext) -> bool:
    """The button that takes the brush up and puts it down; True when pressed."""
    pressed = icon_button("brush", Icon.BRUSH, ui, dim=not view.brush.active)
    tip("Paint the strength of the selected layer", "brush")
    return pressed


def draw_ring(view: ViewState, ui: UiContext) -> None:
    """The brush at the cursor: its edge, and inside which its touch is full."""
    brush, mouse = view.brush, imgui.get_mouse_pos()
    canvas, radius = imgui.get_background_draw_list(), brush.radius * ui.scale
    inner = radius * (1.0 - brush.softness)
    for size, alpha in ((radius, 1.0), (inner, 0.45)):
        if size > 2.0 * ui.scale:
            canvas.add_circle(mouse, size, u32((0.0, 0.0, 0.0, 0.5 * alpha)), 0, 3.0 * ui.scale)
            canvas.add_circle(mouse, size, u32((*PALETTE.handle[:3], alpha)), 0, 1.25 * ui.scale)
