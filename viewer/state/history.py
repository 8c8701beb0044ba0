"""Undo, redo and the list of both: one entry per gesture, of what is edited, of snapshots, and of what of the
view a person sets, such as background and comparison; never of where one looks from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from viewer.camera.view_camera import Vec3, ViewCamera, with_up

from .selection import SelectionState
from .view_state import Blend, Comparison, LayerGroup, LayerState, SnapshotPair, Timeline, ViewState

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
class ViewSettings:
    """How the scene is looked at, as a person sets it."""

    up: Vec3 = ViewCamera.up
    fov_y: float = ViewCamera.fov_y
    background: tuple[float, float, float] = ViewState.background
    compare: Comparison = Comparison()
    grid: bool = False
    axes: bool = True
    safe_frame: str = ""
    dynamic_resolution: str = ViewState.dynamic_resolution


@dataclass(frozen=True)
class HistoryEntry:
    """What one entry brings back."""

    edit: Edit  # the part of the state
    look: ViewSettings = ViewSettings()  # as a person set it last
    snapshots: tuple[Any, ...] = ()  # those there were, see snapshots.py, which is built on this module


@dataclass(frozen=True)
class History:
    """Entries before and after the present one; `seen`: the look of the state, also where the camera's way to
    another view, a film or a file has changed it, which is no entry."""

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
        state.camera.up, state.camera.fov_y, **{name: getattr(state, name) for name in _OF_VIEW}
    )


def begin(state: ViewState, snapshots: tuple[Any, ...] = ()) -> History:
    """A history whose present is `state` with these snapshots, and that has nothing to undo."""
    look = look_of(state)
    return History(HistoryEntry(edit_of(state), look, snapshots), seen=look)


def record(history: History, state: ViewState, snapshots: tuple[Any, ...] = ()) -> History:
    """Call whenever no gesture is under way: what a press, move and release changed becomes one entry.

    A gesture that ends where it began leaves no entry.
    """
    seen = look_of(state)
    present = history.present
    step = HistoryEntry(edit_of(state), _take_changes(present.look, history.seen, seen), snapshots)
    if step == present:
        return history if seen == history.seen else replace(history, seen=seen)
    if history.past and _only_compares(history.past[-1], present) and _only_compares(present, step):
        *past, before = history.past  # one looks at this and at that: no trail of it
        return History(step, tuple(past) if step == before else history.past, seen=seen)
    return History(step, (*history.past, present)[-LONGEST:], seen=seen)


def _only_compares(before: HistoryEntry, after: HistoryEntry) -> bool:
    """Whether nothing but the comparison is another one."""
    return before != after == replace(before, look=replace(before.look, compare=after.look.compare))


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


def follow_look(history: History, before: ViewState, after: ViewState) -> History:
    """What is seen has changed by itself: no entry; what a person has just set and is not recorded yet stays
    to be."""
    seen = _take_changes(history.seen, look_of(before), look_of(after))
    return history if seen == history.seen else replace(history, seen=seen)


def undo(history: History) -> History:
    """One entry back; unchanged where there is none."""
    return go_to(history, len(history.past) - 1)


def redo(history: History) -> History:
    """One entry forward; unchanged where there is none."""
    return go_to(history, len(history.past) + 1)


def entries(history: History) -> tuple[HistoryEntry, ...]:
    """All there are, the first one first."""
    return *history.past, history.present, *history.future


def go_to(history: History, index: int) -> History:
    """That of the `entries` is the present one; unchanged where there is no such, or it is already."""
    steps = entries(history)
    if index == len(history.past) or not 0 <= index < len(steps):
        return history
    look = _take_changes(history.seen, history.present.look, steps[index].look)
    return History(steps[index], steps[:index], steps[index + 1 :], look)


def _take_changes(look: ViewSettings, before: ViewSettings, after: ViewSettings) -> ViewSettings:
    """The look with what is different after than before."""
    names = [
        field.name
        for field in fields(ViewSettings)
        if getattr(before, field.name) != getattr(after, field.name)
    ]
    changes: dict[str, Any] = {name: getattr(after, name) for name in names}
    return replace(look, **changes) if changes else look


def apply_edit(state: ViewState, edit: Edit) -> ViewState:
    """`state` edited as in `edit`, seen from where it is."""
    return replace(state, **_edit_values(edit))


def apply_present(state: ViewState, history: History) -> ViewState:
    """`state` as the present entry has it, seen from where it is; another up axis only rolls it upright."""
    look = history.seen
    camera = state.camera
    if camera.up != look.up:
        camera = replace(with_up(camera, look.up), up=look.up)
    if camera.fov_y != look.fov_y:
        camera = replace(camera, fov_y=look.fov_y)
    looks: dict[str, Any] = {name: getattr(look, name) for name in _OF_VIEW}
    return replace(apply_edit(state, history.present.edit), camera=camera, **looks)


_OF_LAYERS = {
    "name": "name",
    "strength": "strength",
    "gains": "gains",
    "paint": "paint",
    "enabled": "visibility",
    "solo": "solo",
    "locked": "lock",
    "group": "group",
}
_OF_SELECTIONS = {"regions": "regions", "hidden": "hidden splats", "members": "selection"}
_OF_EDITS = {
    "timeline": "timeline",
    "groups": "groups",
    "blend": "blend rule",
    "overshoot": "overshoot",
    "pair": "snapshot pair",
}
_OF_VIEW = {
    "background": "background",
    "compare": "comparison",
    "grid": "ground grid",
    "axes": "axes",
    "safe_frame": "safe frame",
    "dynamic_resolution": "dynamic resolution",
}
"""Of `ViewSettings`, what stands in the view itself."""
_OF_LOOKS = {"up": "up axis", "fov_y": "field of view", **_OF_VIEW}


def next_undo(history: History) -> str:
    """What an undo takes back, in a few words; "" where there is nothing."""
    return describe_entry(history, len(history.past)) if history.past else ""


def next_redo(history: History) -> str:
    """What a redo brings back, in a few words; "" where there is nothing."""
    return describe_entry(history, len(history.past) + 1) if history.future else ""


def describe_entry(history: History, index: int) -> str:
    """What that of the `entries` changed, in a few words."""
    steps = entries(history)
    return _describe_change(steps[index - 1], steps[index]) if index else "as opened"


def _describe_change(before: HistoryEntry, after: HistoryEntry) -> str:
    """The first that is different, of what matters most."""
    old, new = ({layer.gdf: layer for layer in entry.edit.layers} for entry in (before, after))
    if old.keys() != new.keys():
        added = new.keys() - old.keys()
        removed = old.keys() - new.keys()
        names = [new[gdf].name for gdf in added] or [old[gdf].name for gdf in removed]
        done = "replace" if added and removed else "add" if added else "delete"
        return f"{done} {_one_or_many(names)}"
    for attribute, word in _OF_LAYERS.items():
        names = [new[gdf].name for gdf in new if getattr(old[gdf], attribute) != getattr(new[gdf], attribute)]
        if names:
            return f"{word} of {_one_or_many(names)}"
    if before.edit.layers != after.edit.layers:
        return "layer order"
    for words, one, other in (
        (_OF_SELECTIONS, before.edit.selection, after.edit.selection),
        (_OF_EDITS, before.edit, after.edit),
        (_OF_LOOKS, before.look, after.look),
    ):
        for attribute, word in words.items():
            if getattr(one, attribute) != getattr(other, attribute):
                return word
    return "snapshots"


def _one_or_many(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{len(names)} layers"
