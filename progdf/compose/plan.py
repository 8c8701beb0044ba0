"""What `progdf.compose.composer` prepares once: edits as flat arrays, and which members share which rows."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf

from .arrays import BLOCK, COLUMN, EDIT, GAINS, LAYER, PART, Bases, Rows, Stack, Target
from .coverage import coverage
from .layers import KINDS, Layer, check_weights


@dataclass(frozen=True)
class RowPlan:
    """How to rewrite the members of some edits, with all others that share rows with them.

    Args:
        rows: what is rewritten. [U]
        lists: the same for the kernel, with each edit's members among them; where each row is among those of
            all edits only if it was asked for
        edits: indices of the edits that have members among them
        begin: where each edit's list begins within `lists`
        aligned: edits whose members are the rows, one for one
        bounds: where each block of rows begins in each edit's list. [B+1]
        prepared: see `stack`, by the edits of a stack
    """

    rows: NDArray[np.int64]
    lists: Rows
    edits: frozenset[int]
    begin: Mapping[int, int]
    aligned: frozenset[int]
    bounds: Mapping[int, NDArray[np.int64]]
    prepared: dict[tuple[int, ...], Stack]

    @property
    def blocks(self) -> int:
        """How many blocks of rows there are."""
        return -(-len(self.rows) // BLOCK)

    def stack(self, edits: tuple[int, ...]) -> Stack:
        """Layers of these edits, lowest first, made once; strengths, gains and weights are left to be set."""
        if edits not in self.prepared:
            if len(self.prepared) >= 32:
                self.prepared.clear()
            layers = np.zeros(len(edits), LAYER)
            layers["edit"] = edits
            layers["list"] = [self.begin[edit] for edit in edits]
            layers["aligned"] = [edit in self.aligned for edit in edits]
            bounds = np.array([self.bounds[edit] for edit in edits], np.int64)
            gains = np.zeros((len(edits), len(GAINS)), np.float32)
            none = np.zeros(0, np.float32)
            self.prepared[edits] = Stack(
                layers, gains, bounds.reshape(len(edits), self.blocks + 1), none, over=False, normalize=False
            )
        return self.prepared[edits]


def plan_rows(
    members: Sequence[NDArray[np.int64]], changed: frozenset[int], edited: NDArray[np.int64] | None = None
) -> RowPlan:
    """The plan that rewrites all members of the changed edits.

    Args:
        members: of every edit, sorted. [M] each
        changed: indices of edits
        edited: all members, sorted; None where nobody asks where the rows are among them
    """
    chosen = [members[edit] for edit in sorted(changed)]
    rows = chosen[0] if len(chosen) == 1 else np.unique(np.concatenate(chosen))
    edges = np.arange(-(-len(rows) // BLOCK) + 1) * BLOCK
    begin: dict[int, int] = {}
    bounds: dict[int, NDArray[np.int64]] = {}
    aligned = set()
    found_members, found_rows = [], []
    length = 0
    for edit, own in enumerate(members):
        row_index = np.searchsorted(rows, own)
        inside = (
            np.flatnonzero(rows[np.minimum(row_index, len(rows) - 1)] == own) if len(rows) else row_index[:0]
        )
        if not len(inside):
            continue
        begin[edit] = length
        length += len(inside)
        if len(inside) == len(own) == len(rows):
            aligned.add(edit)
        row_index = row_index[inside]
        found_members.append(inside.astype(np.uint32))
        found_rows.append(row_index.astype(np.uint32))
        bounds[edit] = np.searchsorted(row_index, edges).astype(np.int64)
    nothing = np.zeros(0, np.uint32)
    base_index = nothing if edited is None else np.searchsorted(edited, rows).astype(np.uint32)
    lists = Rows(
        rows.view(np.uint64),
        base_index,
        np.concatenate([nothing, *found_members]),
        np.concatenate([nothing, *found_rows]),
    )
    return RowPlan(rows, lists, frozenset(begin), begin, frozenset(aligned), bounds, {})


def flatten_edits(scene: Gaussians, gdfs: Sequence[Gdf], names: Sequence[str]) -> Bases:
    """Lay out the edits' bases for these attributes, and their coverage."""
    edits = np.zeros(len(gdfs), EDIT)
    parts = np.zeros((len(gdfs), len(names)), PART)
    parts["end"] = -1
    floats, levels = [np.zeros(0, np.float32)], [np.zeros(0, np.int8)]
    tables = [np.zeros(0, np.float32)]
    float_count = level_count = table_count = 0
    for i, gdf in enumerate(gdfs):
        float_lines: list[NDArray[np.float32]] = []
        level_lines: list[NDArray[np.int8]] = []
        coverages: dict[str, int] = {}
        for kind, covered in coverage(scene, gdf).items():
            coverages[kind] = len(float_lines)
            float_lines.append(covered.numpy())
        for j, name in enumerate(names):
            bases = gdf.field.attributes.get(name)
            if bases is None:
                continue
            end = len(float_lines)
            float_lines += list(bases.end_offset.numpy().T)
            residual = bases.residual_basis.permute(2, 0, 1).flatten(0, 1)  # a channel's bases side by side
            is_float = bases.residual_basis.dtype != torch.int8
            lines = len(float_lines) if is_float else len(level_lines)
            if is_float:
                float_lines += list(residual.float().numpy())
            else:
                level_lines += list(residual.numpy())
            scale = table_count + bases.coefficients.numel()
            tables += [bases.coefficients.numpy().reshape(-1), bases.scale.numpy().reshape(-1)]
            rank, covers = len(bases.residual_basis), coverages[KINDS[name]]
            parts[i, j] = (end, lines, is_float, rank, table_count, scale, covers)
            table_count = scale + bases.scale.numel()
        edits[i] = float_count, len(float_lines), level_count, len(level_lines)
        floats.append(split_blocks(float_lines, np.float32))
        levels.append(split_blocks(level_lines, np.int8))
        float_count, level_count = float_count + len(floats[-1]), level_count + len(levels[-1])
    return Bases(edits, parts, np.concatenate(floats), np.concatenate(levels), np.concatenate(tables))


