"""The stack of layers as pure functions: which of them show, order, names, groups, and what a lock keeps.

`ViewState.layers` begins with the lowest layer; the panel shows the last one, which lies on top, at the top.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from dataclasses import replace

from .view_state import OVERSHOOT, LayerGroup, LayerState, ViewState

SLIDERS = ("strength", "geometry", "opacity", "color")
"""What the arrow keys move: the strength, or a gain."""

LONGEST_NAME = 60


def visible_layers(view: ViewState) -> tuple[LayerState, ...]:
    """The layers that take part, in their order, each at its strength times its group's.

    They are the soloed ones where there are any, else the enabled of enabled groups.
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
    """Whether a layer of `view` takes part."""
    return any(visible.name == layer.name for visible in visible_layers(view))


def visible_edits(view: ViewState) -> list[str]:
    """The names of the layers that change the picture."""
    return [layer.name for layer in visible_layers(view) if layer.strength > 0.0]


def largest_strength(view: ViewState) -> float:
    """The upper end of the sliders."""
    return OVERSHOOT if view.overshoot else 1.0


def change_layer(view: ViewState, index: int, change: Callable[[LayerState], LayerState]) -> ViewState:
    """`view` with one layer changed; as it was where there is no such layer."""
    if not 0 <= index < len(view.layers):
        return view
    layers = list(view.layers)
    layers[index] = change(layers[index])
    return replace(view, layers=tuple(layers))


def with_slider_value(layer: LayerState, slider: str, value: float, upper: float = 1.0) -> LayerState:
    """The layer with its strength or a gain at `value`, held to 0..1 (a strength to 0..`upper`).

    A locked layer stays as it is.
    """
    if layer.locked:
        return layer
    if slider == "strength":
        return replace(layer, strength=min(upper, max(0.0, value)))
    return replace(layer, gains=replace(layer.gains, **{slider: min(1.0, max(0.0, value))}))


def slider_value(layer: LayerState, slider: str) -> float:
    """Where one of `SLIDERS` stands."""
    return layer.strength if slider == "strength" else float(getattr(layer.gains, slider))


def nudge_slider(view: ViewState, index: int, slider: str, by: float) -> ViewState:
    """One layer's slider a step further."""

    def step(layer: LayerState) -> LayerState:
        # rounded, so that steps forth and back end on the number they began with
        return with_slider_value(
            layer, slider, round(slider_value(layer, slider) + by, 6), largest_strength(view)
        )

    return change_layer(view, index, step)


def move_layers(view: ViewState, indices: Collection[int], at: int, group: str = "") -> ViewState:
    """These layers taken out and put in over what of the others is among the `at` lowest.

    Args:
        group: which they join; "" for none, but a group all of whose layers move stays one
    """
    remaining = [layer for i, layer in enumerate(view.layers) if i not in indices]
    left = {layer.group for layer in remaining}
    moved = [
        replace(l, group=group or (l.group if l.group not in left else ""))
        for i, l in enumerate(view.layers)
        if i in indices
    ]
    below = sum(i not in indices for i in range(at))
    return tidy_groups(replace(view, layers=(*remaining[:below], *moved, *remaining[below:])))


def step_layers(view: ViewState, indices: Collection[int], by: int) -> ViewState:
    """These layers over the next one above (1) or under the next below (−1); the ends of the stack stop them.

    Between two layers of a group they join them, away from those of their own they leave them; groups go over
    groups.
    """
    past = max(indices) + 1 if by > 0 else min(indices) - 1
    if not 0 <= past < len(view.layers):
        return view
    remaining = {i: layer.group for i, layer in enumerate(view.layers) if i not in indices}
    groups = {view.layers[i].group for i in indices}
    if "" not in groups and not groups & {*remaining.values()}:
        while past + by in remaining and remaining[past + by] == remaining[past] != "":
            past += by
    at = past + 1 if by > 0 else past
    below = next((remaining[i] for i in range(at - 1, -1, -1) if i in remaining), "")
    above = next((remaining[i] for i in range(at, len(view.layers)) if i in remaining), "")
    joined = below if below == above or {below} == groups else above if {above} == groups else ""
    return move_layers(view, indices, at, joined)


def rename_layer(view: ViewState, index: int, text: str) -> ViewState:
    """The layer under another name, on one line; a name that is taken gets a number; none changes nothing."""
    name = " ".join(text.split())[:LONGEST_NAME]
    if not name:
        return view
    free = free_name(replace(view, layers=(*view.layers[:index], *view.layers[index + 1 :])), name)
    return change_layer(view, index, lambda layer: replace(layer, name=free))


def free_name(view: ViewState, name: str) -> str:
    """A name for one more layer, with a number where a layer has it."""
    taken = {layer.name for layer in view.layers}
    free = name
    number = 2
    while free in taken:
        free = re.sub(r"-\d+\Z", "", name) + f"-{number}"
        number = number + 1
    return free


def add_layer(view: ViewState, gdf: int, name: str, strength: float = 1.0) -> ViewState:
    """An edit of its own on top of the others, at full strength unless said, so that one sees what came."""
    return replace(view, layers=(*view.layers, LayerState(gdf, free_name(view, name), strength)))


