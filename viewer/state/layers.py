"""Layer stack as pure functions: visibility, order, names, groups and locks.

`ViewState.layers` begins with the lowest layer. The panel lists the last layer, the topmost, first.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from dataclasses import replace

from progdf.compose.layers import MAX_TEXTURE

from .view_state import OVERSHOOT, LayerGroup, LayerState, ViewState

SLIDERS = ("strength", "geometry", "opacity", "color", "texture")
"""Sliders that the arrow keys can move: the strength and the gains."""

LONGEST_NAME = 60  # characters in the name of a layer, group or snapshot


def visible_layers(view: ViewState) -> tuple[LayerState, ...]:
    """Return the visible layers in order, each at its strength times its group's strength.

    These are the soloed layers if there are any, else the enabled layers outside disabled groups.
    """
    groups = {group.name: group for group in view.groups}
    alone = tuple(layer for layer in view.layers if layer.solo)
    visible = alone or tuple(
        layer
        for layer in view.layers
        if layer.enabled and (layer.group not in groups or groups[layer.group].enabled)
    )
    factors = {name: group.strength for name, group in groups.items() if group.strength != 1.0}
    return tuple(
        replace(layer, strength=layer.strength * factors[layer.group]) if layer.group in factors else layer
        for layer in visible
    )


def is_visible(view: ViewState, layer: LayerState) -> bool:
    """Return whether a layer of `view` is visible."""
    return any(visible.name == layer.name for visible in visible_layers(view))


def visible_edits(view: ViewState) -> list[str]:
    """Return the names of the visible layers with a strength above 0."""
    return [layer.name for layer in visible_layers(view) if layer.strength > 0.0]


def describe_strengths(view: ViewState) -> str:
    """Return the visible layers with their strengths as text."""
    return ", ".join(f"{layer.name} {layer.strength:g}" for layer in visible_layers(view)) or "no edits"


def largest_strength(view: ViewState) -> float:
    """Return the upper end of the strength sliders: 1, or `OVERSHOOT` if overshoot is on."""
    return OVERSHOOT if view.overshoot else 1.0


def largest_value(view: ViewState, slider: str) -> float:
    """Return the upper end of one of `SLIDERS`. With overshoot, texture reaches `MAX_TEXTURE`."""
    if slider == "strength":
        return largest_strength(view)
    return MAX_TEXTURE if view.overshoot and slider == "texture" else 1.0


def change_layer(view: ViewState, index: int, change: Callable[[LayerState], LayerState]) -> ViewState:
    """Return `view` with one layer changed. An invalid index changes nothing."""
    if not 0 <= index < len(view.layers):
        return view
    layers = list(view.layers)
    layers[index] = change(layers[index])
    return replace(view, layers=tuple(layers))


def with_slider_value(layer: LayerState, slider: str, value: float, upper: float = 1.0) -> LayerState:
    """Return the layer with its strength or a gain set to `value`, unless it is locked.

    The value is clamped to 0 to `upper`, see `largest_value`.
    """
    if layer.locked:
        return layer
    value = min(upper, max(0.0, value))
    if slider == "strength":
        return replace(layer, strength=value)
    return replace(layer, gains=replace(layer.gains, **{slider: value}))


def slider_value(layer: LayerState, slider: str) -> float:
    """Return the value of one of `SLIDERS`."""
    return layer.strength if slider == "strength" else float(getattr(layer.gains, slider))


def nudge_slider(view: ViewState, index: int, slider: str, by: float) -> ViewState:
    """Move one layer's slider by `by`."""

    def step(layer: LayerState) -> LayerState:
        # rounded, so that steps forward and back return to the initial number
        value = round(slider_value(layer, slider) + by, 6)
        return with_slider_value(layer, slider, value, largest_value(view, slider))

    return change_layer(view, index, step)


def move_layers(view: ViewState, indices: Collection[int], at: int, group: str = "") -> ViewState:
    """Move layers to a position in the stack.

    Args:
        view: the state
        indices: layers to move
        at: gap to insert them into: the number of layers below it before the move
        group: group that they join, or "" for none; a group whose layers all move stays a group
    """
    remaining = [layer for i, layer in enumerate(view.layers) if i not in indices]
    remaining_groups = {layer.group for layer in remaining}
    moved = [
        replace(l, group=group or (l.group if l.group not in remaining_groups else ""))
        for i, l in enumerate(view.layers)
        if i in indices
    ]
    below = sum(i not in indices for i in range(at))
    return tidy_groups(replace(view, layers=(*remaining[:below], *moved, *remaining[below:])))