def split_blocks(lines: Sequence[NDArray[Any]], dtype: DTypeLike) -> NDArray[Any]:
    """Lines of as many numbers, cut into blocks of 256; the last is filled up with 0. P × [M] -> [B·P·256]"""
    if not lines:
        return np.zeros(0, dtype)
    blocks = -(-len(lines[0]) // BLOCK)
    laid = np.zeros((blocks, len(lines), BLOCK), dtype)
    for i, line in enumerate(lines):
        whole = len(line) // BLOCK
        laid[:whole, i] = line[: whole * BLOCK].reshape(whole, BLOCK)
        laid[whole:, i, : len(line) - whole * BLOCK] = line[whole * BLOCK :]
    return laid.reshape(-1)


def flatten_scene(scene: Gaussians, names: Sequence[str], edited: NDArray[np.int64]) -> Target:
    """Attributes of the edited rows in blocks, those of all rows back to back, and where each is."""
    tensors: list[Tensor] = [getattr(scene, name).detach().float() for name in names]
    tables = [tensor.numpy().reshape(len(tensor), math.prod(tensor.shape[1:])) for tensor in tensors]
    base = split_blocks([line for table in tables for line in table[edited].T], np.float32)
    out = np.concatenate([np.zeros(0, np.float32), *(table.reshape(-1) for table in tables)])
    columns = np.zeros(len(names), COLUMN)
    line = at = 0
    for i, (name, table) in enumerate(zip(names, tables, strict=True)):
        columns[i] = line, table.shape[1], at, GAINS.index(KINDS[name]), name == "means"
        line, at = line + table.shape[1], at + table.size
    return Target(base, out, columns)


class FlatWeights:
    """The painted weights of a stack's layers, back to back; laid out anew only where one has changed."""

    def __init__(self) -> None:
        self.flat: NDArray[np.float32] = np.zeros(0, np.float32)
        self.begins: list[int] = []
        """Where each layer's begin in `flat`; −1 for a layer without."""
        self._given: list[tuple[Tensor, int]] = []  # and their versions: they may be written to in place

    def update(self, layers: Sequence[Layer]) -> bool:
        """Take the weights of these layers; whether `flat` is another now.

        Raises:
            ValueError: weights do not fit the members, or one is not in 0..1.
        """
        given = [(layer.weights, layer.weights._version) for layer in layers if layer.weights is not None]
        kept = self._given
        same = len(given) == len(kept) and all(
            a[0] is b[0] and a[1] == b[1] for a, b in zip(given, kept, strict=True)
        )
        if not same:
            for layer in layers:
                check_weights(layer)
            parts = [weights.detach().float().numpy() for weights, _ in given]
            self.flat, self._given = np.concatenate([np.zeros(0, np.float32), *parts]), given
        begin, self.begins = 0, []
        for layer in layers:
            self.begins.append(-1 if layer.weights is None else begin)
            begin += 0 if layer.weights is None else len(layer.weights)
        return not same
