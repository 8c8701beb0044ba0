"""List of keys and mouse gestures: a title, a search field, and columns of topics."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

from imgui_bundle import imgui, imgui_ctx

from progdf.system.desktop import has_command_key
from viewer.state.commands import Action, Plain

from .context import FIXED, PALETTE, SMALL_PX, Icon, UiContext
from .keys import JOINED, TOPICS, Command, chords, is_changed
from .widgets import empty_line, hint, icon_button

MOUSE_HELP = (
    ("Left drag", "Orbit"),
    ("Alt+left drag", "Orbit, with a tool too"),
    ("Middle drag", "Orbit; Shift pans"),
    ("Ctrl+middle drag", "Dolly"),
    ("Right drag", "Pan; look around in fly"),
    ("Wheel", "Zoom"),
    ("Click", "Layer under the mouse"),
    ("Double-click", "Orbit pivot"),
    ("Axes", "Look from an end"),
    ("W A S D Q E", "Fly; Shift fast, Alt slow"),
    ("Slider", "Drag; Shift fine"),
    ("Ctrl+click it", "Type a value"),
    ("Double-click it", "Reset"),
    ("Right-click", "Menu; cancels a drag"),
    ("Letters", "Jump in an open list"),
    ("J in a grade", "Mark clipped colors"),
    ("Ctrl+↑ ↓ ← →", "Decal: scale, rotate"),
)

_MAC = (("Cmd", "Is Ctrl here; both work"),)

# in sizes of the small text: row pitch, and space above a heading
_ROW = 1.24
_BETWEEN = 0.7
# at 1×
COLUMN_PX = 248.0
MAX_COLUMNS = 4
_MARGIN_PX = 16.0
_HEAD_PX = 32.0  # height of the title with the search field
_SEARCH_PX = 240.0


@dataclass(frozen=True)
class Topic:
    """Heading with rows of keys and their effects."""

    name: str
    rows: tuple[tuple[str, str], ...]

    @property
    def height(self) -> float:
        """Height with the heading, in rows."""
        return len(self.rows) + 1 + _BETWEEN / _ROW


def topics() -> tuple[Topic, ...]:
    """Return all commands by topic, each once."""
    mouse = Topic("Mouse", MOUSE_HELP + (_MAC if has_command_key() else ()))
    return mouse, *(Topic(name, tuple(dict.fromkeys(_lines(commands)))) for name, commands in TOPICS.items())


def find_rows(query: str) -> tuple[Topic, ...]:
    """Return the topics with the rows whose topic, keys and text contain all words of the query."""
    words = query.casefold().split()
    found = list[Topic]()
    for topic in topics():
        rows = tuple(row for row in topic.rows if _contains(f"{topic.name} {' '.join(row)}", words))
        if rows:
            found.append(replace(topic, rows=rows))
    return tuple(found)


def _contains(text: str, words: Sequence[str]) -> bool:
    return all(word in text.casefold() for word in words)


def _lines(commands: Sequence[Command]) -> Iterator[tuple[str, str]]:
    """Yield the keys and text of each row. A key with Shift next to the same plain key is only named in the
    text."""
    is_joined = False  # the row before this one includes the command
    for command, following in zip_longest(commands, commands[1:]):
        keys = chords(command.id)
        joins = following is not None and following.row == JOINED
        changed = is_changed(command) or (joins and is_changed(following))
        if joins and not changed:
            keys += tuple(k for k in chords(following.id) if k.replace("Shift+", "") not in keys)
        if keys and not is_joined:
            plain = changed or command.row == JOINED
            listed, text = ("", "") if plain else (command.listed, command.row)
            yield listed or ", ".join(keys), text or command.name
        is_joined = joins and not changed


def columns(topics: Sequence[Topic], count: int) -> list[list[Topic]]:
    """Distribute the topics, in order, over at most `count` columns with the lowest possible height."""
    spans = ((i, j) for i in range(len(topics)) for j in range(i + 1, len(topics) + 1))
    heights = {sum(topic.height for topic in topics[i:j]) for i, j in spans}
    return next(packed for height in sorted(heights) if len(packed := _pack(topics, height)) <= count)


def draw(query: str, room: imgui.ImVec2, ui: UiContext) -> tuple[str, list[Action]]:
    """Draw the list of keys centered in `room`, which starts at the upper left.

    The keys of the commands stay active until the search field has the keyboard. The size does not depend on
    the query. A list that is too long scrolls below its title.

    Args:
        query: text of the search field
        room: width and height, window pixels

    Returns:
        The text of the search field; the requested actions.
    """
    margin = _MARGIN_PX * ui.scale
    head = _HEAD_PX * ui.scale
    wide = COLUMN_PX * ui.scale
    count = max(1, min(MAX_COLUMNS, int((room.x - 2 * margin) / wide)))
    packed = columns(topics(), count)
    tall = max(sum(topic.height for topic in column) for column in packed) * _ROW * SMALL_PX * ui.scale
    width = min(len(packed) * wide + 2 * margin, room.x)
    height = min(head + tall + 2 * margin, room.y)
    imgui.set_next_window_pos(((room.x - width) / 2, (room.y - height) / 2))
    imgui.set_next_window_size((width, height))
    imgui.push_style_color(imgui.Col_.window_bg, imgui.ImVec4(*PALETTE.scrim[:3], 0.97))
    imgui.push_style_var(imgui.StyleVar_.window_rounding, 6.0 * ui.scale)
    imgui.push_style_var(imgui.StyleVar_.window_padding, (margin, margin))
    imgui.push_style_var(imgui.StyleVar_.item_spacing, (8.0 * ui.scale, 0.0))
    imgui.begin("keys", None, FIXED | imgui.WindowFlags_.no_nav.value)
    imgui.internal.bring_window_to_display_front(imgui.internal.get_current_window())
    begin = imgui.get_cursor_pos()
    query, actions = _head(query, ui)
    imgui.set_cursor_pos((begin.x, begin.y + head))
    imgui.begin_child("rows", (0.0, 0.0), 0, imgui.WindowFlags_.no_nav.value)
    found = find_rows(query) if query.strip() else topics()
    if found:
        left = imgui.get_cursor_pos_x()
        top = imgui.get_cursor_pos_y()
        for i, column in enumerate(columns(found, count)):
            _column(column, left + i * wide, top, ui)
    else:
        empty_line("No matching key", ("palette",), ui, actions)
    imgui.end_child()
    imgui.end()
    imgui.pop_style_var(3)
    imgui.pop_style_color()
    return query, actions


def _head(query: str, ui: UiContext) -> tuple[str, list[Action]]:
    """Draw the title, the search field and the close button; return the query and the requested actions."""
    actions = list[Action]()
    gap = 8.0 * ui.scale
    side = imgui.get_frame_height()
    right = imgui.get_cursor_pos_x() + imgui.get_content_region_avail().x
    imgui.align_text_to_frame_padding()
    with imgui_ctx.push_font(ui.fonts.bold, 0.0):
        imgui.text("Keys and mouse")
    imgui.same_line(0.0, 2 * gap)
    field = min(_SEARCH_PX * ui.scale, right - side - gap - imgui.get_cursor_pos_x())
    imgui.same_line(right - side - gap - field)
    imgui.set_next_item_width(field)
    flags = imgui.InputTextFlags_.escape_clears_all.value | imgui.InputTextFlags_.auto_select_all.value
    query = str(imgui.input_text_with_hint("##search keys", "Search keys", query, flags)[1])
    imgui.same_line(0.0, gap)
    if icon_button("close", Icon.CLOSE, ui):
        actions.append(Plain("help"))
    hint("help", "Esc closes it")
    return query, actions


def _column(topics: Sequence[Topic], left: float, top: float, ui: UiContext) -> None:
    step = SMALL_PX * ui.scale
    with imgui_ctx.push_font(None, SMALL_PX):
        wide = (
            max(imgui.calc_text_size(chord).x for topic in topics for chord, _ in topic.rows)
            + 14.0 * ui.scale
        )
        y = top - _BETWEEN * step
        for topic in topics:
            y += _BETWEEN * step
            imgui.set_cursor_pos((left, y))
            with imgui_ctx.push_font(ui.fonts.bold, SMALL_PX):
                imgui.text(topic.name)
            for chord, does in topic.rows:
                y += _ROW * step
                imgui.set_cursor_pos((left, y))
                imgui.text(chord)
                imgui.set_cursor_pos((left + wide, y))
                imgui.text_disabled(does)
            y += _ROW * step


def _pack(topics: Sequence[Topic], height: float) -> list[list[Topic]]:
    """Fill columns of at most this height one after the other; a longer topic gets its own column."""
    packed: list[list[Topic]] = []
    for topic in topics:
        if packed and sum(t.height for t in (*packed[-1], topic)) <= height:
            packed[-1].append(topic)
        else:
            packed.append([topic])
    return packed
