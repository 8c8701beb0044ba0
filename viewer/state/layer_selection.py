"""Selection of layers, and actions on all selected layers: strength, values, order, groups.

The focused layer is always selected. `Workspace.selected` names the other selected layers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from progdf.compose.layers import Gains

from .commands import PressLayer
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
"""Effects of a press on the card of a layer.

"one" selects the layer alone, "keep" selects it alone unless it is already selected, "toggle" (Ctrl) adds or
removes it, "range" (Shift) selects all listed layers from the focused one to it.
"""


def selected_layers(workspace: Workspace) -> tuple[int, ...]:
    """Return the indices of the selected layers in `view.layers`, lowest first. Empty without a focus."""
    layers = workspace.view.layers
    focus = workspace.focus
    if focus is None:
        return ()
    return tuple(i for i, layer in enumerate(layers) if i == focus or layer.gdf in workspace.selected)


def press(workspace: Workspace, action: PressLayer) -> Workspace:
    """Update the focus and the selection after a press on the card of a layer."""
    how = action.how
    index = action.index
    layers = workspace.view.layers
    focus = workspace.focus
    chosen = selected_layers(workspace)
    if how == "range" and focus is not None:
        low, high = sorted((focus, index))
        return replace(
            workspace, selected=frozenset(layers[i].gdf for i in action.listed if low <= i <= high)
        )
    if how == "toggle" and index in chosen:
        remaining = [i for i in chosen if i != index]
        if not remaining:
            return workspace
        new_focus = min(remaining, key=lambda i: abs(i - index)) if focus == index else focus
        return replace(workspace, focus=new_focus, selected=frozenset(layers[i].gdf for i in remaining))
    if how == "toggle":
        return replace(workspace, focus=index, selected=frozenset(layers[i].gdf for i in (*chosen, index)))
    if how == "keep" and index in chosen:
        return replace(workspace, focus=index, selected=frozenset(layers[i].gdf for i in chosen))
    return replace(workspace, focus=index, selected=frozenset())


def select_layers(workspace: Workspace, group: str | None = None) -> Workspace:
    """Select all layers of a group, or all layers. If none of them is focused, focus the topmost."""
    layers = workspace.view.layers
    chosen = [i for i, layer in enumerate(layers) if not group or layer.group == group]
    if not chosen:
        return workspace
    focus = workspace.focus if workspace.focus in chosen else chosen[-1]
    return replace(workspace, focus=focus, selected=frozenset(layers[i].gdf for i in chosen))


def master_strength(view: ViewState, chosen: Sequence[int]) -> float:
    """Return the value of the slider for several layers: the largest strength of the unlocked ones."""
    free = [view.layers[i].strength for i in chosen if not view.layers[i].locked]
    return max(free, default=0.0)


def set_master(workspace: Workspace, strength: float) -> Workspace:
    """Set the strongest selected layer to this strength and scale the others in proportion.

    Locked layers are unchanged. The proportions are those before the gesture, so that a drag to 0 and back
    loses nothing. Layers that were all at 0 get equal strengths.
    """
    chosen = selected_layers(workspace)
    view = workspace.view
    upper = largest_strength(view)
    strength = min(upper, max(0.0, strength))
    before = {layer.gdf: layer.strength for layer in workspace.past.present.edit.layers}
    base = {i: before.get(view.layers[i].gdf, view.layers[i].strength) for i in chosen}
    max_strength = max((s for i, s in base.items() if not view.layers[i].locked), default=0.0)

    def scale(index: int) -> float:
        return strength if not max_strength else min(upper, base[index] / max_strength * strength)

    return change_selected(workspace, lambda i, layer: with_slider_value(layer, "strength", scale(i), upper))


def change_selected(workspace: Workspace, change: Callable[[int, LayerState], LayerState]) -> Workspace:
    """Apply `change` to every selected layer; it receives the index and the layer."""
    layers = list(workspace.view.layers)
    for i in selected_layers(workspace):
        layers[i] = change(i, layers[i])
    return replace(workspace, view=replace(workspace.view, layers=tuple(layers)))


def switch_selected(workspace: Workspace, name: str) -> Workspace:
    """Toggle a switch of the focused layer and set it to the same value on all selected layers."""
    if workspace.focus is None:
        return workspace
    on = not getattr(workspace.view.layers[workspace.focus], name)
    changes: dict[str, Any] = {name: on}
    return change_selected(workspace, lambda _, layer: replace(layer, **changes))


def nudge(workspace: Workspace, by: float) -> Workspace:
    """Move the active slider of the selected layers by `by`. Several strengths move in proportion."""
    chosen = selected_layers(workspace)
    slider = workspace.active_slider
    if len(chosen) > 1 and slider == "strength":
        return set_master(workspace, round(master_strength(workspace.view, chosen) + by, 6))
    view = workspace.view
    for i in chosen:
        view = nudge_slider(view, i, slider, by)
    return replace(workspace, view=view)


def reset(workspace: Workspace, everything: bool) -> Workspace:
    """Reset the selected layers, or all layers and groups: strengths to 0, gains and group strengths to 1.

    Locked layers are unchanged.
    """

    def default(_: int, layer: LayerState) -> LayerState:
        return layer if layer.locked else replace(layer, strength=0.0, gains=Gains())

    if not everything:
        return change_selected(workspace, default)
    view = workspace.view
    layers = tuple(default(i, layer) for i, layer in enumerate(view.layers))
    groups = tuple(replace(group, strength=1.0) for group in view.groups)
    return replace(workspace, view=replace(view, layers=layers, groups=groups))


def move(workspace: Workspace, by: int) -> Workspace:
    """Move the selected layers up (−1) or down (1) in the panel's list. The focus moves with them."""
    chosen = selected_layers(workspace)
    return _with_focus(workspace, step_layers(workspace.view, chosen, -by)) if chosen else workspace


