"""Undo and redo: one entry per gesture, of what is edited (layers, blend), never of where one looks from."""

from __future__ import annotations

from dataclasses import dataclass, replace

from .state import LayerState, ViewState

LONGEST = 1000  # entries; each is a few hundred bytes


@dataclass(frozen=True)
class Edit:
    """The part of the state that undo brings back."""

    layers: tuple[LayerState, ...]
    blend: str
    overshoot: bool = False


@dataclass(frozen=True)
class History:
    """Entries before and after the present one."""

    present: Edit
    past: tuple[Edit, ...] = ()
    future: tuple[Edit, ...] = ()


def edit_of(state: ViewState) -> Edit:
    return Edit(state.layers, state.blend, state.overshoot)


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


def undo(history: History, state: ViewState) -> tuple[History, ViewState]:
    """One entry back; unchanged where there is none."""
    if not history.past:
        return history, state
    *past, back = history.past
    return History(back, tuple(past), (history.present, *history.future)), _restored(state, back)


def redo(history: History, state: ViewState) -> tuple[History, ViewState]:
    """One entry forward; unchanged where there is none."""
    if not history.future:
        return history, state
    ahead, *future = history.future
    return History(ahead, (*history.past, history.present), tuple(future)), _restored(state, ahead)


def _restored(state: ViewState, edit: Edit) -> ViewState:
    return replace(state, layers=edit.layers, blend=edit.blend, overshoot=edit.overshoot)
