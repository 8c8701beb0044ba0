"""The stack of edits in the panel: one card per layer, the top one first, and the rule of blending.

Cards are dragged into their order. What takes a layer away or adds one is an action, for after the drawing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from imgui_bundle import imgui

from progdf.compose.reference import BLENDS
from viewer.panel import group_row, layer_bar
from viewer.panel.layer_card import Cards, draw_card
from viewer.state import layers as stack
from viewer.state.layer_selection import filter_layers
from viewer.state.view_state import OVERSHOOT, LayerGroup, ViewState
from viewer.state.workspace import Pointed
from viewer.ui.context import PALETTE, UiContext, u32
from viewer.ui.widgets import (
    right_edge,
    section,
    small,
    tip,
)

HEADING_PX = 34.0  # at 1×: above the cards
INSET_PX = 10.0  # of a group's layers, at 1×
BLEND_HELP = {
    "normalized": "Overlapping edits are averaged by weight; never more than a full edit.",
    "sum": "Overlapping edits add up.",
    "over": "An edit covers those below it, where and as far as it changes something.",
}


@dataclass(frozen=True)
class CardsResult:
    """What became of the state: the focused layer, the one being renamed, those asked about.

    `actions`: those of the cards' menus, as in `actions.perform`; `search`: the words that are looked for.
    """

    state: ViewState
    focus: int | None
    renaming: int | None = None
    overlap: int | None = None
    pointed: Pointed | None = None
    actions: tuple[str, ...] = ()
    search: str = ""


def heading(state: ViewState, form_open: bool, ui: UiContext) -> tuple[ViewState, str]:
    """The heading of the stack: a new edit, overshoot, and the blend rule where there is something to blend.

    The action that was asked for comes with the state, "" for none.
    """
    right = right_edge()
    section("Edits", ui)
    imgui.same_line(0.0, 8.0 * ui.scale)
    action = _new_button(form_open)
    if not state.layers:
        return state, action
    combo = 118.0 * ui.scale if len(state.layers) > 1 else 0.0
    wide = 40.0 * ui.scale
    imgui.same_line(right - combo - wide - (6.0 * ui.scale if combo else 0.0))
    state = _overshoot(state, wide)
    if not combo:
        return state, action
    imgui.same_line(right - combo)
    imgui.set_next_item_width(combo)
    if imgui.begin_combo("##blend", state.blend.capitalize()):
        for blend in BLENDS:
            if imgui.selectable(blend.capitalize(), blend == state.blend)[0]:
                state = replace(state, blend=blend)
            tip(BLEND_HELP[blend])
        imgui.end_combo()
    else:
        tip("Where edits overlap (M): " + BLEND_HELP[state.blend])
    return state, action


def _new_button(form_open: bool) -> str:
    imgui.push_style_color(
        imgui.Col_.button, imgui.ImVec4(*(PALETTE.accent_dark if form_open else PALETTE.field))
    )
    pressed = imgui.button("+ New##edit")
    imgui.pop_style_color()
    tip("New edit (Ctrl+N): choose a region and an editor, see it, train it")
    return "new_edit" if pressed else ""


def _overshoot(state: ViewState, width: float) -> ViewState:
    on = state.overshoot
    for slot, color in (
        (imgui.Col_.button, PALETTE.warning_dark if on else PALETTE.field),
        (imgui.Col_.text, PALETTE.text if on else PALETTE.dim),
    ):
        imgui.push_style_color(slot, imgui.ImVec4(*color))
    imgui.push_style_var(imgui.StyleVar_.frame_padding, imgui.ImVec2(0.0, imgui.get_style().frame_padding.y))
    if imgui.button(f"{OVERSHOOT:g}##overshoot", imgui.ImVec2(width, 0.0)):
        state = stack.with_overshoot(state, not on)
    imgui.pop_style_var()
    imgui.pop_style_color(2)
    tip(f"Overshoot to {OVERSHOOT:g} (O): extrapolates past the trained range")
    return state


def draw(state: ViewState, cards: Cards, ui: UiContext, expected: bool = False) -> CardsResult:
    """All cards, under the rows of their groups. `expected`: layers are about to come."""
    if not state.layers and not expected:
        imgui.push_text_wrap_pos(0.0)
        imgui.text_disabled("No edits yet. Make one (Ctrl+N), or drop a .gdf file on the window.")
        imgui.pop_text_wrap_pos()
    focus, renaming, overlap = cards.focus, None, None
    pointed: Pointed | None = None
    actions: list[str] = []
    search = layer_bar.search(state, cards, ui, actions) if state.layers else ""
    texts = [f"{row.region} {row.instruction}" for row in cards.rows]
    found = filter_layers(state, texts, search)[::-1]  # as seen: the top layer, which is the last one, first
    dragged: int | None = None  # a place among the listed ones
    dropped = False
    spans: list[tuple[float, float]] = []
    listed: list[int] = []
    visible = {layer.name for layer in stack.visible_layers(state)}
    group = ""
    for i in found:
        layer = state.layers[i]
        if layer.group and layer.group != group:
            state = _group(state, layer.group, ui, actions)
            _tighten(cards, ui)
        group = layer.group
        if group in state.collapsed and not search:
            continue
        inset = INSET_PX * ui.scale * bool(group)
        top, left = imgui.get_cursor_screen_pos().y, imgui.get_cursor_pos_x()
        imgui.set_cursor_pos_x(left + inset)
        card = draw_card(state, i, layer.name in visible, cards, ui)
        state = card.state
        spans.append((top, imgui.get_item_rect_max().y))
        _tighten(cards, ui)
        if cards.reveal and cards.focus == i:
            imgui.set_scroll_here_y(0.5)
        focus = i if card.touched and card.press in ("", "one", "keep") else focus
        if card.press and (cards.selected or card.press in ("toggle", "range")):
            actions.append(f"press_layer:{card.press}:{i}:{','.join(str(i) for i in found)}")
        renaming = i if card.renaming else renaming
        overlap = i if card.overlap else overlap
        pointed = ("layer", i) if card.pointed else pointed
        actions += [card.action] if card.action else []
        if card.drag:
            dragged, dropped = len(listed), card.drag == "dropped"
        listed.append(i)
    if state.layers and not found:
        small("No layer has these words", PALETTE.dim)
    if dragged is not None:
        to = _place(dragged, spans, imgui.get_mouse_pos().y)
        if dropped and to != dragged:
            focus = listed[to]
            state = stack.move_layer(state, listed[dragged], focus)
        elif not dropped:
            _show_place(dragged, to, spans, ui)
    return CardsResult(state, focus, renaming, overlap, pointed, tuple(actions), search)


def _group(state: ViewState, name: str, ui: UiContext, actions: list[str]) -> ViewState:
    """The row of a group; one that only its layers know is as any other, from the first change on."""
    group = next((group for group in state.groups if group.name == name), LayerGroup(name))
    if group not in state.groups:
        state = replace(state, groups=(*state.groups, group))
    return group_row.draw(state, group, sum(layer.group == name for layer in state.layers), ui, actions)


def _tighten(cards: Cards, ui: UiContext) -> None:
    """Compact rows lie closer together."""
    if cards.compact:
        imgui.set_cursor_pos_y(imgui.get_cursor_pos_y() - 3.0 * ui.scale)


def _place(dragged: int, spans: Sequence[tuple[float, float]], y: float) -> int:
    """The row where the dragged card would lie: past each card over whose middle the hand is."""
    return sum(y > (top + bottom) / 2 for i, (top, bottom) in enumerate(spans) if i != dragged)


def _show_place(dragged: int, to: int, spans: Sequence[tuple[float, float]], ui: UiContext) -> None:
    """A veil over the dragged card and a line where it would lie; near an edge the list scrolls."""
    imgui.set_mouse_cursor(imgui.MouseCursor_.resize_ns)
    canvas, left = imgui.get_window_draw_list(), imgui.get_window_pos().x
    right, gap = left + imgui.get_window_width(), imgui.get_style().item_spacing.y / 2
    top, bottom = spans[dragged]
    veil = imgui.ImVec2(left, top), imgui.ImVec2(right, bottom)
    canvas.add_rect_filled(*veil, u32((*PALETTE.panel[:3], 0.6)), 6.0 * ui.scale)
    if to != dragged:
        y = spans[to][1] + gap if to > dragged else spans[to][0] - gap
        ends = imgui.ImVec2(left, y - ui.scale), imgui.ImVec2(right, y + ui.scale)
        canvas.push_clip_rect_full_screen()
        canvas.add_rect_filled(*ends, u32(PALETTE.accent), ui.scale)
        canvas.pop_clip_rect()
    mouse, margin, step = imgui.get_mouse_pos().y, 24.0 * ui.scale, 6.0 * ui.scale
    if mouse < imgui.get_window_pos().y + margin:
        imgui.set_scroll_y(max(imgui.get_scroll_y() - step, 0.0))
    elif mouse > imgui.get_window_pos().y + imgui.get_window_height() - margin:
        imgui.set_scroll_y(min(imgui.get_scroll_y() + step, imgui.get_scroll_max_y()))
