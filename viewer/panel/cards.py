"""Layer stack in the panel: cards under their group rows, the search field, the selected layers."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

from imgui_bundle import imgui, imgui_ctx

from progdf.compose.reference import BLENDS
from progdf.terminal import format_count
from viewer.state.commands import Action, Plain, PressLayer, Rename, WithText, WithValue
from viewer.state.facts import LayerRow
from viewer.state.layer_selection import filter_layers, master_strength, selected_layers
from viewer.state.layers import (
    change_group,
    largest_strength,
    move_layers,
    toggle_collapsed,
    visible_layers,
    with_overshoot,
)
from viewer.state.view_state import LayerGroup, ViewState
from viewer.state.workspace import Workspace, is_compact
from viewer.ui.context import HALF_GAP_PX, PALETTE, Icon, UiContext, u32
from viewer.ui.keys import shortcut
from viewer.ui.widgets import (
    SEPARATOR_PX,
    accent_button,
    elide,
    empty_line,
    entry,
    grip,
    hint,
    icon_button,
    inert,
    menu,
    menu_item,
    menu_items,
    more_button,
    name_field,
    right_edge,
    section,
    small,
    start_naming,
    tip,
)

from . import slider
from .card import BLEND_HELP, BLEND_TITLES, COMPACT_PX, SLIDER_PX, SLIM_PX, draw_card

MASTER_PX = 20.0  # height of the slider for several layers, at 1×
SEARCH_THRESHOLD = 6
"""Number of layers above which the search field is shown."""
_BUTTONS = ("group", "reset")


def draw_search(work: Workspace, ui: UiContext) -> str:
    """Draw the search field, if there are many layers, and return its text."""
    if not (len(work.view.layers) > SEARCH_THRESHOLD or work.searching or work.search):
        return work.search
    side = imgui.get_frame_height()
    gap = 4.0 * ui.scale
    clear_button = side + gap if work.search else 0.0
    imgui.set_next_item_width(imgui.get_content_region_avail().x - clear_button)
    if work.searching:
        imgui.set_keyboard_focus_here()
    flags = imgui.InputTextFlags_.escape_clears_all.value | imgui.InputTextFlags_.auto_select_all.value
    _, text = imgui.input_text_with_hint("##search", "Search by name, region, group", work.search, flags)
    tip(f"Show only layers with all these words ({shortcut('search')}). Esc: show all")
    if work.search:
        imgui.same_line(0.0, gap)
        if icon_button("clear", Icon.CLOSE, ui):
            text = ""
        tip("Show all layers")
    return str(text)


def selection_height(chosen: Sequence[int], ui: UiContext) -> float:
    """Return the height of `draw_selection` in window pixels; 0 if it is hidden."""
    if len(chosen) < 2:
        return 0.0
    spacing = imgui.get_style().item_spacing.y
    return float(imgui.get_frame_height() + MASTER_PX * ui.scale + 3 * spacing) + SEPARATOR_PX


def draw_selection(state: ViewState, chosen: Sequence[int], ui: UiContext, actions: list[Action]) -> None:
    """Draw the strength of several selected layers and their actions, under the cards."""
    if len(chosen) < 2:
        return
    imgui.separator()
    right = right_edge()
    imgui.align_text_to_frame_padding()
    small(f"{len(chosen)} layers", PALETTE.dim)
    imgui.same_line(right - imgui.get_frame_height())
    more_button("of layers", _BUTTONS, ui, actions)
    tip("Group, reset")
    value = master_strength(state, chosen)
    max_strength = largest_strength(state)
    number = imgui.calc_text_size(f"{value:.3f}").x
    with inert(all(state.layers[i].locked for i in chosen)):
        at = imgui.get_cursor_screen_pos()
        room = imgui.get_content_region_avail().x - number - 8.0 * ui.scale
        help_ = "Strength of the strongest selected layer; the others keep their proportions"
        new = slider.draw(
            "##master",
            value,
            (),
            room,
            ui,
            PALETTE.accent,
            most=max_strength,
            height=MASTER_PX,
            help_=help_,
        )
    corner = (at.x + room + 8.0 * ui.scale, at.y)
    imgui.get_window_draw_list().add_text(corner, u32(PALETTE.text), f"{new:.3f}")
    if new != value:
        actions.append(WithValue("master", new))


_MENU = "menu of a group"


def draw_group(
    state: ViewState, group: LayerGroup, count: int, ui: UiContext, actions: list[Action]
) -> tuple[ViewState, str]:
    """Draw the row of a group of `count` layers; return the changed state and the gesture, see `grip`.

    Requested actions are appended to `actions`.
    """
    scale = ui.scale
    folded = group.name in state.collapsed
    with imgui_ctx.push_id(f"group {group.name}"), imgui_ctx.begin_group():
        right = right_edge() - COMPACT_PX * scale
        arrow = Icon.FOLDED if folded else Icon.UNFOLDED
        if icon_button("fold", arrow, ui, side=imgui.get_frame_height()):
            state = toggle_collapsed(state, group.name)
        tip("Expand or collapse the group")
        imgui.same_line(0.0, 0.0)
        if icon_button("eye", Icon.SHOWN if group.enabled else Icon.HIDDEN, ui, dim=not group.enabled):
            state = change_group(state, group.name, lambda old: replace(old, enabled=not old.enabled))
        tip("Show or hide the group")
        imgui.same_line(0.0, 4.0 * scale)
        number = f"{group.strength:.2f}"
        wide = imgui.calc_text_size(number).x
        slider_at = right - wide - (SLIDER_PX + 6.0) * scale
        corner, gesture = _group_name(
            state, group, count, slider_at - 6.0 * scale - imgui.get_cursor_pos_x(), ui, actions
        )
        imgui.same_line(slider_at)
        imgui.set_cursor_pos_y(imgui.get_cursor_pos_y() + (imgui.get_frame_height() - SLIM_PX * scale) / 2)
        strength = slider.draw(
            "##factor",
            group.strength,
            (),
            SLIDER_PX * scale,
            ui,
            PALETTE.faint,
            group.enabled,
            height=SLIM_PX,
            default=LayerGroup.strength,
            help_="Factor on the strengths of its layers. Layers that are even alone may be uneven together. "
            "Double-click: reset to 1",
        )
        number_at = (imgui.get_item_rect_max().x + 6.0 * scale, corner[1])
        color = u32(PALETTE.text if group.enabled else PALETTE.dim)
        imgui.get_window_draw_list().add_text(number_at, color, f"{strength:.2f}")
    if strength == group.strength:
        return state, gesture
    return change_group(state, group.name, lambda old: replace(old, strength=strength)), gesture


def _group_name(
    state: ViewState, group: LayerGroup, count: int, room: float, ui: UiContext, actions: list[Action]
) -> tuple[tuple[float, float], str]:
    """Draw the name and its menu; return the corner of its text, and the gesture.

    A click selects the layers, a double click renames the group, a drag moves the layers.
    """
    x, y = imgui.get_cursor_screen_pos()
    corner = (x, y + imgui.get_style().frame_padding.y)
    select = WithText("select_layers", group.name)
    if name_field(group.name, room, partial(Rename, "rename_group", state.groups.index(group)), actions):
        return corner, ""
    imgui.invisible_button("name", (max(room, 1.0), imgui.get_frame_height()))
    gesture = grip(ui)
    if gesture == "clicked":
        actions.append(select)
    hovered = imgui.is_item_hovered()
    about = f"{group.name}, {format_count(count, 'layer')}"
    tip(f"{about}\nClick to select, drag to reorder, double-click to rename")
    if hovered and imgui.is_mouse_double_clicked(imgui.MouseButton_.left.value):
        start_naming()
    if imgui.is_item_clicked(imgui.MouseButton_.right.value):
        imgui.open_popup(_MENU)
    with imgui_ctx.push_font(ui.fonts.bold, 0.0):
        color = PALETTE.text if group.enabled else PALETTE.dim
        if hovered:
            color = PALETTE.handle
        imgui.get_window_draw_list().add_text(corner, u32(color), elide(group.name, room))
    ungroup = WithText("ungroup", group.name)
    items = (("Rename…", None, ""), ("Select its layers", select, ""), ("Ungroup", ungroup, ""))
    for action in menu_items(_MENU, items, ui):
        start_naming(action is None)
        if action is not None:
            actions.append(action)
    return corner, gesture


HEADING_PX = 32.0  # height of the heading above the cards, at 1×
_DRAGS = ("dragged", "dropped")
INSET_PX = 10.0  # indentation of a group's layers, at 1×


@dataclass(frozen=True)
class _Row:
    """Card in the list, or row of a group."""

    top: float  # window pixels
    bottom: float
    layers: tuple[int, ...]  # indices in `ViewState.layers` that are dragged with it
    group: str  # the group's name, or that of its layer's group
    heads: bool = False  # it is the row of a group


def draw_heading(work: Workspace, ui: UiContext, actions: list[Action]) -> Workspace:
    """Draw the heading of the stack, with the button for a new edit and the menu for all layers."""
    right = right_edge()
    work = replace(work, layout=section("Edits", work.layout, ui))
    side = imgui.get_frame_height()
    text = "+ New edit"
    wide = imgui.calc_text_size(text).x + 2 * imgui.get_style().frame_padding.x
    if _is_empty(work):
        return work  # the line of the empty list has the button
    menu_button = side + 4.0 * ui.scale if work.view.layers else 0.0
    imgui.same_line(right - wide - menu_button)
    if imgui.button(text, (wide, 0.0)):
        actions.append(Plain("new_edit"))
    hint("new_edit")
    if not work.view.layers:
        return work
    imgui.same_line(0.0, 4.0 * ui.scale)
    if icon_button("about layers", Icon.MENU, ui):
        imgui.open_popup("about layers")
    tip("Blend rule, overshoot, compact rows")
    with menu("about layers", ui) as is_open:
        return replace(work, view=_choose_rules(work, ui, actions)) if is_open else work


def _is_empty(work: Workspace) -> bool:
    """Return True if there is no layer, no job that makes one, and no open form."""
    return not (work.view.layers or work.jobs or work.form_open)


def _choose_rules(work: Workspace, ui: UiContext, actions: list[Action]) -> ViewState:
    """Draw the menu for all layers: blend rule, overshoot, compact rows. Return the changed state."""
    state = work.view
    imgui.text_disabled("Blend rule of layers without their own")
    for blend in BLENDS:
        if entry(BLEND_TITLES[blend], BLEND_HELP[blend], state.blend == blend, PALETTE.text, ui):
            state = replace(state, blend=blend)
    imgui.separator()
    if menu_item("overshoot", state.overshoot):
        state = with_overshoot(state, not state.overshoot)
    if menu_item("cards", is_compact(work)):
        actions.append(Plain("cards"))
    return state


def draw(
    work: Workspace,
    rows: Sequence[LayerRow],
    thumbnails: Sequence[int],
    reveal: bool,
    ui: UiContext,
    actions: list[Action],
) -> Workspace:
    """Draw all cards, under their group rows, and return the changed workspace.

    Args:
        rows: one per .gdf, indexed by `LayerState.gdf`
        thumbnails: GL names of the thumbnails of the edits in the same order, 0 before one is drawn
        reveal: scroll to the focused layer, and to partly visible selected ones
    """
    if _is_empty(work):
        empty_line("No edits yet", ("new_edit", "open"), ui, actions)
    work = replace(
        work,
        pointed=None,
        search=draw_search(work, ui) if work.view.layers else "",
        searching=False,
    )
    if "Edits" in work.layout.folded:
        return work
    texts = [f"{row.region} {row.instruction}" for row in rows]
    # on-screen order: the top layer, which is the last one, comes first
    listed = filter_layers(work.view, texts, work.search)[::-1]
    focus = work.focus
    group = ""
    # index in `lines` of the dragged row, and its gesture
    dragged = -1
    gesture = ""
    lines: list[_Row] = []
    visible = {layer.name for layer in visible_layers(work.view)}
    for i in listed:
        layer = work.view.layers[i]
        if layer.group and layer.group != group:
            top = imgui.get_cursor_screen_pos().y
            view, drag = _group(work.view, layer.group, ui, actions)
            work = replace(work, view=view)
            dragged, gesture = (len(lines), drag) if drag in _DRAGS else (dragged, gesture)
            layers = tuple(at for at, other in enumerate(view.layers) if other.group == layer.group)
            lines.append(_Row(top, imgui.get_item_rect_max().y, layers, layer.group, heads=True))
            _tighten(work, ui)
        group = layer.group
        if group in work.view.collapsed and not work.search:
            continue
        top = imgui.get_cursor_screen_pos().y
        left = imgui.get_cursor_pos_x()
        inset = INSET_PX * ui.scale if group else 0.0
        imgui.set_cursor_pos_x(left + inset)
        work, touch = draw_card(
            work,
            i,
            layer.name in visible,
            rows,
            thumbnails[layer.gdf] if layer.gdf < len(thumbnails) else 0,
            ui,
            actions,
        )
        dragged, gesture = (len(lines), touch.drag) if touch.drag in _DRAGS else (dragged, gesture)
        lines.append(_Row(top, imgui.get_item_rect_max().y, (i,), group))
        _tighten(work, ui)
        cut = layer.gdf in work.selected and imgui.is_item_visible()
        if reveal and (work.focus == i or cut):
            imgui.internal.scroll_to_item(imgui.internal.ScrollFlags_.keep_visible_edge_y.value)
        focus = i if touch.touched and touch.press in ("", "one", "keep") else focus
        if touch.press and (work.selected or touch.press in ("toggle", "range")):
            actions.append(PressLayer(touch.press, i, tuple(listed)))
    if work.view.layers and not listed:
        empty_line("No matching layer", (), ui, actions)
        imgui.same_line(0.0, 8.0 * ui.scale)
        if accent_button("Show all", (0.0, 0.0)):
            work = replace(work, search="")
    if work.renaming is not None and not any(l.layers == (work.renaming,) and not l.heads for l in lines):
        work = replace(work, renaming=None)
    if gesture:
        view, focus = _drag(work, focus, lines, dragged, gesture, ui)
        work = replace(work, view=view)
    return replace(work, focus=focus)


def _group(state: ViewState, name: str, ui: UiContext, actions: list[Action]) -> tuple[ViewState, str]:
    """Draw the row of a group, see `draw_group`; add the group to the state if it is missing."""
    group = next((group for group in state.groups if group.name == name), LayerGroup(name))
    if group not in state.groups:
        state = replace(state, groups=(*state.groups, group))
    return draw_group(state, group, sum(layer.group == name for layer in state.layers), ui, actions)


def _tighten(work: Workspace, ui: UiContext) -> None:
    """Reduce the gap under compact rows."""
    if is_compact(work):
        imgui.set_cursor_pos_y(imgui.get_cursor_pos_y() - HALF_GAP_PX * ui.scale)


def _drag(
    work: Workspace, focus: int | None, rows: Sequence[_Row], dragged: int, gesture: str, ui: UiContext
) -> tuple[ViewState, int | None]:
    """Return the state and the focused layer after a drag of a row. All selected layers move together."""
    state = work.view
    layers = rows[dragged].layers
    chosen = selected_layers(work)
    if not rows[dragged].heads and layers[0] in chosen:
        layers = chosen
    y, index, group = _nearest_gap(state, rows, layers, rows[dragged].heads, imgui.get_mouse_pos().y)
    moved = move_layers(state, layers, index, group)
    if gesture == "dragged":
        _show_place(y if moved.layers != state.layers else None, bool(group), layers, rows, ui)
        return state, focus
    if focus is not None:
        name = state.layers[focus].name
        focus = next(i for i, layer in enumerate(moved.layers) if layer.name == name)
    return moved, focus


def _nearest_gap(
    state: ViewState, rows: Sequence[_Row], layers: Sequence[int], whole: bool, mouse: float
) -> tuple[float, int, str]:
    """Return the nearest drop target: y of its line, number of layers below it, and the joined group.

    Args:
        layers: the dragged layers
        whole: the layers are dragged as a group; groups do not nest
        mouse: y of the pointer, window pixels
    """
    groups = {state.layers[i].group for i in layers}
    gap = imgui.get_style().item_spacing.y / 2
    gaps = [(rows[0].top, max(rows[0].layers) + 1, "")]
    for above, row in pairwise(rows):
        inside = bool(row.group) and above.group == row.group
        if inside and whole and {row.group} != groups:
            continue
        group = ""
        if inside:
            group = row.group
        elif not above.heads and {above.group} == groups:
            group = above.group
        gaps.append((row.top, max(row.layers) + 1, "" if whole else group))
    last = rows[-1]
    stays = bool(last.group) and not (whole or last.heads) and {last.group} == groups
    gaps.append((last.bottom + 2 * gap, min(last.layers), last.group if stays else ""))
    if stays:  # half a row below the end, the layer leaves the group
        gaps.append((last.bottom + 2 * gap + imgui.get_frame_height() / 2, min(last.layers), ""))
    y, index, group = min(gaps, key=lambda candidate: abs(candidate[0] - gap - mouse))
    return y - gap, index, group


def _show_place(
    y: float | None, joins: bool, layers: Collection[int], rows: Sequence[_Row], ui: UiContext
) -> None:
    """Dim the dragged rows and draw a line at the drop target. Scroll the list near its edges."""
    imgui.set_mouse_cursor(imgui.MouseCursor_.resize_ns)
    # drawn over the cards
    below = imgui.get_window_draw_list()
    canvas = imgui.get_foreground_draw_list()
    canvas.push_clip_rect(below.get_clip_rect_min(), below.get_clip_rect_max())
    left = imgui.get_cursor_screen_pos().x
    right = left + imgui.get_content_region_avail().x
    for row in rows:
        if {*row.layers} <= {*layers}:
            veil = (left, row.top), (right, row.bottom)
            canvas.add_rect_filled(*veil, u32((*PALETTE.panel[:3], 0.6)), 6.0 * ui.scale)
    if y is not None:
        start = left + INSET_PX * ui.scale * joins
        ends = (start, y - ui.scale), (right, y + ui.scale)
        canvas.add_rect_filled(*ends, u32(PALETTE.accent), ui.scale)
    canvas.pop_clip_rect()
    mouse = imgui.get_mouse_pos().y
    margin = 24.0 * ui.scale
    step = 6.0 * ui.scale
    if mouse < imgui.get_window_pos().y + margin:
        imgui.set_scroll_y(max(imgui.get_scroll_y() - step, 0.0))
    elif mouse > imgui.get_window_pos().y + imgui.get_window_height() - margin:
        imgui.set_scroll_y(min(imgui.get_scroll_y() + step, imgui.get_scroll_max_y()))
