"""Where the axes of the world point, at the upper right of the picture: click an end, drag the rest."""

from __future__ import annotations

from dataclasses import dataclass

from imgui_bundle import imgui

from viewer.camera.named_views import AXES
from viewer.camera.view_camera import ViewCamera, axes, dot
from viewer.state.view_state import ViewState

from .context import Rgba, UiContext, u32
from .overlay import Area

DRAG = "axes"
"""The name of its drag, beside those of `keys.DRAGS`."""

LENGTH_PX, BALL_PX, MARGIN_PX = 34.0, 9.5, 10.0  # at 1×
LETTER_PX = 13.0
LEAST_PX = 240.0
"""Width of the picture below which there is no room for it."""

_REACH_PX = LENGTH_PX + BALL_PX + 3.0
_INKS: dict[str, Rgba] = {
    "X": (0.93, 0.24, 0.30, 1.0),
    "Y": (0.42, 0.71, 0.10, 1.0),
    "Z": (0.20, 0.50, 0.94, 1.0),
}
_SHADE, _DISC = (0.08, 0.09, 0.10, 0.62), (0.5, 0.5, 0.5, 0.28)
_DARK, _LIGHT = (0.04, 0.04, 0.05, 1.0), (1.0, 1.0, 1.0, 1.0)
_AWAY = 0.35  # of an ink that an end has lost where it points away


@dataclass(frozen=True)
class _End:
    """An end of an axis on screen: window pixels, and how far it points towards the eye, −1..1."""

    name: str
    x: float
    y: float
    nearness: float


def under(view: ViewState, area: Area, ui: UiContext) -> str:
    """What the mouse is on: an end of `AXES`, "disc" for the rest of it, "" where it is elsewhere."""
    if not _is_shown(view, area, ui):
        return ""
    mouse, (x, y) = imgui.get_io().mouse_pos, _center(area, ui)
    for end in reversed(_ends(view.camera, area, ui)):
        if (mouse.x - end.x) ** 2 + (mouse.y - end.y) ** 2 <= (BALL_PX * ui.scale) ** 2:
            return end.name
    return "disc" if (mouse.x - x) ** 2 + (mouse.y - y) ** 2 <= (_REACH_PX * ui.scale) ** 2 else ""


def draw(view: ViewState, area: Area, lit: bool, ui: UiContext) -> None:
    """Draw it over the picture.

    Args:
        lit: the mouse is on it, or holds it
    """
    if not _is_shown(view, area, ui):
        return
    canvas, (x, y), s = imgui.get_background_draw_list(), _center(area, ui), ui.scale
    if lit:
        canvas.add_circle_filled(imgui.ImVec2(x, y), _REACH_PX * s, u32(_DISC))
    on = under(view, area, ui) if lit else ""
    for end in _ends(view.camera, area, ui):
        sign, letter = end.name[0], end.name[1]
        ink, at = _dimmed(_INKS[letter], end.nearness), imgui.ImVec2(end.x, end.y)
        if sign == "+":
            canvas.add_line(imgui.ImVec2(x, y), at, u32(_SHADE), 3.5 * s)
            canvas.add_line(imgui.ImVec2(x, y), at, u32(ink), 2.0 * s)
            canvas.add_circle_filled(at, (BALL_PX + 0.75) * s, u32(_SHADE))
            canvas.add_circle_filled(at, BALL_PX * s, u32(ink))
            _letter(canvas, end, letter, _LIGHT if end.name == on else _DARK, ui)
        else:
            canvas.add_circle_filled(at, BALL_PX * s, u32(_SHADE))
            canvas.add_circle(at, (BALL_PX - 0.75) * s, u32(ink), 0, 1.75 * s)
            if end.name == on:
                _letter(canvas, end, f"−{letter}", _LIGHT, ui)


def _is_shown(view: ViewState, area: Area, ui: UiContext) -> bool:
    """It goes with the panel: F12 leaves nothing but the picture."""
    return view.axes and view.panel and area.width >= LEAST_PX * ui.scale


def _center(area: Area, ui: UiContext) -> tuple[float, float]:
    inset = (_REACH_PX + MARGIN_PX) * ui.scale
    return area.width - inset, inset


def _ends(camera: ViewCamera, area: Area, ui: UiContext) -> list[_End]:
    """The six ends, the farthest first."""
    picture, (x, y), length = axes(camera), _center(area, ui), LENGTH_PX * ui.scale
    found = (
        _End(
            name,
            x + length * dot(way, picture.right),
            y - length * dot(way, picture.up),
            dot(way, picture.back),
        )
        for name, way in AXES.items()
    )
    return sorted(found, key=lambda end: end.nearness)


def _dimmed(ink: Rgba, nearness: float) -> Rgba:
    """An ink as it is on an end that points so far towards the eye."""
    share = 1.0 - _AWAY * max(-nearness, 0.0)
    return ink[0] * share, ink[1] * share, ink[2] * share, ink[3]


def _letter(canvas: imgui.ImDrawList, end: _End, text: str, color: Rgba, ui: UiContext) -> None:
    size = LETTER_PX * ui.scale
    imgui.push_font(ui.fonts.bold, LETTER_PX)
    wide = imgui.calc_text_size(text).x
    imgui.pop_font()
    at = imgui.ImVec2(round(end.x - wide / 2), round(end.y - size / 2))
    canvas.add_text(ui.fonts.bold, size, at, u32(color), text)