def remove(workspace: Workspace, index: int | None) -> Workspace:
    """Remove a layer, or all selected layers if it is selected, and focus the layer below."""
    chosen = selected_layers(workspace)
    at = workspace.focus if index is None else index
    if at is None or not 0 <= at < len(workspace.view.layers):
        return workspace
    view = workspace.view
    removed = chosen if at in chosen else (at,)
    for i in reversed(removed):
        view = remove_layer(view, i)
    focus = max(removed[0] - 1, 0) if view.layers else None
    return replace(workspace, view=view, focus=focus, selected=frozenset(), renaming=None)


def group(workspace: Workspace, name: str | None) -> Workspace:
    """Group the selected layers, or move them to the bottom of the group of this name."""
    view = workspace.view
    chosen = selected_layers(workspace)
    grouped = move_to_group(view, chosen, name) if name else group_layers(view, chosen)
    return _with_focus(workspace, grouped)


def ungroup(workspace: Workspace, name: str | None) -> Workspace:
    """Dissolve a group, or the groups of the selected layers."""
    view = workspace.view
    names = {name} if name else {view.layers[i].group for i in selected_layers(workspace)}
    return replace(workspace, view=dissolve_groups(view, names - {""}))


def _with_focus(workspace: Workspace, view: ViewState) -> Workspace:
    """Replace the view and keep the focus on the layer of the same name."""
    focus = workspace.focus
    if focus is not None:
        name = workspace.view.layers[focus].name
        focus = next((i for i, layer in enumerate(view.layers) if layer.name == name), None)
    return replace(workspace, view=view, focus=focus)


def filter_layers(view: ViewState, texts: Sequence[str], search: str) -> tuple[int, ...]:
    """Return the indices of the layers that match all words of a search.

    Args:
        texts: further searchable text of each edit (region, instruction), indexed by `LayerState.gdf`
    """
    words = search.casefold().split()
    return tuple(
        i
        for i, layer in enumerate(view.layers)
        if all(word in f"{layer.name} {layer.group} {texts[layer.gdf]}".casefold() for word in words)
    )
