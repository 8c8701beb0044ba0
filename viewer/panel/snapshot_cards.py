"""The panel's part for snapshots: small pictures, a click goes back to one."""

from __future__ import annotations

from dataclasses import dataclass

from imgui_bundle import imgui

from viewer.ui.context import PALETTE, SMALL_PX, UiContext, u32
from viewer.ui.widgets import elide, menu, right_edge, section, tip, typed_name

COLUMNS = 3
_MENU = "menu of a snapshot"
_ITEMS = ("Rename…", "Delete")


@dataclass(frozen=True)
class SnapshotCard:
    """One snapshot as the panel shows it. `texture`: its GL name, 0 before it is drawn"""

    name: str
    texture: int = 0


def draw(cards: tuple[SnapshotCard, ...], ui: UiContext, actions: list[str]) -> None:
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
    gap = 6.0 * ui.scale
    each = (imgui.get_content_region_avail().x - (COLUMNS - 1) * gap) / COLUMNS
    for i, card in enumerate(cards if len(cards) > 1 else ()):
        if i % COLUMNS:
            imgui.same_line(0.0, gap)
        _card(i, card, each, ui, actions)


def _card(index: int, card: SnapshotCard, wide: float, ui: UiContext, actions: list[str]) -> None:
    imgui.push_id(index)
    imgui.begin_group()
    at = imgui.get_cursor_screen_pos()
    tall = 0.75 * wide
    if imgui.invisible_button(f"restore{index}", imgui.ImVec2(wide, tall)):
        actions.append(f"restore:{index}")
    hovered = imgui.is_item_hovered()
    tip("Restore (right-click: rename, delete)" if index else "Restore the original: all sliders at 0")
    if index and imgui.is_item_clicked(imgui.MouseButton_.right.value):
        imgui.open_popup(_MENU)
    item, renaming = _menu(ui), imgui.get_id("renaming")
    if item == "Rename…":
        imgui.get_state_storage().set_bool(renaming, True)
    elif item == "Delete":
        actions.append(f"forget:{index}")
    canvas, end = imgui.get_window_draw_list(), imgui.ImVec2(at.x + wide, at.y + tall)
    if card.texture:
        zero, one = imgui.ImVec2(0.0, 0.0), imgui.ImVec2(1.0, 1.0)
        white = u32((1.0, 1.0, 1.0, 1.0))
        texture = imgui.ImTextureRef(card.texture)
        canvas.add_image_rounded(texture, at, end, zero, one, white, 4.0 * ui.scale)
    else:
        canvas.add_rect_filled(at, end, u32(PALETTE.card), 4.0 * ui.scale)
    if hovered:
        canvas.add_rect(at, end, u32(PALETTE.accent), 4.0 * ui.scale, 2.0 * ui.scale)
    imgui.push_font(None, SMALL_PX)
    if imgui.get_state_storage().get_bool(renaming):
        name = typed_name(card.name, wide)
        imgui.get_state_storage().set_bool(renaming, name is None)
        actions += [f"name_snapshot:{index}:{name}"] if name else []
    else:
        imgui.text_disabled(elide(card.name, wide))
    imgui.pop_font()
    imgui.end_group()
    imgui.pop_id()


def _menu(ui: UiContext) -> str:
    """The item that was chosen, "" for none."""
    with menu(_MENU, ui) as is_open:
        chosen = [name for name in _ITEMS if is_open and imgui.menu_item(name, "", False)[0]]
    return chosen[0] if chosen else ""
