"""One layer in the panel: eye, name, strength, slider, and what unfolds below it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from imgui_bundle import imgui

from viewer.panel import layer_details as layer_fold
from viewer.panel import strength_slider
from viewer.state import layers as stack
from viewer.state.layer_facts import LayerRow
from viewer.state.view_state import LayerState, ViewState
from viewer.ui.context import PALETTE, Icon, Rgba, UiContext, u32
from viewer.ui.widgets import (
    elide,
    grip,
    group_digits,
    icon_button,
    menu,
    right_edge,
    small,
    small_toggle,
    tip,
    typed_name,
)

TOGGLE_PX = 24.0
CARD_PX = 97.0  # a whole card with what is between two, at 1×
COMPACT_PX, SLIDER_PX, SLIM_PX = 7.0, 92.0, 16.0  # a compact row: its padding, its slider's width and height
_MENU = "menu of a layer"
_MENU_ITEMS = (
    ("Rename…", "Enter", "rename"),
    ("Duplicate", "Ctrl+D", "duplicate"),
    ("Replace…", "", "replace"),
    ("", "", ""),
    ("Delete", "Ctrl+Del", "remove"),
    ("", "", ""),
    ("Copy values", "Ctrl+C", "copy_values"),
    ("Paste values", "Ctrl+V", "paste_values"),
    ("Reset values", "Ctrl+R", "reset"),
    ("", "", ""),
    ("Group", "", "group"),
    ("Select all layers", "Ctrl+Alt+A", "select_layers"),
    ("Reset all layers", "Ctrl+Shift+R", "reset_all"),
)
_OF_ONE = ("rename", "duplicate", "replace", "remove")
"""Actions that are told which layer; the others are about all that are selected."""


@dataclass(frozen=True)
class Cards:
    """What the cards show besides the state.

    Args:
        rows: one per .gdf, indexed by `LayerState.gdf`
        focus: the focused layer, an index into `ViewState.layers`, or None
        reveal: scroll to it, and to what is cut of the selected ones
        active_slider: which of `layers.SLIDERS` of it the arrow keys move
        renaming: the layer whose name is being typed, or None
        selected: `LayerState.gdf` of the layers that are selected with the focused one
        compact: rows of one line in place of cards
        search: only the layers in which these words are found
        searching: the field of the search takes the keyboard
    """

    rows: Sequence[LayerRow]
    focus: int | None = None
    reveal: bool = False
    active_slider: str = "strength"
    renaming: int | None = None
    selected: frozenset[int] = frozenset()
    compact: bool = False
    search: str = ""
    searching: bool = False


@dataclass(frozen=True)
class CardResult:
    """What one card made of the state: the layer touched, being renamed, asked about.

    `drag`: what the hand does with its name, see `grip`; `press`: of `layer_selection.PRESSES`, "" where no
    button went down on it.
    """

    state: ViewState
    touched: bool = False
    renaming: bool = False
    drag: str = ""
    overlap: bool = False
    pointed: bool = False
    action: str = ""
    press: str = ""
    named: bool = False


def draw_card(state: ViewState, index: int, active: bool, cards: Cards, ui: UiContext) -> CardResult:
    """One card: eye, swatch, name and value; the slider; count and toggles; unfolded, curve and gains.

    Where cards are compact, a row with the eye, the swatch, the name, a short slider and the value.
    `active`: the layer takes part in the picture.
    """
    scale, p = ui.scale, PALETTE
    layer, focused = state.layers[index], cards.focus == index
    selected = focused or layer.gdf in cards.selected
    row = cards.rows[layer.gdf]
    imgui.push_id(index)
    canvas = imgui.get_window_draw_list()
    clip = canvas.get_clip_rect_min(), canvas.get_clip_rect_max()
    imgui.push_style_color(imgui.Col_.child_bg, imgui.ImVec4(*(p.card_focused if selected else p.card)))
    padding = (COMPACT_PX, 0.0) if cards.compact else (10.0, 8.0)
    imgui.push_style_var(imgui.StyleVar_.window_padding, imgui.ImVec2(*(side * scale for side in padding)))
    child = imgui.ChildFlags_
    imgui.begin_child(
        "card",
        imgui.ImVec2(0.0, 0.0),
        child.auto_resize_y.value | child.always_use_window_padding.value,
        imgui.WindowFlags_.no_nav.value,
    )
    imgui.pop_style_var()  # here, as tips and menus have paddings of their own
    right = right_edge()
    card = _head(CardResult(state), index, row, cards, active, ui)
    number_at, layer = imgui.get_item_rect_min(), card.state.layers[index]
    if cards.compact:
        imgui.same_line(right - SLIDER_PX * scale - _number_width(cards, layer) - 6.0 * scale)
        imgui.set_cursor_pos_y(imgui.get_cursor_pos_y() + (imgui.get_frame_height() - SLIM_PX * scale) / 2)
    imgui.begin_disabled(layer.locked)
    strength = strength_slider.draw(
        "##strength",
        layer.strength,
        row.recorded,
        SLIDER_PX * scale if cards.compact else imgui.get_content_region_avail().x,
        scale,
        p.accent if selected else p.accent_dark,
        active,
        stack.largest_strength(state),
        SLIM_PX if cards.compact else strength_slider.HEIGHT_PX,
    )
    touched = imgui.is_item_active()
    imgui.end_disabled()
    _number(number_at, strength, active, cards)
    if strength != layer.strength:  # a new state takes its time, and most cards rest
        moved = stack.change_layer(card.state, index, lambda old: replace(old, strength=strength))
        card = replace(card, state=moved)
    if not cards.compact:
        card = _foot(card, index, row, ui)
    if layer.gdf in card.state.unfolded:
        active_slider = cards.active_slider if focused else None
        unfolded = layer_fold.draw(
            card.state.layers[index], row, active_slider, stack.largest_strength(state), ui
        )
        card = replace(card, state=stack.change_layer(card.state, index, lambda _: unfolded))
        if cards.compact:
            imgui.dummy(imgui.ImVec2(0.0, 2.0 * scale))
    over = imgui.is_window_hovered(imgui.HoveredFlags_.allow_when_blocked_by_active_item.value)
    press = _press(card) if over and imgui.is_mouse_clicked(imgui.MouseButton_.left.value) else ""
    several, alone = len(cards.selected) if selected else 0, imgui.get_id("alone")
    if press:  # one of several may be dragged with the others: a click makes it the only one as it ends
        imgui.get_state_storage().set_bool(alone, press == "one" and several > 1)
        press = "keep" if press == "one" and several > 1 else press
    if card.drag == "clicked" and imgui.get_state_storage().get_bool(alone):
        press = "one"
    held = imgui.is_mouse_down(imgui.MouseButton_.left.value)  # then the right button calls its drag off
    if over and not held and imgui.is_mouse_clicked(imgui.MouseButton_.right.value):
        press = "keep"
        imgui.open_popup(_MENU)
    card = replace(card, action=_menu(card.state, index, several, ui))
    if selected:
        _focus_bar(clip, p.accent if focused else p.accent_dark, scale)
    imgui.end_child()
    imgui.pop_style_color()
    imgui.pop_id()
    return replace(card, touched=card.touched or touched or bool(press), press=press)


def _press(card: CardResult) -> str:
    """What the press on the card does to the selection, of `layer_selection.PRESSES`.

    On a button or a slider the modifiers have their own sense.
    """
    if imgui.is_any_item_active() and not card.named:
        return "keep"
    io = imgui.get_io()
    return "toggle" if io.key_ctrl else "range" if io.key_shift else "one"


def _menu(state: ViewState, index: int, several: int, ui: UiContext) -> str:
    """What can be done with a layer as a whole; the action that was chosen, "" for none.

    Args:
        several: how many layers are selected with it, 0 for it alone
    """
    chosen = ""
    with menu(_MENU, ui) as is_open:
        for name, keys, action in _MENU_ITEMS if is_open else ():
            if action == "group":
                chosen = _group_menu(state, state.layers[index], ui) or chosen
                continue
            if name == "Delete" and several > 1:
                name = f"Delete {several} layers"
            if not name:
                imgui.separator()
            elif imgui.menu_item(name, keys, False)[0]:
                chosen = f"{action}:{index}" if action in _OF_ONE else action
    return chosen


def _group_menu(state: ViewState, layer: LayerState, ui: UiContext) -> str:
    chosen = ""
    if imgui.begin_menu("Group"):
        if imgui.menu_item("New group", "Ctrl+G", False)[0]:
            chosen = "group"
        for group in state.groups:
            name = elide(group.name, 200.0 * ui.scale)
            if imgui.menu_item(f"{name}##{group.name}", "", group.name == layer.group)[0]:
                chosen = f"group:{group.name}"
        if layer.group and imgui.menu_item("Ungroup", "Ctrl+Shift+G", False)[0]:
            chosen = "ungroup"
        imgui.end_menu()
    return chosen


def _focus_bar(clip: tuple[imgui.ImVec2, imgui.ImVec2], color: Rgba, scale: float) -> None:
    """A stripe along the left edge of the card that is being drawn, in the panel's clip."""
    canvas, corner = imgui.get_window_draw_list(), imgui.get_window_pos()
    edge = imgui.ImVec2(corner.x + 3 * scale, corner.y + imgui.get_window_size().y)
    canvas.push_clip_rect(*clip, False)
    canvas.add_rect_filled(corner, edge, u32(color), 3 * scale)
    canvas.pop_clip_rect()


