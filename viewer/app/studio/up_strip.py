"""The question which way is up: four pictures at the lower edge, of which one is clicked."""

from __future__ import annotations

from dataclasses import dataclass

from imgui_bundle import imgui

from viewer.camera.view_camera import ViewCamera
from viewer.ui.context import PALETTE, SMALL_PX, UiContext, u32
from viewer.ui.overlay import Area
from viewer.ui.widgets import picture, right_edge

SIZE = (160, 120)
"""Pixels of a picture."""
_WIDE_PX = 128.0
"""Of a picture at 1×, where there is room."""
_GAP_PX, _PAD_PX, _TITLE_PX = 8.0, 10.0, 24.0


@dataclass(frozen=True)
class UpChoice:
    """A direction that may be up.

    Args:
        name: as "+Y"
        camera: the first view if it is
        texture: GL name of its picture, 0 while there is none
    """

    name: str
    camera: ViewCamera
    texture: int = 0


@dataclass(frozen=True)
class UpStrip:
    """The question while it is asked; `now` is what counts as up meanwhile."""

    choices: tuple[UpChoice, ...]
    now: str


def height(strip: UpStrip | None, area: Area, ui: UiContext) -> float:
    """How much of the lower edge of the picture it covers, window pixels."""
    if strip is None:
        return 0.0
    return 0.75 * _width(strip, area, ui) + (2 * _PAD_PX + _TITLE_PX + _GAP_PX) * ui.scale


def draw(strip: UpStrip, area: Area, ui: UiContext) -> tuple[str, ...]:
    """Draw it along the lower edge of `area`; the requests that come of it."""
    wide, scale, requests = _width(strip, area, ui), ui.scale, list[str]()
    tall = height(strip, area, ui) - _GAP_PX * scale
    imgui.set_next_window_pos(imgui.ImVec2(area.width / 2, area.height - _GAP_PX * scale), 0, _BELOW)
    count = len(strip.choices)
    across = count * wide + ((count - 1) * _GAP_PX + 2 * _PAD_PX) * scale
    imgui.set_next_window_size(imgui.ImVec2(across, tall))
    imgui.push_style_color(imgui.Col_.window_bg, imgui.ImVec4(*PALETTE.scrim))
    imgui.push_style_var(imgui.StyleVar_.window_rounding, 6.0 * scale)
    imgui.push_style_var(imgui.StyleVar_.window_padding, imgui.ImVec2(_PAD_PX * scale, _PAD_PX * scale))
    imgui.begin("up axis", None, _FLAGS)
    top, right = imgui.get_cursor_pos_y(), right_edge()
    imgui.text("Which way is up?")
    keep = f"Keep {strip.now} (Esc)"
    imgui.push_font(None, SMALL_PX)
    room = imgui.calc_text_size(keep).x + 2 * imgui.get_style().frame_padding.x
    if right - room > imgui.get_item_rect_size().x + _PAD_PX * scale:
        imgui.same_line(right - room)
        if imgui.small_button(keep):
            requests.append("keep_up")
    imgui.pop_font()
    for i, choice in enumerate(strip.choices):
        imgui.set_cursor_pos(
            imgui.ImVec2((_PAD_PX + i * _GAP_PX) * scale + i * wide, top + _TITLE_PX * scale)
        )
        if _picture(choice, wide, choice.name == strip.now, ui):
            requests.append(f"set_up:{i}")
    imgui.end()
    imgui.pop_style_var(2)
    imgui.pop_style_color()
    return tuple(requests)


def _width(strip: UpStrip, area: Area, ui: UiContext) -> float:
    """Of a picture, window pixels."""
    count = len(strip.choices)
    room = area.width - (2 * _PAD_PX + (count + 1) * _GAP_PX) * ui.scale
    return max(min(_WIDE_PX * ui.scale, room / count), 24.0 * ui.scale)


def _picture(choice: UpChoice, wide: float, now: bool, ui: UiContext) -> bool:
    at, rounding = imgui.get_cursor_screen_pos(), 4.0 * ui.scale
    pressed = bool(imgui.invisible_button(choice.name, imgui.ImVec2(wide, 0.75 * wide)))
    canvas, end = imgui.get_window_draw_list(), imgui.ImVec2(at.x + wide, at.y + 0.75 * wide)
    picture(choice.texture, at, end, rounding)
    if now or imgui.is_item_hovered():
        ink = PALETTE.accent if imgui.is_item_hovered() else PALETTE.dim
        canvas.add_rect(at, end, u32(ink), rounding, 2.0 * ui.scale)
    size, pad = SMALL_PX * ui.scale, 4.0 * ui.scale
    imgui.push_font(ui.fonts.bold, SMALL_PX)
    text = imgui.calc_text_size(choice.name)
    imgui.pop_font()
    corner = imgui.ImVec2(at.x + text.x + 2 * pad, at.y + size + pad)
    canvas.add_rect_filled(at, corner, u32(PALETTE.scrim), rounding)
    at = imgui.ImVec2(round(at.x + pad), round(at.y + pad / 2))
    canvas.add_text(ui.fonts.bold, size, at, u32(PALETTE.text), choice.name)
    return pressed


_BELOW = imgui.ImVec2(0.5, 1.0)
_FLAGS = (
    imgui.WindowFlags_.no_decoration.value
    | imgui.WindowFlags_.no_move.value
    | imgui.WindowFlags_.no_saved_settings.value
    | imgui.WindowFlags_.no_focus_on_appearing.value
    | imgui.WindowFlags_.no_nav.value
)
