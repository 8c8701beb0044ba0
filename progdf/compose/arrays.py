"""Edits, rows and layers as the kernel of `progdf.compose` reads them: arrays with named fields."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

BLOCK = 256
"""Rows worked on at once: the sums of a channel stay in the first cache. The kernel spells it out."""

EDIT = np.dtype([("floats", "i8"), ("float_lines", "i8"), ("bytes", "i8"), ("byte_lines", "i8")], align=True)
"""An edit: where its blocks begin in `Bases.floats`, the lines of 256 of each; the same in `levels`."""

_PART = ("end", "residual", "is_float", "rank", "table", "scale", "coverage")
PART = np.dtype([(name, "i8") for name in _PART], align=True)
"""One attribute of an edit: where the lines of 256 begin in a block of `Bases.floats`, −1 where the edit does
not move it; those of bases 1..R, in `levels` or, if `is_float`, `floats`; R; where its coefficients begin in
`tables`, [S,1+R], and its scales, [R,c]; the line of its coverage in `floats`."""

LAYER = np.dtype(
    [(name, "i8") for name in ("edit", "list", "aligned", "weights", "right", "at_knot")]
    + [("share", "f4"), ("clamped_strength", "f4")],
    align=True,
)
"""A layer: which edit; where its list of members and rows begins; 1 where the members of the list are all of
the edit's; where its [M] weights begin, −1 for all 1; the segment that its strength is in: the right knot, 1
where the strength is at it, and else the share of the way there; the strength within 0..1."""

COLUMN = np.dtype([(name, "i8") for name in ("line", "width", "out", "gain", "centers")], align=True)
"""An attribute: its first line in a block of `Target.base`, its width, its first number in `out`, the column
of `Stack.gains` that scales it, and 1 for the centers."""


GAINS = ("geometry", "opacity", "color")
"""Columns of `Stack.gains`."""


class Bases(NamedTuple):
    """All edits as they are stored.

    Args:
        edits, parts: [E] of `EDIT`, [E,A] of `PART`
        floats, levels: lines of 256 numbers of each block of members, blocks and edits back to back; float32
            and int8
        tables: coefficients and scales of all attributes of all edits
    """

    edits: Array
    parts: Array
    floats: Array
    levels: Array
    tables: Array


class Target(NamedTuple):
    """The scene before and after.

    Args:
        base: its numbers in all rows that any edit may change, in blocks of 256
        out: the edited attributes, back to back, each of N rows
        columns: where each attribute is. [A] of `COLUMN`
    """

    base: Array
    out: Array
    columns: Array


class Rows(NamedTuple):
    """What is written, and which members meet there.

    Args:
        rows: ascending. [U] uint64
        base_index: which row of `Target.base` each of them is. [U] uint32
        members, row_index: an edit's members among `rows`, and where these are in it; edits back to back.
            uint32
    """

    rows: Array
    base_index: Array
    members: Array
    row_index: Array


class Stack(NamedTuple):
    """The layers, lowest first.

    Args:
        layers: [L] of `LAYER`
        gains: geometry, opacity, color. [L,3] float32
        bounds: where each block of rows begins in each layer's list. [L,B+1]
        weights: per member, of all layers that have any. float32
        over: the blend rule "over"
        normalize: the blend rule "normalized", and strengths may add up to more than 1 somewhere
    """

    layers: Array
    gains: Array
    bounds: Array
    weights: Array
    over: bool
    normalize: bool
