"""Overlays on the picture: messages, a banner, the safe frame, the axes of the world."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from imgui_bundle import imgui, imgui_ctx

from viewer.camera.view_camera import SHAPES, ViewCamera, axes, dot, widen
from viewer.camera.views import AXES
from viewer.state.commands import Action
from viewer.state.view_state import ViewState
from viewer.state.workspace import Message, Question

from .context import FONT_PX, GAP_PX, PALETTE, SMALL_PX, Rgba, UiContext, u32
from .tips import wrap
from .widgets import plate

_BANNER_PX = 12.0  # upper edge of a banner's text, at 1×
_BANNER_SIDE_PX = 114.0  # free width at each side of a banner, for the toolbar and the axes
_LINE_HEIGHT = 1.25  # distance of a banner's lines relative to the size of its text
_UNDER_BAR_PX = 52.0  # the same below a bar at the picture's upper edge


@dataclass(frozen=True)
class Area:
    """Part of the window that shows the picture, in window pixels."""

    width: float
    height: float


def banner(text: str, area: Area, ui: UiContext, under_bar: bool = False) -> None:
    """Draw a text at the top center of the picture, on several lines if the picture is narrow.

    Args:
        under_bar: a bar of the tool or of the comparison is there; the text goes below it
    """
    size = FONT_PX * ui.scale
    pad = GAP_PX * ui.scale
    room = area.width - 2 * _BANNER_SIDE_PX * ui.scale
    lines = wrap_words(text, room, lambda line: _text_width(line, size, ui))
    widths = [_text_width(line, size, ui) for line in lines]
    height = _LINE_HEIGHT * size
    y = (_UNDER_BAR_PX if under_bar else _BANNER_PX) * ui.scale
    left = (area.width - max(widths)) / 2 - 1.5 * pad
    bottom = y + (len(lines) - 1) * height + size + pad / 2
    corners = (left, y - pad / 2), (area.width - left, bottom)
    imgui.get_background_draw_list().add_rect_filled(*corners, u32(PALETTE.scrim), 5 * ui.scale)
    for i, (line, wide) in enumerate(zip(lines, widths, strict=True)):
        _text((area.width - wide) / 2, y + i * height, line, size, PALETTE.text, ui)


def wrap_words(text: str, room: float, width: Callable[[str], float]) -> list[str]:
    """Return the lines of a text. Only a line of a single word may be wider than `room`.

    Args:
        text: the text
        room: largest width, window pixels
        width: returns the width of a line, window pixels
    """
    lines = [""]
    for word in text.split(" "):
        longer = f"{lines[-1]} {word}"
        if lines[-1] and width(longer) > room:
            lines.append(word)
        else:
            lines[-1] = longer.lstrip()
    return [line.rstrip() for line in lines]


def safe_frame(view: ViewState, area: Area, covered: float = 0.0) -> Area | None:
    """Return the size of the safe frame, centered in the picture; None if it is hidden.

    Args:
        covered: height of the timeline over the lower edge, window pixels
    """
    if not view.safe_frame or not view.panel or view.compare.mode == "beside":
        return None
    shape = SHAPES[view.safe_frame]
    height = max(min(area.height - 2.0 * covered, area.width / shape), 1.0)
    return Area(height * shape, height)


def fit_to_frame(view: ViewState, frame: Area, area: Area) -> ViewState:
    """Return `view` with a wider lens, so that the frame gets the vertical field of view of the film."""
    return replace(view, camera=widen(view.camera, frame.height / area.height))


def draw_cross(at: tuple[float, float], ui: UiContext) -> None:
    """Draw the pointer that keys move."""
    (x, y), canvas = at, imgui.get_background_draw_list()
    for color, thick in ((PALETTE.scrim, 4.0), (PALETTE.handle, 1.5)):
        for dx, dy in ((9.0 * ui.scale, 0.0), (0.0, 9.0 * ui.scale)):
            ends = (x - dx, y - dy), (x + dx, y + dy)
            canvas.add_line(*ends, u32(color), thick * ui.scale)


def draw_frame(name: str, frame: Area, area: Area, ui: UiContext) -> None:
    """Draw the safe frame as a thin line with its name, and a shade over the area outside the film."""
    canvas = imgui.get_background_draw_list()
    shade = u32((*PALETTE.scrim[:3], 0.55))
    left = round((area.width - frame.width) / 2)
    top = round((area.height - frame.height) / 2)
    right = round(area.width) - left
    bottom = round(area.height) - top
    for corners in (
        (0, 0, area.width, top),
        (0, bottom, area.width, area.height),
        (0, top, left, bottom),
        (right, top, area.width, bottom),
    ):
        canvas.add_rect_filled(corners[:2], corners[2:], shade)
    line = u32(PALETTE.handle)
    at = ((left, top), (right, bottom))
    canvas.add_rect(*at, line, thickness=ui.scale)
    size = SMALL_PX * ui.scale
    pad = 5.0 * ui.scale
    # on the right, as the toolbar is on the left
    x = right - _text_width(name, size, ui) - 2 * pad
    y = bottom - size - pad
    canvas.add_rect_filled((x, y), at[1], u32(PALETTE.scrim))
    _text(x + pad, y + pad / 2, name, size, PALETTE.text, ui)


def message(line: Message, area: Area, left: float, ui: UiContext) -> tuple[str, float]:
    """Draw a message at the bottom left, wrapped in a narrow window.

    Args:
        line: the message
        area: the picture above the timeline
        left: width that the toolbar takes from it, window pixels
        ui: fonts and scale

    Returns:
        The clicked button ("close", "copy" for the details, "do" for the message's button, or ""), and the
        message's upper edge in window pixels.
    """
    pad = GAP_PX * ui.scale
    left = max(left, pad)
    buttons = {}
    if line.details:
        buttons["copy"] = "Copy details"
    elif line.button is not None:
        buttons["do"] = line.button[0]
    widest = min(area.width - left - pad, 640.0 * ui.scale)
    at = (left, area.height - pad)
    return _line("message", line.text, line.error, buttons, at, (0.0, 1.0), widest, ui)


def question(
    line: Question, corner: tuple[float, float], room: float, ui: UiContext
) -> tuple[bool, Action | None]:
    """Draw a question with its buttons.

    Args:
        line: the question
        corner: its upper right corner, window pixels
        room: largest width, window pixels
        ui: fonts and scale

    Returns:
        Whether it was answered or closed, and the command of the pressed button.
    """
    labels = {label: label for label, _ in line.buttons}
    widest = min(room, 420.0 * ui.scale)
    clicked, _ = _line("question", line.text, line.error, labels, corner, (1.0, 0.0), widest, ui)
    return bool(clicked), dict(line.buttons).get(clicked)


def _line(
    name: str,
    text: str,
    error: bool,
    buttons: Mapping[str, str],
    at: tuple[float, float],
    pivot: tuple[float, float],
    widest: float,
    ui: UiContext,
) -> tuple[str, float]:
    """Draw a plate with a text and its buttons; return the clicked one and the plate's upper edge."""
    pad = GAP_PX * ui.scale
    imgui.set_next_window_size_constraints((0.0, 0.0), (widest, imgui.get_io().display_size.y))
    with plate(name, at, ui, pivot):
        labels = {**buttons, "close": "×"}
        around = 2 * imgui.get_style().frame_padding.x + imgui.get_style().item_spacing.x
        room = widest - 2 * pad - sum(imgui.calc_text_size(label).x + around for label in labels.values())
        imgui.align_text_to_frame_padding()
        imgui.text_colored(PALETTE.error if error else PALETTE.text, wrap(text, room))
        clicked = ""
        for key, label in labels.items():
            imgui.same_line()
            clicked = key if imgui.small_button(label) else clicked
        top = imgui.get_window_pos().y
    return clicked, top


def _text_width(text: str, size: float, ui: UiContext) -> float:
    with imgui_ctx.push_font(ui.fonts.regular, size / ui.scale):
        return float(imgui.calc_text_size(text).x)


def _text(
    x: float, y: float, text: str, size: float, color: tuple[float, float, float, float], ui: UiContext
) -> None:
    at = (round(x), round(y))
    imgui.get_background_draw_list().add_text(ui.fonts.regular, size, at, u32(color), text)


AXES_DRAG = "axes"
"""Name of the drag of the axes, in addition to those of `keys.DRAGS`."""

# sizes at 1×
LENGTH_PX = 34.0
BALL_PX = 9.5
MARGIN_PX = 8.0
LETTER_PX = 13.0
MIN_PX = 240.0
"""Picture width below which the axes are hidden."""

_REACH_PX = LENGTH_PX + BALL_PX + 3.0
_INKS: dict[str, Rgba] = {
    "X": (0.93, 0.24, 0.30, 1.0),
    "Y": (0.42, 0.71, 0.10, 1.0),
    "Z": (0.20, 0.50, 0.94, 1.0),
}
_SHADE = (0.08, 0.09, 0.10, 0.62)
_DISC = (0.5, 0.5, 0.5, 0.28)
_DARK = (0.04, 0.04, 0.05, 1.0)
_LIGHT = (1.0, 1.0, 1.0, 1.0)
_AWAY_DIMMING = 0.35  # share of its color that an end loses when it points away


@dataclass(frozen=True)
class _End:
    """End of an axis on screen, in window pixels, and its nearness to the camera, −1 to 1."""

    name: str
    x: float
    y: float
    nearness: float


def axis_under(view: ViewState, area: Area, ui: UiContext) -> str:
    """Return the part of the axes under the mouse: an end of `AXES`, "disc" for the rest, "" for none."""
    if not _has_axes(view, area, ui):
        return ""
    mouse, (x, y) = imgui.get_io().mouse_pos, _center(area, ui)
    for end in reversed(_ends(view.camera, area, ui)):
        if (mouse.x - end.x) ** 2 + (mouse.y - end.y) ** 2 <= (BALL_PX * ui.scale) ** 2:
            return end.name
    return "disc" if (mouse.x - x) ** 2 + (mouse.y - y) ** 2 <= (_REACH_PX * ui.scale) ** 2 else ""


def draw_axes(view: ViewState, area: Area, lit: bool, ui: UiContext) -> None:
    """Draw the axes over the picture.

    Args:
        lit: the mouse hovers or drags them
    """
    if not _has_axes(view, area, ui):
        return
    canvas, (x, y), s = imgui.get_background_draw_list(), _center(area, ui), ui.scale
    if lit:
        canvas.add_circle_filled((x, y), _REACH_PX * s, u32(_DISC))
    hovered_end = axis_under(view, area, ui) if lit else ""
    for end in _ends(view.camera, area, ui):
        sign = end.name[0]
        letter = end.name[1]
        ink = _dim(_INKS[letter], end.nearness)
        at = (end.x, end.y)
        if sign == "+":
            canvas.add_line((x, y), at, u32(_SHADE), 3.5 * s)
            canvas.add_line((x, y), at, u32(ink), 2.0 * s)
            canvas.add_circle_filled(at, (BALL_PX + 0.75) * s, u32(_SHADE))
            canvas.add_circle_filled(at, BALL_PX * s, u32(ink))
            _letter(canvas, end, letter, _LIGHT if end.name == hovered_end else _DARK, ui)
        else:
            canvas.add_circle_filled(at, BALL_PX * s, u32(_SHADE))
            canvas.add_circle(at, (BALL_PX - 0.75) * s, u32(ink), 0, 1.75 * s)
            if end.name == hovered_end:
                _letter(canvas, end, f"−{letter}", _LIGHT, ui)


def axes_height(view: ViewState, area: Area, ui: UiContext) -> float:
    """Return the height and width of the axes from the upper right corner, in window pixels; 0 if hidden."""
    return 2 * (_REACH_PX + MARGIN_PX) * ui.scale if _has_axes(view, area, ui) else 0.0


def _has_axes(view: ViewState, area: Area, ui: UiContext) -> bool:
    """Return whether the axes are visible. Hiding the panel (F12) hides them too."""
    return view.axes and view.panel and area.width >= MIN_PX * ui.scale


def _center(area: Area, ui: UiContext) -> tuple[float, float]:
    inset = (_REACH_PX + MARGIN_PX) * ui.scale
    return area.width - inset, inset


def _ends(camera: ViewCamera, area: Area, ui: UiContext) -> list[_End]:
    """Return the six ends of the axes, the farthest first."""
    picture, (x, y), length = axes(camera), _center(area, ui), LENGTH_PX * ui.scale
    ends = (
        _End(
            name,
            x + length * dot(direction, picture.right),
            y - length * dot(direction, picture.up),
            dot(direction, picture.back),
        )
        for name, direction in AXES.items()
    )
    return sorted(ends, key=lambda end: end.nearness)


def _dim(ink: Rgba, nearness: float) -> Rgba:
    """Return a color, darkened for an end that points away from the camera."""
    share = 1.0 - _AWAY_DIMMING * max(-nearness, 0.0)
    return ink[0] * share, ink[1] * share, ink[2] * share, ink[3]


def _letter(canvas: imgui.ImDrawList, end: _End, text: str, color: Rgba, ui: UiContext) -> None:
    size = LETTER_PX * ui.scale
    with imgui_ctx.push_font(ui.fonts.bold, LETTER_PX):
        wide = imgui.calc_text_size(text).x
    at = (round(end.x - wide / 2), round(end.y - size / 2))
    canvas.add_text(ui.fonts.bold, size, at, u32(color), text)
