"""What is drawn around and over the picture in a frame, and what becomes of the workspace by it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from imgui_bundle import imgui

from viewer.panel import panel, timeline_bar, tools
from viewer.pictures.compare import Labels
from viewer.state import history, workspace
from viewer.state.actions import GLIDES, perform
from viewer.state.facts import obstacle
from viewer.state.workspace import PreviewState, Workspace
from viewer.ui import overlay
from viewer.ui.context import FIXED, PALETTE, SMALL_PX, UNFOCUSED, UiContext
from viewer.ui.keys import TOPICS
from viewer.ui.pointer import PointerContext

from . import dialogs, mouse, select_tool
from .mouse import MouseTool
from .studio import pages
from .studio.pages import UpStrip

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


def columns(topics: Sequence[Topic], count: int) -> list[list[Topic]]:
    """The topics in their order in at most `count` columns, the longest as short as it can be."""
    spans = ((i, j) for i in range(len(topics)) for j in range(i + 1, len(topics) + 1))
    heights = {sum(topic.height for topic in topics[i:j]) for i, j in spans}
    return next(packed for height in sorted(heights) if len(packed := _pack(topics, height)) <= count)


def draw_bindings(room: imgui.ImVec2, ui: UiContext) -> None:
    """The list in the middle of a `room` at the upper left; it scrolls where it is longer than that."""
    margin, wide = _MARGIN_PX * ui.scale, COLUMN_PX * ui.scale
    count = max(1, min(_MOST_COLUMNS, int((room.x - 2 * margin) / wide)))
    packed = columns(topics(), count)
    needed = max(sum(topic.height for topic in column) for column in packed) * _ROW * SMALL_PX * ui.scale
    size = imgui.ImVec2(min(len(packed) * wide + 2 * margin, room.x), min(needed + 2 * margin, room.y))
    imgui.set_next_window_pos(imgui.ImVec2((room.x - size.x) / 2, (room.y - size.y) / 2))
    imgui.set_next_window_size(size)
    imgui.push_style_color(imgui.Col_.window_bg, imgui.ImVec4(*PALETTE.scrim[:3], 0.97))
    imgui.push_style_var(imgui.StyleVar_.window_rounding, 6.0 * ui.scale)
    imgui.push_style_var(imgui.StyleVar_.window_padding, imgui.ImVec2(margin, margin))
    imgui.push_style_var(imgui.StyleVar_.item_spacing, imgui.ImVec2(8.0 * ui.scale, 0.0))
    imgui.begin("bindings", None, FIXED & ~imgui.WindowFlags_.no_scrollbar.value | UNFOCUSED)
    imgui.internal.bring_window_to_display_front(imgui.internal.get_current_window())
    left, top = imgui.get_cursor_pos_x(), imgui.get_cursor_pos_y()
    for i, column in enumerate(packed):
        _column(column, left + i * wide, top, ui)
    imgui.end()
    imgui.pop_style_var(3)
    imgui.pop_style_color()


def _column(topics: Sequence[Topic], left: float, top: float, ui: UiContext) -> None:
    step = SMALL_PX * ui.scale
    imgui.push_font(None, SMALL_PX)
    wide = max(imgui.calc_text_size(chord).x for topic in topics for chord, _ in topic.rows) + 14.0 * ui.scale
    y = top - _BETWEEN * step
    for topic in topics:
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
    imgui.text(name)
    imgui.pop_font()


def _pack(topics: Sequence[Topic], height: float) -> list[list[Topic]]:
    """Columns of at most this height, filled one after the other; too long a topic stands alone."""
    packed: list[list[Topic]] = []
    for topic in topics:
        if packed and sum(t.height for t in (*packed[-1], topic)) <= height:
            packed[-1].append(topic)
        else:
            packed.append([topic])
    return packed


def panels(
    work: Workspace,
    pointer: PointerContext,
    pictures: panel.Pictures,
    preview: PreviewState,
    recent: Sequence[Path],
    reveal: bool,
    compared: tuple[Labels, bool],
) -> Workspace:
    """The panel, the tools and, where it is shown, the timeline. Arguments as of `panel.draw`.

    Args:
        compared: the words of the comparison on screen, and whether the original is shown
    """
    actions: list[str] = []
    area, ui = pointer.area, pointer.ui
    work = panel.draw(work, pointer.facts, pictures, preview, recent, reveal, ui, actions)
    work = perform_actions(work, actions, pointer)
    if work.player.shown:
        requested = timeline_bar.draw(work.view.timeline, work.player, work.view.safe_frame, area, ui)
        work = perform_actions(work, requested, pointer)
    actions = []
    above = replace(area, height=area.height - timeline_bar.height(work.player, area, ui))
    tools.draw_toolbar(work.view, above, ui, actions)
    work, foot = tools.draw_options(work, above, ui, actions)
    work = replace(work, view=tools.draw_view(work.view, above, foot, ui, actions))
    work, asked = draw_pill(work, pointer, compared, foot)
    return perform_actions(work, [*actions, *asked], pointer)


def draw_pill(
    work: Workspace, pointer: PointerContext, compared: tuple[Labels, bool], foot: float
) -> tuple[Workspace, list[str]]:
    """What is compared with what, where there is anything to compare; what was asked for.

    Args:
        compared: as of `panels`
        foot: of what lies above it, window pixels
    """
    words, original = compared
    if not (work.view.layers or original or work.view.compare.mode != "off"):
        return work, []
    why = {"recorded": obstacle(pointer.facts.recordings)}
    why["snapshots"] = "" if work.snapshots else "There is no snapshot"
    scale, wide = pointer.ui.scale, pointer.area.width
    free = wide - (0.0 if foot else tools.view_width(work.view, pointer.area, pointer.ui))
    middle = min((wide + tools.TOOLBAR_PX * scale) / 2, free - 85.0 * scale)  # half of what it mostly takes
    place = imgui.ImVec2(middle, foot + tools.EDGE_PX * scale)
    work, asked = tools.draw_comparison(work, words, why, original, place, pointer.ui)
    return work, [asked] * bool(asked)


def over_picture(
    work: Workspace,
    pointer: PointerContext,
    held: MouseTool,
    labels: Labels,
    figures: Sequence[tuple[str, str]],
    original: bool,
    strip: UpStrip | None = None,
) -> Workspace:
    """The brush, the comparison, timings, bindings and the message, which leaves when its time is over.

    Args:
        held: what the mouse holds
        labels: over the comparison on screen
        figures: of the table of timings
        original: the key that shows it is held
        strip: asks which way is up
    """
    area, ui, view = pointer.area, pointer.ui, work.view
    io = imgui.get_io()
    on_axes = not io.want_capture_mouse and bool(overlay.axis_under(view, area, ui))
    if view.brush.active and not (io.want_capture_mouse or io.key_alt or on_axes):
        tools.draw_ring(view, ui)
    overlay.draw_axes(view, area, on_axes or held.drag == overlay.AXES_DRAG, ui)
    select_tool.draw_strokes(held.strokes, work, pointer)
    select_tool.draw_gesture(held.gesture, view, ui, pointer.left)
    if not original:
        mouse.draw_comparison(view, area, mouse.grips_divider(held, view, pointer), ui)
    if not view.panel and (original or view.compare.mode != "off"):
        work = draw_pill(work, pointer, (labels, original), 0.0)[0]
    if view.overlay:
        overlay.table(figures, ui)
    free = imgui.get_io().display_size
    bar = timeline_bar.height(work.player, area, ui) if view.panel else 0.0
    above = replace(area, height=area.height - bar)
    if strip is not None and work.dialog is None:
        work = replace(work, requests=(*work.requests, *pages.draw_up_strip(strip, above, ui)))
        above = replace(above, height=above.height - pages.up_strip_height(strip, area, ui))
    if (line := work.message) is not None:
        clicked, top = overlay.message(line, above, ui)
        free = imgui.ImVec2(free.x, top)
        if clicked == "copy":
            imgui.set_clipboard_text(line.details)
            work = workspace.with_message(work, "Copied; paste it into a report of what you did", pointer.now)
        elif clicked or pointer.now >= line.until:
            work = replace(work, message=None)
            work = perform_actions(work, [line.button[1]] * (clicked == "do"), pointer)
    if work.help:
        draw_bindings(free, ui)
    return work


def draw_dialog(
    work: Workspace, pointer: PointerContext, recent: Sequence[Path], pressed: Sequence[str]
) -> Workspace:
    """The question that is open, if one is.

    Args:
        recent: files opened before, the last one first
        pressed: chords that went down in this frame
    """
    if work.dialog is None:
        return work
    answer = dialogs.draw(work.dialog, recent, pressed, pointer.ui, pointer.area)
    return replace(work, dialog=answer.dialog, requests=(*work.requests, *answer.requests))


def perform_actions(work: Workspace, actions: Sequence[str], pointer: PointerContext) -> Workspace:
    """What keys and buttons ask for, see `perform`; an undo says what it took back."""
    for action in actions:
        before = work
        work = perform(work, action, pointer.facts, pointer.area.width / pointer.area.height)
        if action.partition(":")[0] in GLIDES:
            work = workspace.glide_from(work, before.view.camera)
        elif action in _UNDOES and work.past is not before.past:
            did, describe = _UNDOES[action]
            work = workspace.with_message(
                work, f"{did}: {describe(before.past)}", pointer.now, seconds=UNDO_S
            )
    return work


UNDO_S = 2.0
"""How long it is said what an undo took back."""
_UNDOES = {"undo": ("Undid", history.next_undo), "redo": ("Redid", history.next_redo)}
