"""The panel's part "Select": the tools, what they do, and what is done with the selection."""

from __future__ import annotations

from dataclasses import replace

from imgui_bundle import imgui

from viewer.state.view_state import LARGEST_PX, SELECT_MODES, SMALLEST_PX, SelectTool, ViewState
from viewer.state.workspace import Pointed
from viewer.ui.context import PALETTE, Icon, UiContext
from viewer.ui.widgets import (
    choice,
    group_digits,
    icon_button,
    label,
    right_edge,
    section,
    small,
    tip,
    typed_name,
    value_slider,
)

_TOOLS = (
    ("box", Icon.BOX, "Box (R)"),
    ("lasso", Icon.LASSO, "Lasso (L)"),
    ("polygon", Icon.POLYGON, "Polygon (P): click its corners; Enter or a double click closes it"),
    ("brush", Icon.SELECT_BRUSH, "Brush (U)"),
    ("sphere", Icon.SPHERE, "Sphere (Shift+R): drag from its center on a surface"),
    ("flood", Icon.FLOOD, "Flood (J): click a surface; what is connected and alike in color"),
    ("color", Icon.COLOR, "Color (I): click; everything that is alike in color"),
)
_MODES = "Shift adds, Ctrl subtracts, both intersect"
_OPERATIONS = (
    (
        ("Grow", "select_grow", "Add the neighbors (Ctrl+])"),
        ("Shrink", "select_shrink", "Drop what borders on others (Ctrl+[)"),
        ("Smooth", "select_smooth", "Straighten the border, drop strays, fill holes"),
        ("Largest", "select_largest", "Keep only the largest connected part"),
    ),
    (
        ("Invert", "select_invert", "Select everything else (Ctrl+I)"),
        ("None", "select_none", "Select nothing (Ctrl+Shift+A)"),
        ("Hide", "hide_selected", "Hide the selection (Ctrl+H)"),
        ("Isolate", "isolate", "Hide everything else (Ctrl+Shift+H)"),
    ),
)


def draw(state: ViewState, ui: UiContext, actions: list[str]) -> tuple[ViewState, Pointed | None]:
    """The section; the changed state and what the mouse rests on. What was asked for goes into `actions`."""
    imgui.dummy(imgui.ImVec2(0.0, 4.0 * ui.scale))
    right = right_edge()
    section("Select", ui)
    side, gap = imgui.get_frame_height(), 1.0 * ui.scale
    imgui.same_line(right - len(_TOOLS) * (side + gap) + gap)
    for tool, icon, help_ in _TOOLS:
        if _lit_button(tool, icon, state.select.tool == tool, ui):
            actions.append(f"select_tool:{tool}")
        tip(f"{help_}\n{_MODES}")
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
            tip(help_)
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
        tip("Select only the front surface, or everything behind it too (N)")
        if through is not None:
            held = replace(held, through=bool(through))
    if held.tool == "brush":
        label("Radius", column)
        ends = (SMALLEST_PX, LARGEST_PX)
        radius = value_slider("##select radius", held.radius, ends, "%.0f px", SelectTool.radius, ui)
        tip("Brush radius ([ and ])")
        held = replace(held, radius=radius)
    if held.tool in ("flood", "color"):
        label("Tolerance", column)
        ends = (0.01, 1.0)
        tolerance = value_slider("##tolerance", held.tolerance, ends, "%.2f", SelectTool.tolerance, ui)
        tip("How unlike the clicked color a color may be ([ and ])")
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
        tip("Show all splats again (Alt+H)")


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
