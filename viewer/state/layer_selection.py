"""Which layers are selected, and what is done to all of them at once: strength, values, order, groups.

The focused layer is always selected; `Workspace.selected` names the others beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from progdf.compose.layers import Gains

from .layers import (
    dissolve_groups,
    group_layers,
    largest_strength,
    move_to_group,
    nudge_slider,
    remove_layer,
    step_layers,
    with_slider_value,
)
from .view_state import LayerState, ViewState
from .workspace import Workspace

PRESSES = ("one", "keep", "toggle", "range")
"""What a press does to the selection: this card alone; alone unless among several; with Ctrl; with Shift."""


def selected_layers(workspace: Workspace) -> tuple[int, ...]:
    """Places of the selected layers in `view.layers`, the lowest first; none where none is focused."""
    layers = workspace.view.layers
    focus = workspace.focus
    if focus is None:
        return ()
    return tuple(i for i, layer in enumerate(layers) if i == focus or layer.gdf in workspace.selected)


def press(workspace: Workspace, argument: str) -> Workspace:
    """The focus and the selection after a press on the card of a layer.

    Args:
        argument: `HOW:INDEX:LISTED`, of `PRESSES`; LISTED are the places of the layers that the panel lists,
            with commas, as a range is of what one sees
    """
    how, at, listed = argument.split(":")
    index, rows = int(at), [int(i) for i in listed.split(",") if i]
    layers = workspace.view.layers
    focus = workspace.focus
    chosen = selected_layers(workspace)
    if how == "range" and focus is not None:
        low, high = sorted((focus, index))
        return replace(workspace, selected=frozenset(layers[i].gdf for i in rows if low <= i <= high))
    if how == "toggle" and index in chosen:
        remaining = [i for i in chosen if i != index]
        if not remaining:
            return workspace
        near = min(remaining, key=lambda i: abs(i - index)) if focus == index else focus
        return replace(workspace, focus=near, selected=frozenset(layers[i].gdf for i in remaining))
    if how == "toggle":
        return replace(workspace, focus=index, selected=frozenset(layers[i].gdf for i in (*chosen, index)))
    if how == "keep" and index in chosen:
        return replace(workspace, focus=index, selected=frozenset(layers[i].gdf for i in chosen))
    return replace(workspace, focus=index, selected=frozenset())


def select_layers(workspace: Workspace, group: str = "") -> Workspace:
    """All layers of a group selected, or all there are; the topmost is focused where none of them was."""
    layers = workspace.view.layers
    chosen = [i for i, layer in enumerate(layers) if not group or layer.group == group]
    if not chosen:
        return workspace
    focus = workspace.focus if workspace.focus in chosen else chosen[-1]
    return replace(workspace, focus=focus, selected=frozenset(layers[i].gdf for i in chosen))


def master_strength(view: ViewState, chosen: Sequence[int]) -> float:
    """Where the slider over several layers stands: at the strongest of those that are not locked."""
    free = [view.layers[i].strength for i in chosen if not view.layers[i].locked]
    return max(free, default=0.0)


def set_master(workspace: Workspace, strength: float) -> Workspace:
    """The strongest of the selected layers at this strength, the others in proportion; locked ones stay.

    Proportions are those before the gesture, so that a drag over 0 and back loses nothing. Layers that were
    all at 0 rise together.
    """
    chosen = selected_layers(workspace)
    view = workspace.view
    upper = largest_strength(view)
    strength = min(upper, max(0.0, strength))
    before = {layer.gdf: layer.strength for layer in workspace.past.present.edit.layers}
    base = {i: before.get(view.layers[i].gdf, view.layers[i].strength) for i in chosen}
    most = max((s for i, s in base.items() if not view.layers[i].locked), default=0.0)

    def scale(index: int) -> float:
        return strength if not most else min(upper, base[index] / most * strength)

    return change_selected(workspace, lambda i, layer: with_slider_value(layer, "strength", scale(i), upper))


def change_selected(workspace: Workspace, change: Callable[[int, LayerState], LayerState]) -> Workspace:
    """Every selected layer changed."""
    layers = list(workspace.view.layers)
    for i in selected_layers(workspace):
        layers[i] = change(i, layers[i])
    return replace(workspace, view=replace(workspace.view, layers=tuple(layers)))


def switch_selected(workspace: Workspace, name: str) -> Workspace:
    """A switch of the focused layer turned, and that of all selected ones with it."""
    if workspace.focus is None:
        return workspace
    on = not getattr(workspace.view.layers[workspace.focus], name)
    changes: dict[str, Any] = {name: on}
    return change_selected(workspace, lambda _, layer: replace(layer, **changes))


def nudge(workspace: Workspace, by: float) -> Workspace:
    """The slider that the arrow keys move a step further; several strengths in proportion."""
    chosen = selected_layers(workspace)
    slider = workspace.active_slider
    if len(chosen) > 1 and slider == "strength":
        return set_master(workspace, round(master_strength(workspace.view, chosen) + by, 6))
    view = workspace.view
    for i in chosen:
        view = nudge_slider(view, i, slider, by)
    return replace(workspace, view=view)


def reset(workspace: Workspace, everything: bool) -> Workspace:
    """Strengths to 0 and gains to 1, of the selected layers, or of all with their groups; no locked ones."""

    def default(_: int, layer: LayerState) -> LayerState:
        return layer if layer.locked else replace(layer, strength=0.0, gains=Gains())

    if not everything:
        return change_selected(workspace, default)
    view = workspace.view
    layers = tuple(default(i, layer) for i, layer in enumerate(view.layers))
    groups = tuple(replace(group, strength=1.0) for group in view.groups)
    return replace(workspace, view=replace(view, layers=layers, groups=groups))


def move(workspace: Workspace, by: int) -> Workspace:
    """The selected layers up (−1) or down in the panel's list; the focus goes with them."""
    chosen = selected_layers(workspace)
    return _with_focus(workspace, step_layers(workspace.view, chosen, -by)) if chosen else workspace


