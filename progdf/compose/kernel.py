"""The inner loop of `progdf.compose.composer`: all attributes of many rows, summed over layers from bases as
they are stored, in one call.

Numbers lie in blocks of 256 members, channel by channel within a block: every sum runs along memory with one
factor, and a step reads each array from front to back. Self-contained, because numba's cache on disk notices
changes of this file only.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.cpu.jit import Number, kernel

BLOCK = 256
"""Rows worked on at once: the sums of a channel stay in the first cache. The kernels spell it out."""

PART = ("full", "rest", "rest_is_float", "rank", "table", "step", "coverage")
"""Columns of `parts`, one line an edit and attribute: where the lines of 256 begin in an edit's block of
`floats`, −1 where the edit does not move it; those of bases 1..R, in `bytes_` or `floats`; R; where its
coefficients begin in `tables`, [S,1+R], and its steps, [R,c]; the line of its coverage in `floats`."""

EDIT = ("floats", "float_lines", "bytes", "byte_lines")
"""Columns of `edits`: where its blocks begin in `floats`, the lines of 256 of each; the same in `bytes_`."""

LAYER = ("edit", "list", "aligned", "weights", "node", "on_node")
"""Columns of `layers`: which edit; where its list of members and rows begins; 1 where the members of the list
are all of the edit's; where its [M] weights begin, −1 for all 1; the node at or right of the strength; 1
where it is at the node."""

NUMBER = ("between", "clamped_strength", "geometry", "opacity", "color")
"""Columns of `numbers`: where between two nodes the strength is; the strength within 0..1; its gains."""

COLUMN = ("line", "width", "out", "gain", "centers")
"""Columns of `columns`, one line an attribute: its first line in a block of `base`, its width, its first
number in `out`, the column of `numbers` with its gain, and 1 for the centers."""


@kernel(cache=True, allocates=True)
def compose_rows(
    base: NDArray[np.float32],
    out: NDArray[np.float32],
    rows: NDArray[np.uint64],
    base_index: NDArray[np.uint32],
    columns: NDArray[np.int64],
    chosen: NDArray[np.int64],
    layers: NDArray[np.int64],
    numbers: NDArray[np.float32],
    bounds: NDArray[np.int64],
    list_members: NDArray[np.uint32],
    list_rows: NDArray[np.uint32],
    edits: NDArray[np.int64],
    parts: NDArray[np.int64],
    floats: NDArray[np.float32],
    bytes_: NDArray[np.int8],
    tables: NDArray[np.float32],
    weights: NDArray[np.float32],
    over: bool,
    normalize: bool,
    first_block: int,
    last_block: int,
) -> float:
    """Write base + blend of the layers' offsets into `out`, for blocks of `rows`, as `compose_layers` does.

    Args:
        base: the scene's numbers of all rows that any edit may change, in blocks of 256
        out: the edited attributes, back to back, each of N rows
        rows: what is written, ascending. [U]
        base_index: which row of `base` each of them is. [U]
        columns: [A,5], see `COLUMN`
        chosen: the attributes to write
        layers: the stack, lowest first. [L,6], see `LAYER`
        numbers: [L,5], see `NUMBER`
        bounds: where each block begins in each layer's list. [L,B+1]
        list_members, list_rows: a layer's members among `rows`, and where these are in it; lists back to back
        edits, parts: [E,4], [E,A,7], see `EDIT`, `PART`
        floats, bytes_: bases as they are stored
        tables: coefficients and steps
        weights: per member
        over: the blend rule "over"
        normalize: the blend rule "normalized", and strengths may add up to more than 1 somewhere
        first_block, last_block: which blocks of 256 rows

    Returns:
        The largest squared distance between new and old centers; 0 where these are not chosen.
    """
    one = np.float32(1.0)
    weight_sum = np.empty(256, np.float32)
    member_weights = np.ones(len(layers) * 256, np.float32)
    base_lines = columns[-1, 0] + columns[-1, 1]
    offset = np.uint64(columns[:, 1].max() * 256)
    values = np.empty(
        offset + np.uint64(256), np.float32
    )  # of a block's attribute, and one layer's of a channel
    largest = np.float32(0.0)
    # no slices in here: each would count references, which takes longer than a sum
    for block in range(first_block, last_block):
        begin = block * 256
        count = min(256, len(rows) - begin)
        for index in range(len(layers)):
            if layers[index, 3] >= 0:
                start = layers[index, 1] + bounds[index, block]
                for i in range(bounds[index, block + 1] - bounds[index, block]):
                    member_weights[index * 256 + i] = weights[layers[index, 3] + list_members[start + i]]
        if normalize:
            for i in range(count):
                weight_sum[i] = np.float32(0.0)
            for index in range(len(layers)):
                start = layers[index, 1] + bounds[index, block]
                for i in range(bounds[index, block + 1] - bounds[index, block]):
                    weight_sum[list_rows[start + i] - begin] += (
                        member_weights[index * 256 + i] * numbers[index, 1]
                    )
            for i in range(count):
                weight_sum[i] = max(weight_sum[i], one)
        contiguous = (
            base_index[begin] % 256 == 0 and base_index[begin + count - 1] - base_index[begin] == count - 1
        )
        for attribute in chosen:
            width = columns[attribute, 1]
            for c in range(width):
                total = np.uint64(c * 256)
                empty = True
                for index in range(len(layers)):
                    start = layers[index, 1] + bounds[index, block]
                    found = bounds[index, block + 1] - bounds[index, block]
                    gain = numbers[index, columns[attribute, 3]]
                    edit = layers[index, 0]
                    if found == 0 or parts[edit, attribute, 0] < 0 or gain == 0:
                        continue
                    whole = found == count and layers[index, 3] < 0 and (empty or not over)
                    _sum(
                        values, total if empty and whole else offset, list_members, start, found, layers,
                        numbers, index, attribute, c, width, edits, parts, floats, bytes_, tables,
                    )  # fmt: skip
                    if empty and whole:
                        empty = False
                        if gain != one:
                            for i in range(count):
                                values[total + np.uint64(i)] *= gain
                        continue
                    if empty:
                        empty = False
                        for i in range(count):
                            values[total + np.uint64(i)] = np.float32(-0.0)  # adding leaves every bit
                    if whole:
                        for i in range(count):
                            values[total + np.uint64(i)] += gain * values[offset + np.uint64(i)]
                        continue
                    hidden = numbers[index, 1] * min(abs(gain), one)
                    full, coverage = np.uint64(edits[edit, 0]), parts[edit, attribute, 6]
                    for i in range(found):
                        weight = member_weights[index * 256 + i]
                        if weight == 0.0:
                            continue
                        row = total + np.uint64(list_rows[start + i] - begin)
                        if over:
                            at = full + _place(list_members[start + i], edits[edit, 1], coverage)
                            values[row] *= one - (weight * hidden) * floats[at]
                        values[row] += (weight * gain) * values[offset + np.uint64(i)]
                if empty:
                    for i in range(count):
                        values[total + np.uint64(i)] = np.float32(-0.0)
                if normalize:
                    for i in range(count):
                        values[total + np.uint64(i)] /= weight_sum[i]
                line = columns[attribute, 0] + c
                if contiguous:
                    at = _place(base_index[begin], base_lines, line)
                    for i in range(count):
                        values[total + np.uint64(i)] += base[at + np.uint64(i)]
                else:
                    for i in range(count):
                        values[total + np.uint64(i)] += base[_place(base_index[begin + i], base_lines, line)]
            at = np.uint64(columns[attribute, 2])
            if columns[attribute, 4] != 0:
                for i in range(count):
                    old = at + rows[np.uint64(begin + i)] * np.uint64(3)
                    x = values[i] - out[old]
                    y = values[256 + i] - out[old + np.uint64(1)]
                    z = values[512 + i] - out[old + np.uint64(2)]
                    largest = max(largest, x * x + y * y + z * z)
            _write(out, at, rows, begin, count, width, values)
    return float(largest)


@kernel(inline=True)
def _place(row: Number, lines: Number, line: Number) -> Number:
    """Where a row's number is among blocks of 256 with so many lines each."""
    row = np.uint64(row)
    block = row >> np.uint64(8)
    return ((block * np.uint64(lines) + np.uint64(line)) << np.uint64(8)) + (row & np.uint64(255))


