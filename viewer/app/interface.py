"""What is drawn around and over the picture in a frame, and what becomes of the workspace by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from imgui_bundle import imgui

from viewer.panel import brush, panel, timeline_bar
from viewer.panel.snapshot_cards import SnapshotCard
from viewer.pictures.compare_labels import Labels
from viewer.state import workspace
from viewer.state.recordings import obstacle
from viewer.state.workspace import Workspace
from viewer.ui import overlay

from . import bindings, compare_overlay, dialogs
from . import mouse as hand
from .mouse import Hand, Sight


def panels(work: Workspace, sight: Sight, cards: tuple[SnapshotCard, ...], reveal: bool) -> Workspace:
    """The panel and, where it is shown, the timeline.

    Args:
        cards: of the snapshots
        reveal: scroll to the focused layer
    """
    facts, past = sight.facts, work.past
    shown = panel.PanelInput(
        workspace.UNSAVED * workspace.unsaved(work) + facts.title,
        facts.count,
        facts.rows,
        work.focus,
        len(past.past),
        len(past.future),
        reveal,
        work.dial,
        work.renaming,
        cards,
        obstacle(facts.recordings),
    )
    result = panel.draw(work.view, shown, sight.ui)
    work = replace(work, view=result.state, focus=result.focus, renaming=result.renaming)
    work = replace(work, overlap=result.overlap)
    work = _performed(work, result.actions, sight)
    if work.player.shown:
        work = _performed(
            work, timeline_bar.draw(work.view.timeline, work.player, sight.area, sight.ui), sight
        )
    return work


def over_picture(
    work: Workspace,
    sight: Sight,
    held: Hand,
    said: Labels,
    figures: Sequence[tuple[str, str]],
    original: bool,
) -> Workspace:
    """The brush, the comparison, timings, bindings and the message, which leaves when its time is over.

    Args:
        held: what the mouse holds
        said: over the comparison on screen
        figures: of the table of timings
        original: the key that shows it is held
    """
    area, ui, view = sight.area, sight.ui, work.view
    if view.brush.active and not imgui.get_io().want_capture_mouse:
        brush.ring(view, ui)
    if original:
        overlay.banner("Original", area, ui)
    else:
        compare_overlay.draw(view, said, area, hand.grips_divider(held, view, sight), ui)
    if view.overlay:
        overlay.table(figures, ui)
    closed, free = False, imgui.get_io().display_size
    if work.message is not None:
        bar = timeline_bar.height(work.player, area, ui) if view.panel else 0.0
        closed, top = overlay.message(work.message, replace(area, height=area.height - bar), ui)
        closed, free = closed or sight.now >= work.message.until, imgui.ImVec2(free.x, top)
    if work.help:
        bindings.draw(free, ui)
    return replace(work, message=None) if closed else work


def asked(work: Workspace, sight: Sight, recent: Sequence[Path], pressed: Sequence[str]) -> Workspace:
    """The question that is open, if one is.

    Args:
        recent: files opened before, the last one first
        pressed: chords that went down in this frame
    """
    if work.dialog is None:
        return work
    answer = dialogs.draw(work.dialog, recent, pressed, sight.ui, sight.area)
    return replace(work, dialog=answer.dialog, requests=(*work.requests, *answer.requests))


def _performed(work: Workspace, actions: Sequence[str], sight: Sight) -> Workspace:
    for action in actions:
        work = workspace.perform(work, action, sight.facts, sight.area.width / sight.area.height)
    return work
