"""Panels and overlays of one frame: each function draws a part and returns the new workspace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from imgui_bundle import imgui, imgui_ctx

from viewer.panel import dialogs, histogram, panel, timeline_bar, tools, view_settings
from viewer.panel.card import BLEND_TITLES
from viewer.pictures.compare import PHOTOGRAPH, Labels
from viewer.state import history, workspace
from viewer.state.actions import GLIDES, perform
from viewer.state.commands import Action, OnItem, Plain
from viewer.state.transient import Pull
from viewer.state.workspace import SceneFacts, Workspace
from viewer.ui import key_list, overlay, tour_card
from viewer.ui.context import PALETTE, PANEL_PADDING_PX, SMALL_PX, UiContext, u32
from viewer.ui.keys import COMMANDS, Command, Keys, shortcut
from viewer.ui.pointer import PointerContext
from viewer.ui.search import find_commands
from viewer.ui.widgets import elide, empty_line, group_digits, menu, search_field

from . import color_tool, decal, handles, measure, mouse, select_tool
from .inspect.readouts import Distributions
from .pull import tool as pull_tool
from .pull.marks import draw_marks


def texts_of(work: Workspace, facts: SceneFacts) -> str:
    """Return the names and texts of the window that the user chose, joined."""
    view = work.view
    transient = work.transient
    texts = [facts.title, work.session, work.search, work.query, work.form.name, work.form.sentence]
    texts += [layer.name for layer in (*view.layers, *transient.live)]
    texts += [group.name for group in view.groups]
    texts += [region.name for region in view.selection.regions]
    texts += [snapshot.name for snapshot in work.snapshots]
    texts += [job.name for job in work.jobs]
    texts += [file.name for file in transient.recent]
    texts += [f"{file.path.name}{file.title}" for file in transient.start_files]
    texts += [work.message.text] if work.message is not None else []
    texts += [work.dialog.text] if work.dialog is not None else []
    return "".join(texts)


def draw_lists(
    work: Workspace, pointer: PointerContext, offered: Sequence[str], pressed: Sequence[str]
) -> Workspace:
    """Draw the undo history and the command palette, if they are open.

    Args:
        offered: commands listed in the palette
        pressed: chords pressed in this frame
    """
    if work.history is not None:
        work, chosen = draw_history(work, pointer.ui)
        work = perform_actions(work, chosen, pointer)
    if work.palette is None:
        return work
    missing = range(len(work.view.layers) + 1, 10)  # numbers of layers in the table that do not exist
    numbered = [OnItem(name, i) for name in ("focus", "toggle") for i in missing]
    listed = [command for command in offered if COMMANDS[command].action not in numbered]
    work, requested = draw_palette(work, listed, pressed, pointer.ui, pointer.area)
    return perform_actions(work, [requested] if requested is not None else [], pointer)


PALETTE_PX = 460.0
ROWS = 12
"""Width of the command palette at 1×, in pixels, and its number of visible rows."""


def draw_palette(
    work: Workspace, offered: Sequence[str], pressed: Sequence[str], ui: UiContext, area: overlay.Area
) -> tuple[Workspace, Action | None]:
    """Draw a search field and below it the matching commands, the best match first.

    Returns:
        The workspace; the chosen action, None for none.
    """
    if work.palette == -1:
        imgui.open_popup("commands")
    wide = min(PALETTE_PX * ui.scale, area.width)
    row = imgui.get_frame_height()
    place = (area.width / 2, max(0.12 * area.height, 8.0 * ui.scale))
    imgui.set_next_window_pos(place, 0, (0.5, 0.0))
    imgui.set_next_window_size((wide, 0.0))
    requested: Action | None = None
    at = work.palette or 0
    with menu("commands", ui, imgui.WindowFlags_.no_nav.value) as is_open:
        if not is_open:
            return replace(work, palette=None), None
        query = search_field("Search all commands", work.query)
        found = find_commands(query, offered)
        moved = 0 if at == -1 else ("Down" in pressed) - ("Up" in pressed)
        fresh = at == -1 or query != work.query
        at = 0 if query != work.query else at + moved
        at = min(max(at, 0), max(len(found) - 1, 0))
        imgui.push_style_var(imgui.StyleVar_.item_spacing, (0.0, 0.0))
        imgui.begin_child("found", (0.0, row * min(ROWS, max(len(found), 1))))
        keys = list[Action]()
        if not found:
            empty_line("No matching command", ("help",), ui, keys)
        requested = next(iter(keys), None)
        for i, command in enumerate(found):
            if _command_row(command, i == at, ui):
                requested = command.action
            if i == at and (moved or fresh):
                imgui.set_scroll_here_y(0.5)
        imgui.end_child()
        imgui.pop_style_var()
        if work.palette != -1 and "Enter" in pressed and found:
            requested = found[at].action
        closes = requested is not None or (work.palette != -1 and "Escape" in pressed)
        if closes:
            imgui.close_current_popup()
    return replace(work, query=query, palette=None if closes else at), requested


def _command_row(command: Command, chosen: bool, ui: UiContext) -> bool:
    """Draw the command's name, description and key; return True if it was clicked."""
    x, y = imgui.get_cursor_screen_pos()
    wide = imgui.get_content_region_avail().x
    tall = imgui.get_frame_height()
    pressed = imgui.invisible_button(command.id, (wide, tall))
    canvas = imgui.get_window_draw_list()
    pad = 8.0 * ui.scale
    if chosen or imgui.is_item_hovered():
        ground = u32(PALETTE.accent if chosen else PALETTE.field)
        canvas.add_rect_filled((x, y), (x + wide, y + tall), ground, 4.0 * ui.scale)
    ink, dim = (u32(PALETTE.ink),) * 2 if chosen else (u32(PALETTE.text), u32(PALETTE.dim))
    top = round(y + imgui.get_style().frame_padding.y)
    key = shortcut(command.id)
    end = x + wide - pad - imgui.calc_text_size(key).x
    canvas.add_text((round(x + pad), top), ink, command.name)
    canvas.add_text((round(end), top), ink, key)
    x += 2 * pad + imgui.calc_text_size(command.name).x
    with imgui_ctx.push_font(None, SMALL_PX):
        canvas.add_text((round(x), top + ui.scale), dim, elide(command.help, end - x - pad))
    return bool(pressed)