@kernel(inline=True)
def _sum(
    values: NDArray[np.float32],
    into: Number,
    list_members: NDArray[np.uint32],
    start: Number,
    found: Number,
    layers: NDArray[np.int64],
    numbers: NDArray[np.float32],
    index: Number,
    attribute: Number,
    c: Number,
    width: Number,
    edits: NDArray[np.int64],
    parts: NDArray[np.int64],
    floats: NDArray[np.float32],
    bytes_: NDArray[np.int8],
    tables: NDArray[np.float32],
) -> None:
    """Σ_k a_k(s) · basis k of one channel, for a layer's members: `BakedField.attribute_offsets`."""
    edit = layers[index, 0]
    rank = parts[edit, attribute, 3]
    aligned, is_float = layers[index, 2] != 0, parts[edit, attribute, 2] != 0
    full = np.uint64(edits[edit, 0])
    rest, lines = full if is_float else np.uint64(edits[edit, 2]), edits[edit, 1 if is_float else 3]
    member = list_members[start]
    zero = True
    k = 0
    while k <= rank:
        factor = _coefficient(tables, parts, layers, numbers, index, attribute, k)
        zero = zero and factor == 0
        if k == 0:
            line = parts[edit, attribute, 0] + c
            if aligned:
                at = full + _place(member, edits[edit, 1], line)
                for i in range(found):
                    values[into + np.uint64(i)] = factor * floats[at + np.uint64(i)]
            else:
                for i in range(found):
                    at = full + _place(list_members[start + i], edits[edit, 1], line)
                    values[into + np.uint64(i)] = factor * floats[at]
            k += 1
            continue
        k += 1
        if factor == 0:
            continue
        factor *= tables[parts[edit, attribute, 5] + (k - 2) * width + c]
        line = parts[edit, attribute, 1] + c * rank + k - 2
        if not aligned:
            for i in range(found):
                at = rest + _place(list_members[start + i], lines, line)
                number = floats[at] if is_float else np.float32(bytes_[at])
                values[into + np.uint64(i)] += factor * number
            continue
        at = rest + _place(member, lines, line)
        if is_float:
            for i in range(found):
                values[into + np.uint64(i)] += factor * floats[at + np.uint64(i)]
            continue
        following = np.float32(0.0)
        if k <= rank:
            following = _coefficient(tables, parts, layers, numbers, index, attribute, k)
        if following != 0:  # two bases at once: half as many sums to fetch and to put back
            zero = False
            following *= tables[parts[edit, attribute, 5] + (k - 1) * width + c]
            k += 1
            for i in range(found):
                value = values[into + np.uint64(i)] + factor * np.float32(bytes_[at + np.uint64(i)])
                second = np.float32(bytes_[at + np.uint64(256 + i)])
                values[into + np.uint64(i)] = value + following * second
        else:
            for i in range(found):
                values[into + np.uint64(i)] += factor * np.float32(bytes_[at + np.uint64(i)])
    if zero:
        for i in range(found):
            values[into + np.uint64(i)] = np.float32(0.0)


