"""Position of a window on the screen: entirely inside the work area of its monitor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from .glfw_library import glfw


@dataclass(frozen=True)
class Box:
    """Rectangle on the desktop in screen coordinates, which may be pixels or points."""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True)
class Frame:
    """Widths of the title bar and borders around a window's content, screen coordinates."""

    left: int = 0
    top: int = 0
    right: int = 0
    bottom: int = 0


def keep_on_screen(handle: Any, least: tuple[int, int]) -> None:
    """Shrink and move a window that reaches beyond the work area of its monitor.

    Args:
        handle: glfw's handle of the window
        least: minimum width and height of the window, less on a smaller screen
    """
    window = window_box(handle)
    fitted = fit_box(window, window_frame(handle), work_areas())
    min_width = min(least[0], fitted.width)
    min_height = min(least[1], fitted.height)
    glfw.set_window_size_limits(handle, min_width, min_height, glfw.DONT_CARE, glfw.DONT_CARE)
    if (fitted.width, fitted.height) != (window.width, window.height):
        glfw.set_window_size(handle, fitted.width, fitted.height)
    if (fitted.x, fitted.y) != (window.x, window.y):
        glfw.set_window_pos(handle, fitted.x, fitted.y)


def fit_box(window: Box, frame: Frame, areas: Sequence[Box]) -> Box:
    """Return the content of a window, shrunk and moved so that it lies in a work area with its frame.

    Args:
        window: content of the window
        frame: its title bar and borders
        areas: work areas of the monitors, the primary one first; without any, the window stays unchanged
    """
    if not areas:
        return window
    area = max(areas, key=lambda other: _overlap(window, other))  # the first one if several overlap equally
    width = max(min(window.width, area.width - frame.left - frame.right), 1)
    height = max(min(window.height, area.height - frame.top - frame.bottom), 1)
    max_x = area.x + area.width - frame.right - width
    max_y = area.y + area.height - frame.bottom - height
    x = max(min(window.x, max_x), area.x + frame.left)
    y = max(min(window.y, max_y), area.y + frame.top)
    return Box(x, y, width, height)


def work_areas() -> list[Box]:
    """Return the work areas of the monitors, the primary one first.

    A monitor without a reported work area counts as a whole; one without a size is omitted.
    """
    areas = []
    for monitor in glfw.get_monitors():
        area = Box(*glfw.get_monitor_workarea(monitor))
        if min(area.width, area.height) <= 0:
            size = glfw.get_video_mode(monitor).size
            area = Box(*glfw.get_monitor_pos(monitor), size.width, size.height)
        if min(area.width, area.height) > 0:
            areas.append(area)
    return areas


def window_box(handle: Any) -> Box:
    """Return the content of a window."""
    return Box(*glfw.get_window_pos(handle), *glfw.get_window_size(handle))


def window_frame(handle: Any) -> Frame:
    """Return the frame around a window; all zero if the system reports none."""
    return Frame(*glfw.get_window_frame_size(handle))


def _overlap(a: Box, b: Box) -> int:
    width = min(a.x + a.width, b.x + b.width) - max(a.x, b.x)
    height = min(a.y + a.height, b.y + b.height) - max(a.y, b.y)
    return max(width, 0) * max(height, 0)
