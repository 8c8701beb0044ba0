"""Undo and redo: one entry per gesture, of what is edited and of snapshots, never of where one looks from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from .selection import SelectionState
from .view_state import Blend, LayerGroup, LayerState, SnapshotPair, Timeline, ViewState

LONGEST = 1000  # entries; each is a few hundred bytes, with a selection some kilobytes


@dataclass(frozen=True)
class Edit:
    """The part of the state that undo brings back."""

    layers: tuple[LayerState, ...]
    blend: Blend
    overshoot: bool = False
    timeline: Timeline = Timeline()
    selection: SelectionState = SelectionState()
    groups: tuple[LayerGroup, ...] = ()
    pair: SnapshotPair = SnapshotPair()


@dataclass(frozen=True)
class HistoryEntry:
    """What one entry brings back.

    Args:
        edit: the part of the state
        snapshots: those there were, see snapshots.py, which is built on this module
    """

    edit: Edit
    snapshots: tuple[Any, ...] = ()


@dataclass(frozen=True)
class History:
    """Entries before and after the present one."""

    present: HistoryEntry
    past: tuple[HistoryEntry, ...] = ()
    future: tuple[HistoryEntry, ...] = ()


def edit_of(state: ViewState) -> Edit:
    return Edit(
        state.layers,
        state.blend,
        state.overshoot,
        state.timeline,
        state.selection,
        state.groups,
        state.pair,
    )


def begin(state: ViewState, snapshots: tuple[Any, ...] = ()) -> History:
    """A history whose present is `state` with these snapshots, and that has nothing to undo."""
    return History(HistoryEntry(edit_of(state), snapshots))


def record(history: History, state: ViewState, snapshots: tuple[Any, ...] = ()) -> History:
    """Call whenever no gesture is under way: what a press, move and release changed becomes one entry.

    A gesture that ends where it began leaves no entry.
    """
    step = HistoryEntry(edit_of(state), snapshots)
    if step == history.present:
        return history
    return History(step, (*history.past, history.present)[-LONGEST:])


def merge(history: History) -> History:
    """What the last entry brings back is taken out: the last two changes are one."""
    return replace(history, past=history.past[:-1])


def follow_playhead(history: History, before: ViewState, after: ViewState) -> History:
    """The playhead has moved strengths: no entry, as nobody edited them; gestures under way stay such."""
    if after.layers == before.layers:
        return history
    was = {layer.gdf: layer.strength for layer in before.layers}
    went = {layer.gdf: layer.strength for layer in after.layers if layer.strength != was.get(layer.gdf)}
    edit = history.present.edit
    layers = tuple(replace(layer, strength=went.get(layer.gdf, layer.strength)) for layer in edit.layers)
    return replace(history, present=replace(history.present, edit=replace(edit, layers=layers)))


def undo(history: History) -> History:
    """One entry back; unchanged where there is none."""
    if not history.past:
        return history
    *past, back = history.past
    return History(back, tuple(past), (history.present, *history.future))


def redo(history: History) -> History:
    """One entry forward; unchanged where there is none."""
    if not history.future:
        return history
    ahead, *future = history.future
    return History(ahead, (*history.past, history.present), tuple(future))


def apply_edit(state: ViewState, edit: Edit) -> ViewState:
    """`state` edited as in `edit`, seen from where it is."""
    return replace(
        state,
        layers=edit.layers,
        blend=edit.blend,
        overshoot=edit.overshoot,
        timeline=edit.timeline,
        selection=edit.selection,
        groups=edit.groups,
        pair=edit.pair,
    )
