"""What is drawn over the picture: timings, messages, the word "Original"."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from imgui_bundle import imgui

from viewer.render.timings import FrameTimings
from viewer.state.workspace import Message

from .context import FONT_PX, PALETTE, SMALL_PX, UiContext, u32
from .widgets import group_digits


@dataclass(frozen=True)
class Area:
    """The part of the window that shows the picture, window pixels."""

    width: float
    height: float


def figures(
    timings: FrameTimings,
    latencies_ms: Sequence[float],
    count: int,
    draws_with: str,
    size: tuple[int, int],
    pixels: int = 1,
) -> list[tuple[str, str]]:
    """Names and figures of a picture.

    Args:
        timings: where its time went
        latencies_ms: from a slider's event to finished pixels, the last ones
        count: Gaussians in the scene
        draws_with: "gl" or "cpu"
        size: of the picture as drawn: width, height
        pixels: of the window that each of its pixels fills, each way; more than 1 while it is coarse
    """
    lines = [
        ("frame", f"{timings.total_ms:.1f} ms"),
        ("  compose", f"{timings.compose_ms:.1f} ms"),
        ("  upload", f"{timings.upload_ms:.1f} ms"),
        ("  sort", f"{timings.sort_ms:.1f} ms"),
        ("  draw", f"{timings.draw_ms:.1f} ms"),
        ("picture", f"{size[0]}×{size[1]}" + (", coarse" if pixels > 1 else "")),
    ]
    if latencies_ms:
        median, late = np.percentile(latencies_ms, (50, 95))
        lines.append(("slider p50 / p95", f"{median:.0f} / {late:.0f} ms"))
    lines.append(("splats", f"{group_digits(timings.drawn)} of {group_digits(count)}"))
    lines.append(("drawn by", {"gl": "OpenGL", "cpu": "CPU"}[draws_with]))
    return lines


def table(lines: Sequence[tuple[str, str]], ui: UiContext) -> None:
    """A small table at the upper left: names, and figures aligned at the right."""
    size, pad, gap = SMALL_PX * ui.scale, 8.0 * ui.scale, 14.0 * ui.scale
    names = max((_text_width(name, size, ui) for name, _ in lines), default=0.0)
    figures = max((_text_width(figure, size, ui) for _, figure in lines), default=0.0)
    step = size * 1.35
    left = top = 10.0 * ui.scale
    right = left + names + figures + gap + 2 * pad
    bottom = top + step * len(lines) + 2 * pad - (step - size)
    canvas = imgui.get_background_draw_list()
    canvas.add_rect_filled(
        imgui.ImVec2(left, top), imgui.ImVec2(right, bottom), u32(PALETTE.scrim), 5 * ui.scale
    )
    for i, (name, figure) in enumerate(lines):
        y = top + pad + i * step
        _text(left + pad, y, name, size, PALETTE.dim, ui)
        _text(right - pad - _text_width(figure, size, ui), y, figure, size, PALETTE.text, ui)


def banner(text: str, area: Area, ui: UiContext, row: int = 0) -> None:
    """A word at the top center of the picture, or so many rows below."""
    size, pad = FONT_PX * ui.scale, 8.0 * ui.scale
    wide = _text_width(text, size, ui)
    x, y = (area.width - wide) / 2, (14.0 + 32.0 * row) * ui.scale
    corners = imgui.ImVec2(x - 1.5 * pad, y - pad / 2), imgui.ImVec2(x + wide + 1.5 * pad, y + size + pad / 2)
    imgui.get_background_draw_list().add_rect_filled(*corners, u32(PALETTE.scrim), 5 * ui.scale)
    _text(x, y, text, size, PALETTE.text, ui)


def message(shown: Message, area: Area, ui: UiContext) -> tuple[str, float]:
    """One line at the bottom left, wrapped where the window is narrow.

    Returns:
        What was clicked: "close", "copy" for its details, or ""; its upper edge in window pixels.
    """
    pad = 12.0 * ui.scale
    widest = min(area.width - 2 * pad, 640.0 * ui.scale)
    imgui.set_next_window_pos(imgui.ImVec2(pad, area.height - pad), 0, imgui.ImVec2(0.0, 1.0))
    imgui.set_next_window_size_constraints(imgui.ImVec2(0.0, 0.0), imgui.ImVec2(widest, area.height))
    imgui.push_style_color(imgui.Col_.window_bg, imgui.ImVec4(*PALETTE.scrim))
    imgui.push_style_var(imgui.StyleVar_.window_rounding, 5.0 * ui.scale)
    imgui.begin("message", None, _FLOATING)
    buttons = {"Copy details": "copy", "×": "close"} if shown.details else {"×": "close"}
    around = 2 * imgui.get_style().frame_padding.x + imgui.get_style().item_spacing.x
    room = widest - 2 * pad - sum(imgui.calc_text_size(text).x + around for text in buttons)
    wrap = imgui.calc_text_size(shown.text).x > room
    imgui.push_text_wrap_pos(imgui.get_cursor_pos_x() + room if wrap else -1.0)
    imgui.align_text_to_frame_padding()
    color = PALETTE.error if shown.error else PALETTE.text
    imgui.text_colored(imgui.ImVec4(*color), shown.text)
    imgui.pop_text_wrap_pos()
    clicked = ""
    for text, name in buttons.items():
        imgui.same_line()
        clicked = name if imgui.small_button(text) else clicked
    top = imgui.get_window_pos().y
    imgui.end()
    imgui.pop_style_var()
    imgui.pop_style_color()
    return clicked, top


_FLOATING = (
    imgui.WindowFlags_.no_decoration.value
    | imgui.WindowFlags_.always_auto_resize.value
    | imgui.WindowFlags_.no_saved_settings.value
    | imgui.WindowFlags_.no_focus_on_appearing.value
    | imgui.WindowFlags_.no_nav.value
    | imgui.WindowFlags_.no_move.value
)


def _text_width(text: str, size: float, ui: UiContext) -> float:
    imgui.push_font(ui.fonts.regular, size / ui.scale)
    wide = float(imgui.calc_text_size(text).x)
    imgui.pop_font()
    return wide


def _text(
    x: float, y: float, text: str, size: float, color: tuple[float, float, float, float], ui: UiContext
) -> None:
    at = imgui.ImVec2(round(x), round(y))
    imgui.get_background_draw_list().add_text(ui.fonts.regular, size, at, u32(color), text)
