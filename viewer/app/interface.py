"""What is drawn around and over the picture in a frame, and what becomes of the workspace by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from imgui_bundle import imgui

from viewer.panel import brush, panel, timeline_bar
from viewer.pictures.compare_labels import Labels
from viewer.select import outline
from viewer.state import history, workspace
from viewer.state.actions import GLIDES, perform
from viewer.state.workspace import Workspace
from viewer.ui import axis_gizmo, overlay
from viewer.ui.pointer import PointerContext

from . import bindings, compare_overlay, dialogs, mouse
from .mouse import MouseTool
from .studio import up_strip
from .studio.up_strip import UpStrip


def panels(
    work: Workspace,
    pointer: PointerContext,
    textures: Sequence[int],
    preview: tuple[str, bool],
    recent: Sequence[Path],
    reveal: bool,
) -> Workspace:
    """The panel and, where it is shown, the timeline. Arguments as of `panel.draw`."""
    actions: list[str] = []
    work = panel.draw(work, pointer.facts, textures, preview, recent, reveal, pointer.ui, actions)
    work = perform_actions(work, actions, pointer)
    if work.player.shown:
        asked = timeline_bar.draw(work.view.timeline, work.player, pointer.area, pointer.ui)
        work = perform_actions(work, asked, pointer)
    return work


def over_picture(
    work: Workspace,
    pointer: PointerContext,
    held: MouseTool,
    said: Labels,
    figures: Sequence[tuple[str, str]],
    original: bool,
    strip: UpStrip | None = None,
) -> Workspace:
    """The brush, the comparison, timings, bindings and the message, which leaves when its time is over.

    Args:
        held: what the mouse holds
        said: over the comparison on screen
        figures: of the table of timings
        original: the key that shows it is held
        strip: asks which way is up
    """
    area, ui, view = pointer.area, pointer.ui, work.view
    io = imgui.get_io()
    on_axes = not io.want_capture_mouse and bool(axis_gizmo.under(view, area, ui))
    if view.brush.active and not (io.want_capture_mouse or io.key_alt or on_axes):
        brush.ring(view, ui)
    axis_gizmo.draw(view, area, on_axes or held.drag == axis_gizmo.DRAG, ui)
    outline.draw(held.gesture, view, ui, pointer.left)
    if original:
        overlay.banner("Original", area, ui)
    else:
        compare_overlay.draw(view, said, area, mouse.grips_divider(held, view, pointer), ui)
    if view.overlay:
        overlay.table(figures, ui)
    free = imgui.get_io().display_size
    bar = timeline_bar.height(work.player, area, ui) if view.panel else 0.0
    above = replace(area, height=area.height - bar)
    if strip is not None and work.dialog is None:
        work = replace(work, requests=(*work.requests, *up_strip.draw(strip, above, ui)))
        above = replace(above, height=above.height - up_strip.height(strip, area, ui))
    if (line := work.message) is not None:
        clicked, top = overlay.message(line, above, ui)
        free = imgui.ImVec2(free.x, top)
        if clicked == "copy":
            imgui.set_clipboard_text(line.details)
            work = workspace.with_message(work, "Copied; paste it into a report of what you did", pointer.now)
        elif clicked == "close" or pointer.now >= line.until:
            work = replace(work, message=None)
    if work.help:
        bindings.draw(free, ui)
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