@kernel(inline=True)
def _coefficient(
    tables: NDArray[np.float32],
    parts: NDArray[np.int64],
    layers: NDArray[np.int64],
    numbers: NDArray[np.float32],
    index: Number,
    attribute: Number,
    k: Number,
) -> Number:
    """a_k(s) of a layer's attribute, linear between two nodes: `BakedField.coefficients`."""
    part = layers[index, 0]
    count = 1 + parts[part, attribute, 3]
    at = parts[part, attribute, 4] + layers[index, 4] * count + k
    right = tables[at]
    if layers[index, 5] != 0:
        return right
    left = tables[at - count]
    return left + numbers[index, 0] * (right - left)


@kernel(inline=True)
def _write(
    out: NDArray[np.float32],
    at: Number,
    rows: NDArray[np.uint64],
    begin: Number,
    count: Number,
    width: Number,
    values: NDArray[np.float32],
) -> None:
    """Channels side by side again, into their rows."""
    if width == 3:
        for i in range(count):
            to = at + rows[np.uint64(begin + i)] * np.uint64(3)
            out[to] = values[i]
            out[to + np.uint64(1)] = values[256 + i]
            out[to + np.uint64(2)] = values[512 + i]
    elif width == 4:
        for i in range(count):
            to = at + rows[np.uint64(begin + i)] * np.uint64(4)
            out[to] = values[i]
            out[to + np.uint64(1)] = values[256 + i]
            out[to + np.uint64(2)] = values[512 + i]
            out[to + np.uint64(3)] = values[768 + i]
    else:
        for c in range(width):
            for i in range(count):
                to = at + rows[np.uint64(begin + i)] * np.uint64(width) + np.uint64(c)
                out[to] = values[c * 256 + i]
