"""What `progdf.compose.composer` prepares once: edits as flat arrays, and which members share which rows."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf

from .coverage import coverage
from .kernel import BLOCK, COLUMN, EDIT, LAYER, NUMBER, PART
from .layers import KINDS

StackedEdits = tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.int64]]
"""[L,6] and [L,5], see `compose_kernel.LAYER` and `NUMBER`, written to at every step; bounds, [L,B+1]."""


@dataclass(frozen=True)
class RowPlan:
    """How to rewrite the members of some edits, with all others that share rows with them.

    Args:
        rows: what is rewritten. [U]
        base_index: where each of them is among the rows of all edits, if asked for. [U]
        edits: indices of the edits that have members among them
        begin: where each edit's list begins within `members` and `row_index`
        aligned: edits whose members are the rows, one for one
        members, row_index: members of the edits, and where in `rows` they are
        bounds: where each block of rows begins in each edit's list. [B+1]
        prepared: see `stack_edits`, by the edits of a stack
    """

    rows: NDArray[np.int64]
    base_index: NDArray[np.uint32]
    edits: frozenset[int]
    begin: Mapping[int, int]
    aligned: frozenset[int]
    members: NDArray[np.uint32]
    row_index: NDArray[np.uint32]
    bounds: Mapping[int, NDArray[np.int64]]
    prepared: dict[tuple[int, ...], StackedEdits]

    @property
    def blocks(self) -> int:
        """How many blocks of rows there are."""
        return -(-len(self.rows) // BLOCK)

    def stack_edits(self, edits: tuple[int, ...]) -> StackedEdits:
        """What the kernel reads of layers of these edits, lowest first; made once."""
        if edits not in self.prepared:
            if len(self.prepared) >= 32:
                self.prepared.clear()
            layers = np.zeros((len(edits), len(LAYER)), np.int64)
            for i, edit in enumerate(edits):
                layers[i, :3] = edit, self.begin[edit], edit in self.aligned
            bounds = np.array([self.bounds[edit] for edit in edits], np.int64)
            numbers = np.zeros((len(edits), len(NUMBER)), np.float32)
            self.prepared[edits] = (layers, numbers, bounds.reshape(len(edits), self.blocks + 1))
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
    return RowPlan(
        rows=rows,
        base_index=nothing if edited is None else np.searchsorted(edited, rows).astype(np.uint32),
        edits=frozenset(begin),
        begin=begin,
        aligned=frozenset(aligned),
        members=np.concatenate([nothing, *found_members]),
        row_index=np.concatenate([nothing, *found_rows]),
        bounds=bounds,
        prepared={},
    )


@dataclass(frozen=True)
class FlatEdits:
    """All edits as the kernel reads them.

    Args:
        edits, parts: [E,4], [E,A,7], see `compose_kernel.EDIT`, `PART`
        floats, bytes_: lines of 256 numbers of each block of members, blocks and edits back to back
        tables: coefficients and steps of all attributes of all edits
        nodes: of each edit
    """

    edits: NDArray[np.int64]
    parts: NDArray[np.int64]
    floats: NDArray[np.float32]
    bytes_: NDArray[np.int8]
    tables: NDArray[np.float32]
    nodes: tuple[tuple[float, ...], ...]


def flatten_edits(scene: Gaussians, gdfs: Sequence[Gdf], names: Sequence[str]) -> FlatEdits:
    """Lay out the edits' bases for these attributes, and their coverage."""
    edits = np.zeros((len(gdfs), len(EDIT)), np.int64)
    parts = np.full((len(gdfs), len(names), len(PART)), -1, np.int64)
    floats, bytes_ = [np.zeros(0, np.float32)], [np.zeros(0, np.int8)]
    tables = [np.zeros(0, np.float32)]
    ends = [0, 0, 0]  # of the three
    for i, gdf in enumerate(gdfs):
        float_lines: list[NDArray[np.float32]] = []
        byte_lines: list[NDArray[np.int8]] = []
        coverages: dict[str, int] = {}
        for kind, covered in coverage(scene, gdf).items():
            coverages[kind] = len(float_lines)
            float_lines.append(covered.numpy())
        for j, name in enumerate(names):
            bases = gdf.field.attributes.get(name)
            if bases is None:
                continue
            full = len(float_lines)
            float_lines += list(bases.end_offset.numpy().T)
            rest = bases.residual_basis.permute(2, 0, 1).flatten(0, 1)  # the bases of a channel side by side
            is_float = bases.residual_basis.dtype != torch.int8
            lines = len(float_lines) if is_float else len(byte_lines)
            if is_float:
                float_lines += list(rest.float().numpy())
            else:
                byte_lines += list(rest.numpy())
            table, step = ends[2], ends[2] + bases.coefficients.numel()
            tables += [bases.coefficients.numpy().reshape(-1), bases.scale.numpy().reshape(-1)]
            ends[2] = step + bases.scale.numel()
            parts[i, j] = (
                full,
                lines,
                is_float,
                len(bases.residual_basis),
                table,
                step,
                coverages[KINDS[name]],
            )
        edits[i] = ends[0], len(float_lines), ends[1], len(byte_lines)
        floats.append(split_blocks(float_lines, np.float32))
        bytes_.append(split_blocks(byte_lines, np.int8))
        ends[:2] = ends[0] + len(floats[-1]), ends[1] + len(bytes_[-1])
    nodes = tuple(tuple(gdf.field.knots.tolist()) for gdf in gdfs)
    flat = (np.concatenate(floats), np.concatenate(bytes_), np.concatenate(tables))
    return FlatEdits(edits, parts, *flat, nodes)


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


