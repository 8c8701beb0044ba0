"""Order of painted layers while a slider is dragged, see `progdf.compose.overlap`."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.system.equality import equal_fields

from .follow import COLORS, changes_shape, find_rims
from .layers import Layer
from .overlap import ARRANGED, PaintRows, opacities, overlaps_below, paint_layers, paint_order
from .overlap_kernel import (
    add_tints,
    color_rims,
    copy_colors,
    copy_rows,
    cover_rims,
    fade_rows,
    raise_rows,
    rest_rims,
    restore_centers,
    write_centers,
    write_colors,
    write_logits,
)
from .paint_sheets import Overlap
from .states import Known, MakeComposer, States

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class _RimOverlap:
    """Part of an `Overlap` whose upper rows are rims; the fields are as there."""

    __eq__ = equal_fields

    over: Rows  # [R]
    under: Rows  # [R]
    cover: Doubles  # [R]


class PaintOrder:
    """Rows of painted layers that depend on other layers, in their order; fast version of `arrange`.

    It stores the rows as they are without the order of layers. The composer therefore writes a row only if
    the row's own edit changes.

    Args:
        scene: the extended scene
        gdfs: its edits
        paint: see `find_paint`
        known: values of the edits in the scene
        make: constructor of the composer of the states
    """

    def __init__(
        self,
        scene: Gaussians,
        gdfs: Sequence[Gdf],
        paint: PaintRows,
        known: Known,
        make: MakeComposer,
    ) -> None:
        self.paint = paint
        self._painted = frozenset(np.unique(paint.edits).tolist())
        self._shaping = frozenset(edit for edit, gdf in enumerate(gdfs) if changes_shape(gdf))
        # the rows without the order of layers. [A,3], [A,1], [A,3]
        rows = torch.from_numpy(paint.rows)
        self._means: Floats = scene.means[rows].float().numpy()
        self._logits: Floats = scene.logit_opacities[rows, None].float().numpy()
        self._colors: Floats = scene.sh0[rows].float().flatten(1).numpy()
        # their order in the last picture, see `arrange`
        self._risen = np.zeros(len(paint))
        self._kept = np.ones(len(paint))
        self._mixed = self._colors.astype(np.float64)  # colors of rims; those of other rows are their own
        self._beside = np.zeros((len(paint), 3))
        self._tints = np.zeros((len(paint), 3))
        self._rims = np.flatnonzero(paint.rim > 0)
        self._edit_rims = {edit: self._rims[paint.edits[self._rims] == edit] for edit in paint.spans}
        self._rim_overlaps = {id(pair): _rim_overlap(pair, paint.rim) for pair in paint.pairs.values()}
        found = find_rims(gdfs, len(scene), paint)
        self._states = None
        if found is not None:
            self._states = States(scene, gdfs, found, known, COLORS, make)
            self._tinted = np.searchsorted(paint.rows, found.rows)  # indices of the rows that have states

    def names(self, changed: Collection[int], rows: Rows) -> Collection[str]:
        """Return the attributes of rows of paint to write when some edits change."""
        if not len(rows):
            return ()
        return ARRANGED if self.paint.pairs and not self._shaping.isdisjoint(changed) else ("sh0",)

    def partners(self, changed: frozenset[int]) -> frozenset[int]:
        """Return the changed edits, and the painted ones whose place in the order depends on them."""
        return changed.union(*(self.paint.partners(edit) for edit in changed & self._painted))

    def dependents(self, edit: int) -> Rows:
        """Return the rows of the scene, sorted, that may change with an edit besides its members."""
        chosen = []
        if edit in self._painted:
            partners = list(self.paint.partners(edit) - {edit})
            chosen.append(self.paint.rows[np.isin(self.paint.edits, partners)])
        if self._states is not None:
            chosen.append(self._with_upper(self._states.followers.dependents(edit)))
        return np.unique(np.concatenate(chosen)) if chosen else np.zeros(0, np.int64)

    def _with_upper(self, rows: Rows) -> Rows:
        """Return rows of paint, and the rows above them, whose rims take their colors."""
        below = np.isin(self.paint.rows, rows)
        count = -1
        while count < below.sum():
            count = int(below.sum())
            for pair in self.paint.pairs.values():
                below[pair.over[below[pair.under]]] = True
        return self.paint.rows[below]

    def release(self, means: Floats, written: Rows) -> None:
        """Write centers as they are without the order of layers, ahead of the update by the composer.

        Args:
            means: centers of the composed scene, updated in place. [N,3]
            written: indices of the rows that the composer will write. [K]
        """
        restore_centers(means, self.paint.rows, self._means, self._risen, written)

    def arrange(
        self,
        values: Mapping[str, Floats],
        stack: Sequence[tuple[int, Layer]],
        blend: str,
        index: tuple[Rows, Rows],
        names: tuple[Collection[str], Collection[str]],
    ) -> float:
        """Put rows of paint into the order of layers; return the largest change of a row's height.

        Args:
            values: attributes of the composed scene; updated in place. [N,c] each
            stack: active layers with the index of their edit, lowest first
            blend: one of `BLENDS`
            index: indices of the rows that the composer has written [K], and of all rows that may change [L];
                see `PaintRows`
            names: attributes that the composer has written, and those that may change
        """
        written, rows = index
        self._read(values, written, names[0])
        if self._states is not None and len(self._states.update(stack, blend)):
            self._measure_tints(self._states)
        layers = paint_layers(stack)
        opacity = opacities(self.paint, layers)
        order = paint_order(self.paint, layers)
        self._mix_rims(order, opacity)
        at = self.paint.rows
        write_colors(values["sh0"], at, self._rims, self._colors, self._mixed, opacity)
        if "means" not in names[1]:
            return 0.0
        risen = np.zeros(len(at))
        kept = np.ones(len(at))
        for edit in order:
            for pair in overlaps_below(self.paint, order, edit):
                raise_rows(risen, pair.over, pair.under, pair.rise)
                fade_rows(kept, pair.hidden, pair.above, pair.share, opacity)
        factors = kept, self._kept
        write_logits(values["logit_opacities"], at, rows, self._logits, factors, opacity)
        heights = risen, self._risen
        return write_centers(values["means"], at, rows, self._means, heights, self.paint.outward, opacity)

    def _read(self, values: Mapping[str, Floats], written: Rows, names: Collection[str]) -> None:
        """Copy the rows that the composer has written, which are without the order of layers."""
        rows = self.paint.rows
        if not len(written):
            return
        if "sh0" in names:
            copy_colors(values["sh0"], rows, self._colors, self._mixed, written)
        if self.paint.pairs and "means" in names:
            copy_rows(values["means"], rows, self._means, written)
        if self.paint.pairs and "logit_opacities" in names:
            copy_rows(values["logit_opacities"], rows, self._logits, written)

    def _mix_rims(self, order: Sequence[int], opacity: Doubles) -> None:
        """Compute the colors of rims, see `arrange`."""
        rest_rims(self._mixed, self._beside, self._rims, self._colors, self._tints)
        for edit in order:
            for pair in overlaps_below(self.paint, order, edit):
                rims = self._rim_overlaps[id(pair)]
                cover_rims(self._beside, rims.over, rims.under, rims.cover, opacity, self._mixed)
            color_rims(self._mixed, self._beside, self._edit_rims[edit], self.paint.rim, self._colors)

    def _measure_tints(self, states: States) -> None:
        """Measure how other layers change the colors of the anchors of rims."""
        followers = states.followers
        before, after = (
            each.sh0.detach().float().reshape(-1, 3).numpy()
            for each in (states.before, states.composer.gaussians)
        )
        add_tints(self._tints, self._tinted, followers.anchors, followers.weights, before, after)


def _rim_overlap(pair: Overlap, rim: Doubles) -> _RimOverlap:
    """Return the part of an overlap whose upper rows are rims."""
    at = np.flatnonzero(rim[pair.over] > 0)
    return _RimOverlap(pair.over[at], pair.under[at], pair.cover[at])
