"""Side panel: draws a workspace and returns the changed one. Uses imgui only: no scene, no GL, no files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from imgui_bundle import imgui, imgui_ctx

from progdf.gdf.placed import Placement
from progdf.terminal import escape_text
from viewer.state import history
from viewer.state.commands import Action, OnItem, Plain, Rename, SelectRegion, WithText
from viewer.state.layer_selection import selected_layers
from viewer.state.selection import NamedRegion
from viewer.state.view_state import SceneState
from viewer.state.workspace import REGIONS_OF_EDITS, UNSAVED, Layout, SceneFacts, Workspace, has_unsaved
from viewer.ui import widgets
from viewer.ui.context import (
    BEHIND,
    FIXED,
    GAP_PX,
    HALF_GAP_PX,
    PALETTE,
    PANEL_PADDING_PX,
    SMALL_PX,
    Icon,
    UiContext,
    u32,
)

from . import card, cards, new_edit_form, snapshot_cards, training_cards

MENU_ID = "main menu"
MAX_PX = 360.0  # maximum width of a file name in the menu, at 1×
_MENU_ACTIONS = ("", "save", "save_as", "take_view", "hide_strays", "", "palette", "help", "about", "quit")
_MAX_RECENT = 6
_SHARE_ACTIONS = ("export", "export_page", "render_picture", "render_film", "picture")


def _menu_button(recent: Sequence[Path], side: float, ui: UiContext, actions: list[Action]) -> None:
    """Draw the menu at the right of the current line; `recent`: recently opened files, the last one first."""
    room = MAX_PX * ui.scale
    files = [
        (
            widgets.elide(escape_text(path.name), room),
            WithText("open_file", str(path)),
            escape_text(str(path)),
        )
        for path in recent[:_MAX_RECENT]
    ]
    widgets.more_button(MENU_ID, ("open", "add_scene", *files, *_MENU_ACTIONS), ui, actions, Icon.BARS, side)
    widgets.tip("Menu")


WIDTH_PX = Layout.panel_px  # initial width, at 1×
_EDGE_PX = 6.0
_SCROLLBAR_INSET_PX = 6.0  # of the grab at both sides


class Pictures(NamedTuple):
    """GL names of thumbnails, 0 before one is drawn."""

    snapshots: Sequence[int] = ()  # the original first
    edits: Sequence[int] = ()  # one per .gdf


def width(layout: Layout, ui: UiContext) -> float:
    """Return the panel's width in window pixels, at most 60 % of the window."""
    return min(layout.panel_px, 0.6 * imgui.get_io().display_size.x / ui.scale) * ui.scale


def draw(
    work: Workspace,
    facts: SceneFacts,
    pictures: Pictures,
    reveal: bool,
    ui: UiContext,
    actions: list[Action],
) -> Workspace:
    """Draw the panel along the right edge of the display, between `imgui.new_frame` and `imgui.render`.

    Args:
        work: the state to show and change
        facts: data of the open scene
        pictures: thumbnails of snapshots and edits
        reveal: scroll to the focused layer
        ui: fonts and scale
        actions: receives the requested actions, see `perform`
    """
    display = imgui.get_io().display_size
    ui.is_sliding = False
    wide = width(work.layout, ui)
    imgui.set_next_window_pos((display.x - wide, 0.0))
    imgui.set_next_window_size((wide, display.y))
    # the cleared framebuffer is its background: software GL takes a millisecond to fill it again
    imgui.get_background_draw_list().push_clip_rect((0.0, 0.0), (display.x - wide, display.y))
    flags = imgui.WindowFlags_.no_scroll_with_mouse.value | imgui.WindowFlags_.no_background.value
    imgui.set_next_window_scroll((0.0, 0.0))  # keyboard focus would scroll title and footer, too
    imgui.push_style_var(imgui.StyleVar_.window_padding, imgui.ImVec2(*PANEL_PADDING_PX) * ui.scale)
    imgui.begin("panel", None, FIXED | BEHIND | flags | ui.nav_flags("panel"))
    imgui.pop_style_var()
    ui.take_keyboard("panel")
    work = replace(work, layout=_drag_edge(work.layout, ui))
    _title(work, facts, ui, actions)
    footer = imgui.get_frame_height() + imgui.get_style().item_spacing.y * 2 + widgets.SEPARATOR_PX
    footer += training_cards.height(work.jobs, ui)
    room = imgui.get_content_region_avail().y - footer - cards.HEADING_PX * ui.scale
    if len(work.view.layers) > cards.SEARCH_THRESHOLD:
        room -= imgui.get_frame_height_with_spacing()
    if work.view.scenes:
        lines = 1 if SCENES in work.layout.folded else 1 + len(work.view.scenes)
        room -= lines * imgui.get_frame_height_with_spacing()
    work = replace(work, cards_fit=len(work.view.layers) * card.CARD_PX * ui.scale <= room)
    selected = selected_layers(work)
    _begin_body(footer + cards.selection_height(selected, ui), ui)
    work = _scenes(work, facts, ui, actions)
    work = cards.draw_heading(work, ui, actions)
    work = new_edit_form.draw(work, facts.count, ui, actions)
    work = cards.draw(work, facts.rows, pictures.edits, reveal, ui, actions)
    work = _regions(work, ui, actions)
    work = snapshot_cards.draw(work, pictures.snapshots, ui, actions)
    _end_body()
    cards.draw_selection(work.view, selected, ui, actions)
    training_cards.draw(work.jobs, ui, actions)
    _footer(work, ui, actions)
    imgui.end()
    return work


