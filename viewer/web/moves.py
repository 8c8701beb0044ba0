"""Moves on a web page: the edits that carry others, as src/moves.js reads them.

See `progdf.compose.parents.rows` for the computation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.compose.parents.rows import MOVED, anchored_rows
from progdf.gdf.file import Gdf
from progdf.sh import half_turn
from progdf.similarity import AffineMotion

NO_PART = -1
"""Part of members that have none, such as copies."""


def pack_moves(
    gdfs: Sequence[Gdf],
    place: NDArray[np.int64],
    inside: Sequence[Tensor],
    kept: int,
    add: Callable[[NDArray[Any]], dict[str, Any]],
    edit_record: Callable[[Gdf, Tensor], dict[str, Any]],
) -> list[dict[str, Any]]:
    """Append the moves among some edits; return their header entries.

    Args:
        gdfs: edits of the extended scene, with their motions
        place: position of each row on the page. [N]
        inside: members of each edit in the page's order. [M] each
        kept: number of SH coefficients above the first
        add: appends an array to the container and returns its entry
        edit_record: appends an edit, given with its members in the page's order, and returns its entry
    """
    records = []
    for edit, (gdf, members) in enumerate(zip(gdfs, inside, strict=True)):
        motions = gdf.motions
        if motions is None:
            continue
        attributes = {name: bases for name, bases in gdf.field.attributes.items() if name in MOVED}
        moved = replace(gdf, field=replace(gdf.field, attributes=attributes), motions=None)
        parts = torch.full((len(gdf.region),), NO_PART)
        parts[: len(motions.parts)] = motions.parts
        page = np.empty(len(members), np.int64)
        page[members.numpy()] = np.arange(len(members))
        records.append(
            {
                "edit": edit,
                "field": edit_record(moved, members),
                "motions": [[_motion(motion, kept) for motion in part] for part in motions.motions],
                "parts": add(parts[members].numpy().astype(np.int32)),
                "added": _added_records(gdfs, gdf, place, page, add),
            }
        )
    return records


def _added_records(
    gdfs: Sequence[Gdf],
    move: Gdf,
    place: NDArray[np.int64],
    page: NDArray[np.int64],
    add: Callable[[NDArray[Any]], dict[str, Any]],
) -> list[dict[str, Any]]:
    """Append the rows that follow a move; return their entries, one per edit that adds some.

    Args:
        gdfs, move: edits of the extended scene
        place: position of each row on the page. [N]
        page: index of each member of the move on the page. [M]
        add: appends an array to the container
    """
    entries = []
    for edit, gdf in enumerate(gdfs):
        found = anchored_rows(gdf, move)
        if found is None:
            continue
        rows = place[found.rows.numpy()]
        order = np.argsort(rows)
        table = np.column_stack([rows[:, None], page[found.members.numpy()]])[order]
        weights = found.weights.numpy()[order]
        entries.append(
            {
                "edit": edit,
                "rows": add(table.astype(np.int32)),
                "weights": add(weights.astype(np.float32)),
            }
        )
    return entries


def _motion(motion: AffineMotion, kept: int) -> dict[str, Any]:
    """Return the header entry of a motion: its stretch as axes and logarithms of their factors."""
    logs, axes = torch.linalg.eigh(motion.stretch)
    parity = None
    if motion.mirror is not None:
        signs = [1.0, 1.0, 1.0]
        signs[motion.mirror] = -1.0
        by_band = half_turn(torch.ones(1, kept, 3), (signs[0], signs[1], signs[2]))
        parity = by_band[0, :, 0].tolist()
    return {
        "turn": motion.turn.tolist(),
        "axes": axes.tolist(),
        "logs": logs.tolist(),
        "mirror": motion.mirror,
        "parity": parity,
    }
