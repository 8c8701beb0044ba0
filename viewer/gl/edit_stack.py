"""A stack of layers at its present strengths, as shaders/include/edit_layers.glsl reads it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progdf.compose.layers import Layer

from .edit_bases import Floats, PackedEdits, TargetBases
from .layout import EDIT_LAYER, PLACES


def pack_stack(
    packed: PackedEdits, stack: Sequence[tuple[int, Layer]], weights_at: Sequence[int]
) -> tuple[NDArray[Any], Floats]:
    """The lists `edit_layers` and `edit_numbers`.

    Args:
        packed: the edits
        stack: index of the edit and the layer, the lowest first
        weights_at: where each layer's painted weights begin; −1 where it has none

    Returns:
        [L] of `EDIT_LAYER`, and the numbers it points to. [·,4] float32
    """
    layers = np.zeros(len(stack), EDIT_LAYER)
    lines: list[Floats] = []
    length = 0

    def put(some: Floats) -> int:
        nonlocal length
        begin, length = length, length + len(some)
        lines.append(some)
        return begin

    for i, (edit, layer) in enumerate(stack):
        entry: Any = layers[i]
        entry["places"], entry["weights"] = edit * len(packed.slots), weights_at[i]
        entry["covers"] = packed.covers[edit]
        entry["numbers"] = put(np.array([[layer.clamped_strength, 0.0, 0.0, 0.0]], np.float32))
        entry["targets"]["numbers"] = -1
        for target, bases in packed.edits[edit].items():
            if not any(layer.gain(name) for name in bases.attributes):
                continue
            numbers = put(_numbers(bases, packed.width(target), layer))
            entry["targets"][target] = (bases.full, bases.rest, bases.rank, numbers)
    return layers, np.concatenate([np.zeros((0, 4), np.float32), *lines])


def _numbers(bases: TargetBases, width: int, layer: Layer) -> Floats:
    """The gain, then the factors of every basis, `width` texels each. [1+(1+R)·width,4]"""
    lines = np.zeros((1 + (1 + bases.rank) * width, 4), np.float32)
    for name in bases.attributes:
        place = PLACES[name]
        columns = slice(place.component, place.component + place.components)
        own = layer.gdf.field.factors(name, layer.strength)[:, : width * place.components].numpy()
        own = own.reshape(-1, place.components)
        lines[0, columns] = layer.gain(name)
        lines[1 : 1 + len(own), columns] = own
    return lines
