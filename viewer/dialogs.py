"""Questions over the picture: where to save, what to open, what becomes of unsaved changes.

All of it goes by keys too: Enter takes the marked button, Escape leaves all as it was. Where to save is asked
until it is saved: the desk takes that question away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from imgui_bundle import imgui

from .overlay import Area
from .ui_context import PALETTE, SMALL_PX, UiContext
from .widgets import elided, section, small, tip
from .workspace import Dialog

WIDTH_PX = 520.0  # at 1×
_POPUP = "##dialog"
_NAMES = {"save": "Save the session", "open": "Open", "leave": "There are unsaved changes"}
_HINTS = {
    "save": "A .session.json file; the scene and its edits stay where they are.",
    "open": "A scene (.ply, .spz, .sog …), an edit (.gdf), a session or cameras, told apart by content.",
    "leave": "Save them in {} first?",
}


@dataclass(frozen=True)
class Answer:
    """The dialog as it is now, None once it is over, and the requests that come of it."""

    dialog: Dialog | None
    requests: tuple[str, ...] = ()


def draw(dialog: Dialog, recent: Sequence[Path], pressed: Sequence[str], ui: UiContext, area: Area) -> Answer:
    """Draw the question and take its answer.

    Args:
        recent: files opened before, the last one first
        pressed: chords that went down in this frame
        area: the picture; the question stands in its upper part
    """
    if not imgui.is_popup_open(_POPUP):
        imgui.open_popup(_POPUP)
    middle = imgui.ImVec2(area.width / 2, 0.25 * area.height)
    imgui.set_next_window_pos(middle, 0, imgui.ImVec2(0.5, 0.5))
    room = area.width - 16.0 * ui.scale
    imgui.set_next_window_size(imgui.ImVec2(min(WIDTH_PX * ui.scale, room), 0.0))
    flags = imgui.WindowFlags_
    fixed = flags.no_move.value | flags.no_nav.value
    shown = flags.no_decoration.value | flags.no_saved_settings.value | fixed
    imgui.push_style_var(imgui.StyleVar_.window_rounding, 6.0 * ui.scale)
    imgui.push_style_var(imgui.StyleVar_.window_padding, imgui.ImVec2(16.0 * ui.scale, 14.0 * ui.scale))
    imgui.push_style_color(imgui.Col_.modal_window_dim_bg, imgui.ImVec4(0.0, 0.0, 0.0, 0.45))
    answer = Answer(dialog)
    if imgui.begin_popup_modal(_POPUP, None, shown)[0]:
        answer = _content(dialog, recent, pressed, ui)
        if answer.dialog is None:
            imgui.close_current_popup()
        imgui.end_popup()
    imgui.pop_style_color()
    imgui.pop_style_var(2)
    return answer


def _content(dialog: Dialog, recent: Sequence[Path], pressed: Sequence[str], ui: UiContext) -> Answer:
    imgui.push_font(ui.fonts.bold, 0.0)
    imgui.text(_NAMES[dialog.kind])
    imgui.pop_font()
    imgui.push_font(None, SMALL_PX)
    imgui.text_colored(imgui.ImVec4(*PALETTE.dim), _HINTS[dialog.kind].format(Path(dialog.text).name))
    imgui.pop_font()
    imgui.dummy(imgui.ImVec2(0.0, 2.0 * ui.scale))
    if "Escape" in pressed:
        return Answer(None)
    if dialog.chosen:
        return _given(dialog, dialog.chosen)
    if dialog.kind == "leave":
        return _leaving(dialog, pressed, ui)
    if imgui.is_window_appearing() or (dialog.error and not imgui.is_any_item_active()):
        imgui.set_keyboard_focus_here()  # Enter lets go of the field, and the path is to be corrected
    more, gap = 36.0 * ui.scale, 6.0 * ui.scale
    imgui.set_next_item_width(-more - gap)
    _, text = imgui.input_text("##path", dialog.text)
    dialog = replace(dialog, text=text)
    imgui.same_line(0.0, gap)
    imgui.begin_disabled(dialog.choosing)
    browse = imgui.button("…", imgui.ImVec2(more, 0.0))
    imgui.end_disabled()
    tip("Choose in the desktop's own dialog (Ctrl+B)")
    if browse or ("Ctrl+B" in pressed and not dialog.choosing):
        return Answer(dialog, ("browse",))
    if dialog.notice:
        small(dialog.notice, PALETTE.warning)
    if dialog.error:
        _wrapped(dialog.error)
    if dialog.kind == "open":
        chosen = _recent(recent, ui)
        if chosen is not None:
            return Answer(None, (f"open_file:{chosen}",))
    imgui.dummy(imgui.ImVec2(0.0, 2.0 * ui.scale))
    name = {"save": "Save", "open": "Open"}[dialog.kind]
    button = _buttons((name, "Cancel"), ui)
    if button == "Cancel":
        return Answer(None)
    path = text.strip().strip("\"'")
    if path and (button == name or "Enter" in pressed):
        return _given(dialog, path)
    return Answer(dialog)


def _given(dialog: Dialog, path: str) -> Answer:
    """The file that was asked for."""
    if dialog.kind == "save":
        return Answer(replace(dialog, text=path, chosen=""), (f"save_to:{path}",))
    return Answer(None, (f"open_file:{path}",))


def _wrapped(error: str) -> None:
    """Why the path did not serve, in as many lines as it takes."""
    imgui.push_font(None, SMALL_PX)
    imgui.push_text_wrap_pos(0.0)
    imgui.text_colored(imgui.ImVec4(*PALETTE.error), error)
    imgui.pop_text_wrap_pos()
    imgui.pop_font()


def _leaving(dialog: Dialog, pressed: Sequence[str], ui: UiContext) -> Answer:
    button = _buttons(("Save", "Discard", "Cancel"), ui)
    if button == "Cancel":
        return Answer(None)
    if button == "Discard" or "D" in pressed:
        return Answer(None, ("discard", dialog.then))
    if button == "Save" or "Enter" in pressed or "S" in pressed:
        return Answer(None, (f"save:{dialog.then}",))
    return Answer(dialog)


def _recent(recent: Sequence[Path], ui: UiContext) -> Path | None:
    """The list of files opened before; the one that was clicked."""
    chosen = None
    if recent:
        section("Recent", ui)
    for i, path in enumerate(recent):
        room = imgui.get_content_region_avail().x
        if imgui.selectable(f"{elided(path.name, 0.4 * room)}##{i}", False)[0]:
            chosen = path
        imgui.same_line(0.42 * room)
        imgui.push_font(None, SMALL_PX)
        imgui.text_disabled(elided(str(path.parent), 0.56 * room))
        imgui.pop_font()
    return chosen


def _buttons(names: Sequence[str], ui: UiContext) -> str | None:
    """Buttons at the right, the first one marked; the name of the pressed one."""
    wide, gap = 92.0 * ui.scale, 8.0 * ui.scale
    start = imgui.get_content_region_avail().x - len(names) * wide - (len(names) - 1) * gap
    imgui.set_cursor_pos_x(imgui.get_cursor_pos_x() + max(start, 0.0))
    pressed = None
    for i, name in enumerate(names):
        if i:
            imgui.same_line(0.0, gap)
        colour = PALETTE.field if i else PALETTE.accent_dark
        imgui.push_style_color(imgui.Col_.button, imgui.ImVec4(*colour))
        if imgui.button(name, imgui.ImVec2(wide, 0.0)):
            pressed = name
        imgui.pop_style_color()
    return pressed
