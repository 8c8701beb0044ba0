"""A gesture over the picture: the line that is being drawn, a sphere's circle, the ring of the brush."""

from __future__ import annotations

from collections.abc import Sequence

from imgui_bundle import imgui

from viewer.state.view_state import ViewState
from viewer.ui.context import PALETTE, UiContext, u32

from .gesture import Gesture

_HALO, _LINE = 3.0, 1.25  # widths at 1×


def draw(gesture: Gesture | None, view: ViewState, ui: UiContext, left: int = 0) -> None:
    """Draw it, in window coordinates; the ring of the brush also between its strokes.

    Args:
        left: the column in framebuffer pixels at which the picture begins
    """
    io, mouse = imgui.get_io(), imgui.get_mouse_pos()
    over = not io.want_capture_mouse
    if view.select.tool == "brush" and over:
        _circle(mouse, view.select.radius * ui.scale, ui)
    if gesture is None:
        return
    density = io.display_framebuffer_scale
    path = [imgui.ImVec2((x + left) / density.x, y / density.y) for x, y in gesture.path]
    first, last = path[0], path[-1]
    if gesture.tool == "box":
        corners = (imgui.ImVec2(last.x, first.y), last, imgui.ImVec2(first.x, last.y))
        _line([first, *corners], True, ui)
    elif gesture.tool == "lasso":
        _line(path, True, ui)
    elif gesture.tool == "polygon":
        _line([*path, mouse] if over else path, False, ui)
        for corner in path:
            _dot(corner, ui)
    elif gesture.tool == "sphere":
        _circle(first, ((last.x - first.x) ** 2 + (last.y - first.y) ** 2) ** 0.5, ui)
        _dot(first, ui)


def _line(path: Sequence[imgui.ImVec2], closed: bool, ui: UiContext) -> None:
    canvas = imgui.get_background_draw_list()
    flags = imgui.ImDrawFlags_.closed.value if closed else 0
    for color, width in ((_DARK, _HALO), (PALETTE.handle, _LINE)):
        canvas.add_polyline([*path], u32(color), width * ui.scale, flags)


def _circle(center: imgui.ImVec2, radius: float, ui: UiContext) -> None:
    canvas = imgui.get_background_draw_list()
    for color, width in ((_DARK, _HALO), (PALETTE.handle, _LINE)):
        canvas.add_circle(center, radius, u32(color), 0, width * ui.scale)


def _dot(center: imgui.ImVec2, ui: UiContext) -> None:
    canvas = imgui.get_background_draw_list()
    for color, radius in ((_DARK, 4.5), (PALETTE.handle, 3.0)):
        canvas.add_circle_filled(center, radius * ui.scale, u32(color))


_DARK = (0.0, 0.0, 0.0, 0.5)
