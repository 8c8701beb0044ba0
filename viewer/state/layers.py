"""The stack of layers as pure functions: which of them show, their order, names, and what a lock keeps.

`ViewState.layers` begins with the lowest layer; the panel shows the last one, which lies on top, at the top.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from .view_state import OVERSHOOT, LayerState, ViewState

SLIDERS = ("strength", "geometry", "opacity", "color")
"""What the arrow keys move: the strength, or a gain."""

LONGEST_NAME = 60


def visible_layers(view: ViewState) -> tuple[LayerState, ...]:
    """The layers that take part, in their order: the soloed ones where there are any, else the enabled."""
    alone = tuple(layer for layer in view.layers if layer.solo)
    return alone or tuple(layer for layer in view.layers if layer.enabled)


def shown_edits(view: ViewState) -> list[str]:
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


def nudge(view: ViewState, index: int, slider: str, by: float) -> ViewState:
    """One layer's slider a step further."""

    def step(layer: LayerState) -> LayerState:
        # rounded, so that steps forth and back end on the number they began with
        return with_slider_value(
            layer, slider, round(slider_value(layer, slider) + by, 6), largest_strength(view)
        )

    return change_layer(view, index, step)


def move_layer(view: ViewState, index: int, to: int) -> ViewState:
    """The layer at `index` taken out and put in at `to`; the ends of the stack stop it."""
    if not 0 <= index < len(view.layers):
        return view
    layers = list(view.layers)
    layers.insert(max(0, min(to, len(layers) - 1)), layers.pop(index))
    return replace(view, layers=tuple(layers))


def rename_layer(view: ViewState, index: int, text: str) -> ViewState:
    """The layer under another name, on one line; a name that is taken gets a number; none changes nothing."""
    name = " ".join(text.split())[:LONGEST_NAME]
    if not name:
        return view
    free = free_name(replace(view, layers=(*view.layers[:index], *view.layers[index + 1 :])), name)
    return change_layer(view, index, lambda layer: replace(layer, name=free))


def free_name(view: ViewState, name: str) -> str:
    """A name for one more layer, with a number where a layer has it."""
    taken, free, number = {layer.name for layer in view.layers}, name, 2
    while free in taken:
        free, number = f"{name}-{number}", number + 1
    return free


def add_layer(view: ViewState, gdf: int, name: str) -> ViewState:
    """An edit of its own on top of the others, at full strength, so that one sees what came."""
    layer = LayerState(gdf, free_name(view, name), strength=1.0)
    return replace(view, layers=(*view.layers, layer))


def remove_layer(view: ViewState, index: int) -> ViewState:
    """Without one layer; as it was where there is no such layer."""
    if not 0 <= index < len(view.layers):
        return view
    return replace(view, layers=(*view.layers[:index], *view.layers[index + 1 :]))


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
    return replace(view, layers=layers)


def with_overshoot(view: ViewState, on: bool) -> ViewState:
    """Sliders that go beyond 1, or that end there again; what stood beyond comes back to 1."""
    view = replace(view, overshoot=on)
    upper = largest_strength(view)
    return replace(
        view, layers=tuple(replace(layer, strength=min(layer.strength, upper)) for layer in view.layers)
    )


def toggle_details(view: ViewState, index: int) -> ViewState:
    """Show or hide the gains and the curve of the layer at `index`."""
    if not 0 <= index < len(view.layers):
        return view
    gdf = view.layers[index].gdf
    if gdf in view.unfolded:
        return replace(view, unfolded=tuple(g for g in view.unfolded if g != gdf))
    return replace(view, unfolded=(*view.unfolded, gdf))