def _head(
    card: CardResult, index: int, row: LayerRow, cards: Cards, active: bool, ui: UiContext
) -> CardResult:
    """Eye, swatch, name, and last the place of the number, which is drawn when the slider has its value."""
    scale, state, layer = ui.scale, card.state, card.state.layers[index]
    right, gap = right_edge(), 4.0 * scale if cards.compact else imgui.get_style().item_spacing.x
    if icon_button("eye", Icon.SHOWN if layer.enabled else Icon.HIDDEN, ui, dim=not active):
        if imgui.get_io().key_alt:
            state = stack.toggle_solo(state, index)
        else:
            state = stack.change_layer(state, index, lambda old: replace(old, enabled=not old.enabled))
    tip("Show or hide (H). Alt+click: solo")
    imgui.same_line(0.0, gap)
    _swatch(row.swatch, active, ui)
    imgui.same_line(0.0, gap)
    number_width = _number_width(cards, layer)
    room = right - number_width - 10 * scale - imgui.get_cursor_pos_x()
    room -= SLIDER_PX * scale if cards.compact else 0.0
    card = _name(replace(card, state=state), index, room, cards, active, ui)
    imgui.same_line(right - number_width)
    imgui.dummy(imgui.ImVec2(number_width, imgui.get_frame_height()))
    if imgui.is_item_clicked() and not layer.locked:
        strength_slider.start_typing("##strength")
    tip("Locked (Shift+L)" if layer.locked else "Click to type a value")
    return card


