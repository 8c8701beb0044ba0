"""The list of bindings (F1): all that mouse and keys do, by topic, made from the tables that decide it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

from imgui_bundle import imgui

from viewer.ui.context import PALETTE, SMALL_PX, UiContext
from viewer.ui.keys import TOPICS

MOUSE_HELP = (
    ("Left drag", "orbit; with Alt also while a tool is on"),
    ("Middle drag", "orbit; with Shift pan, with Ctrl dolly"),
    ("Right drag", "pan; in fly mode look around"),
    ("Wheel", "zoom"),
    ("Click", "select the layer under the cursor"),
    ("Double-click", "set the orbit pivot"),
    ("Axes", "click an end to look from there"),
    ("W A S D Q E", "fly; Shift faster, Alt slower"),
    ("Shift on a slider", "fine adjustment"),
    ("Ctrl+click a slider", "type a value"),
    ("Double-click a slider", "reset it"),
    ("Right-click", "menu of a layer or snapshot"),
    ("Esc, right-click", "cancel a drag"),
)

_MAC = (("Cmd", "does what Ctrl does here; shortcuts take both"),)

_ROW, _BETWEEN = 1.24, 0.7  # in sizes of the small text: from row to row, and above a heading
COLUMN_PX, _MARGIN_PX = 322.0, 14.0  # at 1×
_MOST_COLUMNS = 3


@dataclass(frozen=True)
class Topic:
    """A heading, and under it what does what."""

    name: str
    rows: tuple[tuple[str, str], ...]

    @property
    def height(self) -> float:
        """With its heading, in rows."""
        return len(self.rows) + 1 + _BETWEEN / _ROW


def topics() -> tuple[Topic, ...]:
    """Everything that can be done, each once."""
    mouse = Topic("Mouse", MOUSE_HELP + (_MAC if sys.platform == "darwin" else ()))
    return mouse, *(
        Topic(name, tuple((key.listed or key.chord, key.help) for key in keys if key.help))
        for name, keys in TOPICS.items()
    )


def columns(shown: Sequence[Topic], count: int) -> list[list[Topic]]:
    """The topics in their order in at most `count` columns, the longest as short as it can be."""
    spans = ((i, j) for i in range(len(shown)) for j in range(i + 1, len(shown) + 1))
    heights = {sum(topic.height for topic in shown[i:j]) for i, j in spans}
    return next(found for height in sorted(heights) if len(found := _pack(shown, height)) <= count)


def draw(room: imgui.ImVec2, ui: UiContext) -> None:
    """The list in the middle of a `room` at the upper left; it scrolls where it is longer than that."""
    margin, wide = _MARGIN_PX * ui.scale, COLUMN_PX * ui.scale
    count = max(1, min(_MOST_COLUMNS, int((room.x - 2 * margin) / wide)))
    found = columns(topics(), count)
    needed = max(sum(topic.height for topic in column) for column in found) * _ROW * SMALL_PX * ui.scale
    size = imgui.ImVec2(min(len(found) * wide + 2 * margin, room.x), min(needed + 2 * margin, room.y))
    imgui.set_next_window_pos(imgui.ImVec2((room.x - size.x) / 2, (room.y - size.y) / 2))
    imgui.set_next_window_size(size)
    imgui.push_style_color(imgui.Col_.window_bg, imgui.ImVec4(*PALETTE.scrim[:3], 0.97))
    imgui.push_style_var(imgui.StyleVar_.window_rounding, 6.0 * ui.scale)
    imgui.push_style_var(imgui.StyleVar_.window_padding, imgui.ImVec2(margin, margin))
    imgui.push_style_var(imgui.StyleVar_.item_spacing, imgui.ImVec2(8.0 * ui.scale, 0.0))
    imgui.begin("bindings", None, _OVER_ALL)
    imgui.internal.bring_window_to_display_front(imgui.internal.get_current_window())
    left, top = imgui.get_cursor_pos_x(), imgui.get_cursor_pos_y()
    for i, column in enumerate(found):
        _column(column, left + i * wide, top, ui)
    imgui.end()
    imgui.pop_style_var(3)
    imgui.pop_style_color()


def _column(shown: Sequence[Topic], left: float, top: float, ui: UiContext) -> None:
    step = SMALL_PX * ui.scale
    imgui.push_font(None, SMALL_PX)
    wide = max(imgui.calc_text_size(chord).x for topic in shown for chord, _ in topic.rows) + 14.0 * ui.scale
    y = top - _BETWEEN * step
    for topic in shown:
        y += _BETWEEN * step
        imgui.set_cursor_pos(imgui.ImVec2(left, y))
        _heading(topic.name, ui)
        for chord, does in topic.rows:
            y += _ROW * step
            imgui.set_cursor_pos(imgui.ImVec2(left, y))
            imgui.text(chord)
            imgui.set_cursor_pos(imgui.ImVec2(left + wide, y))
            imgui.text_disabled(does)
        y += _ROW * step
    imgui.pop_font()


def _heading(name: str, ui: UiContext) -> None:
    imgui.push_font(ui.fonts.bold, SMALL_PX)
    imgui.text_colored(imgui.ImVec4(*PALETTE.accent), name)
    imgui.pop_font()


def _pack(shown: Sequence[Topic], height: float) -> list[list[Topic]]:
    """Columns of at most this height, filled one after the other; too long a topic stands alone."""
    found: list[list[Topic]] = []
    for topic in shown:
        if found and sum(t.height for t in (*found[-1], topic)) <= height:
            found[-1].append(topic)
        else:
            found.append([topic])
    return found


_OVER_ALL = (
    imgui.WindowFlags_.no_title_bar.value
    | imgui.WindowFlags_.no_resize.value
    | imgui.WindowFlags_.no_collapse.value
    | imgui.WindowFlags_.no_saved_settings.value
    | imgui.WindowFlags_.no_focus_on_appearing.value
    | imgui.WindowFlags_.no_nav.value
    | imgui.WindowFlags_.no_move.value
)
