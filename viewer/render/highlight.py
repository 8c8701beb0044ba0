"""Highlight colors over the splats: selection, regions, painted weights (blue 0 to yellow 1), hiding."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from progdf.compose import layer_paint
from progdf.gdf.file import Gdf
from viewer.state.layers import is_visible
from viewer.state.selection import EMPTY_MASK, Color, unpack
from viewer.state.transient import PullInfluence
from viewer.state.view_state import ViewState
from viewer.state.workspace import Pointed

RAMP_SHARE = 0.75
"""Share of the color ramp in a member's color. The remainder keeps the shading recognizable."""

THIN_TINT_SHARE = 0.2
"""Share of the thin tint at weight 0, falling to 0 at weight 1, so that the result stays visible."""

RAMP = ((0.0, 0x2B3FA8), (0.25, 0x7A35B5), (0.5, 0xC8407A), (0.75, 0xF08A3C), (1.0, 0xF9E558))
"""Color ramp: weights and 0xRRGGBB. Lightness rises with the weight, so it also reads in gray."""

SELECTED: Color = (1.0, 0.72, 0.05)  # tint of the selection
GUESSED: Color = (0.25, 0.55, 1.0)  # tint of the selected Gaussians that no view with a scribble shows
TINT = 140  # share of a tint, of 255
FAINT_TINT = 45  # share of the selection's tint while no selection tool is active, of 255
PULLED: Color = (1.0, 0.38, 0.08)  # tint of the Gaussians that a pull can move
PULLED_TINT = 110  # share of this tint where the pull has its full influence, of 255
HIDDEN = 255  # share that marks a Gaussian as not drawn

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Highlight:
    """Highlight drawn over the scene."""

    # edit whose members are colored by weight (a `LayerState.gdf`), or None
    gdf: int | None = None
    paint: str = layer_paint.FULL  # its weights, from `layer_paint.encode`
    thin: bool = False  # only a thin tint over weights below 1
    # packed masks, their colors and shares of 255; later ones cover earlier ones
    tinted: tuple[tuple[bytes, Color, int], ...] = ()
    region: int | None = None  # edit whose members are all tinted (a `LayerState.gdf`), or None
    hidden: bytes = EMPTY_MASK  # packed mask of hidden Gaussians
    pulled: PullInfluence | None = None  # Gaussians that a handle moves, tinted by its influence


def requested_highlight(
    view: ViewState,
    focus: int | None,
    pointed: Pointed | None = None,
    looks: bool = False,
    pulled: PullInfluence | None = None,
    guessed: bytes = EMPTY_MASK,
    graded: bool = False,
) -> Highlight | None:
    """Return the highlight for a view, or None.

    It shows the layer under the mouse in the panel, else painted weights while the brush is active, else the
    selection and the visible regions. Comparisons have no highlight, and invisible layers show no weights.

    The selection is faint while no selection tool is active. It is invisible while the panel is hidden,
    edits are being changed, or the form's grade is in the picture. The engine adds hidden Gaussians itself.

    Args:
        view: the state
        focus: index of the focused layer in `view.layers`, or None
        pointed: panel item under the mouse
        looks: edits are being changed, so the selection is not shown
        pulled: Gaussians that a handle moves right now, or None
        guessed: selected Gaussians that no view with a scribble shows, packed
        graded: the form's grade is in the picture, so that a tint would falsify its colors
    """
    if view.compare.mode != "off":
        return None
    if pulled is not None:
        return Highlight(pulled=pulled)
    state = view.selection
    kind, index = pointed or ("", 0)
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
    strong = kind == "selection" or (bool(view.select.tool) and not graded)
    faint = view.panel and not (looks or graded)
    if state.count and (strong or faint):
        tinted.append((state.members, SELECTED, TINT if strong else FAINT_TINT))
        if guessed != EMPTY_MASK:
            tinted.append((guessed, GUESSED, TINT))
    return Highlight(tinted=tuple(tinted)) if tinted else None


def ramp_colors(weights: NDArray[np.float32]) -> Bytes:
    """Return the ramp colors of weights (0 to 1) as rgb, 0 to 255. [M] -> [M,3]"""
    at = [weight for weight, _ in RAMP]
    channels = zip(*(rgba(rgb) for _, rgb in RAMP), strict=True)
    mixed = [np.round(255.0 * np.interp(weights, at, channel)) for channel in channels]
    return np.stack(mixed[:3], axis=-1).astype(np.uint8)


def rgba(color: int) -> tuple[float, float, float, float]:
    """Convert 0xRRGGBB to an opaque color with channels from 0 to 1."""
    red, green, blue = (color >> shift & 255 for shift in (16, 8, 0))
    return red / 255, green / 255, blue / 255, 1.0


def highlight_colors(highlight: Highlight, gdfs: Sequence[Gdf], total: int) -> Bytes:
    """Compute the highlight color of each Gaussian: rgb and its share, 0 to 255, or `HIDDEN`. [N,4]

    Args:
        highlight: the highlight
        gdfs: the edits that its indices refer to
        total: N

    Raises:
        ProgdfError: see `layer_paint.decode` and `unpack`.
    """
    colors = np.zeros((total, 4), np.uint8)
    hidden = unpack(highlight.hidden, total)
    for packed, color, share in highlight.tinted:
        mask = unpack(packed, total)
        if (
            share != FAINT_TINT or not hidden.any() or not (mask | hidden).all()
        ):  # an isolated selection needs no faint tint
            colors[mask] = _tint(color, share)
    if highlight.pulled is not None:
        tints = np.round(PULLED_TINT * highlight.pulled.shares.clip(0.0, 1.0)).astype(np.uint8)
        moved = highlight.pulled.rows[tints > 0]
        colors[moved, :3] = _tint(PULLED, 0)[:3]
        colors[moved, 3] = tints[tints > 0]
    if highlight.region is not None:
        colors[gdfs[highlight.region].region.members.numpy()] = _tint(SELECTED, TINT)
    if highlight.gdf is not None:
        gdf = gdfs[highlight.gdf]
        members = gdf.region.members.numpy()
        decoded = layer_paint.decode(highlight.paint, len(members), gdf.from_others)
        weights = np.ones(len(members), np.float32) if decoded is None else decoded.numpy()
        colors[members, :3] = ramp_colors(weights)
        shares = THIN_TINT_SHARE * (1.0 - weights) if highlight.thin else np.full_like(weights, RAMP_SHARE)
        colors[members, 3] = np.round(255.0 * shares)
    colors[hidden, 3] = HIDDEN
    return colors


def _tint(color: Color, share: int) -> Bytes:
    return np.array([*(round(255 * channel) for channel in color), share], np.uint8)