def step_layers(view: ViewState, indices: Collection[int], by: int) -> ViewState:
    """Move layers past the next layer above (1) or below (−1). At the end of the stack nothing changes.

    Layers that end up between two layers of a group join it. Layers that move away from their group leave it.
    Whole groups move past whole groups.
    """
    passed = max(indices) + 1 if by > 0 else min(indices) - 1
    if not 0 <= passed < len(view.layers):
        return view
    remaining = {i: layer.group for i, layer in enumerate(view.layers) if i not in indices}
    groups = {view.layers[i].group for i in indices}
    if "" not in groups and not groups & {*remaining.values()}:
        while passed + by in remaining and remaining[passed + by] == remaining[passed] != "":
            passed += by
    at = passed + 1 if by > 0 else passed
    below = next((remaining[i] for i in range(at - 1, -1, -1) if i in remaining), "")
    above = next((remaining[i] for i in range(at, len(view.layers)) if i in remaining), "")
    joined = ""
    if below == above or {below} == groups:
        joined = below
    elif {above} == groups:
        joined = above
    return move_layers(view, indices, at, joined)


def rename_layer(view: ViewState, index: int, text: str) -> ViewState:
    """Rename a layer.

    The name is put on one line and gets a number if taken. An empty name changes nothing.
    """
    name = " ".join(text.split())[:LONGEST_NAME]
    if not name:
        return view
    free = free_name(replace(view, layers=(*view.layers[:index], *view.layers[index + 1 :])), name)
    return change_layer(view, index, lambda layer: replace(layer, name=free))


def free_name(view: ViewState, name: str) -> str:
    """Return a name for a new layer, with a number if a layer already has it."""
    taken = {layer.name for layer in view.layers}
    free = name
    number = 2
    while free in taken:
        free = re.sub(r"-\d+\Z", "", name) + f"-{number}"
        number = number + 1
    return free


def add_layer(view: ViewState, gdf: int, name: str, strength: float = 1.0) -> ViewState:
    """Add a layer for an edit on top, by default at full strength so that the result is visible."""
    return replace(view, layers=(*view.layers, LayerState(gdf, free_name(view, name), strength)))


def remove_layer(view: ViewState, index: int) -> ViewState:
    """Remove one layer. An invalid index changes nothing."""
    if not 0 <= index < len(view.layers):
        return view
    return tidy_groups(replace(view, layers=(*view.layers[:index], *view.layers[index + 1 :])))


def duplicate_layer(view: ViewState, index: int, gdf: int) -> ViewState:
    """Copy a layer and insert the copy above it, with edit index `gdf` (the same edit under a new index)."""
    layer = view.layers[index]
    copy = replace(layer, gdf=gdf, name=free_name(view, layer.name))
    return replace(view, layers=(*view.layers[: index + 1], copy, *view.layers[index + 1 :]))


def replace_edit(view: ViewState, index: int, gdf: int, name: str) -> ViewState:
    """Replace the edit of a layer, also on the timeline.

    The position, strength and gains are unchanged. The paint is removed.
    """
    old = view.layers[index].gdf
    keys = tuple(
        replace(key, strengths=tuple((gdf if g == old else g, s) for g, s in key.strengths))
        for key in view.timeline.keys
    )
    view = replace(view, timeline=replace(view.timeline, keys=keys))
    view = change_layer(view, index, lambda layer: replace(layer, gdf=gdf, paint=""))
    return rename_layer(view, index, name)


def index_of(view: ViewState, row: int) -> int:
    """Return the index into `layers` of a row of the panel.

    Row 0 is the topmost layer, the last of `layers`.
    """
    return len(view.layers) - 1 - row


def toggle_solo(view: ViewState, index: int) -> ViewState:
    """Toggle solo on one layer. Other soloed layers stay soloed."""
    return change_layer(view, index, lambda layer: replace(layer, solo=not layer.solo))


def with_paint(view: ViewState, index: int, paint: str) -> ViewState:
    """Set the painted weights of one layer, unless it is locked."""
    return change_layer(view, index, lambda layer: layer if layer.locked else replace(layer, paint=paint))


def show_all(view: ViewState) -> ViewState:
    """Enable all layers and groups and end all solos."""
    layers = tuple(replace(layer, enabled=True, solo=False) for layer in view.layers)
    return replace(view, layers=layers, groups=tuple(replace(g, enabled=True) for g in view.groups))


