"""Layers as people name them after `progdf view`, `render` and `export`: strengths, gains, who is alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from progdf.checkpoint import Gdf
from progdf.errors import ProgdfError

from . import stack
from .arguments import known_edit, layers_of
from .state import LayerState


def stack_of(
    gdfs: Sequence[Gdf],
    settings: Sequence[str],
    gains: Sequence[str] = (),
    solo: Sequence[str] = (),
    overshoot: bool = False,
) -> tuple[LayerState, ...]:
    """One layer per edit.

    Args:
        gdfs: the edits, the lowest layer first
        settings: `NAME=S`, the strengths
        gains: `NAME:KIND=G`, with geometry, opacity or colour for KIND
        solo: names of the edits that alone are shown
        overshoot: whether strengths go to `stack.OVERSHOOT`

    Raises:
        ProgdfError: there is no such edit or kind, or a number is outside its range.
    """
    layers = {layer.name: layer for layer in layers_of(gdfs, settings, stack.OVERSHOOT if overshoot else 1.0)}
    for text in gains:
        name, kind, gain = _gain(text, gdfs)
        layers[name] = stack.dialled(layers[name], kind, gain)
    for name in solo:
        known_edit(name, gdfs, "--solo")
        layers[name] = replace(layers[name], solo=True)
    return tuple(layers.values())


def _gain(text: str, gdfs: Sequence[Gdf]) -> tuple[str, str, float]:
    """Name, kind and number of `NAME:KIND=G`."""
    kinds = stack.DIALS[1:]
    right = f"write NAME:KIND=G, for example {gdfs[0].name if gdfs else 'NAME'}:colour=0.5"
    left, equals, number = text.rpartition("=")
    name, colon, kind = left.rpartition(":")
    if not equals or not colon or not name:
        raise ProgdfError(f"--gain {text} is no gain; {right}")
    known_edit(name, gdfs, "--gain")
    kind = {"color": "colour"}.get(kind, kind)
    if kind not in kinds:
        raise ProgdfError(f"--gain {text}: there is no gain '{kind}'; the gains are {', '.join(kinds)}")
    try:
        gain = float(number)
    except ValueError:
        gain = math.nan
    if not 0.0 <= gain <= 1.0:
        raise ProgdfError(f"--gain {text}: the gain '{number}' is not a number from 0 to 1")
    return name, kind, gain