def _digits(strength: float, cards: Cards) -> str:
    return f"{strength:.2f}" if cards.compact else f"{strength:.3f}"


def _number_width(cards: Cards, layer: LayerState) -> float:
    return float(imgui.calc_text_size(_digits(layer.strength, cards)).x)


def _number(corner: imgui.ImVec2, strength: float, active: bool, cards: Cards) -> None:
    """The strength in the card's upper right corner; every digit is equally wide."""
    beyond = PALETTE.warning if strength > 1.0 else PALETTE.text
    at = imgui.ImVec2(corner.x, corner.y + imgui.get_style().frame_padding.y)
    text = _digits(strength, cards)
    imgui.get_window_draw_list().add_text(at, u32(beyond if active else PALETTE.dim), text)


def _name(card: CardResult, index: int, room: float, cards: Cards, active: bool, ui: UiContext) -> CardResult:
    """The name: dragged it moves the card, double-clicked it becomes a text field."""
    layer = card.state.layers[index]
    if cards.renaming == index:
        text = typed_name(layer.name, room)
        return replace(card, renaming=text is None, state=stack.rename_layer(card.state, index, text or ""))
    x, y = imgui.get_cursor_screen_pos()
    imgui.invisible_button("name", imgui.ImVec2(max(room, 1.0), imgui.get_frame_height()))
    gesture = grip(ui)
    at = imgui.ImVec2(x, y + imgui.get_style().frame_padding.y)
    color = PALETTE.text if active else PALETTE.dim
    card = replace(card, named=True) if imgui.is_item_active() else card
    marks = f"{Icon.LOCKED} " * (layer.locked and cards.compact) + "S " * (layer.solo and cards.compact)
    imgui.get_window_draw_list().add_text(at, u32(color), elide(marks + layer.name, room))
    if imgui.is_item_hovered(imgui.HoveredFlags_.for_tooltip.value):
        card = replace(card, pointed=True)  # the picture shows its region
    tip(f"{layer.name}\nDrag to reorder (Alt+↑ ↓), double-click to rename (Enter)")
    double = imgui.is_mouse_double_clicked(imgui.MouseButton_.left.value) and _press(card) == "one"
    if imgui.is_item_hovered() and double:
        return replace(card, renaming=True, touched=True)
    return replace(card, drag=gesture)


