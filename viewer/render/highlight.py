"""Colors over the splats: the selection and regions, painted weights from blue (none of the edit) to yellow;
and what is hidden.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from progdf.gdf.file import Gdf
from viewer.state import paint
from viewer.state.layers import is_visible
from viewer.state.selection import NOBODY, Color, unpack
from viewer.state.view_state import ViewState
from viewer.state.workspace import Pointed

SHARE = 0.75
"""Of a member's color that the ramp takes, so that the rest still tells its shape."""

THIN = 0.2
"""The same of a member without the edit, where the result is what one looks at; 0 where it has all of it."""

RAMP = ((0.0, 0x2B3FA8), (0.25, 0x7A35B5), (0.5, 0xC8407A), (0.75, 0xF08A3C), (1.0, 0xF9E558))
"""Weights and their colors, rgb; lightness rises with the weight, so that also gray tells them apart."""

SELECTED: Color = (1.0, 0.72, 0.05)
TINT = 140
TRACE = 45
HIDDEN = 255
"""Shares of 255 that a tint takes, and that of a selection while no tool selects; and the one that means that
a Gaussian is not drawn at all."""

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Highlight:
    """What to show over the scene."""

    # an edit whose members show their weights, as `LayerState.gdf` counts; None for none
    gdf: int | None = None
    paint: str = paint.FULL  # its weights, as `paint.encode` writes them
    thin: bool = False  # only a tint over what has less than all of the edit
    # packed masks, their colors and shares of 255, later ones over earlier ones
    tinted: tuple[tuple[bytes, Color, int], ...] = ()
    region: int | None = None  # an edit whose members are tinted as one, or None
    hidden: bytes = NOBODY  # packed mask of what is not drawn


def requested_highlight(
    view: ViewState,
    focus: int | None,
    pointed: Pointed | None = None,
    looks: bool = False,
) -> Highlight | None:
    """What `view` shows: what the panel is asked about, weights while the brush is out, or the selection,
    with the regions that are shown.

    Not in a comparison, and no weights of a hidden layer. A selection is a trace while no tool selects, and
    none where the panel is hidden or one looks at the edits. What is hidden is the engine's to know.

    Args:
        focus: the focused layer, an index into `view.layers`, or None
        pointed: what the mouse rests on in the panel
        looks: edits are being moved or made, and are what one looks at
    """
    if view.compare.mode != "off":
        return None
    state, kind, index = view.selection, *(pointed or ("", 0))
    if kind == "layer" and index < len(view.layers):
        return Highlight(region=view.layers[index].gdf)
    if view.brush.active:
        layer = None if focus is None or focus >= len(view.layers) else view.layers[focus]
        if layer is None or not is_visible(view, layer):
            return None
        return Highlight(layer.gdf, layer.paint, thin=not view.brush.weights)
    tinted = [
        (region.members, region.color, TINT)
        for i, region in enumerate(state.regions)
        if region.visible or (kind, index) == ("region", i)
    ]
    strong = bool(view.select.tool) or kind == "selection"
    if state.count and (strong or (view.panel and not looks)):
        tinted.append((state.members, SELECTED, TINT if strong else TRACE))
    return Highlight(tinted=tuple(tinted)) if tinted else None


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


def highlight_colors(highlight: Highlight, gdfs: Sequence[Gdf], total: int) -> Bytes:
    """What is drawn over each Gaussian of the scene: rgb and its share, 0..255, or `HIDDEN`. [N,4]

    Args:
        gdfs: the edits that `highlight` counts
        total: N

    Raises:
        ProgdfError: see `paint.decode` and `unpack`.
    """
    colors = np.zeros((total, 4), np.uint8)
    hidden = unpack(highlight.hidden, total)
    for packed, color, share in highlight.tinted:
        mask = unpack(packed, total)
        if share != TRACE or not hidden.any() or not (mask | hidden).all():  # isolated, it is all one sees
            colors[mask] = _tint(color, share)
    if highlight.region is not None:
        colors[gdfs[highlight.region].region.members.numpy()] = _tint(SELECTED, TINT)
    if highlight.gdf is not None:
        gdf = gdfs[highlight.gdf]
        members = gdf.region.members.numpy()
        decoded = paint.decode(highlight.paint, len(members), gdf.from_others)
        weights = np.ones(len(members), np.float32) if decoded is None else decoded.numpy()
        colors[members, :3] = ramp_colors(weights)
        shares = THIN * (1.0 - weights) if highlight.thin else np.full_like(weights, SHARE)
        colors[members, 3] = np.round(255.0 * shares)
    colors[hidden, 3] = HIDDEN
    return colors


def _tint(color: Color, share: int) -> Bytes:
    return np.array([*(round(255 * channel) for channel in color), share], np.uint8)
