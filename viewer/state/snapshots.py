"""Kept states of the sliders: what was edited and from where one looked; the original is always the first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from viewer.camera.view_camera import ViewCamera

from . import history
from .layers import LONGEST_NAME
from .selection import SelectionState
from .view_state import SnapshotPair, Timeline, ViewState

MAX_SNAPSHOTS = 200
ORIGINAL = "original"
"""The name of the first."""


@dataclass(frozen=True)
class SliderSnapshot:
    """One kept state."""

    name: str  # under its picture
    edit: history.Edit  # what going back to it restores, as one undo entry
    camera: ViewCamera = ViewCamera()  # where its small picture is taken from


@dataclass(frozen=True)
class SnapshotSides:
    """Two snapshots that are compared: what each shows, seen from where one looks, and their names."""

    left: ViewState
    right: ViewState
    names: tuple[str, str]


def take(snapshots: Sequence[SliderSnapshot], view: ViewState) -> tuple[SliderSnapshot, ...]:
    """One more, of `view`; as they were where the last one is the same, or there are `MAX_SNAPSHOTS`."""
    new = SliderSnapshot(_name(snapshots), _sliders(view), view.camera)
    same = snapshots and replace(snapshots[-1], name=new.name) == new
    return tuple(snapshots) if same or len(snapshots) >= MAX_SNAPSHOTS else (*snapshots, new)


def remove(snapshots: Sequence[SliderSnapshot], index: int) -> tuple[SliderSnapshot, ...]:
    """All but one."""
    return (*snapshots[:index], *snapshots[index + 1 :])


def rename(snapshots: Sequence[SliderSnapshot], index: int, name: str) -> tuple[SliderSnapshot, ...]:
    """One under another name, on one line, with a number where it is taken; no name changes nothing."""
    name = " ".join(name.split())[:LONGEST_NAME] or snapshots[index].name
    taken = {ORIGINAL, *(other.name for i, other in enumerate(snapshots) if i != index)}
    free = next(n for n in (name, *(f"{name}-{i}" for i in range(2, MAX_SNAPSHOTS + 3))) if n not in taken)
    return (*snapshots[:index], replace(snapshots[index], name=free), *snapshots[index + 1 :])


def move(snapshots: Sequence[SliderSnapshot], index: int, to: int) -> tuple[SliderSnapshot, ...]:
    """One at another place; the ends stop it."""
    moved = list(snapshots)
    moved.insert(max(0, min(to, len(moved) - 1)), moved.pop(index))
    return tuple(moved)


def with_original(snapshots: Sequence[SliderSnapshot], view: ViewState) -> tuple[SliderSnapshot, ...]:
    """What the panel shows: the original of `view`, then those kept."""
    layers = tuple(replace(layer, strength=0.0) for layer in view.layers)
    edit = _sliders(replace(view, layers=layers))
    first = snapshots[0].camera if snapshots else view.camera
    return SliderSnapshot(ORIGINAL, edit, first), *snapshots


def restore(view: ViewState, snapshot: SliderSnapshot) -> ViewState:
    """`view` edited as it was then; edits that were opened since stay in the stack, at 0."""
    known = {layer.gdf for layer in snapshot.edit.layers}
    later = tuple(replace(layer, strength=0.0, group="") for layer in view.layers if layer.gdf not in known)
    back = replace(history.apply_edit(view, snapshot.edit), pair=view.pair)
    return replace(back, layers=(*back.layers, *later), timeline=view.timeline, selection=view.selection)


def pair_of(snapshots: Sequence[SliderSnapshot], pair: SnapshotPair) -> tuple[int, int]:
    """The places of A and B in `snapshots` (the original first); the last two where none is named."""
    places = {snapshot.name: i for i, snapshot in reversed(list(enumerate(snapshots)))}
    return places.get(pair.a, max(len(snapshots) - 2, 0)), places.get(pair.b, len(snapshots) - 1)


def compare_sides(snapshots: Sequence[SliderSnapshot], view: ViewState) -> SnapshotSides | None:
    """What `view` shows where it compares two snapshots, else None."""
    if view.compare.mode == "off" or view.compare.against != "snapshots" or not snapshots:
        return None
    listed = with_original(snapshots, view)
    a, b = (listed[i] for i in pair_of(listed, view.pair))
    return SnapshotSides(restore(view, a), restore(view, b), (a.name, b.name))


def choose(view: ViewState, slot: str, name: str) -> ViewState:
    """Another snapshot as A or B ("a" or "b") of the pair."""
    changes: dict[str, Any] = {slot: name}
    return replace(view, pair=replace(view.pair, **changes))


def _sliders(view: ViewState) -> history.Edit:
    """What a snapshot keeps: all that undo knows but the film, the selection and the pair of snapshots."""
    edit = history.edit_of(view)
    return replace(edit, timeline=Timeline(), selection=SelectionState(), pair=SnapshotPair())


def _name(snapshots: Sequence[SliderSnapshot]) -> str:
    taken_names = {snapshot.name for snapshot in snapshots}
    return next(str(n) for n in range(1, MAX_SNAPSHOTS + 2) if str(n) not in taken_names)