def _foot(card: CardResult, index: int, row: LayerRow, ui: UiContext) -> CardResult:
    """Count, overlap and instruction; at the right alone, lock, the fold and the menu."""
    state = card.state
    layer, wide = state.layers[index], TOGGLE_PX * ui.scale
    right, left = right_edge(), imgui.get_cursor_pos_x()
    overlaps = [
        (other.name, row.shared[other.gdf])
        for i, other in enumerate(state.layers)
        if i != index and other.gdf < len(row.shared) and row.shared[other.gdf]
    ]
    note = f"{group_digits(row.count)} splats"
    if len(overlaps) == 1:
        name, count = overlaps[0]
        note += f"  ·  {'all' if count == row.count else group_digits(count)} in {name}"
    elif overlaps:
        note += f"  ·  overlaps {len(overlaps)} layers"
    elif row.instruction:
        note += f"  ·  {row.instruction}"
    small(note, PALETTE.dim, right - left - 4 * wide - 6.0 * ui.scale)
    asked = bool(overlaps) and imgui.is_item_hovered(imgui.HoveredFlags_.for_tooltip.value)
    shared = [f"{group_digits(count)} of its splats are also in {name}" for name, count in overlaps]
    shared += ["Highlighted in pink"] if overlaps else []
    tip("\n".join((f"{group_digits(row.count)} splats", *filter(None, [row.instruction]), *shared)))
    imgui.same_line(right - 4 * wide)
    if small_toggle("solo", "S", layer.solo, wide, ui):
        state = stack.toggle_solo(state, index)
    tip("Solo: show only soloed layers (Shift+H)")
    imgui.same_line(right - 3 * wide)
    if small_toggle("lock", Icon.LOCKED if layer.locked else Icon.UNLOCKED, layer.locked, wide, ui):
        state = stack.change_layer(state, index, lambda old: replace(old, locked=not old.locked))
    tip("Lock strength, gains and paint (Shift+L)")
    imgui.same_line(right - 2 * wide)
    if small_toggle("fold", Icon.GAINS, layer.gdf in state.unfolded, wide, ui):
        state = stack.toggle_details(state, index)
    tip("Show gains and the curve of visible change (G)")
    imgui.same_line(right - wide)
    if small_toggle("menu", Icon.MENU, False, wide, ui):
        imgui.open_popup(_MENU)
    tip("Rename, duplicate, replace or delete (right-click)")
    return replace(card, state=state, overlap=asked)


def _swatch(color: tuple[float, float, float], active: bool, ui: UiContext) -> None:
    side = 12.0 * ui.scale
    x, y = imgui.get_cursor_screen_pos()
    top = y + (imgui.get_frame_height() - side) / 2
    imgui.dummy(imgui.ImVec2(side, imgui.get_frame_height()))
    rgba: Rgba = (*color, 1.0 if active else 0.35)
    canvas = imgui.get_window_draw_list()
    corners = imgui.ImVec2(x, top), imgui.ImVec2(x + side, top + side)
    canvas.add_rect_filled(*corners, u32(rgba), 3 * ui.scale)
    canvas.add_rect(*corners, u32(PALETTE.line), 3 * ui.scale)