def _drag_edge(layout: Layout, ui: UiContext) -> Layout:
    """Draw the panel's left edge, which can be dragged. A double click restores the initial width."""
    start, (x, y) = imgui.get_cursor_screen_pos(), imgui.get_window_pos()
    imgui.set_cursor_screen_pos((x, y))
    imgui.invisible_button("edge", (_EDGE_PX * ui.scale, imgui.get_window_height()))
    if imgui.is_item_hovered() or imgui.is_item_active():
        imgui.set_mouse_cursor(imgui.MouseCursor_.resize_ew.value)
    if imgui.is_item_active() and imgui.get_io().mouse_delta.x:
        io = imgui.get_io()
        wide = (io.display_size.x - io.mouse_pos.x) / ui.scale
        layout = layout.with_panel(wide)
    if widgets.is_double_clicked():
        layout = layout.with_panel(WIDTH_PX)
    imgui.set_cursor_screen_pos(start)
    return layout


def _begin_body(footer: float, ui: UiContext) -> None:
    """Begin the scrolling part. Its scrollbar fills the panel's margin, so that the content never moves."""
    overflows = imgui.get_state_storage().get_bool(imgui.get_id("overflows"))
    clear = (0.0, 0.0, 0.0, 0.0)
    slots = (imgui.Col_.scrollbar_grab, imgui.Col_.scrollbar_grab_hovered, imgui.Col_.scrollbar_grab_active)
    for slot in () if overflows else slots:
        imgui.push_style_color(slot, clear)
    flags = imgui.WindowFlags_
    margin = PANEL_PADDING_PX[0] * ui.scale
    imgui.push_style_var(imgui.StyleVar_.scrollbar_size, margin)
    imgui.push_style_var(imgui.StyleVar_.scrollbar_padding, _SCROLLBAR_INSET_PX * ui.scale)
    wide = imgui.get_content_region_avail().x + margin
    flags_of_body = flags.always_vertical_scrollbar.value | ui.nav_flags("panel")
    imgui.begin_child("body", (wide, -footer), ui.child_flags("panel"), flags_of_body)
    imgui.pop_style_var(2)
    if not overflows:
        imgui.pop_style_color(len(slots))


def _end_body() -> None:
    # height of the content: imgui's scroll range lags one frame behind
    overflows = imgui.get_cursor_pos_y() - imgui.get_style().item_spacing.y > imgui.get_window_height()
    imgui.end_child()
    imgui.get_state_storage().set_bool(imgui.get_id("overflows"), overflows)


def _title(work: Workspace, facts: SceneFacts, ui: UiContext, actions: list[Action]) -> None:
    """Draw the session's name, with a dot for unsaved changes, the scene with its size, and the icons."""
    corner = imgui.get_cursor_pos()
    side = 24.0 * ui.scale
    scale = ui.scale
    room = imgui.get_content_region_avail().x
    text = room - 3 * side - GAP_PX * scale
    imgui.push_style_var(imgui.StyleVar_.item_spacing, imgui.ImVec2(GAP_PX, HALF_GAP_PX) * scale)
    with imgui_ctx.push_font(ui.fonts.bold, 0.0):
        name = work.session or facts.title
        if has_unsaved(work):
            name = UNSAVED + name
        imgui.text(widgets.elide(name, text))
    imgui.pop_style_var()
    size = f"{widgets.with_added(facts.count, facts.added)} splats"
    widgets.small(f"{facts.title}  ·  {size}" if work.session else size, PALETTE.dim, text)
    widgets.tip(f"{facts.title}\n{size}")
    below = imgui.get_cursor_pos()
    imgui.set_cursor_pos((corner.x + room - 3 * side, corner.y - 2.0 * scale))
    if widgets.icon_button("save", Icon.SAVE, ui, side=side):
        actions.append(Plain("save"))
    widgets.hint("save")
    imgui.same_line(0.0, 0.0)
    widgets.more_button("share", _SHARE_ACTIONS, ui, actions, Icon.SHARE, side)
    widgets.tip("Export and render")
    imgui.same_line(0.0, 0.0)
    _menu_button(work.transient.recent, side, ui, actions)
    imgui.set_cursor_pos(below)
    imgui.dummy((0.0, 1.0 * scale))