def remove(workspace: Workspace, index: str) -> Workspace:
    """A layer, or all selected ones, taken out of the stack; the one below is focused."""
    chosen = selected_layers(workspace)
    at = int(index) if index else workspace.focus
    if at is None or not 0 <= at < len(workspace.view.layers):
        return workspace
    view = workspace.view
    gone = chosen if at in chosen else (at,)
    for i in reversed(gone):
        view = remove_layer(view, i)
    focus = max(gone[0] - 1, 0) if view.layers else None
    return replace(workspace, view=view, focus=focus, selected=frozenset(), renaming=None)


def group(workspace: Workspace, name: str) -> Workspace:
    """The selected layers as a new group, or at the bottom of the one of this name."""
    view = workspace.view
    chosen = selected_layers(workspace)
    grouped = move_to_group(view, chosen, name) if name else group_layers(view, chosen)
    return _with_focus(workspace, grouped)


def ungroup(workspace: Workspace, name: str) -> Workspace:
    """A group, or those of the selected layers, dissolved."""
    view = workspace.view
    names = {name} if name else {view.layers[i].group for i in selected_layers(workspace)}
    return replace(workspace, view=dissolve_groups(view, names - {""}))


def _with_focus(workspace: Workspace, view: ViewState) -> Workspace:
    """Other layers, or in another order; the focus stays on its layer."""
    focus = workspace.focus
    if focus is not None:
        name = workspace.view.layers[focus].name
        focus = next((i for i, layer in enumerate(view.layers) if layer.name == name), None)
    return replace(workspace, view=view, focus=focus)


def filter_layers(view: ViewState, texts: Sequence[str], search: str) -> tuple[int, ...]:
    """Places of the layers in which all words of a search are found.

    Args:
        texts: what is known of each edit besides, by `LayerState.gdf`: its region, what was asked for
    """
    words = search.casefold().split()
    return tuple(
        i
        for i, layer in enumerate(view.layers)
        if all(word in f"{layer.name} {layer.group} {texts[layer.gdf]}".casefold() for word in words)
    )
