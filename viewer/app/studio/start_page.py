"""The page of a window without a scene: files that were open, Open, the demo, and where to drop a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from imgui_bundle import imgui

from progdf import __version__
from progdf.errors import escape_text
from progdf.io.session import SUFFIX
from viewer.ui.context import PALETTE, SMALL_PX, Icon, UiContext, u32
from viewer.ui.widgets import accent_button, elide, picture, section, tip

KEYS = ("open", "quit", "full_screen", "window_picture", "help", "unfocus", "about")
"""Actions of keys that mean something here."""
CARD_PX, GAP_PX, MARGIN_PX, DROP_PX = 168.0, 16.0, 28.0, 84.0
ROW_GAP_PX = 8.0
WIDEST_PX = 4 * CARD_PX + 3 * GAP_PX


@dataclass(frozen=True)
class RecentFile:
    """A scene or session that was open. `texture`: the GL name of its picture, 0 for none"""

    path: Path
    texture: int = 0


def draw(recent: Sequence[RecentFile], ui: UiContext) -> list[str]:
    """The page, over the whole window; the actions that were asked for."""
    display, scale = imgui.get_io().display_size, ui.scale
    imgui.set_next_window_pos(imgui.ImVec2(0.0, 0.0))
    imgui.set_next_window_size(display)
    imgui.push_style_var(imgui.StyleVar_.window_padding, imgui.ImVec2(0.0, 0.0))
    imgui.begin("start page", None, _WHOLE)
    imgui.pop_style_var()
    wide = min(WIDEST_PX * scale, display.x - 2 * MARGIN_PX * scale)
    cards = max(int((wide + GAP_PX * scale) // ((CARD_PX + GAP_PX) * scale)), 1)
    tall = (96.0 + DROP_PX + GAP_PX) * scale + (_rows(recent, cards) * _card_height(ui) + 30.0 * scale)
    left = (display.x - wide) / 2
    imgui.set_cursor_pos(imgui.ImVec2(left, max((display.y - tall) / 2.6, MARGIN_PX * scale)))
    imgui.begin_child("middle", imgui.ImVec2(wide, 0.0))
    actions = _head(ui)
    if recent:
        section("Recent", ui)
        actions += _grid(recent, cards, ui)
    _drop_target(wide, ui)
    imgui.end_child()
    imgui.end()
    return actions


def _head(ui: UiContext) -> list[str]:
    scale, actions = ui.scale, []
    imgui.push_font(ui.fonts.bold, 26.0)
    imgui.text("ProGDF Studio")
    imgui.pop_font()
    imgui.same_line()
    imgui.push_font(None, SMALL_PX)
    imgui.set_cursor_pos_y(imgui.get_cursor_pos_y() + 11.0 * scale)
    imgui.text_disabled(__version__)
    imgui.pop_font()
    imgui.dummy(imgui.ImVec2(0.0, 2.0 * scale))
    size = imgui.ImVec2(150.0 * scale, 34.0 * scale)
    if accent_button(f"{Icon.OPEN}  Open…", size):
        actions.append("open")
    tip("A scene (.ply, .spz, .sog …) or a session (Ctrl+O)")
    imgui.same_line(0.0, 10.0 * scale)
    if imgui.button("Try the demo", size):
        actions.append("demo")
    tip("Makes a small scene and trains four edits of it here: a minute or two")
    imgui.dummy(imgui.ImVec2(0.0, 10.0 * scale))
    return actions


def _grid(recent: Sequence[RecentFile], cards: int, ui: UiContext) -> list[str]:
    actions = []
    for i, file in enumerate(recent):
        if i % cards:
            imgui.same_line(0.0, GAP_PX * ui.scale)
        elif i:
            imgui.dummy(imgui.ImVec2(0.0, ROW_GAP_PX * ui.scale))
        imgui.push_id(i)
        if _card(file, ui):
            actions.append(f"open_file:{file.path}")
        imgui.pop_id()
    return actions


def _card(file: RecentFile, ui: UiContext) -> bool:
    """A picture, the name and the folder; whether it was clicked."""
    wide, tall, rounding = CARD_PX * ui.scale, 0.75 * CARD_PX * ui.scale, 5.0 * ui.scale
    imgui.begin_group()
    at = imgui.get_cursor_screen_pos()
    pressed = bool(imgui.invisible_button("file", imgui.ImVec2(wide, tall)))
    hovered = imgui.is_item_hovered()
    tip(escape_text(str(file.path)))
    canvas, end = imgui.get_window_draw_list(), imgui.ImVec2(at.x + wide, at.y + tall)
    picture(file.texture, at, end, rounding)
    if not file.texture:
        size = imgui.calc_text_size(Icon.PICTURE)
        middle = imgui.ImVec2(round(at.x + (wide - size.x) / 2), round(at.y + (tall - size.y) / 2))
        canvas.add_text(middle, u32(PALETTE.field_hovered), Icon.PICTURE)
    if hovered:
        canvas.add_rect(at, end, u32(PALETTE.accent), rounding, 2.0 * ui.scale)
    name = file.path.name.removesuffix(SUFFIX) if file.path.name.endswith(SUFFIX) else file.path.name
    imgui.text(elide(escape_text(name), wide))
    imgui.push_font(None, SMALL_PX)
    imgui.text_disabled(elide(escape_text(_folder(file.path)), wide))
    imgui.pop_font()
    imgui.end_group()
    return pressed


def _folder(path: Path) -> str:
    """Where it lies, with ~ for the user's home."""
    try:
        return f"~/{path.parent.relative_to(Path.home())}"
    except (ValueError, RuntimeError):
        return str(path.parent)


def _drop_target(wide: float, ui: UiContext) -> None:
    """A dashed frame; files may be dropped anywhere, and this says so."""
    scale = ui.scale
    imgui.dummy(imgui.ImVec2(0.0, 6.0 * scale))
    x, y = imgui.get_cursor_screen_pos()
    tall, dash = DROP_PX * scale, 7.0 * scale
    imgui.dummy(imgui.ImVec2(wide, tall))
    x, y, wide, tall = x + scale, y + scale, wide - 2 * scale, tall - 2 * scale
    canvas, ink = imgui.get_window_draw_list(), u32(PALETTE.field_hovered)
    sides = ((y, wide, True), (y + tall, wide, True), (x, tall, False), (x + wide, tall, False))
    for start, length, along_x in sides:
        for i in range(int(length / (2 * dash)) + 1):
            low, high = 2 * i * dash, min((2 * i + 1) * dash, length)
            ends = (
                (imgui.ImVec2(x + low, start), imgui.ImVec2(x + high, start))
                if along_x
                else (imgui.ImVec2(start, y + low), imgui.ImVec2(start, y + high))
            )
            canvas.add_line(*ends, ink, 1.5 * scale)
    text = "Drop a scene or a session anywhere in this window"
    size = imgui.calc_text_size(text)
    at = imgui.ImVec2(round(x + (wide - size.x) / 2), round(y + (tall - size.y) / 2))
    canvas.add_text(at, u32(PALETTE.dim), text)


def _rows(recent: Sequence[RecentFile], cards: int) -> int:
    return -(-len(recent) // cards)


def _card_height(ui: UiContext) -> float:
    return (0.75 * CARD_PX + 46.0 + ROW_GAP_PX) * ui.scale


_WHOLE = (
    imgui.WindowFlags_.no_decoration.value
    | imgui.WindowFlags_.no_move.value
    | imgui.WindowFlags_.no_saved_settings.value
    | imgui.WindowFlags_.no_bring_to_front_on_focus.value
    | imgui.WindowFlags_.no_nav.value
)
