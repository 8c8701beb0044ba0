"""Order of painted layers: where the paint of two layers overlaps, the upper layer covers the lower one.

Splats are drawn in the order of their centers. Discs of two layers on one surface would therefore cut through
each other, whatever the order of the layers. For a layer of paint above another one:

- Its rows rise above the lower layer's rows that they overlap, by ten thicknesses of a disc, which is about
  one pixel of the painted picture. They rise along the ray of this picture, in which nothing shifts.
- Lower rows that it covers completely fade as its strength s approaches 1, by the factor 1 − c s⁸ with their
  coverage c. Otherwise a row with a nearer center would cover the upper layer when seen from the side. In the
  painted picture this changes a color by at most 4 % of the difference between both layers.
- Rows at its rim repeat the colors beside the paint. They take the colors that are there now: those of the
  lower paint, and those of recolored Gaussians below.

`compose_layers` and `Composer` both call `find_paint`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from progdf.gaussians import Gaussians
from progdf.gdf.anchors import NOTHING
from progdf.gdf.file import Gdf
from progdf.system.equality import equal_fields

from .layers import Layer
from .paint_sheets import Overlap, added_count, find_overlap, find_sheet

ARRANGED = ("means", "logit_opacities", "sh0")
"""Attributes that the order of painted layers changes."""

MIN_OPACITY = 1e-30
"""Opacity of a row that is covered completely, which keeps its logit finite."""

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class PaintRows:
    """Rows of painted layers of an extended scene that depend on other layers."""

    __eq__ = equal_fields

    rows: Rows  # rows of the scene, ascending. [A]
    edits: Rows  # index of the edit that adds each row. [A]
    members: Rows  # its position among the members of this edit. [A]
    rim: Floats  # see `Anchors.rim`. [A]
    outward: Floats  # unit vectors from the surface towards the painted picture's camera. [A,3]
    pairs: Mapping[tuple[int, int], Overlap]  # by the indices of the upper and the lower edit
    spans: Mapping[int, slice]  # by edit: its rows, which are adjacent

    def __len__(self) -> int:
        return len(self.rows)

    def partners(self, edit: int) -> frozenset[int]:
        """Return the edits whose rows may change with an edit, itself included."""
        found = {edit}
        while True:
            linked = {upper for upper, lower in self.pairs if lower in found} | {
                lower for upper, lower in self.pairs if upper in found
            }
            if linked <= found:
                return frozenset(found)
            found |= linked


@dataclass(frozen=True)
class PaintLayer:
    """Active layer of paint in a stack."""

    __eq__ = equal_fields

    edit: int  # index of the edit
    strength: float  # strength times the gain of opacity, 0 to 1
    weights: NDArray[np.float32] | None  # weights of the edit's members; None if all are 1. [M]


def find_paint(scene: Gaussians, gdfs: Sequence[Gdf]) -> PaintRows | None:
    """Return the rows of paint that depend on other layers; None if there are none.

    Args:
        scene: the extended scene
        gdfs: its edits
    """
    paints = [edit for edit, gdf in enumerate(gdfs) if gdf.paints]
    if not paints:
        return None
    counts = {edit: added_count(gdfs[edit]) for edit in paints}
    sheets = {}
    for edit in paints if len(paints) > 1 else ():
        sheets[edit] = find_sheet(scene, gdfs[edit])
    pairs = {}
    used = {edit: np.zeros(counts[edit], bool) for edit in paints}
    for upper, lower in permutations(paints, 2):
        found = find_overlap(sheets[upper], sheets[lower])
        if found is not None:
            pairs[upper, lower] = found
            used[upper][found.over] = True
            used[upper][found.above] = True
            used[lower][found.under] = True
            used[lower][found.hidden] = True
    rims = {edit: _rim(gdfs[edit]) for edit in paints}
    parts = []
    spans = {}
    index = {}
    first = 0
    for edit in sorted(paints, key=lambda edit: int(gdfs[edit].region.members[-1])):
        chosen = np.flatnonzero(used[edit] | (rims[edit] > 0))
        index[edit] = np.full(counts[edit], -1)
        index[edit][chosen] = first + np.arange(len(chosen))
        spans[edit] = slice(first, first + len(chosen))
        first += len(chosen)
        members = len(gdfs[edit].region.members) - counts[edit] + chosen
        outward = sheets[edit].outward[chosen] if edit in sheets else np.zeros((len(chosen), 3))
        added = gdfs[edit].region.members.numpy()[members]
        parts.append((added, np.full(len(chosen), edit), members, rims[edit][chosen], outward))
    if not first:
        return None
    rows, edits, members, rim, outward = (np.concatenate(column) for column in zip(*parts, strict=True))
    placed = {
        (upper, lower): replace(
            pair,
            over=index[upper][pair.over],
            under=index[lower][pair.under],
            hidden=index[lower][pair.hidden],
            above=index[upper][pair.above],
        )
        for (upper, lower), pair in pairs.items()
    }
    return PaintRows(rows, edits, members, rim, outward, placed, spans)


def tints_rim(gdf: Gdf) -> bool:
    """Return whether an edit changes colors below the rims of other edits' paint.

    A grade of the whole scene does not, as it changes the colors of the paint's own rows.
    """
    pushes = NOTHING if gdf.anchors is None else gdf.anchors.pushes
    return "sh0" in gdf.field.attributes and "color" not in pushes and not gdf.from_others


def paint_layers(stack: Sequence[tuple[int, Layer]]) -> list[PaintLayer]:
    """Return the active layers of paint, lowest first.

    Args:
        stack: active layers, lowest first, with the index of their edit
    """
    layers = []
    for edit, layer in stack:
        if layer.gdf.paints:
            weights = None if layer.weights is None else layer.weights.float().numpy()
            gain = min(abs(layer.gains.opacity), 1.0)
            layers.append(PaintLayer(edit, layer.clamped_strength * gain, weights))
    return layers


def _rim(gdf: Gdf) -> Floats:
    """Return the shares of a rim in the colors of the rows that an edit adds. [B]"""
    if gdf.anchors is None or gdf.anchors.rim is None:
        return np.zeros(added_count(gdf))
    return gdf.anchors.rim.double().numpy()


def arrange(
    paint: PaintRows,
    layers: Sequence[PaintLayer],
    tints: Floats,
    values: Mapping[str, NDArray[np.float32]],
) -> None:
    """Move, fade and recolor the rows of paint by the order of the layers.

    `progdf.compose.paint_order.PaintOrder` computes the same values for the rows that a slider changes.

    Args:
        paint: see `find_paint`
        layers: active layers of paint, lowest first
        tints: change of the SH coefficients of degree 0 that other layers make to the anchors of the rows.
            [A,3]
        values: attributes of all rows without the order of layers; updated in place. [N,…]
    """
    opacity = opacities(paint, layers)
    order = paint_order(paint, layers)
    risen, kept = _heights(paint, order, opacity)
    colors = values["sh0"].reshape(-1, 3)
    own = colors[paint.rows].astype(np.float64)
    mixed = _rim_colors(paint, order, opacity, own, own + tints)
    active = opacity != 0.0
    recolored = active & (mixed != own).any(axis=1)
    colors[paint.rows[recolored]] = mixed[recolored]
    higher = active & (risen > 0.0)
    step = risen[higher, None] * paint.outward[higher]
    values["means"][paint.rows[higher]] += step.astype(np.float32)
    fading = active & (kept < 1.0)
    logits = values["logit_opacities"].reshape(-1)
    visible = kept[fading] / (1.0 + np.exp(-logits[paint.rows[fading]].astype(np.float64)))
    visible = np.maximum(visible, MIN_OPACITY)
    logits[paint.rows[fading]] = np.log(visible) - np.log1p(-visible)


def opacities(paint: PaintRows, layers: Sequence[PaintLayer]) -> Floats:
    """Return the strength at which each row of paint shows, 0 to 1. [A]

    Of two layers of one edit, the stronger one shows, see `Anchors.pushes`.
    """
    opacity = np.zeros(len(paint))
    for layer in layers:
        if layer.edit not in paint.spans:
            continue
        mine = paint.spans[layer.edit]
        visible: float | Floats = layer.strength
        if layer.weights is not None:
            visible = layer.strength * layer.weights[paint.members[mine]].astype(np.float64)
        opacity[mine] = np.maximum(opacity[mine], visible)
    return opacity


def paint_order(paint: PaintRows, layers: Sequence[PaintLayer]) -> tuple[int, ...]:
    """Return the edits with rows of paint, in the order of their uppermost layers, lowest first."""
    upper_first = dict.fromkeys(layer.edit for layer in reversed(layers) if layer.edit in paint.spans)
    return tuple(upper_first)[::-1]


def overlaps_below(paint: PaintRows, order: Sequence[int], edit: int) -> list[Overlap]:
    """Return the overlaps of an edit with the edits below it, lowest first."""
    lower = order[: order.index(edit)]
    return [paint.pairs[edit, each] for each in lower if (edit, each) in paint.pairs]


def _heights(paint: PaintRows, order: Sequence[int], opacity: Floats) -> tuple[Floats, Floats]:
    """Return the distance by which each row rises, and the factor of its opacity. [A], [A]"""
    risen = np.zeros(len(paint))
    kept = np.ones(len(paint))
    for edit in order:
        for pair in overlaps_below(paint, order, edit):
            risen[pair.over] = np.maximum(risen[pair.over], pair.rise + risen[pair.under])
            kept[pair.hidden] *= 1.0 - pair.share * _eighth_power(opacity[pair.above])
    return risen, kept


def _rim_colors(
    paint: PaintRows, order: Sequence[int], opacity: Floats, own: Floats, beside: Floats
) -> Floats:
    """Return the colors of the rows, of which rims take those beside the paint.

    Args:
        paint: see `find_paint`
        order: edits, lowest first
        opacity: see `opacities`. [A]
        own: colors without the order of layers. [A,3]
        beside: colors of the surface beside the paint; overwritten. [A,3]

    Returns:
        [A,3]
    """
    color = own.copy()
    rim = paint.rim[:, None]
    for edit in order:
        for pair in overlaps_below(paint, order, edit):
            share = (pair.cover * opacity[pair.under])[:, None]
            beside[pair.over] += share * (color[pair.under] - beside[pair.over])
        mine = paint.spans[edit]
        color[mine] += rim[mine] * (beside[mine] - own[mine])
    return color


def _eighth_power(strength: Floats) -> Floats:
    """Return the power by which covered rows fade, as in the module docstring."""
    square = strength * strength
    fourth = square * square
    return fourth * fourth