def with_overshoot(view: ViewState, on: bool) -> ViewState:
    """Switch overshoot on or off. Off clamps strengths and the gains of texture to 1."""
    view = replace(view, overshoot=on)
    return replace(view, layers=tuple(_within_limits(view, layer) for layer in view.layers))


def _within_limits(view: ViewState, layer: LayerState) -> LayerState:
    """Return a layer with its sliders clamped to their ranges. Locked layers are clamped, too."""
    strength = min(layer.strength, largest_strength(view))
    texture = min(layer.gains.texture, largest_value(view, "texture"))
    return replace(layer, strength=strength, gains=replace(layer.gains, texture=texture))


def toggle_details(view: ViewState, index: int) -> ViewState:
    """Show or hide the gains of the layer at `index`."""
    if not 0 <= index < len(view.layers):
        return view
    gdf = view.layers[index].gdf
    if gdf in view.unfolded:
        return replace(view, unfolded=tuple(g for g in view.unfolded if g != gdf))
    return replace(view, unfolded=(*view.unfolded, gdf))


def group_layers(view: ViewState, indices: Collection[int], name: str = "Group") -> ViewState:
    """Group layers at the position of the topmost. They leave their earlier groups."""
    if not indices:
        return view
    taken = {group.name for group in view.groups}
    free = name
    number = 2
    while free in taken:
        free = f"{name} {number}"
        number = number + 1
    members = [replace(view.layers[i], group=free) for i in sorted(indices)]
    remaining = [layer for i, layer in enumerate(view.layers) if i not in indices]
    at = sum(i not in indices for i in range(max(indices)))
    if 0 < at < len(remaining) and remaining[at - 1].group and remaining[at - 1].group == remaining[at].group:
        at = max(
            i + 1 for i, layer in enumerate(remaining) if layer.group == remaining[at].group
        )  # never inside another group
    layers = (*remaining[:at], *members, *remaining[at:])
    return tidy_groups(replace(view, layers=layers, groups=(*view.groups, LayerGroup(free))))


def move_to_group(view: ViewState, indices: Collection[int], name: str) -> ViewState:
    """Move layers to the bottom of an existing group. An unknown name changes nothing."""
    moved = [replace(view.layers[i], group=name) for i in sorted(indices) if view.layers[i].group != name]
    remaining = [layer for i, layer in enumerate(view.layers) if i not in indices or layer.group == name]
    at = next((i for i, layer in enumerate(remaining) if layer.group == name), None)
    if at is None:
        return view
    return tidy_groups(replace(view, layers=(*remaining[:at], *moved, *remaining[at:])))


def dissolve_groups(view: ViewState, names: Collection[str]) -> ViewState:
    """Dissolve groups.

    Each layer takes over the group's visibility and strength, so the picture is unchanged.
    """
    groups = {group.name: group for group in view.groups if group.name in names}

    def alone(layer: LayerState) -> LayerState:
        group = groups.get(layer.group)
        if group is None:
            return layer
        enabled = layer.enabled and group.enabled
        return replace(layer, group="", enabled=enabled, strength=layer.strength * group.strength)

    return tidy_groups(replace(view, layers=tuple(map(alone, view.layers))))


def change_group(view: ViewState, name: str, change: Callable[[LayerGroup], LayerGroup]) -> ViewState:
    """Return `view` with one group changed.

    A new name is put on one line and applied to the group's layers. A name that is empty or taken is ignored.
    """
    old = next((group for group in view.groups if group.name == name), None)
    if old is None:
        return view
    new = change(old)
    free = " ".join(new.name.split())[:LONGEST_NAME]
    if not free or any(group.name == free for group in view.groups if group is not old):
        free = name
    return replace(
        view,
        layers=tuple(replace(l, group=free) if l.group == name else l for l in view.layers),
        groups=tuple(replace(new, name=free) if group is old else group for group in view.groups),
        collapsed=tuple(free if collapsed == name else collapsed for collapsed in view.collapsed),
    )


def toggle_collapsed(view: ViewState, name: str) -> ViewState:
    """Expand or collapse a group in the panel's list."""
    remaining = tuple(collapsed for collapsed in view.collapsed if collapsed != name)
    return replace(view, collapsed=remaining if name in view.collapsed else (*remaining, name))


def tidy_groups(view: ViewState) -> ViewState:
    """Remove groups without layers."""
    names = {layer.group for layer in view.layers}
    return replace(
        view,
        groups=tuple(group for group in view.groups if group.name in names),
        collapsed=tuple(name for name in view.collapsed if name in names),
    )