def panels(
    work: Workspace,
    pointer: PointerContext,
    pictures: panel.Pictures,
    reveal: bool,
    compared: tuple[Labels, bool],
    distributions: Distributions,
) -> Workspace:
    """Draw the panel, the tools and, if open, the timeline. Further arguments as in `panel.draw`.

    Args:
        compared: labels of the comparison on screen, and whether the original is visible
        distributions: histograms of the scene
    """
    actions: list[Action] = []
    area = pointer.area
    ui = pointer.ui
    work = panel.draw(work, pointer.facts, pictures, reveal, ui, actions)
    work = perform_actions(work, actions, pointer)
    if work.player.shown:
        requested = timeline_bar.draw(work, area, ui)
        work = perform_actions(work, requested, pointer)
    actions = []
    above = replace(area, height=area.height - timeline_bar.height(work, area, ui))
    tools.draw_toolbar(work.view, above, ui, actions, _active_tool(work))
    work, foot = tools.draw_options(work, above, ui, actions, select_tool.next_step(work))
    work = replace(work, view=view_settings.draw_view(work.view, above, foot, ui, actions))
    if work.transient.histogram is not None:
        found = distributions.get(work.transient.histogram.property, pointer)
        work, closes = histogram.draw(work, found, above, ui)
        actions += [closes] if closes is not None else []
    work, asked = draw_pill(work, pointer, compared, foot)
    work = perform_actions(work, [*actions, *asked], pointer)
    return _draw_question(_open_settings(work), pointer)


def _open_settings(work: Workspace) -> Workspace:
    """Open the menu of the view settings if that was requested."""
    window = imgui.internal.find_window_by_name("view")
    if work.settings_opening and window is not None and window.active:
        imgui.open_popup(window.get_id("view settings"))
    return replace(work, settings_opening=False)


def _draw_question(work: Workspace, pointer: PointerContext) -> Workspace:
    """Draw the question, if there is one, below the axes, and below all bars of a narrow picture."""
    question = work.question
    if question is None:
        return work
    ui = pointer.ui
    area = pointer.area
    edge = tools.EDGE_PX * ui.scale
    is_narrow = area.width < tools.NARROW_PX * ui.scale
    bars: tuple[str, ...] = ("view", "view mode")
    if is_narrow:
        bars += ("options", "placing", "comparison", "comparison note")
    above = [imgui.internal.find_window_by_name(name) for name in bars]
    shown = [window for window in above if window is not None and window.was_active]
    top = max((window.pos.y + window.size.y for window in shown), default=0.0) + edge
    room = area.width - tools.LEFT_PX * ui.scale - edge
    answered, command = overlay.question(question, (area.width - edge, top), room, ui)
    if not answered:
        return work
    work = replace(work, question=None)
    return perform_actions(work, [] if command is None else [command], pointer)


def _active_tool(work: Workspace) -> str:
    """Return the command of the active tool that is no part of the view; "" for none."""
    if isinstance(work.transient.gizmo, Pull):
        return "pull"
    return "measure" if work.transient.measure is not None else ""