SCENES = "Scenes"
"""Section of the panel with the scenes of a view that has several."""
_SCENE_MENU = "menu of a scene"


def _scene_menu(index: int, is_placed: bool) -> tuple[tuple[str, Action | None, str], ...]:
    place_back = (("Back to its own place", OnItem("reset_scene", index), ""),) if is_placed else ()
    return (
        ("Select", OnItem("select_scene", index), ""),
        ("Move…", OnItem("move_scene", index), "Move, rotate and scale it"),
        *place_back,
        ("Rename…", None, ""),
        ("Remove", OnItem("remove_scene", index), "With its layers; its file stays"),
    )


def _scenes(work: Workspace, facts: SceneFacts, ui: UiContext, actions: list[Action]) -> Workspace:
    """Draw the scenes of a view that has several."""
    if not work.view.scenes:
        return work
    work = replace(work, layout=widgets.section(SCENES, work.layout, ui))
    if SCENES in work.layout.folded:
        return work
    for i, state in enumerate(work.view.scenes):
        count = facts.scene_counts[state.scene] if state.scene < len(facts.scene_counts) else 0
        with imgui_ctx.push_id(f"scene {i}"):
            icon = Icon.SHOWN if state.visible else Icon.HIDDEN
            if widgets.icon_button("eye", icon, ui, dim=not state.visible):
                actions.append(OnItem("show_scene", i))
            widgets.tip("Hide this scene" if state.visible else "Show this scene")
            imgui.same_line()
            wide = 8.0 * ui.scale
            right = widgets.right_edge()
            room = right - imgui.get_cursor_pos_x() - wide
            if widgets.name_field(state.name, room, partial(Rename, "rename_scene", i), actions):
                continue
            _scene_name(i, state, widgets.group_digits(count), right, ui, actions)
    return work


def _scene_name(
    index: int, state: SceneState, count: str, right: float, ui: UiContext, actions: list[Action]
) -> None:
    """Draw the name and the count of a scene: a click selects it, a double click moves it."""
    scale = ui.scale
    x, y = imgui.get_cursor_screen_pos()
    size = (max(right - imgui.get_cursor_pos_x(), 1.0), imgui.get_frame_height())
    with imgui_ctx.push_font(None, SMALL_PX):
        wide = imgui.calc_text_size(count).x
    if imgui.invisible_button("select", size, imgui.ButtonFlags_.enable_nav.value):
        actions.append(OnItem("select_scene", index))
    if widgets.is_double_clicked():
        actions.append(OnItem("move_scene", index))
    is_hovered = imgui.is_item_hovered()
    widgets.tip(f"{state.name}\nClick to select, double click to move. Right-click: rename, remove")
    if imgui.is_item_clicked(imgui.MouseButton_.right.value):
        imgui.open_popup(_SCENE_MENU)
    above = imgui.get_style().frame_padding.y
    canvas = imgui.get_window_draw_list()
    color = u32(PALETTE.text if state.visible else PALETTE.dim)
    canvas.add_text((x, y + above), color, widgets.elide(state.name, size[0] - wide - 10.0 * scale))
    at = (imgui.get_item_rect_max().x - wide, y + above + 1.0 * scale)
    dim = u32(PALETTE.text if is_hovered else PALETTE.dim)
    canvas.add_text(ui.fonts.regular, SMALL_PX * scale, at, dim, count)
    menu = _scene_menu(index, state.placement != Placement())
    for action in widgets.menu_items(_SCENE_MENU, menu, ui):
        widgets.start_naming(action is None)
        if action is not None:
            actions.append(action)


_REGION_MENU = "menu of a region"


