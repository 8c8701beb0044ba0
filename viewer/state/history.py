"""Undo history with one entry per gesture.

An entry covers edits, snapshots and view settings such as background and comparison, but never the position
of the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from viewer.camera.view_camera import Vec3, ViewCamera, with_up

from .selection import SelectionState
from .view_state import (
    Blend,
    Comparison,
    LayerGroup,
    LayerState,
    PaintedPicture,
    SceneState,
    SnapshotPair,
    Timeline,
    ViewState,
)

LONGEST = 1000  # maximum number of entries; each takes a few hundred bytes, with a selection some kilobytes


@dataclass(frozen=True)
class Edit:
    """Edits, timeline and selection that an undo entry restores."""

    layers: tuple[LayerState, ...]
    blend: Blend
    overshoot: bool = False
    timeline: Timeline = Timeline()
    selection: SelectionState = SelectionState()
    groups: tuple[LayerGroup, ...] = ()
    pair: SnapshotPair = SnapshotPair()
    painted: tuple[PaintedPicture, ...] = ()
    scenes: tuple[SceneState, ...] = ()


@dataclass(frozen=True)
class ViewSettings:
    """View settings that an undo entry restores if the user has changed them."""

    up: Vec3 = ViewCamera.up
    fov_y: float = ViewCamera.fov_y
    background: tuple[float, float, float] = ViewState.background
    compare: Comparison = Comparison()
    grid: bool = False
    axes: bool = True
    safe_frame: str = ""
    mode: str = ViewState.mode
    unit: float = 1.0
    dynamic_resolution: str = ViewState.dynamic_resolution


@dataclass(frozen=True)
class HistoryEntry:
    """State that one entry restores."""

    edit: Edit
    look: ViewSettings = ViewSettings()  # as last set by the user
    snapshots: tuple[Any, ...] = ()  # `SliderSnapshot`s; untyped because snapshots.py imports this module


@dataclass(frozen=True)
class History:
    """Entries before and after the present one.

    `seen` holds the current view settings. It includes changes by a camera glide, the timeline or a file,
    which make no entry.
    """

    present: HistoryEntry
    past: tuple[HistoryEntry, ...] = ()
    future: tuple[HistoryEntry, ...] = ()
    seen: ViewSettings = ViewSettings()


def edit_of(state: ViewState) -> Edit:
    return Edit(**_edit_values(state))


def _edit_values(part: ViewState | Edit) -> dict[str, Any]:
    return {field.name: getattr(part, field.name) for field in fields(Edit)}


def look_of(state: ViewState) -> ViewSettings:
    return ViewSettings(
        state.camera.up, state.camera.fov_y, **{name: getattr(state, name) for name in _VIEW_LABELS}
    )


def begin(state: ViewState, snapshots: tuple[Any, ...] = ()) -> History:
    """Return a history with `state` and these snapshots as its present and no entries to undo."""
    look = look_of(state)
    return History(HistoryEntry(edit_of(state), look, snapshots), seen=look)


def record(history: History, state: ViewState, snapshots: tuple[Any, ...] = ()) -> History:
    """Record the changes of a finished gesture (press, move, release) as one entry.

    Call it whenever no gesture is in progress. A gesture that ends where it began makes no entry, and
    successive changes of the comparison share one entry.
    """
    seen = look_of(state)
    present = history.present
    step = HistoryEntry(edit_of(state), _take_changes(present.look, history.seen, seen), snapshots)
    if step == present:
        return history if seen == history.seen else replace(history, seen=seen)
    if history.past and _only_compares(history.past[-1], present) and _only_compares(present, step):
        *past, before = history.past  # switching comparisons back and forth adds no entries
        return History(step, tuple(past) if step == before else history.past, seen=seen)
    return History(step, (*history.past, present)[-LONGEST:], seen=seen)


def _only_compares(before: HistoryEntry, after: HistoryEntry) -> bool:
    """Return whether two entries differ in the comparison alone."""
    return before != after == replace(before, look=replace(before.look, compare=after.look.compare))


def merge(history: History) -> History:
    """Merge the last two changes into one by removing the latest past entry."""
    return replace(history, past=history.past[:-1])


def follow_playhead(history: History, before: ViewState, after: ViewState) -> History:
    """Update the present entry with strengths that the playhead moved.

    This adds no entry, and gestures in progress stay unrecorded.
    """
    if after.layers == before.layers:
        return history
    old_strengths = {layer.gdf: layer.strength for layer in before.layers}
    moved_strengths = {
        layer.gdf: layer.strength for layer in after.layers if layer.strength != old_strengths.get(layer.gdf)
    }
    edit = history.present.edit
    layers = tuple(
        replace(layer, strength=moved_strengths.get(layer.gdf, layer.strength)) for layer in edit.layers
    )
    return replace(history, present=replace(history.present, edit=replace(edit, layers=layers)))


def follow_look(history: History, before: ViewState, after: ViewState) -> History:
    """Update `seen` after an automatic change of view settings, without an entry.

    Changes by the user that are not recorded yet remain pending.
    """
    seen = _take_changes(history.seen, look_of(before), look_of(after))
    return history if seen == history.seen else replace(history, seen=seen)


def undo(history: History) -> History:
    """Go back one entry. Without an earlier entry the history is unchanged."""
    return go_to(history, len(history.past) - 1)


def redo(history: History) -> History:
    """Go forward one entry. Without a later entry the history is unchanged."""
    return go_to(history, len(history.past) + 1)


def entries(history: History) -> tuple[HistoryEntry, ...]:
    """Return all entries, oldest first."""
    return *history.past, history.present, *history.future


def go_to(history: History, index: int) -> History:
    """Make the entry at `index` of `entries` the present one. An invalid index changes nothing."""
    steps = entries(history)
    if index == len(history.past) or not 0 <= index < len(steps):
        return history
    look = _take_changes(history.seen, history.present.look, steps[index].look)
    return History(steps[index], steps[:index], steps[index + 1 :], look)


def _take_changes(look: ViewSettings, before: ViewSettings, after: ViewSettings) -> ViewSettings:
    """Return `look` with the settings that differ between `before` and `after`, taken from `after`."""
    names = [
        field.name
        for field in fields(ViewSettings)
        if getattr(before, field.name) != getattr(after, field.name)
    ]
    changes: dict[str, Any] = {name: getattr(after, name) for name in names}
    return replace(look, **changes) if changes else look


def apply_edit(state: ViewState, edit: Edit) -> ViewState:
    """Return `state` with the values of `edit`. The camera is unchanged."""
    return replace(state, **_edit_values(edit))


def apply_present(state: ViewState, history: History) -> ViewState:
    """Return `state` as in the present entry.

    The camera keeps its position and only rolls to a new up axis.
    """
    look = history.seen
    camera = state.camera
    if camera.up != look.up:
        camera = replace(with_up(camera, look.up), up=look.up)
    if camera.fov_y != look.fov_y:
        camera = replace(camera, fov_y=look.fov_y)
    settings: dict[str, Any] = {name: getattr(look, name) for name in _VIEW_LABELS}
    return replace(apply_edit(state, history.present.edit), camera=camera, **settings)


_LAYER_LABELS = {
    "name": "name",
    "strength": "strength",
    "gains": "gains",
    "paint": "paint",
    "enabled": "visibility",
    "solo": "solo",
    "locked": "lock",
    "group": "group",
    "blend": "blend rule",
}
_SELECTION_LABELS = {"regions": "regions", "hidden": "hidden splats", "members": "selection"}
_EDIT_LABELS = {
    "timeline": "timeline",
    "groups": "groups",
    "blend": "blend rule",
    "overshoot": "overshoot",
    "pair": "snapshot pair",
    "painted": "painting",
    "scenes": "scenes",
}
_VIEW_LABELS = {
    "background": "background",
    "compare": "comparison",
    "grid": "ground grid",
    "axes": "axes",
    "safe_frame": "safe frame",
    "mode": "view mode",
    "unit": "unit of length",
    "dynamic_resolution": "dynamic resolution",
}
"""Labels of the `ViewSettings` that are attributes of `ViewState`."""
_LOOK_LABELS = {"up": "up axis", "fov_y": "field of view", **_VIEW_LABELS}


def next_undo(history: History) -> str:
    """Return a short label of the change that undo reverts, or "" if there is none."""
    return describe_entry(history, len(history.past)) if history.past else ""


def next_redo(history: History) -> str:
    """Return a short label of the change that redo restores, or "" if there is none."""
    return describe_entry(history, len(history.past) + 1) if history.future else ""


def describe_entry(history: History, index: int) -> str:
    """Return a short label of the change that the entry at `index` of `entries` made."""
    steps = entries(history)
    return _describe_change(steps[index - 1], steps[index]) if index else "as opened"


def _describe_change(before: HistoryEntry, after: HistoryEntry) -> str:
    """Return a label of the most important difference."""
    old, new = ({layer.gdf: layer for layer in entry.edit.layers} for entry in (before, after))
    if old.keys() != new.keys():
        added = new.keys() - old.keys()
        removed = old.keys() - new.keys()
        names = [new[gdf].name for gdf in added] or [old[gdf].name for gdf in removed]
        verb = "add" if added else "delete"
        if added and removed:
            verb = "replace"
        return f"{verb} {_name_or_count(names)}"
    for attribute, word in _LAYER_LABELS.items():
        names = [new[gdf].name for gdf in new if getattr(old[gdf], attribute) != getattr(new[gdf], attribute)]
        if names:
            return f"{word} of {_name_or_count(names)}"
    if before.edit.layers != after.edit.layers:
        return "layer order"
    for words, old_part, new_part in (
        (_SELECTION_LABELS, before.edit.selection, after.edit.selection),
        (_EDIT_LABELS, before.edit, after.edit),
        (_LOOK_LABELS, before.look, after.look),
    ):
        for attribute, word in words.items():
            if getattr(old_part, attribute) != getattr(new_part, attribute):
                return word
    return "snapshots"


def _name_or_count(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{len(names)} layers"
