"""Rows that depend on the composed state of other rows, updated by `Composer`.

The dependent rows are those that follow a surface (`progdf.compose.follow`), and the rims of painted layers
(`progdf.compose.paint_order`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.gdf.texture import ColorSplit, Split
from progdf.threads import run_chunks

from .follow import (
    FOLLOWED,
    Followers,
    banded_followers,
    mean_quats,
    pack_shapes,
    state_scene,
    turn_bands,
)
from .follow_kernel import (
    Shapes,
    carry_fast,
    gather_shapes,
    measure_motions,
    release_rows,
    rest_blends,
    rest_motions,
)
from .layers import DEFAULT_BLEND, Change, Layer
from .reference import Coverage

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]

_CARRIED_ROWS = 2_048  # rows that follow, per task of a thread


class StateComposer(Protocol):
    """The part of `Composer` that composes states."""

    gaussians: Gaussians

    def update(self, layers: Sequence[Layer], blend: str = DEFAULT_BLEND) -> Change:
        """Set `gaussians` to the scene under some layers."""

    def touch(self, gdf: Gdf) -> None:
        """Let the next update read the offsets of an edit again."""

    def shapes(self) -> Shapes:
        """Return the followed attributes of `gaussians`."""


MakeComposer = Callable[[Gaussians, Sequence[Gdf], Coverage, Split], StateComposer]
"""Constructor of `Composer`."""
Known = tuple[Callable[[int], Mapping[str, Tensor]], Callable[[int], ColorSplit | None]]
"""Functions from the index of an edit to its coverage, and to its color apart from its texture."""


class States:
    """States of the rows on which other rows depend, see `Followers`, composed like a scene of their own.

    Args:
        scene: the extended scene
        gdfs: its edits
        followers: the rows and their states
        known: values of the edits in the scene
        names: attributes of the states that are composed
        make: constructor of the composer
    """

    def __init__(
        self,
        scene: Gaussians,
        gdfs: Sequence[Gdf],
        followers: Followers,
        known: Known,
        names: Sequence[str],
        make: MakeComposer,
    ) -> None:
        self.followers = followers
        self.before, self._gdfs = state_scene(scene, gdfs, followers, names)
        self._index = {id(gdf): edit for edit, gdf in enumerate(self._gdfs)}
        self._coverage_of, self._split_of = known
        self.composer = make(self.before, self._gdfs, self._covers, self._split)
        self._sliced: dict[
            int, tuple[Tensor, int, Tensor]
        ] = {}  # by edit: weights, their version, and a part

    def update(self, stack: Sequence[tuple[int, Layer]], blend: str) -> Rows:
        """Compose the states; return those that may have changed."""
        changed = self.followers.changed
        layers = [self._layer(edit, layer) for edit, layer in stack if len(changed[edit][0])]
        return self.composer.update(layers, blend).rows

    def touch(self, edit: int, gdf: Gdf) -> None:
        """Copy the offsets of an edit, which were written in place."""
        at = torch.from_numpy(self.followers.changed[edit][1])
        if not len(at):
            return
        part = self._gdfs[edit]
        for name, bases in part.field.attributes.items():
            bases.end_offset.copy_(gdf.field.attributes[name].end_offset[at])
        self.composer.touch(part)

    def _layer(self, edit: int, layer: Layer) -> Layer:
        """Return a layer restricted to the states."""
        weights = layer.weights
        if weights is None:
            return replace(layer, gdf=self._gdfs[edit])
        known = self._sliced.get(edit)
        if known is None or known[0] is not weights or known[1] != weights._version:
            part = weights[torch.from_numpy(self.followers.changed[edit][1])]
            known = weights, weights._version, part
            self._sliced[edit] = known
        return replace(layer, gdf=self._gdfs[edit], weights=known[2])

    def _covers(self, _: Gaussians, gdf: Gdf) -> Mapping[str, Tensor]:
        """Return the coverage that an edit of the states has in the scene."""
        edit = self._index[id(gdf)]
        members = torch.from_numpy(self.followers.changed[edit][1])
        return {kind: share[members] for kind, share in self._coverage_of(edit).items()}

    def _split(self, _: Gaussians, gdf: Gdf) -> ColorSplit | None:
        """Return the color and the texture that an edit of the states has in the scene."""
        edit = self._index[id(gdf)]
        found = self._split_of(edit)
        return None if found is None else found.take(torch.from_numpy(self.followers.changed[edit][1]))


class Surface:
    """States of the rows that others follow, see `Followers`, composed like a scene of their own.

    Only this class writes the attributes in `FOLLOWED` of pushed rows. Those of added rows are first written
    by the composer, without following.

    Args:
        scene: the extended scene
        gdfs: its edits
        followers: see `find_followers`
        known: values of the edits in the scene
        make: constructor of the composer of the states
    """

    def __init__(
        self,
        scene: Gaussians,
        gdfs: Sequence[Gdf],
        followers: Followers,
        known: Known,
        make: MakeComposer,
    ) -> None:
        self.followers = followers
        self._states = States(scene, gdfs, followers, known, FOLLOWED, make)
        states = self._states.before
        rows = torch.from_numpy(followers.rows)
        self._own = pack_shapes(scene, rows).numpy()  # the rows before they follow. [F,11]
        self._drawn = scene.means[rows].float().numpy()  # their centers in the last picture. [F,3]
        self._before = pack_shapes(states).numpy()
        self._motions = rest_motions(self._before)
        self._blends = rest_blends(len(followers.rows))
        self._touched = np.zeros(len(states), bool)  # states whose motion has changed in this update
        self._is_anchor = np.zeros(len(states), bool)
        self._is_anchor[followers.anchors] = True
        self._follows = np.ones(len(gdfs) + 1, bool)  # by edit + 1: its rows follow; the first: pushed rows
        self.banded = banded_followers(scene, gdfs, followers)
        """Indices of the following rows with higher SH bands. [B]"""
        self._bands = scene.shN[rows].float()  # bands of the rows before they follow. [F,K,3]
        self._dependents: dict[int, Rows] = {}

    def dependents(self, edit: int) -> Rows:
        """Return `Followers.dependents`, cached."""
        if edit not in self._dependents:
            self._dependents[edit] = self.followers.dependents(edit)
        return self._dependents[edit]

    def touch(self, edit: int, gdf: Gdf) -> None:
        """Copy the offsets of an edit, which were written in place."""
        self._states.touch(edit, gdf)

    def release(self, shapes: Shapes, index: Rows) -> None:
        """Write added rows as they are before they follow, ahead of the update by the composer.

        Args:
            shapes: the composed scene, see `Composer.shapes`; updated in place
            index: indices of the rows, see `Followers`. [F]
        """
        release_rows(shapes, index, self.followers.rows, self._own)

    def carry(
        self,
        shapes: Shapes,
        index: Rows,
        added: Rows,
        stack: Sequence[tuple[int, Layer]],
        blend: str,
    ) -> float:
        """Write the rows that follow; return the largest movement of a center.

        Args:
            shapes: the composed scene, see `Composer.shapes`; updated in place
            index: indices of the rows to write, see `Followers`. [F]
            added: indices of the added rows among them that the composer has written. [G]
            stack: active layers with the index of their edit, lowest first
            blend: one of `BLENDS`
        """
        followers = self.followers
        changed = self._states.update(stack, blend)
        states = self._states.composer.shapes()
        moved = changed[self._is_anchor[changed]]
        measure_motions(self._motions, moved, self._before, states)
        self._touched[moved] = True
        touched = self._touched if len(moved) else self._touched[:0]
        gather_shapes(self._own, added, shapes, followers.rows)
        self._follows[1:] = False
        self._follows[[edit + 1 for edit, _ in stack]] = True
        table = followers.rows, followers.edits, followers.own, followers.anchors, followers.weights
        count = 1 + len(index) // _CARRIED_ROWS
        cuts = [len(index) * part // count for part in range(count + 1)]
        moves = run_chunks(
            lambda chunk: carry_fast(
                shapes,
                (self._own, self._drawn),
                index[cuts[chunk] : cuts[chunk + 1]],
                table,
                self._follows,
                (self._before, states),
                self._motions,
                (*self._blends, touched),
            ),
            count,
        )
        self._touched[moved] = False
        return math.sqrt(max(moves))

    def turn(self, bands: Floats, index: Rows, recolored: Rows) -> None:
        """Turn the higher SH bands of following rows.

        Args:
            bands: bands of the composed scene, updated in place. [N,3K]
            index: indices of the rows to write. [B]
            recolored: those of them that the composer has written
        """
        followers = self.followers
        width = self._bands.shape[1:]
        self._bands[recolored] = torch.from_numpy(bands[followers.rows[recolored]]).reshape(-1, *width)
        moves, turns, *_ = self._motions
        anchors = followers.anchors[index]
        weights = followers.weights[index]
        is_moved = (moves[anchors, 0] & (weights > 0)).any(axis=1) & self._follows[followers.edits[index] + 1]
        mean = mean_quats(torch.from_numpy(turns[anchors, :4]), torch.from_numpy(weights)[..., None])
        turned = turn_bands(self._bands[index], mean, torch.from_numpy(is_moved))
        bands[followers.rows[index]] = turned.flatten(1).numpy()