def _region_menu(index: int) -> tuple[tuple[str, Action | None, str], ...]:
    return (
        ("Select", SelectRegion(index), ""),
        ("Add to selection", SelectRegion(index, "add"), ""),
        ("Subtract from selection", SelectRegion(index, "subtract"), ""),
        ("Rename…", None, ""),
        ("Delete", OnItem("forget_region", index), ""),
    )


def _regions(work: Workspace, ui: UiContext, actions: list[Action]) -> Workspace:
    """Draw the sections of saved regions and of regions that training made; empty ones are left out."""
    regions = list(enumerate(work.view.selection.regions))
    saved = [(i, region) for i, region in regions if not region.edit]
    of_edits = [(i, region) for i, region in regions if region.edit]
    for name, listed in (("Regions", saved), (REGIONS_OF_EDITS, of_edits)):
        if not listed:
            continue
        work = replace(work, layout=widgets.section(name, work.layout, ui))
        if name in work.layout.folded:
            continue
        for i, region in listed:
            with imgui_ctx.push_id(f"region {i}"):
                if _row(i, region, ui, actions):
                    work = replace(work, pointed=work.pointed or ("region", i))
    return work


def _row(index: int, region: NamedRegion, ui: UiContext, actions: list[Action]) -> bool:
    """Draw visibility, swatch, name and count of a region; return whether the mouse hovers it."""
    right = widgets.right_edge()
    scale = ui.scale
    icon = Icon.SHOWN if region.visible else Icon.HIDDEN
    if widgets.icon_button("eye", icon, ui, dim=not region.visible):
        actions.append(OnItem("show_region", index))
    widgets.tip("Tint this region in the picture")
    imgui.same_line()
    card.swatch(region.color, 1.0, False, ui)
    tall = imgui.get_frame_height()
    canvas = imgui.get_window_draw_list()
    imgui.same_line()
    count = widgets.group_digits(region.count)
    with imgui_ctx.push_font(None, SMALL_PX):
        wide = imgui.calc_text_size(count).x
    room = right - wide - 10.0 * scale - imgui.get_cursor_pos_x()
    if widgets.name_field(region.name, room, partial(Rename, "rename_region", index), actions):
        return False
    x, y = imgui.get_cursor_screen_pos()
    io = imgui.get_io()
    mouse = imgui.MouseButton_
    size = (max(right - imgui.get_cursor_pos_x(), 1.0), tall)
    nav = imgui.ButtonFlags_.enable_nav
    if imgui.invisible_button("select", size, nav.value):
        mode = "subtract" if io.key_ctrl else "new"
        if io.key_shift:
            mode = "add"
        actions.append(SelectRegion(index, mode))
    hovered = imgui.is_item_hovered(imgui.HoveredFlags_.for_tooltip.value)
    color = u32(PALETTE.text if imgui.is_item_hovered() else PALETTE.dim)
    widgets.tip(f"{region.path}\nClick to select; Shift adds, Ctrl subtracts. Right-click: rename, delete")
    if imgui.is_item_clicked(mouse.right.value):
        imgui.open_popup(_REGION_MENU)
    above = imgui.get_style().frame_padding.y
    canvas.add_text((x, y + above), u32(PALETTE.text), widgets.elide(region.name, room))
    at = (imgui.get_item_rect_max().x - wide, y + above + 1.0 * scale)
    canvas.add_text(ui.fonts.regular, SMALL_PX * scale, at, color, count)
    for action in widgets.menu_items(_REGION_MENU, _region_menu(index), ui):
        widgets.start_naming(action is None)
        if action is not None:
            actions.append(action)
    return bool(hovered)


_FOOTER_BUTTONS = (("timeline", Icon.FILM), ("picture", Icon.PICTURE), ("help", Icon.HELP))


def _footer(work: Workspace, ui: UiContext, actions: list[Action]) -> None:
    imgui.separator()
    right = widgets.right_edge()
    changes = {"undo": history.next_undo(work.past), "redo": history.next_redo(work.past)}
    named = zip(changes.items(), (Icon.UNDO, Icon.REDO), strict=True)
    steps = [*((name, icon, change) for (name, change), icon in named), ("history", Icon.HISTORY, "")]
    off = [name for name, change in changes.items() if not change]
    widgets.icon_row(steps, ui, actions, 8.0 * ui.scale, off=off)
    side = imgui.get_frame_height()
    gap = GAP_PX * ui.scale
    imgui.same_line(right - 3 * side - 2 * gap)
    widgets.icon_row(_FOOTER_BUTTONS, ui, actions, gap)
