"""The stack of edits in the panel: one card per layer, the top one first, and the rule of blending.

Cards are dragged into their order. What takes a layer away or adds one is an action, for after the drawing.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from imgui_bundle import imgui

from progdf.compose.reference import BLENDS
from viewer.panel import group_row, layer_bar
from viewer.panel.layer_card import draw_card
from viewer.state.layer_facts import LayerRow
from viewer.state.layer_selection import filter_layers, selected_layers
from viewer.state.layers import move_layers, visible_layers, with_overshoot
from viewer.state.view_state import OVERSHOOT, LayerGroup, ViewState
from viewer.state.workspace import Workspace, is_compact
from viewer.ui.context import PALETTE, UiContext, u32
from viewer.ui.keys import shortcut
from viewer.ui.widgets import (
    drop_down,
    right_edge,
    section,
    small,
    tip,
)

HEADING_PX = 34.0  # at 1×: above the cards
_DRAGS = ("dragged", "dropped")
INSET_PX = 10.0  # of a group's layers, at 1×
BLEND_HELP = {
    "normalized": "Overlapping edits are averaged by weight; never more than a full edit.",
    "sum": "Overlapping edits add up.",
    "over": "An edit covers those below it, where and as far as it changes something.",
}


@dataclass(frozen=True)
class _Row:
    """A card in the list, or the row over a group."""

    top: float  # window pixels
    bottom: float
    layers: tuple[int, ...]  # places of what is dragged with it, in `ViewState.layers`
    group: str  # its own, or that of its layer
    heads: bool = False  # it is the row over a group


def heading(state: ViewState, form_open: bool, ui: UiContext, actions: list[str]) -> ViewState:
    """The heading of the stack: a new edit, overshoot, and the blend rule where layers can overlap."""
    right = right_edge()
    section("Edits", ui)
    imgui.same_line(0.0, 8.0 * ui.scale)
    _new_button(form_open, actions)
    if not state.layers:
        return state
    combo = 118.0 * ui.scale if len(state.layers) > 1 else 0.0
    wide = 40.0 * ui.scale
    imgui.same_line(right - combo - wide - (6.0 * ui.scale if combo else 0.0))
    state = _overshoot(state, wide)
    if not combo:
        return state
    imgui.same_line(right - combo)
    imgui.set_next_item_width(combo)
    titles, now = [blend.capitalize() for blend in BLENDS], BLENDS.index(state.blend)
    help_ = f"Where edits overlap ({shortcut('blend')}): " + BLEND_HELP[state.blend]
    pressed = drop_down(
        "##blend", titles[now], titles, now, ui, help_, [BLEND_HELP[blend] for blend in BLENDS]
    )
    return state if pressed is None else replace(state, blend=BLENDS[pressed])


def _new_button(form_open: bool, actions: list[str]) -> None:
    imgui.push_style_color(
        imgui.Col_.button, imgui.ImVec4(*(PALETTE.accent_dark if form_open else PALETTE.field))
    )
    if imgui.button("+ New##edit"):
        actions.append("new_edit")
    imgui.pop_style_color()
    tip(f"New edit ({shortcut('new_edit')}): choose a region and an editor, see it, train it")


def _overshoot(state: ViewState, width: float) -> ViewState:
    on = state.overshoot
    for slot, color in (
        (imgui.Col_.button, PALETTE.warning_dark if on else PALETTE.field),
        (imgui.Col_.text, PALETTE.text if on else PALETTE.dim),
    ):
        imgui.push_style_color(slot, imgui.ImVec4(*color))
    imgui.push_style_var(imgui.StyleVar_.frame_padding, imgui.ImVec2(0.0, imgui.get_style().frame_padding.y))
    if imgui.button(f"{OVERSHOOT:g}##overshoot", imgui.ImVec2(width, 0.0)):
        state = with_overshoot(state, not on)
    imgui.pop_style_var()
    imgui.pop_style_color(2)
    tip(f"Overshoot to {OVERSHOOT:g} ({shortcut('overshoot')}): extrapolates past the trained range")
    return state


def draw(
    work: Workspace, rows: Sequence[LayerRow], reveal: bool, ui: UiContext, actions: list[str]
) -> Workspace:
    """All cards, under the rows of their groups.

    Args:
        rows: one per .gdf, indexed by `LayerState.gdf`
        reveal: scroll to the focused layer, and to what is cut of the selected ones
    """
    if not (work.view.layers or work.jobs or work.deliveries or work.form_open):
        imgui.push_text_wrap_pos(0.0)
        imgui.text_disabled(
            f"No edits yet. Make one ({shortcut('new_edit')}), or drop a .gdf file on the window."
        )
        imgui.pop_text_wrap_pos()
    work = replace(
        work,
        overlap=None,
        pointed=None,
        search=layer_bar.search(work, ui, actions) if work.view.layers else "",
        searching=False,
    )
    texts = [f"{row.region} {row.instruction}" for row in rows]
    # as seen: the top layer, which is the last one, first
    listed = filter_layers(work.view, texts, work.search)[::-1]
    focus, group = work.focus, ""
    dragged, gesture = -1, ""  # one of the lines, and what the hand does with it
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
        top, left = imgui.get_cursor_screen_pos().y, imgui.get_cursor_pos_x()
        imgui.set_cursor_pos_x(left + INSET_PX * ui.scale * bool(group))
        work, touch = draw_card(work, i, layer.name in visible, rows, ui, actions)
        dragged, gesture = (len(lines), touch.drag) if touch.drag in _DRAGS else (dragged, gesture)
        lines.append(_Row(top, imgui.get_item_rect_max().y, (i,), group))
        _tighten(work, ui)
        cut = layer.gdf in work.selected and imgui.is_item_visible()
        if reveal and (work.focus == i or cut):
            imgui.internal.scroll_to_item(imgui.internal.ScrollFlags_.keep_visible_edge_y.value)
        focus = i if touch.touched and touch.press in ("", "one", "keep") else focus
        if touch.press and (work.selected or touch.press in ("toggle", "range")):
            actions.append(f"press_layer:{touch.press}:{i}:{','.join(str(i) for i in listed)}")
    if work.view.layers and not listed:
        small("No layer has these words", PALETTE.dim)
    if work.renaming is not None and not any(l.layers == (work.renaming,) and not l.heads for l in lines):
        work = replace(work, renaming=None)
    if gesture:
        view, focus = _drag(work, focus, lines, dragged, gesture, ui)
        work = replace(work, view=view)
    return replace(work, focus=focus)


def _group(state: ViewState, name: str, ui: UiContext, actions: list[str]) -> tuple[ViewState, str]:
    """The row of a group, see `group_row.draw`; one that only its layers know becomes as any other."""
    group = next((group for group in state.groups if group.name == name), LayerGroup(name))
    if group not in state.groups:
        state = replace(state, groups=(*state.groups, group))
    return group_row.draw(state, group, sum(layer.group == name for layer in state.layers), ui, actions)


def _tighten(work: Workspace, ui: UiContext) -> None:
    """Compact rows lie closer together."""
    if is_compact(work):
        imgui.set_cursor_pos_y(imgui.get_cursor_pos_y() - 3.0 * ui.scale)


def _drag(
    work: Workspace, focus: int | None, rows: Sequence[_Row], dragged: int, gesture: str, ui: UiContext
) -> tuple[ViewState, int | None]:
    """The state and the focused layer after a drag of a row: all selected layers go with one of them."""
    state, layers, chosen = work.view, rows[dragged].layers, selected_layers(work)
    if not rows[dragged].heads and layers[0] in chosen:
        layers = chosen
    y, place, group = _nearest_gap(state, rows, layers, rows[dragged].heads, imgui.get_mouse_pos().y)
    moved = move_layers(state, layers, place, group)
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
    """Where what is dragged would lie: the line's height, how many layers there are below, the group joined.

    Args:
        layers: that are dragged
        whole: as a group, which lies in no other
        mouse: the hand's height
    """
    own = {state.layers[i].group for i in layers}
    gap, gaps = imgui.get_style().item_spacing.y / 2, [(rows[0].top, max(rows[0].layers) + 1, "")]
    for over, row in pairwise(rows):
        inside = bool(row.group) and over.group == row.group
        if inside and whole and {row.group} != own:
            continue
        group = row.group if inside else over.group if not over.heads and {over.group} == own else ""
        gaps.append((row.top, max(row.layers) + 1, "" if whole else group))
    last = rows[-1]
    stays = bool(last.group) and not (whole or last.heads) and {last.group} == own
    gaps.append((last.bottom + 2 * gap, min(last.layers), last.group if stays else ""))
    if stays:  # half a row further down it leaves the group
        gaps.append((last.bottom + 2 * gap + imgui.get_frame_height() / 2, min(last.layers), ""))
    y, place, group = min(gaps, key=lambda found: abs(found[0] - gap - mouse))
    return y - gap, place, group


def _show_place(
    y: float | None, joins: bool, layers: Collection[int], rows: Sequence[_Row], ui: UiContext
) -> None:
    """A veil over what is dragged and a line where it would lie; near an edge the list scrolls."""
    imgui.set_mouse_cursor(imgui.MouseCursor_.resize_ns)
    below, canvas = imgui.get_window_draw_list(), imgui.get_foreground_draw_list()  # that is over the cards
    canvas.push_clip_rect(below.get_clip_rect_min(), below.get_clip_rect_max())
    left = imgui.get_cursor_screen_pos().x
    right = left + imgui.get_content_region_avail().x
    for row in rows:
        if {*row.layers} <= {*layers}:
            veil = imgui.ImVec2(left, row.top), imgui.ImVec2(right, row.bottom)
            canvas.add_rect_filled(*veil, u32((*PALETTE.panel[:3], 0.6)), 6.0 * ui.scale)
    if y is not None:
        start = left + INSET_PX * ui.scale * joins
        ends = imgui.ImVec2(start, y - ui.scale), imgui.ImVec2(right, y + ui.scale)
        canvas.add_rect_filled(*ends, u32(PALETTE.accent), ui.scale)
    canvas.pop_clip_rect()
    mouse, margin, step = imgui.get_mouse_pos().y, 24.0 * ui.scale, 6.0 * ui.scale
    if mouse < imgui.get_window_pos().y + margin:
        imgui.set_scroll_y(max(imgui.get_scroll_y() - step, 0.0))
    elif mouse > imgui.get_window_pos().y + imgui.get_window_height() - margin:
        imgui.set_scroll_y(min(imgui.get_scroll_y() + step, imgui.get_scroll_max_y()))
