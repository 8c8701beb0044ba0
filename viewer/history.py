"""Undo and redo: one entry per gesture, of what is edited (layers, blend), never of where one looks from."""

from __future__ import annotations

from dataclasses import dataclass, replace

from .state import LayerState, Timeline, ViewState

LONGEST = 1000  # entries; each is a few hundred bytes


@dataclass(frozen=True)
class Edit:
    """The part of the state that undo brings back."""

    layers: tuple[LayerState, ...]
    blend: str
    overshoot: bool = False
    timeline: Timeline = Timeline()


@dataclass(frozen=True)
class History:
    """Entries before and after the present one."""

    present: Edit
    past: tuple[Edit, ...] = ()
    future: tuple[Edit, ...] = ()


def edit_of(state: ViewState) -> Edit:
    return Edit(state.layers, state.blend, state.overshoot, state.timeline)


def begin(state: ViewState) -> History:
    """A history whose present is `state` and that has nothing to undo."""
    return History(edit_of(state))


def record(history: History, state: ViewState) -> History:
    """Call whenever no gesture is under way: what a press, move and release changed becomes one entry.

    A gesture that ends where it began leaves no entry.
    """
    edit = edit_of(state)
    if edit == history.present:
        return history
    return History(edit, (*history.past, history.present)[-LONGEST:])


def followed(history: History, before: ViewState, after: ViewState) -> History:
    """The playhead has moved strengths: no entry, as nobody edited them; gestures under way stay such."""
    if after.layers == before.layers:
        return history
    was = {layer.gdf: layer.strength for layer in before.layers}
    went = {layer.gdf: layer.strength for layer in after.layers if layer.strength != was.get(layer.gdf)}
    layers = tuple(
        replace(layer, strength=went.get(layer.gdf, layer.strength)) for layer in history.present.layers
    )
    return replace(history, present=replace(history.present, layers=layers))


def undo(history: History, state: ViewState) -> tuple[History, ViewState]:
    """One entry back; unchanged where there is none."""
    if not history.past:
        return history, state
    *past, back = history.past
    return History(back, tuple(past), (history.present, *history.future)), restored(state, back)


def redo(history: History, state: ViewState) -> tuple[History, ViewState]:
    """One entry forward; unchanged where there is none."""
    if not history.future:
        return history, state
    ahead, *future = history.future
    return History(ahead, (*history.past, history.present), tuple(future)), restored(state, ahead)


def restored(state: ViewState, edit: Edit) -> ViewState:
    """`state` edited as in `edit`, seen from where it is."""
    return replace(
        state, layers=edit.layers, blend=edit.blend, overshoot=edit.overshoot, timeline=edit.timeline
    )
