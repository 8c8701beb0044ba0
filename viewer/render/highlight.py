"""Colors over the splats: painted weights, from blue (none of the edit) to yellow, or what layers share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from progdf.gdf.file import Gdf
from viewer.state import layers as stack
from viewer.state import paint
from viewer.state.view_state import ViewState

SHARE = 0.75
"""Of a member's color that the ramp takes, so that the rest still tells its shape."""

RAMP = ((0.0, 0x2B3FA8), (0.25, 0x7A35B5), (0.5, 0xC8407A), (0.75, 0xF08A3C), (1.0, 0xF9E558))
"""Weights and their colors, rgb; lightness rises with the weight, so that also gray tells them apart."""

SHARED = 0xFF3FA0
"""The color of what is in several layers."""

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Highlight:
    """What to show of the members of one edit.

    Args:
        gdf: the edit, as `LayerState.gdf` counts
        paint: its weights, as `paint.encode` writes them
        others: edits of which to show, in place of weights, the members that they share with this one
    """

    gdf: int
    paint: str = paint.FULL
    others: tuple[int, ...] = ()


def requested_highlight(view: ViewState, focus: int | None, overlap: int | None = None) -> Highlight | None:
    """What `view` shows: an overlap where one is asked for, or weights while the brush is out.

    Not in a comparison, and no weights of a hidden layer.

    Args:
        focus: the focused layer, an index into `view.layers`, or None
        overlap: the layer of which to show what it shares with the others, or None
    """
    if overlap is not None and overlap < len(view.layers) and view.compare.mode == "off":
        gdf = view.layers[overlap].gdf
        return Highlight(gdf, others=tuple(layer.gdf for layer in view.layers if layer.gdf != gdf))
    asked = view.brush.active and view.brush.weights and view.compare.mode == "off"
    if not asked or focus is None or focus >= len(view.layers):
        return None
    layer = view.layers[focus]
    return Highlight(layer.gdf, layer.paint) if layer in stack.visible_layers(view) else None


def ramp_colors(weights: NDArray[np.float32]) -> Bytes:
    """The ramp at weights 0..1: rgb, 0..255. [M] -> [M,3]"""
    at = [weight for weight, _ in RAMP]
    channels = zip(*(rgba(rgb) for _, rgb in RAMP), strict=True)
    mixed = [np.round(255.0 * np.interp(weights, at, channel)) for channel in channels]
    return np.stack(mixed[:3], axis=-1).astype(np.uint8)


def rgba(color: int) -> tuple[float, float, float, float]:
    """0xRRGGBB as numbers 0..1, opaque."""
    red, green, blue = (color >> shift & 255 for shift in (16, 8, 0))
    return red / 255, green / 255, blue / 255, 1.0


def highlight_colors(highlight: Highlight, gdfs: Sequence[Gdf]) -> Bytes:
    """What is drawn over each member: rgb and its share, 0..255. [M,4]

    Args:
        gdfs: the edits that `highlight` counts

    Raises:
        ProgdfError: see `paint.decode`.
    """
    members = gdfs[highlight.gdf].region.members
    shares = np.full(len(members), round(255 * SHARE), np.uint8)
    if highlight.others:
        others = np.concatenate([gdfs[i].region.members.numpy() for i in highlight.others])
        shares[~np.isin(members.numpy(), others)] = 0
        over = np.tile(np.round(255.0 * np.array(rgba(SHARED)[:3])), (len(members), 1)).astype(np.uint8)
    else:
        found = paint.decode(highlight.paint, len(members))
        over = ramp_colors(np.ones(len(members), np.float32) if found is None else found.numpy())
    return np.concatenate([over, shares[:, None]], axis=1)
