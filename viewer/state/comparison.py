"""How two pictures are compared: the choices, and switching between them."""

from __future__ import annotations

from dataclasses import replace

from .view_state import ViewState


def toggle_mode(view: ViewState, mode: str) -> ViewState:
    """`mode` on, or off where it was on."""
    mode = "off" if view.compare.mode == mode else mode
    return replace(view, compare=replace(view.compare, mode=mode))


def toggle_against(view: ViewState) -> ViewState:
    """Against the recording instead of the original, or back; where nothing is compared, side by side."""
    compare = view.compare
    if compare.mode == "off":
        return replace(view, compare=replace(compare, mode="split", against="recorded"))
    against = "original" if compare.against == "recorded" else "recorded"
    return replace(view, compare=replace(compare, against=against))


def toggle_snapshots(view: ViewState) -> ViewState:
    """One snapshot against the other, or what was on the screen before; where nothing is compared, split."""
    compare = view.compare
    if compare.against == "snapshots" and compare.mode != "off":
        return replace(view, compare=replace(compare, mode="off", against="original"))
    mode = "split" if compare.mode == "off" else compare.mode
    return replace(view, compare=replace(compare, mode=mode, against="snapshots"))


def end_at_edit(before: ViewState, view: ViewState) -> ViewState:
    """No comparison of snapshots any more where layers have changed: one shall see what one does."""
    edited = (view.layers, view.groups, view.blend) != (before.layers, before.groups, before.blend)
    compare = view.compare
    if not edited or compare.mode == "off" or compare.against != "snapshots":
        return view
    return replace(view, compare=replace(compare, mode="off", against="original"))
