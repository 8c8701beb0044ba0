"""The panel's part for snapshots: small pictures to go back to, and a slider between two of them."""

from __future__ import annotations

from dataclasses import dataclass

from imgui_bundle import imgui

from viewer.panel import strength_slider
from viewer.ui.context import PALETTE, SMALL_PX, Icon, UiContext, u32
from viewer.ui.widgets import (
    drop_down,
    elide,
    grip,
    icon_button,
    menu,
    picture,
    right_edge,
    section,
    tip,
    typed_name,
)

COLUMNS = 3
_MENU = "menu of a snapshot"
_ITEMS = (
    ("Rename…", ""),
    ("Use as A", "choose_snapshot:a:"),
    ("Use as B", "choose_snapshot:b:"),
    ("Move left", ""),
    ("Move right", ""),
    ("Delete", "forget:"),
)


@dataclass(frozen=True)
class SnapshotCard:
    """One snapshot as the panel shows it. `texture`: its GL name, 0 before it is drawn"""

    name: str
    texture: int = 0


@dataclass(frozen=True)
class SnapshotSlider:
    """The slider between two snapshots.

    Args:
        a, b: places of the two among the cards
        share: where it stands, 0 at A
        current: what is on screen is what it made
        compared: the two are compared in the picture
    """

    a: int = 0
    b: int = 0
    share: float = 0.0
    current: bool = False
    compared: bool = False


