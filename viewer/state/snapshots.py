"""Snapshots: saved slider states with their camera. The original is always the first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from viewer.camera.view_camera import ViewCamera

from . import history
from .layers import LONGEST_NAME
from .selection import SelectionState
from .view_state import SnapshotPair, Timeline, ViewState

MAX_SNAPSHOTS = 200  # without the original
ORIGINAL = "original"
"""Name of the first snapshot."""


@dataclass(frozen=True)
class SliderSnapshot:
    """Saved state of the sliders."""

    name: str  # label under its thumbnail
    edit: history.Edit  # restored as one undo entry
    camera: ViewCamera = ViewCamera()  # camera of its thumbnail


@dataclass(frozen=True)
class SnapshotSides:
    """Two compared snapshots from the current camera, and their names."""

    left: ViewState
    right: ViewState
    names: tuple[str, str]


def take(snapshots: Sequence[SliderSnapshot], view: ViewState) -> tuple[SliderSnapshot, ...]:
    """Append a snapshot of `view`, unless it equals the last one or there are `MAX_SNAPSHOTS`."""
    new = SliderSnapshot(_next_name(snapshots), _snapshot_edit(view), view.camera)
    same = snapshots and replace(snapshots[-1], name=new.name) == new
    return tuple(snapshots) if same or len(snapshots) >= MAX_SNAPSHOTS else (*snapshots, new)


def remove(snapshots: Sequence[SliderSnapshot], index: int) -> tuple[SliderSnapshot, ...]:
    """Remove the snapshot at `index`."""
    return (*snapshots[:index], *snapshots[index + 1 :])


def rename(snapshots: Sequence[SliderSnapshot], index: int, name: str) -> tuple[SliderSnapshot, ...]:
    """Rename a snapshot.

    The name is put on one line and gets a number if taken. An empty name changes nothing.
    """
    name = " ".join(name.split())[:LONGEST_NAME] or snapshots[index].name
    taken = {ORIGINAL, *(other.name for i, other in enumerate(snapshots) if i != index)}
    free = next(n for n in (name, *(f"{name}-{i}" for i in range(2, MAX_SNAPSHOTS + 3))) if n not in taken)
    return (*snapshots[:index], replace(snapshots[index], name=free), *snapshots[index + 1 :])


def move(snapshots: Sequence[SliderSnapshot], index: int, to: int) -> tuple[SliderSnapshot, ...]:
    """Move a snapshot to index `to`, clamped to the list."""
    moved = list(snapshots)
    moved.insert(max(0, min(to, len(moved) - 1)), moved.pop(index))
    return tuple(moved)


def with_original(snapshots: Sequence[SliderSnapshot], view: ViewState) -> tuple[SliderSnapshot, ...]:
    """Return the panel's list: the original of `view`, then the snapshots."""
    layers = tuple(replace(layer, strength=0.0) for layer in view.layers)
    edit = _snapshot_edit(replace(view, layers=layers))
    first = snapshots[0].camera if snapshots else view.camera
    return SliderSnapshot(ORIGINAL, edit, first), *snapshots


def restore(view: ViewState, snapshot: SliderSnapshot) -> ViewState:
    """Restore a snapshot in `view`. Edits opened since then stay in the stack at strength 0.

    The camera, the timeline, the selection, the scenes and unfinished paint are unchanged.
    """
    known = {layer.gdf for layer in snapshot.edit.layers}
    later = tuple(replace(layer, strength=0.0, group="") for layer in view.layers if layer.gdf not in known)
    restored = replace(history.apply_edit(view, snapshot.edit), pair=view.pair)
    return replace(
        restored,
        layers=(*restored.layers, *later),
        timeline=view.timeline,
        selection=view.selection,
        painted=view.painted,
        scenes=view.scenes,
    )


def pair_of(snapshots: Sequence[SliderSnapshot], pair: SnapshotPair) -> tuple[int, int]:
    """Return the indices of A and B in `snapshots` (the original first).

    A side without a name is the last snapshot but one (A) or the last one (B).
    """
    places = {snapshot.name: i for i, snapshot in reversed(list(enumerate(snapshots)))}
    return places.get(pair.a, max(len(snapshots) - 2, 0)), places.get(pair.b, len(snapshots) - 1)


def compare_sides(snapshots: Sequence[SliderSnapshot], view: ViewState) -> SnapshotSides | None:
    """Return both sides if `view` compares two snapshots, else None."""
    if view.compare.mode == "off" or view.compare.against != "snapshots" or not snapshots:
        return None
    listed = with_original(snapshots, view)
    a, b = (listed[i] for i in pair_of(listed, view.pair))
    return SnapshotSides(restore(view, a), restore(view, b), (a.name, b.name))


def choose(view: ViewState, slot: str, name: str) -> ViewState:
    """Set A or B (`slot` "a" or "b") of the compared pair to the named snapshot."""
    changes: dict[str, Any] = {slot: name}
    return replace(view, pair=replace(view.pair, **changes))


def _snapshot_edit(view: ViewState) -> history.Edit:
    """Return the edit that a snapshot stores: the layers with their groups and blend rule."""
    edit = history.edit_of(view)
    return replace(
        edit, timeline=Timeline(), selection=SelectionState(), pair=SnapshotPair(), painted=(), scenes=()
    )


def _next_name(snapshots: Sequence[SliderSnapshot]) -> str:
    taken_names = {snapshot.name for snapshot in snapshots}
    return next(str(n) for n in range(1, MAX_SNAPSHOTS + 2) if str(n) not in taken_names)


def toggle_mode(view: ViewState, mode: str) -> ViewState:
    """Switch comparison mode `mode` on, or off if it is already on."""
    mode = "off" if view.compare.mode == mode else mode
    return replace(view, compare=replace(view.compare, mode=mode))


def toggle_snapshots(view: ViewState) -> ViewState:
    """Toggle the comparison of two snapshots, as a split view if no comparison is active."""
    compare = view.compare
    if compare.against == "snapshots" and compare.mode != "off":
        return replace(view, compare=replace(compare, mode="off", against="original"))
    mode = "split" if compare.mode == "off" else compare.mode
    return replace(view, compare=replace(compare, mode=mode, against="snapshots"))
