"""Layers as people name them after `progdf view`, `render` and `export`: strengths, gains, who is alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from progdf.errors import ProgdfError
from progdf.gdf.file import Gdf
from progdf.io.npy import open_npy
from viewer.state.layers import SLIDERS, with_slider_value
from viewer.state.paint import encode
from viewer.state.view_state import OVERSHOOT, LayerState

from .arguments import known_edit, layers_of


def stack_of(
    gdfs: Sequence[Gdf],
    settings: Sequence[str],
    gains: Sequence[str] = (),
    solo: Sequence[str] = (),
    overshoot: bool = False,
    paint: Sequence[str] = (),
    unset: float = 0.0,
) -> tuple[LayerState, ...]:
    """One layer per edit.

    Args:
        gdfs: the edits, the lowest layer first
        settings: `NAME=S`, the strengths
        gains: `NAME:KIND=G`, with geometry, opacity or color for KIND
        solo: names of the edits that alone are shown
        overshoot: whether strengths go to `OVERSHOOT`
        paint: `NAME=WEIGHTS.npy`, a weight 0..1 per member, or per Gaussian of the scene
        unset: the strength of the edits that no setting names

    Raises:
        ProgdfError: there is no such edit or kind, or a number is outside its range.
    """
    most = OVERSHOOT if overshoot else 1.0
    layers = {layer.name: layer for layer in layers_of(gdfs, settings, most, unset)}
    for text in gains:
        name, kind, gain = _gain(text, gdfs)
        layers[name] = with_slider_value(layers[name], kind, gain)
    for name in solo:
        known_edit(name, gdfs, "--solo")
        layers[name] = replace(layers[name], solo=True)
    for text in paint:
        name, equals, file = text.partition("=")
        if not equals or not file:
            raise ProgdfError(f"--paint {text} has no NAME=FILE; write NAME=WEIGHTS.npy")
        known_edit(name, gdfs, "--paint")
        gdf = next(gdf for gdf in gdfs if gdf.name == name)
        layers[name] = replace(layers[name], paint=encode(_weights(Path(file), gdf)))
    return tuple(layers.values())


def _weights(path: Path, gdf: Gdf) -> NDArray[np.float32]:
    """Weights of the members, from a file that has them or those of the whole scene. [M]"""
    try:
        found = open_npy(path, "weights")
    except ProgdfError as error:
        raise ProgdfError(f"--paint: {error}") from None
    members, count = gdf.region.members.numpy(), gdf.scene.count
    if found.shape not in ((len(members),), (count,)):
        raise ProgdfError(
            f"--paint: {path} has shape {list(found.shape)}, expected [{len(members)}] or [{count}]"
        )
    if not ((found >= 0) & (found <= 1)).all():
        raise ProgdfError(f"--paint: {path} has a number outside 0 to 1")
    weights: NDArray[np.float32] = (found if len(found) == len(members) else found[members]).astype(
        np.float32
    )
    return weights


def _gain(text: str, gdfs: Sequence[Gdf]) -> tuple[str, str, float]:
    """Name, kind and number of `NAME:KIND=G`."""
    kinds = SLIDERS[1:]
    right = f"write NAME:KIND=G, for example {gdfs[0].name if gdfs else 'NAME'}:color=0.5"
    left, equals, number = text.rpartition("=")
    name, colon, kind = left.rpartition(":")
    if not equals or not colon or not name:
        raise ProgdfError(f"--gain {text} is not a gain; {right}")
    known_edit(name, gdfs, "--gain")
    if kind not in kinds:
        raise ProgdfError(f"--gain {text}: there is no gain '{kind}'; the gains are {', '.join(kinds)}")
    try:
        gain = float(number)
    except ValueError:
        gain = math.nan
    if not 0.0 <= gain <= 1.0:
        raise ProgdfError(f"--gain {text}: the gain '{number}' is not a number from 0 to 1")
    return name, kind, gain