def draw(cards: tuple[SnapshotCard, ...], slider: SnapshotSlider, ui: UiContext, actions: list[str]) -> None:
    """Draw the section; what was asked for goes into `actions`. The first card is the original."""
    imgui.dummy(imgui.ImVec2(0.0, 4.0 * ui.scale))
    right = right_edge()
    section("Snapshots", ui)
    name = "Add"
    wide = imgui.calc_text_size(name).x + 2 * imgui.get_style().frame_padding.x
    imgui.same_line(right - wide)
    if imgui.button(f"{name}##snapshot"):
        actions.append("snapshot")
    tip("Save the current sliders as a snapshot (F3); click a snapshot to restore it")
    if len(cards) < 2:
        return
    _slider(cards, slider, ui, actions)
    gap = 6.0 * ui.scale
    each = (imgui.get_content_region_avail().x - (COLUMNS - 1) * gap) / COLUMNS
    start, dragged = imgui.get_cursor_screen_pos(), ""
    for i, card in enumerate(cards):
        if i % COLUMNS:
            imgui.same_line(0.0, gap)
        badge = "A" * (i == slider.a) + "B" * (i == slider.b)
        dragged = _card(i, card, badge, each, len(cards), ui, actions) or dragged
    if dragged:
        mouse, tall = imgui.get_mouse_pos(), 0.75 * each + SMALL_PX * ui.scale + 2 * gap
        column = max(0, min(COLUMNS - 1, int((mouse.x - start.x) / (each + gap))))
        to = max(1, min(len(cards) - 1, COLUMNS * max(0, int((mouse.y - start.y) / tall)) + column))
        kind, _, index = dragged.partition(":")
        if kind == "dropped" and to != int(index):
            actions.append(f"move_snapshot:{index}:{to}")
        elif kind == "dragged":
            corner = imgui.ImVec2(start.x + (to % COLUMNS) * (each + gap), start.y + to // COLUMNS * tall)
            end = imgui.ImVec2(corner.x + each, corner.y + 0.75 * each)
            imgui.get_window_draw_list().add_rect(
                corner, end, u32(PALETTE.accent), 4.0 * ui.scale, 3.0 * ui.scale
            )


def _slider(
    cards: tuple[SnapshotCard, ...], slider: SnapshotSlider, ui: UiContext, actions: list[str]
) -> None:
    """Which two, whether they are compared, and where between them the picture stands."""
    side, gap = imgui.get_frame_height(), 4.0 * ui.scale
    wide = (imgui.get_content_region_avail().x - side - 2 * gap) / 2
    for slot, chosen in (("a", slider.a), ("b", slider.b)):
        if slot == "b":
            imgui.same_line(0.0, gap)
            if icon_button("compare snapshots", Icon.SPLIT, ui, dim=not slider.compared):
                actions.append("compare_snapshots")
            tip("Compare A with B in the picture (Shift+F3)")
            imgui.same_line(0.0, gap)
        imgui.set_next_item_width(wide)
        label = f"{slot.upper()}   {cards[chosen].name}"
        room = wide - side - 2 * imgui.get_style().frame_padding.x
        help_ = f"Snapshot {slot.upper()}, the {'left' if slot == 'a' else 'right'} end of the slider below"
        titles = [card.name for card in cards]
        pressed = drop_down(f"##snapshot {slot}", elide(label, room), titles, chosen, ui, help_)
        if pressed is not None:
            actions.append(f"choose_snapshot:{slot}:{titles[pressed]}")
    number = imgui.calc_text_size("0.00").x
    at, room = imgui.get_cursor_screen_pos(), imgui.get_content_region_avail().x - number - 8.0 * ui.scale
    share = strength_slider.draw(
        "##blend snapshots",
        slider.share,
        (0.0, 0.5, 1.0),
        room,
        ui.scale,
        PALETTE.accent,
        slider.current,
        help_="Blend from A to B. Ctrl+click: type a value. Shift+drag: fine adjustment.",
    )
    corner = imgui.ImVec2(at.x + room + 8.0 * ui.scale, at.y)
    color = PALETTE.text if slider.current else PALETTE.dim
    imgui.get_window_draw_list().add_text(corner, u32(color), f"{share:.2f}")
    if share != slider.share:
        actions.append(f"blend_snapshots:{share!r}")


def _card(
    index: int, card: SnapshotCard, badge: str, wide: float, count: int, ui: UiContext, actions: list[str]
) -> str:
    """One picture with its name; "dragged:INDEX" while it is moved, "dropped:INDEX" where it is let go."""
    imgui.push_id(index)
    imgui.begin_group()
    at = imgui.get_cursor_screen_pos()
    tall = 0.75 * wide
    imgui.invisible_button(f"restore{index}", imgui.ImVec2(wide, tall))
    gesture = grip(ui)
    dragged = f"{gesture}:{index}" if index and gesture in ("dragged", "dropped") else ""
    if gesture == "clicked":
        actions.append(f"restore:{index}")
    hovered = imgui.is_item_hovered()
    tip(
        "Restore. Drag to reorder; right-click: rename, A, B, delete"
        if index
        else "Restore the original: all sliders at 0"
    )
    if imgui.is_item_clicked(imgui.MouseButton_.right.value):
        imgui.open_popup(_MENU)
    item, renaming = _menu(index, count, ui), imgui.get_id("renaming")
    if item == "Rename…":
        imgui.get_state_storage().set_bool(renaming, True)
    elif item.startswith("Move"):
        actions.append(f"move_snapshot:{index}:{index + (1 if item == 'Move right' else -1)}")
    elif item:
        actions.append(dict(_ITEMS)[item] + (str(index) if item == "Delete" else card.name))
    canvas, end = imgui.get_window_draw_list(), imgui.ImVec2(at.x + wide, at.y + tall)
    picture(card.texture, at, end, 4.0 * ui.scale)
    if hovered or dragged:
        canvas.add_rect(at, end, u32(PALETTE.accent), 4.0 * ui.scale, 2.0 * ui.scale)
    imgui.push_font(ui.fonts.bold, SMALL_PX)
    if badge:
        _badge(badge, at, ui)
    imgui.pop_font()
    imgui.push_font(None, SMALL_PX)
    if imgui.get_state_storage().get_bool(renaming):
        name = typed_name(card.name, wide)
        imgui.get_state_storage().set_bool(renaming, name is None)
        actions += [f"name_snapshot:{index}:{name}"] if name else []
    else:
        imgui.text_disabled(elide(card.name, wide))
        left = imgui.MouseButton_.left.value
        if index and imgui.is_item_hovered() and imgui.is_mouse_double_clicked(left):
            imgui.get_state_storage().set_bool(renaming, True)
    imgui.pop_font()
    imgui.end_group()
    imgui.pop_id()
    return dragged


def _badge(text: str, at: imgui.ImVec2, ui: UiContext) -> None:
    """The letter of a snapshot of the pair, over its picture."""
    canvas, size, pad = imgui.get_window_draw_list(), imgui.calc_text_size(text), 4.0 * ui.scale
    corner = imgui.ImVec2(at.x + pad, at.y + pad)
    end = imgui.ImVec2(corner.x + size.x + 2 * pad, corner.y + size.y + 0.5 * pad)
    canvas.add_rect_filled(corner, end, u32(PALETTE.scrim), 3.0 * ui.scale)
    canvas.add_text(imgui.ImVec2(corner.x + pad, corner.y + 0.25 * pad), u32(PALETTE.text), text)


def _menu(index: int, count: int, ui: UiContext) -> str:
    """The item that was chosen, "" for none; the original is neither renamed nor moved."""
    off = {"Move left": index < 2, "Move right": index == count - 1}
    with menu(_MENU, ui) as is_open:
        chosen = [
            name
            for name, _ in _ITEMS
            if is_open
            and (index or name.startswith("Use"))
            and imgui.menu_item(name, "", False, not off.get(name, False))[0]
        ]
    return chosen[0] if chosen else ""
