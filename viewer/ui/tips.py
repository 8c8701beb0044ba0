"""Tooltips: their text, and their place beside the list or panel of the control."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from imgui_bundle import imgui

GAP_PX = 8.0  # distance from the control and its list, at 1×
WIDEST_PX = 320.0  # width of the text, at 1×


@dataclass(frozen=True)
class Box:
    """Rectangle in window pixels."""

    left: float
    top: float
    right: float
    bottom: float

    def overlaps(self, other: Box) -> bool:
        """Return whether the two share an area."""
        is_beside = self.right <= other.left or other.right <= self.left
        return not (is_beside or self.bottom <= other.top or other.bottom <= self.top)


def show_tip(text: str) -> bool:
    """Show a tooltip of the last item while the mouse hovers it; return whether it is shown.

    A key hides it until the mouse moves again.
    """
    flags = imgui.HoveredFlags_
    # no_nav_override: a field that only has the keyboard shows no tooltip
    hover_flags = flags.for_tooltip.value | flags.allow_when_disabled.value | flags.no_nav_override.value
    if not imgui.is_item_hovered(hover_flags):
        return False
    context = imgui.get_current_context()
    if context.last_keyboard_key_press_time > context.time - context.mouse_stationary_timer:
        return False
    scale = imgui.get_style().font_scale_dpi
    padding = imgui.get_style().window_padding
    text = wrap(text, WIDEST_PX * scale)
    wide, tall = imgui.calc_text_size(text)
    size = (wide + 2 * padding.x, tall + 2 * padding.y)
    low = imgui.get_item_rect_min()
    high = imgui.get_item_rect_max()
    item = Box(low.x, low.y, high.x, high.y)
    display = imgui.get_io().display_size
    at = place(item, _lists(), size, (display.x, display.y), GAP_PX * scale)
    imgui.set_next_window_pos(at)
    imgui.set_tooltip(text)
    return True


def place(
    item: Box,
    lists: Sequence[Box],
    size: tuple[float, float],
    display: tuple[float, float],
    gap: float,
) -> tuple[float, float]:
    """Return the upper left corner of a tooltip that covers neither the item nor its lists.

    It opens beside a tall list and below a wide one, or on the opposite side if it does not fit. Without
    room beside the lists it only keeps clear of the item.

    Args:
        item: the control
        lists: panel, bar or menus that contain the control
        size: width and height of the tooltip
        display: width and height of the window
        gap: distance from the lists
    """
    hull = Box(
        min(box.left for box in lists),
        min(box.top for box in lists),
        max(box.right for box in lists),
        max(box.bottom for box in lists),
    )
    for around in (hull, item):
        for left, top in _sides(item, around, size, gap):
            left = min(max(left, 0.0), max(display[0] - size[0], 0.0))
            top = min(max(top, 0.0), max(display[1] - size[1], 0.0))
            tip = Box(left, top, left + size[0], top + size[1])
            if not tip.overlaps(around):
                return left, top
    return item.left, item.bottom + gap


def _sides(item: Box, around: Box, size: tuple[float, float], gap: float) -> tuple[tuple[float, float], ...]:
    """Return the corner of the tooltip on each side of a box, level with the item, the best one first."""
    beside = (around.right + gap, item.top), (around.left - gap - size[0], item.top)
    level = (item.left, around.bottom + gap), (item.left, around.top - gap - size[1])
    is_tall = around.bottom - around.top > around.right - around.left
    return (*beside, *level) if is_tall else (*level, *beside)


def _lists() -> list[Box]:
    """Return the boxes of the window with the last item, and of the windows that opened it."""
    boxes = []
    window: imgui.internal.Window | None = imgui.internal.get_current_window()
    while window is not None:
        root = window.root_window
        corner = root.pos
        boxes.append(Box(corner.x, corner.y, corner.x + root.size.x, corner.y + root.size.y))
        window = root.parent_window_in_begin_stack if root.flags & imgui.WindowFlags_.popup.value else None
    return boxes


def wrap(text: str, room: float) -> str:
    """Return the text with line breaks so that each line fits `room` window pixels, if its words do."""
    lines = []
    for paragraph in text.split("\n"):
        line = ""
        for word in paragraph.split(" "):
            longer = f"{line} {word}" if line else word
            if line and imgui.calc_text_size(longer).x > room:
                lines.append(line)
                longer = word
            line = longer
        lines.append(line)
    return "\n".join(lines)
