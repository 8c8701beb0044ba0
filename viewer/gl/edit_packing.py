"""Edits and stacks as the edit pass reads them: flat lists of texels.

Bases, original attributes and memberships are made once, the stack with every new strength. The lists grow
with the members of the edits, not with the scene: about 64 bytes of original attributes a member and 16 + 4R
bytes a target, and 4 bytes for every edit to say which member a Gaussian is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.compose.coverage import coverage
from progdf.compose.layers import Layer
from progdf.field.baked import AttributeBases
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf

from .layout import EDIT_LAYER, PLACES, SHOWN_SH, SPAN, SPLATS_PER_ROW, TARGETS, Place

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class TargetBases:
    """What an edit does to one of `TARGETS`: where its bases begin, and what they move.

    Args:
        full: texel of the full offsets in `floats`
        rest: texel of bases 1 to `rank` in `levels`; −1: they follow each full offset in `floats`
        rank: largest R of its attributes
        attributes: one or, in `mean_logit`, up to two
    """

    full: int
    rest: int
    rank: int
    attributes: tuple[str, ...]


@dataclass(frozen=True)
class PackedEdits:
    """All edits of a scene.

    Args:
        slots: Gaussians that are a member of any edit, ascending. [U]
        originals: where the slots' original texels begin in `floats`, by target; −1 where no edit moves it
        floats: [·,4] float32
        levels: [·,4] int8
        places: for each edit in turn, which member each slot is, −1 where none. [E·U] int32
        edits: by target, what each edit does to it
        covers: where each edit's texels of geometry, opacity and color begin in `floats`, see
            `progdf.compose.coverage`; one a member
        sh_coefficients: K of shN that are shown
    """

    slots: NDArray[np.int64]
    originals: tuple[int, ...]
    floats: Floats
    levels: NDArray[np.int8]
    places: NDArray[np.int32]
    edits: tuple[Mapping[int, TargetBases], ...]
    covers: tuple[int, ...]
    sh_coefficients: int

    def width(self, target: int) -> int:
        """Texels of a Gaussian in a target."""
        return self.sh_coefficients if TARGETS[target] == "shN" else 1

    @property
    def texels(self) -> int:
        """Length of the longest list."""
        return max(len(self.floats), len(self.levels), len(self.places))


class _List:
    """A list under construction."""

    def __init__(self) -> None:
        self.parts: list[NDArray[Any]] = []
        self.length = 0

    def append(self, texels: NDArray[Any]) -> int:
        begin, self.length = self.length, self.length + len(texels)
        self.parts.append(texels)
        return begin

    def join(self, dtype: Any) -> NDArray[Any]:
        return np.concatenate([np.zeros((0, 4), dtype), *self.parts])


def pack_edits(scene: Gaussians, gdfs: Sequence[Gdf]) -> PackedEdits:
    """All that the pass has to know of a scene and its edits."""
    shown = min(int(scene.shN.shape[1]), SHOWN_SH)
    members = [gdf.region.members.numpy() for gdf in gdfs]
    slots = np.unique(np.concatenate([np.zeros(0, np.int64), *members]))
    places = np.full((len(gdfs), len(slots)), -1, np.int32)
    for edit, own in enumerate(members):
        places[edit, np.searchsorted(slots, own)] = np.arange(len(own))
    floats, levels = _List(), _List()
    edits = [_edit(gdf, shown, floats, levels) for gdf in gdfs]
    covers = [floats.append(_covers(scene, gdf)) for gdf in gdfs]
    moved = {target for edit in edits for target in edit}
    originals = [-1] * len(TARGETS)
    for target in sorted(moved):
        originals[target] = floats.append(_originals(scene, TARGETS[target], slots, shown))
    return PackedEdits(
        slots,
        tuple(originals),
        floats.join(np.float32),
        levels.join(np.int8),
        places.reshape(-1),
        tuple(edits),
        tuple(covers),
        shown,
    )


def _edit(gdf: Gdf, shown: int, floats: _List, levels: _List) -> dict[int, TargetBases]:
    found: dict[int, TargetBases] = {}
    for target, texture in enumerate(TARGETS):
        attributes = {
            name: bases for name, bases in gdf.field.attributes.items() if PLACES[name].texture == texture
        }
        if attributes and not (texture == "shN" and shown == 0):
            found[target] = _target(attributes, shown, floats, levels)
    return found


def _covers(scene: Gaussians, gdf: Gdf) -> Floats:
    """What a member covers of geometry, opacity and color. [M,4]"""
    texels = np.zeros((len(gdf.region), 4), np.float32)
    for kind, covered in coverage(scene, gdf).items():
        texels[:, ("geometry", "opacity", "color").index(kind)] = covered.numpy()
    return texels


def _target(
    attributes: Mapping[str, AttributeBases], shown: int, floats: _List, levels: _List
) -> TargetBases:
    """Put the attributes of one target side by side, members in turn, each with all its bases."""
    rank = max(bases.residual_basis.shape[0] for bases in attributes.values())
    as_floats = any(bases.residual_basis.dtype != torch.int8 for bases in attributes.values())
    full = rest = np.zeros(0)
    for name, bases in attributes.items():
        place = PLACES[name]
        own = _texels(bases.end_offset.numpy(), place, shown)
        own_rest = bases.residual_basis.float() if as_floats else bases.residual_basis
        if not full.size:
            full = np.zeros((len(own), 4), np.float32)
            rest = np.zeros((len(own), rank, 4), np.float32 if as_floats else np.int8)
        columns = slice(place.component, place.component + place.components)
        full[:, columns] = own
        for k in range(len(own_rest)):
            rest[:, k, columns] = _texels(own_rest[k].numpy(), place, shown)
    if as_floats:
        together = np.concatenate([full[:, None], rest], axis=1).reshape(-1, 4)
        return TargetBases(floats.append(together), -1, rank, tuple(attributes))
    return TargetBases(floats.append(full), levels.append(rest.reshape(-1, 4)), rank, tuple(attributes))


def _originals(scene: Gaussians, texture: str, slots: NDArray[np.int64], shown: int) -> Floats:
    width = shown if texture == "shN" else 1
    texels = np.zeros((len(slots) * width, 4), np.float32)
    for name, place in PLACES.items():
        if place.texture == texture:
            values = getattr(scene, name).detach().float()[torch.from_numpy(slots)].numpy()
            columns = slice(place.component, place.component + place.components)
            rows = values.reshape(len(slots), math.prod(values.shape[1:]))
            texels[:, columns] = _texels(rows, place, shown)
    return texels


def _texels(values: NDArray[Any], place: Place, shown: int) -> NDArray[Any]:
    """Rows of channels as texels, one or `shown` a row. [M,c] -> [M·w,components]"""
    width = shown if place.texture == "shN" else 1
    return values[:, : width * place.components].reshape(-1, place.components)


def pack_stack(
    packed: PackedEdits, stack: Sequence[tuple[int, Layer]], weights_at: Sequence[int]
) -> tuple[NDArray[Any], Floats]:
    """A stack at its present strengths, as include/edit_layers.glsl reads it: `edit_layers`, `edit_numbers`.

    Args:
        packed: the edits
        stack: index of the edit and the layer, the lowest first
        weights_at: where each layer's painted weights begin; −1 where it has none

    Returns:
        [L] of `EDIT_LAYER`, and the numbers it points to. [·,4] float32
    """
    layers = np.zeros(len(stack), EDIT_LAYER)
    lines: list[Floats] = []
    length = 0

    def put(some: Floats) -> int:
        nonlocal length
        begin, length = length, length + len(some)
        lines.append(some)
        return begin

    for i, (edit, layer) in enumerate(stack):
        entry: Any = layers[i]
        entry["places"], entry["weights"] = edit * len(packed.slots), weights_at[i]
        entry["covers"] = packed.covers[edit]
        entry["numbers"] = put(np.array([[layer.clamped_strength, 0.0, 0.0, 0.0]], np.float32))
        entry["targets"]["numbers"] = -1
        for target, bases in packed.edits[edit].items():
            if not any(layer.gain(name) for name in bases.attributes):
                continue
            numbers = put(_numbers(bases, packed.width(target), layer))
            entry["targets"][target] = (bases.full, bases.rest, bases.rank, numbers)
    return layers, np.concatenate([np.zeros((0, 4), np.float32), *lines])


def _numbers(bases: TargetBases, width: int, layer: Layer) -> Floats:
    """The gain, then the factors of every basis, `width` texels each. [1+(1+R)·width,4]"""
    lines = np.zeros((1 + (1 + bases.rank) * width, 4), np.float32)
    for name in bases.attributes:
        place = PLACES[name]
        columns = slice(place.component, place.component + place.components)
        own = layer.gdf.field.factors(name, layer.strength)[:, : width * place.components].numpy()
        own = own.reshape(-1, place.components)
        lines[0, columns] = layer.gain(name)
        lines[1 : 1 + len(own), columns] = own
    return lines


def spans_of(rows: NDArray[np.int64], slots: NDArray[np.int64]) -> NDArray[Any]:
    """The spans that cover `rows` and nothing else.

    Args:
        rows: Gaussians, ascending, each of them in `slots`. [M]
        slots: Gaussians that are a member of any edit, ascending. [U]

    Returns:
        [S] of `SPAN`, S ≤ M
    """
    broken = (np.diff(rows) != 1) | (rows[1:] % SPLATS_PER_ROW == 0)
    begins = np.concatenate([np.arange(min(len(rows), 1)), 1 + np.flatnonzero(broken)])
    firsts = rows[begins]
    spans = np.zeros(len(begins), SPAN)
    spans["row"], spans["column"] = np.divmod(firsts, SPLATS_PER_ROW)
    spans["texels"] = np.diff(begins, append=len(rows))
    spans["slot"] = np.searchsorted(slots, firsts)
    return spans