def flatten_scene(
    scene: Gaussians, names: Sequence[str], edited: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]:
    """Attributes of the edited rows in blocks, those of all rows back to back, and where each is.

    Returns:
        What `compose_kernel.compose_rows` takes as `base`, `out` and `columns`.
    """
    tensors: list[Tensor] = [getattr(scene, name).detach().float() for name in names]
    tables = [tensor.numpy().reshape(len(tensor), math.prod(tensor.shape[1:])) for tensor in tensors]
    base = split_blocks([line for table in tables for line in table[edited].T], np.float32)
    out = np.concatenate([np.zeros(0, np.float32), *(table.reshape(-1) for table in tables)])
    columns = np.zeros((len(names), len(COLUMN)), np.int64)
    line = at = 0
    for i, (name, table) in enumerate(zip(names, tables, strict=True)):
        columns[i] = line, table.shape[1], at, NUMBER.index(KINDS[name]), name == "means"
        line, at = line + table.shape[1], at + table.size
    return base, out, columns


def find_segment(nodes: Sequence[float] | NDArray[np.float64], s: float) -> tuple[int, bool, float]:
    """The node at or right of `s`, whether it is there, and else its share of the way from the left one.

    As `BakedField.coefficients`, which continues the outer segments.
    """
    right = min(max(bisect_left(nodes, float(np.float32(s))), 1), len(nodes) - 1)
    left_s, right_s = nodes[right - 1], nodes[right]
    return right, s == right_s, (s - left_s) / (right_s - left_s)


def factors(
    nodes: Sequence[float] | NDArray[np.float64],
    table: NDArray[np.float32],
    step: NDArray[np.float32],
    s: float,
) -> NDArray[np.float32]:
    """What every basis and channel is multiplied with at `s`; as `BakedField.coefficients`. [1+R,c]

    Args:
        nodes: strengths of the table's rows. [S]
        table: an attribute's coefficients. [S,1+R]
        step: what one unit of bases 1..R is worth. [R,c]
        s: strength
    """
    right, on_node, share = find_segment(nodes, s)
    row = table[right]
    if not on_node:
        left = table[right - 1]
        row = left + np.float32(share) * (row - left)
    return np.concatenate([np.full((1, step.shape[1]), row[0]), row[1:, None] * step])
