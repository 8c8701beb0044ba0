"""Moves of a stack while a slider is dragged: the fast form of `carry` in `progdf.compose.parents.rows`.

The composed scene without its moves stays in the composer. The carrier has its own arrays of the moved
attributes. An update copies only rows that have changed, and lets the moves act on them.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.compose.compose_kernel import add_offsets, mark_differing, write_rows
from progdf.compose.layers import Change, Layer
from progdf.field.baked import find_segment
from progdf.field.stored_bases import StoredBases
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import Gdf
from progdf.gdf.motions import LinearMap, PartMotions
from progdf.system.equality import equal_fields
from progdf.threads import map_threads

from .rows import MOVED, Anchored, anchored_rows, carry_added, carry_members, is_move, part_maps

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]

_CHUNK_MEMBERS = 8192  # members that a thread moves at once
_NO_VALUES = np.zeros(0, np.float32)  # stands for weights that are all 1, and for coverage that is all 0


@dataclass(frozen=True)
class _Move:
    """Edit that carries others."""

    __eq__ = equal_fields

    gdf: Gdf
    bases: Mapping[str, StoredBases]  # offsets of the moved attributes
    added: Mapping[int, Anchored]  # rows that follow it, by the edit that adds them
    rows: Rows  # all rows that it can change: its members and these. Sorted. [R]


class Carrier:
    """Moved attributes of a scene under its moves.

    Args:
        scene: the extended scene
        gdfs: its edits, with their motions
    """

    def __init__(self, scene: Gaussians, gdfs: Sequence[Gdf]) -> None:
        self._bands = scene.shN.shape[1]
        names = [name for name in MOVED if self._bands or name != "shN"]
        self._original = {name: getattr(scene, name).detach().float().flatten(1) for name in MOVED}
        self.tensors = {name: getattr(scene, name).detach().float().clone() for name in names}
        """Moved attributes of the scene after the moves; written in place. [N,...] each"""
        self._now = {name: self.tensors.get(name, getattr(scene, name)).flatten(1) for name in MOVED}
        self._moves = {edit: _find_move(gdf, gdfs) for edit, gdf in enumerate(gdfs) if is_move(gdf)}
        self._is_affected = np.zeros(len(scene), bool)

    def set_motions(self, edit: int, motions: PartMotions) -> None:
        """Set the motions of an edit in progress, which had others before."""
        move = self._moves[edit]
        self._moves[edit] = replace(move, gdf=replace(move.gdf, motions=motions))

    def carry(
        self,
        change: Change,
        changed: Collection[int],
        stack: Sequence[tuple[int, Layer]],
        composed: Mapping[str, Floats],
    ) -> Change:
        """Update the moved attributes; return all changes.

        Args:
            change: changes of the composed scene
            changed: indices of the changed edits
            stack: active layers with the index of their edit, lowest first
            composed: changing attributes of the composed scene without its moves. [N,c] each
        """
        moved = [edit for edit in changed if edit in self._moves]
        if not moved and not any(name in self.tensors for name in change.attributes):
            return change
        rows = change.rows
        self._is_affected[rows] = True
        for edit in moved:
            self._is_affected[self._moves[edit].rows] = True
        if moved:
            rows = np.flatnonzero(self._is_affected)
        last = self._now["means"].numpy()[rows]
        for name in self.tensors:
            source = composed.get(name)
            old = self._original[name].numpy() if source is None else source
            self._now[name].numpy()[rows] = old[rows]
        active = {edit for edit, _ in stack}
        for edit, layer in stack:
            if edit in self._moves:
                self._apply(self._moves[edit], layer, active)
        self._is_affected[rows] = False
        steps = np.square(self._now["means"].numpy()[rows] - last).sum(axis=1)
        names = {*change.attributes, *self.tensors}
        return Change(
            rows,
            tuple(name for name in ATTRIBUTES if name in names),
            math.sqrt(float(steps.max(initial=0.0))),
        )

    def _apply(self, move: _Move, layer: Layer, active: Collection[int]) -> None:
        """Let one move act on the affected rows."""
        layer = Layer(move.gdf, layer.strength, layer.enabled, layer.gains, layer.weights)
        maps = part_maps(layer, self._bands)
        count = len(move.gdf.region)
        weights = torch.ones(count) if layer.weights is None else layer.weights.detach().float()
        added = [
            (found, self._carry_rows(move, found, layer, maps, weights))
            for edit, whole in move.added.items()
            if edit in active and (found := self._affected_rows(whole)) is not None
        ]
        members = move.gdf.region.members
        chosen = np.flatnonzero(self._is_affected[members.numpy()])
        if layer.weights is not None:
            chosen = chosen[weights.numpy()[chosen] > 0.0]
        if len(chosen):
            parts = np.array_split(chosen, math.ceil(len(chosen) / _CHUNK_MEMBERS))
            map_threads(lambda part: self._move_members(move, layer, part, maps, weights), parts)
        for found, values in added:
            for name in self.tensors:
                self._now[name][found.rows] = values[name]

    def _move_members(
        self, move: _Move, layer: Layer, chosen: Rows, maps: Sequence[LinearMap], weights: Tensor
    ) -> None:
        """Let a move act on some of its members; only those that other layers have changed need its maps."""
        rows = move.gdf.region.members.numpy()[chosen]
        is_displaced = np.zeros(len(rows), np.bool_)
        if not all(each.is_identity for each in maps):
            for name in self.tensors:
                mark_differing(is_displaced, self._now[name].numpy(), self._original[name].numpy(), rows)
        displaced = chosen[is_displaced]
        carried: dict[str, Tensor] = {}
        if len(displaced):
            offsets = self._offsets(move, layer, displaced)
            some = torch.from_numpy(displaced)
            carried = carry_members(self._original, self._now, some, layer, maps, offsets, weights)
        segment = find_segment(move.gdf.field.knots, layer.strength)
        part = np.arange(len(chosen)), chosen, _NO_VALUES if layer.weights is None else weights.numpy()
        for name, bases in move.bases.items():
            if name not in self.tensors:
                continue
            used, factors = bases.factors(segment)
            total = np.zeros((len(chosen), bases.end.shape[1]), np.float32)
            gain = np.float32(layer.gain(name))
            stored = bases.end, bases.residual
            add_offsets(total, part, stored, used, factors, gain, np.float32(0.0), _NO_VALUES)
            now = self._now[name].numpy()
            write_rows(now, now, rows, total, _NO_VALUES, False)
        changed = torch.from_numpy(rows[is_displaced])
        for name, values in carried.items():
            self._now[name][changed] = values

    def _affected_rows(self, added: Anchored) -> Anchored | None:
        """Return the added rows that are affected; None if there are none."""
        at = np.flatnonzero(self._is_affected[added.rows.numpy()])
        if not len(at):
            return None
        if len(at) == len(added.rows):
            return added
        some = torch.from_numpy(at)
        return Anchored(added.rows[some], added.members[some], added.weights[some])

    def _carry_rows(
        self, move: _Move, added: Anchored, layer: Layer, maps: Sequence[LinearMap], weights: Tensor
    ) -> dict[str, Tensor]:
        needed = np.unique(added.members.numpy())
        offsets = {}
        for name, values in self._offsets(move, layer, needed).items():
            offsets[name] = torch.zeros(len(move.gdf.region), values.shape[1])  # of all members
            offsets[name][torch.from_numpy(needed)] = values
        return carry_added(self._original, self._now, added, layer, maps, offsets, weights)

    def _offsets(self, move: _Move, layer: Layer, members: Rows) -> dict[str, Tensor]:
        """Return the offsets of some members. [m,c]"""
        segment = find_segment(move.gdf.field.knots, layer.strength)
        at = np.arange(len(members))
        offsets = {}
        for name, bases in move.bases.items():
            used, factors = bases.factors(segment)
            total = np.zeros((len(members), bases.end.shape[1]), np.float32)
            part = at, members, _NO_VALUES
            stored = bases.end, bases.residual
            add_offsets(total, part, stored, used, factors, np.float32(1.0), np.float32(0.0), _NO_VALUES)
            offsets[name] = torch.from_numpy(total)
        return offsets


def _find_move(gdf: Gdf, gdfs: Sequence[Gdf]) -> _Move:
    """Return a move with the rows that follow it."""
    bases = {name: StoredBases.of(each) for name, each in gdf.field.attributes.items() if name in MOVED}
    found = {edit: anchored_rows(other, gdf) for edit, other in enumerate(gdfs)}
    added = {edit: each for edit, each in found.items() if each is not None}
    rows = [gdf.region.members, *(each.rows for each in added.values())]
    return _Move(gdf, bases, added, np.unique(torch.cat(rows).numpy()))
