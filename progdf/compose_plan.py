"""What `progdf.composer` prepares once: edits as flat arrays, and which members share which rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.checkpoint import Gdf
from progdf.compose_kernel import BLOCK
from progdf.field.baked import AttributeBases


@dataclass(frozen=True)
class FlatBases:
    """One attribute of one edit: where its numbers lie in the flat arrays, and its coefficients."""

    full: int
    rest: int
    rest_is_float: bool
    table: NDArray[np.float32]
    step: NDArray[np.float32]


@dataclass(frozen=True)
class Plan:
    """How to rewrite the members of some edits, with all others that share rows with them.

    Args:
        rows: what is rewritten. [U]
        edits: indices of the edits that have members among them
        begin: where each edit's list begins within `members` and `places`
        dense: edits whose list has no gap
        members, places: members of the edits, and where in `rows` they are
        bounds: where each block of rows begins in each edit's list. [B+1]
    """

    rows: NDArray[np.int64]
    edits: frozenset[int]
    begin: Mapping[int, int]
    dense: frozenset[int]
    members: NDArray[np.int32]
    places: NDArray[np.int32]
    bounds: Mapping[int, NDArray[np.int64]]


def plan_rows(members: Sequence[NDArray[np.int64]], changed: frozenset[int]) -> Plan:
    """The plan that rewrites all members of the changed edits.

    Args:
        members: of every edit, sorted. [M] each
        changed: indices of edits
    """
    chosen = [members[edit] for edit in sorted(changed)]
    rows = chosen[0] if len(chosen) == 1 else np.unique(np.concatenate(chosen))
    edges = np.arange(-(-len(rows) // BLOCK) + 1) * BLOCK
    begin: dict[int, int] = {}
    bounds: dict[int, NDArray[np.int64]] = {}
    dense = set()
    found_members, found_places = [], []
    length = 0
    for edit, own in enumerate(members):
        places = np.searchsorted(rows, own)
        inside = np.flatnonzero(rows[np.minimum(places, len(rows) - 1)] == own) if len(rows) else places[:0]
        if not len(inside):
            continue
        begin[edit] = length
        length += len(inside)
        if int(inside[-1] - inside[0]) + 1 == len(inside):
            dense.add(edit)
        places = places[inside]
        found_members.append(inside.astype(np.int32))
        found_places.append(places.astype(np.int32))
        bounds[edit] = np.searchsorted(places, edges).astype(np.int64)
    nothing = np.zeros(0, np.int32)
    return Plan(
        rows=rows,
        edits=frozenset(begin),
        begin=begin,
        dense=frozenset(dense),
        members=np.concatenate([nothing, *found_members]),
        places=np.concatenate([nothing, *found_places]),
        bounds=bounds,
    )


def flat_bases(
    gdfs: Sequence[Gdf],
) -> tuple[NDArray[np.float32], NDArray[np.int8], list[dict[str, FlatBases]]]:
    """All bases back to back as they are stored, and where each attribute's begin."""
    floats, bytes_ = [np.zeros(0, np.float32)], [np.zeros(0, np.int8)]

    def put(kept: list[Any], tensor: Tensor) -> int:
        begin = sum(len(part) for part in kept)
        kept.append(tensor.contiguous().view(-1).numpy())
        return begin

    def laid(bases: AttributeBases) -> FlatBases:
        is_float = bases.rest.dtype != torch.int8
        full = put(floats, bases.full)
        rest = put(floats, bases.rest.float()) if is_float else put(bytes_, bases.rest)
        return FlatBases(full, rest, is_float, bases.coefficients.numpy(), bases.step.numpy())

    found = [{name: laid(bases) for name, bases in gdf.field.attributes.items()} for gdf in gdfs]
    return np.concatenate(floats), np.concatenate(bytes_), found


def factors(
    nodes: NDArray[np.float64], table: NDArray[np.float32], step: NDArray[np.float32], s: float
) -> NDArray[np.float32]:
    """What every basis and channel is multiplied with at `s`; as `BakedField.coefficients`. [1+R,c]

    Args:
        nodes: strengths of the table's rows. [S]
        table: an attribute's coefficients. [S,1+R]
        step: what one unit of bases 1..R is worth. [R,c]
        s: strength
    """
    right = min(max(int(np.searchsorted(nodes, np.float32(s))), 1), len(nodes) - 1)
    left_s, right_s = float(nodes[right - 1]), float(nodes[right])
    row = table[right]
    if s != right_s:
        left = table[right - 1]
        row = left + np.float32((s - left_s) / (right_s - left_s)) * (row - left)
    return np.concatenate([np.full((1, step.shape[1]), row[0]), row[1:, None] * step])
