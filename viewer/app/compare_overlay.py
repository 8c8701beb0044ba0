"""What one sees and grips of a comparison: divider, names of the sides, the line over a difference."""

from __future__ import annotations

from dataclasses import replace

from imgui_bundle import imgui

from viewer.pictures.compare_labels import Labels
from viewer.state.view_state import ViewState
from viewer.ui import overlay
from viewer.ui.context import PALETTE, SMALL_PX, UiContext, u32
from viewer.ui.overlay import Area

REACH_PX = 8.0  # at 1×: so near to the divider the mouse grips it
DIVIDER = "divider"
"""The name of its drag, beside those of `keys.DRAGS`."""


def near(view: ViewState, area: Area, ui: UiContext) -> bool:
    """Whether the mouse is where a press grips the divider; the cursor then says so."""
    if view.compare.mode != "split":
        return False
    mouse = imgui.get_io().mouse_pos
    within = abs(mouse.x - view.compare.divider * area.width) <= REACH_PX * ui.scale
    return within and 0.0 <= mouse.y < area.height


def move_divider(view: ViewState, area: Area) -> ViewState:
    """The divider under the mouse, never out of the picture."""
    return place_divider(view, max(0.0, min(1.0, imgui.get_io().mouse_pos.x / area.width)))


def place_divider(view: ViewState, divider: float) -> ViewState:
    """The divider at this share of the picture's width, 0..1."""
    return replace(view, compare=replace(view.compare, divider=divider))


def show_grip() -> None:
    """The cursor of something that moves sideways."""
    imgui.set_mouse_cursor(imgui.MouseCursor_.resize_ew.value)


def draw(view: ViewState, said: Labels, area: Area, held: bool, ui: UiContext) -> None:
    """Divider and labels, or the line over a difference; and why it is not what was asked for.

    Args:
        said: the words
        held: the mouse holds the divider, or is over it
    """
    if view.compare.mode == "difference":
        overlay.banner(said.line, area, ui)
    if view.compare.mode == "split":
        _divider(view.compare.divider, said, area, held, ui)
        _knob(round(view.compare.divider * area.width), area.height / 2, held, ui)
    if view.compare.mode == "beside":
        _divider(0.5, said, area, False, ui)
    if view.compare.mode != "off" and said.notice:
        overlay.banner(said.notice, area, ui, row=1)


def _divider(share: float, said: Labels, area: Area, held: bool, ui: UiContext) -> None:
    x = round(share * area.width)
    canvas = imgui.get_background_draw_list()
    canvas.push_clip_rect(imgui.ImVec2(0.0, 0.0), imgui.ImVec2(area.width, area.height), False)
    ink = u32(PALETTE.accent if held else PALETTE.handle)
    top, bottom = imgui.ImVec2(x, 0.0), imgui.ImVec2(x, area.height)
    canvas.add_line(top, bottom, u32(PALETTE.scrim), 3.0 * ui.scale)
    canvas.add_line(top, bottom, ink, 1.5 * ui.scale)
    _tag(canvas, x, said.left, True, ui)
    _tag(canvas, x, said.right, False, ui)
    canvas.pop_clip_rect()


def _knob(x: float, y: float, held: bool, ui: UiContext) -> None:
    """A round grip with an arrow to either side."""
    s, canvas = ui.scale, imgui.get_background_draw_list()
    ink = u32(PALETTE.accent if held else PALETTE.handle)
    canvas.add_circle_filled(imgui.ImVec2(x, y), 12.0 * s, u32(PALETTE.scrim))
    canvas.add_circle(imgui.ImVec2(x, y), 12.0 * s, ink, 0, 1.5 * s)
    for way in (-1.0, 1.0):
        canvas.add_triangle_filled(
            imgui.ImVec2(x + way * 7.5 * s, y),
            imgui.ImVec2(x + way * 3.0 * s, y - way * 4.0 * s),
            imgui.ImVec2(x + way * 3.0 * s, y + way * 4.0 * s),
            ink,
        )


def _tag(canvas: imgui.ImDrawList, x: float, text: str, left: bool, ui: UiContext) -> None:
    s = ui.scale
    imgui.push_font(ui.fonts.regular, SMALL_PX)
    wide = imgui.calc_text_size(text).x
    imgui.pop_font()
    pad, gap, size = 8.0 * s, 10.0 * s, SMALL_PX * s
    start = x - gap - wide - 2 * pad if left else x + gap
    corner = imgui.ImVec2(start, 14.0 * s)
    canvas.add_rect_filled(
        corner,
        imgui.ImVec2(start + wide + 2 * pad, 14.0 * s + size + pad),
        u32(PALETTE.scrim),
        5.0 * s,
    )
    at = imgui.ImVec2(round(start + pad), round(14.0 * s + pad / 2))
    canvas.add_text(ui.fonts.regular, size, at, u32(PALETTE.text), text)
