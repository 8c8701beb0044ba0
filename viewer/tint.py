"""Painted weights as colours on the splats: a ramp from blue (none of the edit) to yellow (all of it)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import paint, stack
from .state import ViewState

SHARE = 0.75
"""Of a member's colour that the ramp takes, so that the rest still tells its shape."""

RAMP = ((0.0, 0x2B3FA8), (0.25, 0x7A35B5), (0.5, 0xC8407A), (0.75, 0xF08A3C), (1.0, 0xF9E558))
"""Weights and their colours, rgb; lightness rises with the weight, so that also grey tells them apart."""

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Tint:
    """Which weights to show: those of the edit `gdf`, painted as `paint.encoded` writes it."""

    gdf: int
    paint: str


def wanted(view: ViewState, focus: int | None) -> Tint | None:
    """The weights that `view` shows while the brush is out: not of a hidden layer, not in a comparison.

    Args:
        focus: the focused layer, an index into `view.layers`, or None
    """
    asked = view.brush.active and view.brush.weights and view.compare.mode == "off"
    if not asked or focus is None or focus >= len(view.layers):
        return None
    layer = view.layers[focus]
    return Tint(layer.gdf, layer.paint) if layer in stack.shown(view) else None


def colours(weights: NDArray[np.float32]) -> Bytes:
    """The ramp at weights 0..1: rgb, 0..255. [M] -> [M,3]"""
    at = [weight for weight, _ in RAMP]
    channels = zip(*(rgba(rgb) for _, rgb in RAMP), strict=True)
    mixed = [np.round(255.0 * np.interp(weights, at, channel)) for channel in channels]
    return np.stack(mixed[:3], axis=-1).astype(np.uint8)


def rgba(colour: int) -> tuple[float, float, float, float]:
    """0xRRGGBB as numbers 0..1, opaque."""
    red, green, blue = (colour >> shift & 255 for shift in (16, 8, 0))
    return red / 255, green / 255, blue / 255, 1.0


def tints(tint: Tint, members: int) -> Bytes:
    """What is drawn over each member: rgb and its share, 0..255. [M,4]

    Raises:
        ProgdfError: see `paint.decoded`.
    """
    found = paint.decoded(tint.paint, members)
    weights = np.ones(members, np.float32) if found is None else found.numpy()
    share = np.full((members, 1), round(255 * SHARE), np.uint8)
    return np.concatenate([colours(weights), share], axis=1)
