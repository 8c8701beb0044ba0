"""Kept states of the sliders: what was edited and from where one looked; the original is always the first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from progdf.compose.layers import Gains
from viewer.camera.view_camera import ViewCamera

from . import history, paint
from .history import Edit
from .layers import LONGEST_NAME, SLIDERS, visible_layers
from .selection import SelectionState
from .view_state import LayerGroup, LayerState, SnapshotPair, Timeline, ViewState

MOST = 200
ORIGINAL = "original"
"""The name of the first."""


@dataclass(frozen=True)
class SliderSnapshot:
    """One kept state."""

    name: str  # under its picture
    edit: Edit  # what going back to it restores, as one undo entry
    camera: ViewCamera = ViewCamera()  # where its small picture is taken from


@dataclass(frozen=True)
class SnapshotSides:
    """Two snapshots that are compared: what each shows, seen from where one looks, and their names."""

    left: ViewState
    right: ViewState
    names: tuple[str, str]


def take(snapshots: Sequence[SliderSnapshot], view: ViewState) -> tuple[SliderSnapshot, ...]:
    """One more, of `view`; as they were where the last one is the same, or there are `MOST`."""
    new = SliderSnapshot(_name(snapshots), _sliders(view), view.camera)
    same = snapshots and replace(snapshots[-1], name=new.name) == new
    return tuple(snapshots) if same or len(snapshots) >= MOST else (*snapshots, new)


def remove(snapshots: Sequence[SliderSnapshot], index: int) -> tuple[SliderSnapshot, ...]:
    """All but one."""
    return (*snapshots[:index], *snapshots[index + 1 :])


def rename(snapshots: Sequence[SliderSnapshot], index: int, name: str) -> tuple[SliderSnapshot, ...]:
    """One under another name, on one line, with a number where it is taken; no name changes nothing."""
    name = " ".join(name.split())[:LONGEST_NAME] or snapshots[index].name
    taken = {ORIGINAL, *(other.name for i, other in enumerate(snapshots) if i != index)}
    free = next(n for n in (name, *(f"{name}-{i}" for i in range(2, MOST + 3))) if n not in taken)
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
    """Another snapshot as A or B ("a" or "b") of the pair; the slider between them goes back to A."""
    changes: dict[str, Any] = {slot: name, "share": 0.0}
    return replace(view, pair=replace(view.pair, **changes))


def blend(
    view: ViewState, snapshots: Sequence[SliderSnapshot], share: float, counts: Callable[[int], int]
) -> ViewState:
    """`view` between A and B of its pair: as A at 0, as B at 1, each exactly.

    Strengths, gains, group strengths and painted weights lie between those of the two, in a straight line; a
    layer that only one of them shows fades with that one's gains and paint. The order of layers, the blend
    rule and locks cannot lie between: they change half way.

    Args:
        snapshots: the snapshots with the original
        counts: gives how many members an edit has

    Raises:
        ProgdfError: painted weights do not fit their edit.
    """
    share = min(1.0, max(0.0, share))
    a, b = pair_of(snapshots, view.pair)
    pair = replace(view.pair, a=snapshots[a].name, b=snapshots[b].name, share=share)
    ends = [restore(view, snapshots[i] if i else _faded_snapshot(snapshots[j])) for i, j in ((a, b), (b, a))]
    if share in (0.0, 1.0):
        return replace(ends[round(share)], pair=pair)
    near, far = ends if share < 0.5 else ends[::-1]
    known = {layer.gdf for layer in near.layers}
    stack = (*near.layers, *(replace(layer, group="") for layer in far.layers if layer.gdf not in known))
    members = [_members(end) for end in ends]
    shared = {name for name in members[0] if members[0][name] == members[1].get(name)}  # groups of both
    if any(layer.solo for end in ends for layer in end.layers):
        shared = set()  # soloed layers are shown whatever becomes of their groups
    groups = (
        _group_between(group, ends, share) if group.name in shared else LayerGroup(group.name)
        for group in near.groups
    )
    layers_of = [{layer.gdf: layer for layer in end.layers} for end in ends]
    seen = [{layer.gdf: layer.strength for layer in visible_layers(end)} for end in ends]

    def between(layer: LayerState) -> LayerState:
        first, second = (of.get(layer.gdf, replace(layer, strength=0.0, enabled=False)) for of in layers_of)
        visible = [layer.gdf in of for of in seen]
        strengths = [of.get(layer.gdf, end.strength) for of, end in zip(seen, (first, second), strict=True)]
        if layer.group in shared:
            visible, strengths = [first.enabled, second.enabled], [first.strength, second.strength]
        strength = _fade(visible, strengths, share)
        on = [here and s != 0.0 for here, s in zip(visible, strengths, strict=True)]
        if on[0] != on[1]:
            first = second = first if on[0] else second
        gains = {
            kind: _lerp(getattr(first.gains, kind), getattr(second.gains, kind), share)
            for kind in SLIDERS[1:]
        }
        weights = paint.blend(first.paint, second.paint, share, counts(layer.gdf))
        return replace(
            layer, strength=strength, enabled=any(visible), solo=False, gains=Gains(**gains), paint=weights
        )

    return replace(
        near,
        layers=tuple(map(between, stack)),
        groups=tuple(groups),
        overshoot=near.overshoot or far.overshoot,
        pair=pair,
    )


def is_blend(view: ViewState, snapshots: Sequence[SliderSnapshot], counts: Callable[[int], int]) -> bool:
    """Whether `view` is still what its slider between two snapshots made of it."""
    made = blend(view, snapshots, view.pair.share, counts)
    return (made.layers, made.groups, made.blend) == (view.layers, view.groups, view.blend)


def _faded_snapshot(snapshot: SliderSnapshot) -> SliderSnapshot:
    """The original as the other end of a slider: that snapshot with every strength at 0."""
    layers = tuple(replace(layer, strength=0.0) for layer in snapshot.edit.layers)
    return replace(snapshot, edit=replace(snapshot.edit, layers=layers))


def _members(view: ViewState) -> dict[str, frozenset[int]]:
    """The edits in each group."""
    return {
        group.name: frozenset(layer.gdf for layer in view.layers if layer.group == group.name)
        for group in view.groups
    }


def _group_between(group: LayerGroup, ends: Sequence[ViewState], share: float) -> LayerGroup:
    both = [next(g for g in end.groups if g.name == group.name) for end in ends]
    on = [g.enabled for g in both]
    return replace(group, enabled=any(on), strength=_fade(on, [g.strength for g in both], share))


def _fade(on: Sequence[bool], values: Sequence[float], share: float) -> float:
    """Between two values; what is off at one end is 0 there, unless it is off at both."""
    a, b = (value if here or not any(on) else 0.0 for here, value in zip(on, values, strict=True))
    return _lerp(a, b, share)


def _lerp(a: float, b: float, share: float) -> float:
    return a + share * (b - a)


def _sliders(view: ViewState) -> Edit:
    """What a snapshot keeps: all that undo knows but the film, the selection and the blend of snapshots."""
    edit = history.edit_of(view)
    return replace(edit, timeline=Timeline(), selection=SelectionState(), pair=SnapshotPair())


def _name(snapshots: Sequence[SliderSnapshot]) -> str:
    taken_names = {snapshot.name for snapshot in snapshots}
    return next(str(n) for n in range(1, MOST + 2) if str(n) not in taken_names)