def draw_pill(
    work: Workspace, pointer: PointerContext, compared: tuple[Labels, bool], foot: float
) -> tuple[Workspace, list[Action]]:
    """Draw the comparison bar, if there is anything to compare and nothing else has a bar there.

    Args:
        compared: as in `panels`
        foot: lower edge of the bar above, window pixels

    Returns:
        The workspace; the requested actions.
    """
    words, original = compared
    compare = work.view.compare
    is_useful = work.shows_edit or original or compare.mode != "off" or compare.against == PHOTOGRAPH
    if work.transient.has_bar or not is_useful:
        return work, []
    scale = pointer.ui.scale
    wide = pointer.area.width
    free = wide - (0.0 if foot else tools.view_width(work.view, pointer.area, pointer.ui))
    middle = min((wide + tools.TOOLBAR_PX * scale) / 2, free - 85.0 * scale)  # half of its usual width
    place = (middle, foot + tools.EDGE_PX * scale)
    room = 2.0 * min(middle - tools.LEFT_PX * scale, free - middle)
    work, requested = tools.draw_comparison(work, words, original, place, room, pointer.ui)
    return work, [requested] if requested is not None else []


def over_picture(
    work: Workspace,
    pointer: PointerContext,
    labels: Labels,
    original: bool,
) -> Workspace:
    """Draw the brush, the comparison, the keys and the message, which disappears after its time.

    Args:
        labels: labels of the comparison on screen
        original: the original is visible
    """
    area = pointer.area
    ui = pointer.ui
    view = work.view
    io = imgui.get_io()
    on_axes = not io.want_capture_mouse and bool(overlay.axis_under(view, area, ui))
    if view.brush.active and not (io.want_capture_mouse or io.key_alt or on_axes):
        tools.draw_ring(view, ui)
    if view.color_brush.tool and not (io.want_capture_mouse or on_axes):
        color_tool.draw_tip(work, pointer)
    overlay.draw_axes(view, area, on_axes or work.transient.tool.drag == overlay.AXES_DRAG, ui)
    if isinstance(work.transient.gizmo, Pull) and not original:
        draw_marks(work.transient.gizmo, pointer)
    measure.draw(work, pointer)
    select_tool.draw_strokes(work, pointer)
    select_tool.draw_gesture(work.transient.tool.gesture, view, ui, pointer.left)
    at = work.transient.pointer.at
    if at is not None:
        overlay.draw_cross(at, ui)
    if not original:
        mouse.draw_comparison(view, area, mouse.grips_divider(work, pointer), ui)
    if not view.panel and (original or view.compare.mode != "off"):
        work = draw_pill(work, pointer, (labels, original), 0.0)[0]
    free = imgui.get_io().display_size
    bar = timeline_bar.height(work, area, ui) if view.panel else 0.0
    above = replace(area, height=area.height - bar)
    if (line := work.message) is not None:
        clicked, top = overlay.message(line, above, tools.LEFT_PX * ui.scale if view.panel else 0.0, ui)
        free = imgui.ImVec2(free.x, top)
        if clicked == "copy":
            imgui.set_clipboard_text(line.details)
            work = workspace.with_message(work, "Copied. Paste it into a bug report.", pointer.now)
        elif clicked or pointer.now >= line.until:
            work = replace(work, message=None)
            if clicked == "do" and line.button is not None:
                work = perform_actions(work, [line.button[1]], pointer)
    if work.transient.tour is not None and view.panel:
        bottom = min(free.y, above.height)
        work, requested = tour_card.draw(work, area.width, bottom, ui)
        work = perform_actions(work, [requested] if requested is not None else [], pointer)
    if work.help:
        query, pressed = key_list.draw(work.help_query, free, ui)
        work = perform_actions(replace(work, help_query=query), pressed, pointer)
    return work


def take_keys(work: Workspace, pointer: PointerContext, keys: Keys) -> tuple[Workspace, Keys]:
    """Pass the keys to the part in hand: handles, a decal or a pull; return the unused keys."""
    work, keys = handles.take_keys(work, pointer, keys)
    work, keys = decal.take_keys(work, keys)
    return pull_tool.take_keys(work, pointer, keys)


def draw_dialog(work: Workspace, pointer: PointerContext, pressed: Sequence[str]) -> Workspace:
    """Draw the open dialog, if any; `pressed` holds the chords pressed in this frame."""
    if work.dialog is None:
        return work
    answer = dialogs.draw(work.dialog, pressed, pointer.ui, pointer.area)
    return replace(work, dialog=answer.dialog, requests=(*work.requests, *answer.requests))


