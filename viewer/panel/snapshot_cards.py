"""Snapshots in the panel: thumbnails that restore a state, and the choice of the two to compare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from imgui_bundle import imgui, imgui_ctx

from viewer.state.commands import Action, ChooseSnapshot, MoveSnapshot, OnItem, Plain, Rename
from viewer.state.snapshots import compare_sides, pair_of, with_original
from viewer.state.workspace import Workspace
from viewer.ui import widgets
from viewer.ui.context import GAP_PX, PALETTE, SMALL_PX, Icon, UiContext, u32

COLUMNS = 3
_MENU = "menu of a snapshot"


def _menu(index: int, name: str) -> tuple[tuple[str, Action | None, str], ...]:
    """Return the menu of a snapshot. The original cannot be renamed, moved or deleted."""
    compare = (
        ("Use as A", ChooseSnapshot("a", name), ""),
        ("Use as B", ChooseSnapshot("b", name), ""),
    )
    if not index:
        return compare
    return (
        ("Rename…", None, ""),
        *compare,
        ("Move left", MoveSnapshot(index, index - 1), ""),
        ("Move right", MoveSnapshot(index, index + 1), ""),
        ("Delete", OnItem("forget", index), ""),
    )


@dataclass(frozen=True)
class _Cards:
    """Snapshots in the order drawn, the original first."""

    names: Sequence[str]
    textures: Sequence[int]  # GL names of their pictures, 0 before they are drawn
    a: int  # indices of the compared snapshots
    b: int


def draw(work: Workspace, textures: Sequence[int], ui: UiContext, actions: list[Action]) -> Workspace:
    """Draw the section and return the workspace with its fold state.

    Args:
        textures: GL names of the pictures, the original's first
    """
    right = widgets.right_edge()
    work = replace(work, layout=widgets.section("Snapshots", work.layout, ui))
    name = "Add"
    wide = imgui.calc_text_size(name).x + 2 * imgui.get_style().frame_padding.x
    imgui.same_line(right - wide)
    if imgui.button(f"{name}##snapshot"):
        actions.append(Plain("snapshot"))
    widgets.hint("snapshot")
    if len(textures) < 2 or "Snapshots" in work.layout.folded:
        return work
    snapshots = with_original(work.snapshots, work.view)
    cards = _Cards([s.name for s in snapshots], textures, *pair_of(snapshots, work.view.pair))
    _pair(cards, compare_sides(work.snapshots, work.view) is not None, ui, actions)
    gap = GAP_PX * ui.scale
    each = (imgui.get_content_region_avail().x - (COLUMNS - 1) * gap) / COLUMNS
    for i in range(len(textures)):
        if i % COLUMNS:
            imgui.same_line(0.0, gap)
        _card(i, cards, each, ui, actions)
    return work


def _pair(cards: _Cards, compared: bool, ui: UiContext, actions: list[Action]) -> None:
    """Draw the choice of the two snapshots, and the button that compares them."""
    side = imgui.get_frame_height()
    gap = 4.0 * ui.scale
    wide = (imgui.get_content_region_avail().x - side - 2 * gap) / 2
    for slot, chosen in (("a", cards.a), ("b", cards.b)):
        if slot == "b":
            imgui.same_line(0.0, gap)
            if widgets.icon_button("compare snapshots", Icon.SPLIT, ui, dim=not compared):
                actions.append(Plain("compare_snapshots"))
            widgets.hint("compare_snapshots")
            imgui.same_line(0.0, gap)
        imgui.set_next_item_width(wide)
        label = f"{slot.upper()}   {cards.names[chosen]}"
        room = wide - side - 2 * imgui.get_style().frame_padding.x
        help_ = f"Snapshot {slot.upper()}, on the {'left' if slot == 'a' else 'right'} of a comparison"
        shown = widgets.elide(label, room)
        pressed = widgets.drop_down(f"##snapshot {slot}", shown, cards.names, chosen, ui, help_)
        if pressed is not None:
            actions.append(ChooseSnapshot(slot, cards.names[pressed]))


def _card(index: int, cards: _Cards, wide: float, ui: UiContext, actions: list[Action]) -> None:
    """Draw the thumbnail of a snapshot with its name and menu."""
    name = cards.names[index]
    badge = ""
    if index == cards.a:
        badge += "A"
    if index == cards.b:
        badge += "B"
    with imgui_ctx.push_id(index), imgui_ctx.begin_group():
        at = imgui.get_cursor_screen_pos()
        tall = 0.75 * wide
        if imgui.invisible_button(f"restore{index}", (wide, tall), imgui.ButtonFlags_.enable_nav.value):
            actions.append(OnItem("restore", index))
        hovered = imgui.is_item_hovered()
        widgets.tip(
            "Restore. Right-click: rename, compare, reorder, delete"
            if index
            else "Restore the original: all sliders at 0"
        )
        if imgui.is_item_clicked(imgui.MouseButton_.right.value):
            imgui.open_popup(_MENU)
        last = len(cards.names) - 1
        off = []
        if index <= 1:
            off.append("Move left")
        if index >= last:
            off.append("Move right")
        for action in widgets.menu_items(_MENU, _menu(index, name), ui, off):
            widgets.start_naming(action is None)
            if action is not None:
                actions.append(action)
        canvas = imgui.get_window_draw_list()
        end = (at.x + wide, at.y + tall)
        widgets.picture(cards.textures[index], at, end, 4.0 * ui.scale)
        if hovered:
            canvas.add_rect(at, end, u32(PALETTE.accent), 4.0 * ui.scale, 2.0 * ui.scale)
        with imgui_ctx.push_font(ui.fonts.bold, SMALL_PX):
            if badge:
                _badge(badge, at, ui)
        with imgui_ctx.push_font(None, SMALL_PX):
            if not widgets.name_field(name, wide, partial(Rename, "name_snapshot", index), actions):
                imgui.text_disabled(widgets.elide(name, wide))
                left = imgui.MouseButton_.left.value
                if index and imgui.is_item_hovered() and imgui.is_mouse_double_clicked(left):
                    widgets.start_naming()


def _badge(text: str, at: imgui.ImVec2, ui: UiContext) -> None:
    """Draw a snapshot's letter, A or B, over its picture."""
    canvas = imgui.get_window_draw_list()
    size = imgui.calc_text_size(text)
    pad = 4.0 * ui.scale
    corner = imgui.ImVec2(at.x + pad, at.y + pad)
    end = (corner.x + size.x + 2 * pad, corner.y + size.y + 0.5 * pad)
    canvas.add_rect_filled(corner, end, u32(PALETTE.scrim), 3.0 * ui.scale)
    canvas.add_text((corner.x + pad, corner.y + 0.25 * pad), u32(PALETTE.text), text)