def remove_layer(view: ViewState, index: int) -> ViewState:
    """Without one layer; as it was where there is no such layer."""
    if not 0 <= index < len(view.layers):
        return view
    return tidy_groups(replace(view, layers=(*view.layers[:index], *view.layers[index + 1 :])))


def duplicate_layer(view: ViewState, index: int, gdf: int) -> ViewState:
    """A copy of one layer just above it, which shows `gdf`: the same edit under an index of its own."""
    layer = view.layers[index]
    copy = replace(layer, gdf=gdf, name=free_name(view, layer.name))
    return replace(view, layers=(*view.layers[: index + 1], copy, *view.layers[index + 1 :]))


def replace_edit(view: ViewState, index: int, gdf: int, name: str) -> ViewState:
    """One layer with another edit, on the timeline too: place, strength and gains stay, its paint goes."""
    old = view.layers[index].gdf
    keys = tuple(
        replace(key, strengths=tuple((gdf if g == old else g, s) for g, s in key.strengths))
        for key in view.timeline.keys
    )
    view = replace(view, timeline=replace(view.timeline, keys=keys))
    view = change_layer(view, index, lambda layer: replace(layer, gdf=gdf, paint=""))
    return rename_layer(view, index, name)


def index_of(view: ViewState, row: int) -> int:
    """The layer in a row of the panel, counted from 0 at the top: the top one is the last of `layers`."""
    return len(view.layers) - 1 - row


def toggle_solo(view: ViewState, index: int) -> ViewState:
    """One layer alone, or beside others that are alone; again lets it go."""
    return change_layer(view, index, lambda layer: replace(layer, solo=not layer.solo))


def with_paint(view: ViewState, index: int, paint: str) -> ViewState:
    """One layer under other painted weights, unless it is locked."""
    return change_layer(view, index, lambda layer: layer if layer.locked else replace(layer, paint=paint))


def show_all(view: ViewState) -> ViewState:
    """Every eye open, no layer alone."""
    layers = tuple(replace(layer, enabled=True, solo=False) for layer in view.layers)
    return replace(view, layers=layers, groups=tuple(replace(g, enabled=True) for g in view.groups))


def with_overshoot(view: ViewState, on: bool) -> ViewState:
    """Sliders that go beyond 1, or that end there again; what stood beyond comes back to 1."""
    view = replace(view, overshoot=on)
    upper = largest_strength(view)
    return replace(
        view, layers=tuple(replace(layer, strength=min(layer.strength, upper)) for layer in view.layers)
    )


def toggle_details(view: ViewState, index: int) -> ViewState:
    """Show or hide the gains of the layer at `index`."""
    if not 0 <= index < len(view.layers):
        return view
    gdf = view.layers[index].gdf
    if gdf in view.unfolded:
        return replace(view, unfolded=tuple(g for g in view.unfolded if g != gdf))
    return replace(view, unfolded=(*view.unfolded, gdf))


def group_layers(view: ViewState, indices: Collection[int], name: str = "Group") -> ViewState:
    """A group of these layers, at the place of the topmost; they leave the groups they were in."""
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
        )  # not into a group
    layers = (*remaining[:at], *members, *remaining[at:])
    return tidy_groups(replace(view, layers=layers, groups=(*view.groups, LayerGroup(free))))


def move_to_group(view: ViewState, indices: Collection[int], name: str) -> ViewState:
    """These layers at the bottom of a group there is."""
    moved = [replace(view.layers[i], group=name) for i in sorted(indices) if view.layers[i].group != name]
    remaining = [layer for i, layer in enumerate(view.layers) if i not in indices or layer.group == name]
    at = next((i for i, layer in enumerate(remaining) if layer.group == name), None)
    if at is None:
        return view
    return tidy_groups(replace(view, layers=(*remaining[:at], *moved, *remaining[at:])))


def dissolve_groups(view: ViewState, names: Collection[str]) -> ViewState:
    """The layers of these groups by themselves, as they showed within them."""
    groups = {group.name: group for group in view.groups if group.name in names}

    def alone(layer: LayerState) -> LayerState:
        group = groups.get(layer.group)
        if group is None:
            return layer
        enabled = layer.enabled and group.enabled
        return replace(layer, group="", enabled=enabled, strength=layer.strength * group.strength)

    return tidy_groups(replace(view, layers=tuple(map(alone, view.layers))))


def change_group(view: ViewState, name: str, change: Callable[[LayerGroup], LayerGroup]) -> ViewState:
    """`view` with one group changed; a changed name is one line, no other group's, and its layers follow."""
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
    """The layers of a group listed, or not."""
    remaining = tuple(collapsed for collapsed in view.collapsed if collapsed != name)
    return replace(view, collapsed=remaining if name in view.collapsed else (*remaining, name))


def tidy_groups(view: ViewState) -> ViewState:
    """Without the groups that have no layer."""
    names = {layer.group for layer in view.layers}
    return replace(
        view,
        groups=tuple(group for group in view.groups if group.name in names),
        collapsed=tuple(name for name in view.collapsed if name in names),
    )