def perform_actions(work: Workspace, actions: Sequence[Action], pointer: PointerContext) -> Workspace:
    """Perform the actions of keys and buttons, see `perform`. An undo shows the name of the undone change."""
    for action in actions:
        before = work
        name = action.name
        work = perform(work, action, pointer.facts, pointer.area.width / pointer.area.height)
        if name == "select_refine":
            work = _ask_if_doubled(before, work, pointer)
        elif name in GLIDES and not work.layout.reduced_motion:
            work = workspace.glide_from(work, before.view.camera)
        elif name == "reduced_motion":
            text = f"Reduced motion is {'on' if work.layout.reduced_motion else 'off'}"
            work = workspace.with_message(work, text, pointer.now)
        elif name == "blend":
            work = workspace.with_message(work, _describe_blend(work), pointer.now, seconds=UNDO_S)
        elif name == "compare_snapshots" and not work.snapshots:
            text = f"There is no snapshot to compare; {shortcut('snapshot')} adds one"
            work = workspace.with_message(work, text, pointer.now)
        elif name in _UNDOES and work.past is not before.past:
            did, describe = _UNDOES[name]
            work = workspace.with_message(
                work, f"{did}: {describe(before.past)}", pointer.now, seconds=UNDO_S
            )
        elif name == "go_to":
            entry = history.describe_entry(work.past, len(work.past.past))
            work = workspace.with_message(work, f"Back to: {entry}", pointer.now, seconds=UNDO_S)
    return work


def _describe_blend(work: Workspace) -> str:
    """Return the blend rule of the focused layer, or else of the stack, as a message."""
    if work.focus is None:
        return f"Blend of all layers: {BLEND_TITLES[work.view.blend]}"
    layer = work.view.layers[work.focus]
    return f"Blend: {BLEND_TITLES[layer.blend or work.view.blend]} ({layer.name})"


MAX_REFINE_GROWTH = 2.0
"""Largest factor by which Refine enlarges a selection without asking."""


def _ask_if_doubled(before: Workspace, work: Workspace, pointer: PointerContext) -> Workspace:
    """Return the workspace after Refine, or the one before with a question if the selection doubled."""
    count = before.view.selection.count
    refined = work.view.selection.count
    if refined <= MAX_REFINE_GROWTH * count:
        return work
    text = f"Refine would enlarge the selection from {group_digits(count)} to {group_digits(refined)} splats"
    return workspace.with_question(before, text, [("Enlarge", Plain("refine_anyway"))])


UNDO_S = 2.0
"""Seconds for which the message of an undo stays."""
_UNDOES = {"undo": ("Undid", history.next_undo), "redo": ("Redid", history.next_redo)}
_HISTORY_PX = 280.0
_FLAT = imgui.ChildFlags_.nav_flattened.value


def draw_history(work: Workspace, ui: UiContext) -> tuple[Workspace, list[Action]]:
    """Draw the undo history above the panel's undo buttons, the latest change at the bottom.

    Returns:
        The workspace; the chosen actions.
    """
    if work.history:
        imgui.open_popup("history")
    display = imgui.get_io().display_size
    row = imgui.get_text_line_height_with_spacing()
    requests = list[Action]()
    at = (display.x - PANEL_PADDING_PX[0] * ui.scale, display.y - 40.0 * ui.scale)
    imgui.set_next_window_pos(at, 0, (1.0, 1.0))
    with menu("history", ui) as is_open:
        count = len(history.entries(work.past))
        now = len(work.past.past)
        wide = min(_HISTORY_PX * ui.scale, display.x)
        if is_open and imgui.begin_child("entries", (wide, row * min(count, ROWS)), _FLAT):
            if work.history:
                imgui.set_scroll_y(row * max(now - ROWS // 2, 0))
            clipper = imgui.ListClipper()
            clipper.begin(count, row)
            clipper.include_item_by_index(now)
            while clipper.step():
                for i in range(clipper.display_start, clipper.display_end):
                    if _history_row(work.past, i, ui):
                        requests.append(OnItem("go_to", i))
        if is_open:
            imgui.end_child()
    return replace(work, history=False if is_open else None), requests


def _history_row(past: history.History, index: int, ui: UiContext) -> bool:
    now = len(past.past)
    keep = imgui.SelectableFlags_.no_auto_close_popups.value
    name = history.describe_entry(past, index)
    imgui.push_style_color(imgui.Col_.text, PALETTE.faint if index > now else PALETTE.text)
    line = elide(f"{name[:1].upper()}{name[1:]}", 0.9 * _HISTORY_PX * ui.scale)
    pressed = imgui.selectable(f"{line}##{index}", index == now, keep)[0]
    imgui.pop_style_color()
    if index == now and imgui.is_window_appearing():
        imgui.set_item_default_focus()
    return bool(pressed)
