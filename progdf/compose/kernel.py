"""The inner loop of `progdf.compose.composer`: all attributes of many rows, summed over layers from bases as
they are stored, in one call.

Numbers lie in blocks of 256 members, channel by channel within a block: every sum runs along memory with one
factor, and a step reads each array from front to back.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.cpu.jit import Number, kernel

from .arrays import Bases, Rows, Stack, Target

Array = NDArray[Any]


@kernel(cache=True, allocates=True)
def compose_rows(
    target: Target,
    rows: Rows,
    stack: Stack,
    bases: Bases,
    chosen: Array,
    first_block: int,
    last_block: int,
) -> float:
    """Write base + blend of the layers' offsets into `out`, for blocks of `rows`, as `compose_layers` does.

    Args:
        chosen: the attributes to write, rows of `Target.columns`
        first_block, last_block: which blocks of 256 rows

    Returns:
        The largest squared distance between new and old centers; 0 where these are not chosen.
    """
    one, none = np.float32(1.0), np.float32(-0.0)  # adding −0 leaves every bit
    columns, layers = target.columns, stack.layers
    weight_sum = np.empty(256, np.float32)
    member_weights = np.ones(len(layers) * 256, np.float32)
    values = np.empty(256 * (1 + columns["width"].max()), np.float32)
    base_lines = columns[-1].line + columns[-1].width
    offset = np.uint64(len(values) - 256)
    largest = np.float32(0.0)
    for block in range(first_block, last_block):
        begin = block * 256
        count = min(256, len(rows.rows) - begin)
        _gather_weights(rows, stack, weight_sum, member_weights, block)
        contiguous = (
            rows.base_index[begin] % 256 == 0
            and rows.base_index[begin + count - 1] - rows.base_index[begin] == count - 1
        )
        for attribute in chosen:
            column = columns[attribute]
            for c in range(column.width):
                total = np.uint64(c * 256)
                empty = True
                for index in range(len(layers)):
                    layer = layers[index]
                    start = layer.list + stack.bounds[index, block]
                    found = stack.bounds[index, block + 1] - stack.bounds[index, block]
                    gain = stack.gains[index, column.gain]
                    part = bases.parts[layer.edit, attribute]
                    if found == 0 or part.end < 0 or gain == 0:
                        continue
                    whole = found == count and layer.weights < 0 and (empty or not stack.over)
                    into = total if empty and whole else offset
                    _sum(values, into, rows.members, start, found, layer, part, c, column.width, bases)
                    if empty and whole:
                        empty = False
                        if gain != one:
                            for i in range(count):
                                values[total + np.uint64(i)] *= gain
                        continue
                    if empty:
                        empty = False
                        for i in range(count):
                            values[total + np.uint64(i)] = none
                    if whole:
                        for i in range(count):
                            values[total + np.uint64(i)] += gain * values[offset + np.uint64(i)]
                        continue
                    hidden = layer.clamped_strength * min(abs(gain), one)
                    edit = bases.edits[layer.edit]
                    for i in range(found):
                        weight = member_weights[index * 256 + i]
                        if weight == 0.0:
                            continue
                        row = total + np.uint64(rows.row_index[start + i] - begin)
                        if stack.over:
                            at = _place(rows.members[start + i], edit.float_lines, part.coverage)
                            covered = bases.floats[np.uint64(edit.floats) + at]
                            values[row] *= one - (weight * hidden) * covered
                        values[row] += (weight * gain) * values[offset + np.uint64(i)]
                if empty:
                    for i in range(count):
                        values[total + np.uint64(i)] = none
                if stack.normalize:
                    for i in range(count):
                        values[total + np.uint64(i)] /= weight_sum[i]
                line = column.line + c
                if contiguous:
                    at = _place(rows.base_index[begin], base_lines, line)
                    for i in range(count):
                        values[total + np.uint64(i)] += target.base[at + np.uint64(i)]
                else:
                    for i in range(count):
                        at = _place(rows.base_index[begin + i], base_lines, line)
                        values[total + np.uint64(i)] += target.base[at]
            if column.centers != 0:
                for i in range(count):
                    old = np.uint64(column.out) + rows.rows[np.uint64(begin + i)] * np.uint64(3)
                    x = values[i] - target.out[old]
                    y = values[256 + i] - target.out[old + np.uint64(1)]
                    z = values[512 + i] - target.out[old + np.uint64(2)]
                    largest = max(largest, x * x + y * y + z * z)
            _write(target.out, np.uint64(column.out), rows.rows, begin, count, column.width, values)
    return float(largest)


@kernel(inline=True)
def _gather_weights(
    rows: Rows, stack: Stack, weight_sum: Array, member_weights: Array, block: Number
) -> None:
    """The layers' weights in a block, and Σ m s of its rows, at least 1."""
    begin = block * 256
    if stack.normalize:
        for i in range(256):
            weight_sum[i] = np.float32(0.0)
    for index in range(len(stack.layers)):
        layer = stack.layers[index]
        start = layer.list + stack.bounds[index, block]
        found = stack.bounds[index, block + 1] - stack.bounds[index, block]
        own = index * 256
        if layer.weights >= 0:
            for i in range(found):
                member_weights[own + i] = stack.weights[layer.weights + rows.members[start + i]]
        if stack.normalize:
            for i in range(found):
                row = rows.row_index[start + i] - begin
                weight_sum[row] += member_weights[own + i] * layer.clamped_strength
    if stack.normalize:
        for i in range(256):
            weight_sum[i] = max(weight_sum[i], np.float32(1.0))


@kernel(inline=True)
def _place(row: Number, lines: Number, line: Number) -> Number:
    """Where a row's number is among blocks of 256 with so many lines each."""
    row = np.uint64(row)
    block = row >> np.uint64(8)
    return ((block * np.uint64(lines) + np.uint64(line)) << np.uint64(8)) + (row & np.uint64(255))


@kernel(inline=True)
def _sum(
    values: Array,
    into: Number,
    members: Array,
    start: Number,
    found: Number,
    layer: Number,
    part: Number,
    c: Number,
    width: Number,
    bases: Bases,
) -> None:
    """Σ_k a_k(s) · basis k of one channel, for a layer's members: `BakedField.attribute_offsets`."""
    edit = bases.edits[layer.edit]
    aligned, is_float = layer.aligned != 0, part.is_float != 0
    ends = np.uint64(edit.floats)
    residuals, lines = ends, edit.float_lines
    if not is_float:
        residuals, lines = np.uint64(edit.bytes), edit.byte_lines
    member = members[start]
    factor = _coefficient(bases.tables, part, layer, 0)
    zero = factor == 0
    line = part.end + c
    if aligned:
        at = ends + _place(member, edit.float_lines, line)
        for i in range(found):
            values[into + np.uint64(i)] = factor * bases.floats[at + np.uint64(i)]
    else:
        for i in range(found):
            at = ends + _place(members[start + i], edit.float_lines, line)
            values[into + np.uint64(i)] = factor * bases.floats[at]
    k = 1
    while k <= part.rank:
        factor = _coefficient(bases.tables, part, layer, k)
        zero = zero and factor == 0
        k += 1
        if factor == 0:
            continue
        factor *= bases.tables[part.scale + (k - 2) * width + c]
        line = part.residual + c * part.rank + k - 2
        if not aligned:
            for i in range(found):
                at = residuals + _place(members[start + i], lines, line)
                number = bases.floats[at] if is_float else np.float32(bases.levels[at])
                values[into + np.uint64(i)] += factor * number
            continue
        at = residuals + _place(member, lines, line)
        if is_float:
            for i in range(found):
                values[into + np.uint64(i)] += factor * bases.floats[at + np.uint64(i)]
            continue
        following = np.float32(0.0)
        if k <= part.rank:
            following = _coefficient(bases.tables, part, layer, k)
        if following != 0:  # two bases at once: half as many sums to fetch and to put back
            zero = False
            following *= bases.tables[part.scale + (k - 1) * width + c]
            k += 1
            for i in range(found):
                value = values[into + np.uint64(i)] + factor * np.float32(bases.levels[at + np.uint64(i)])
                second = np.float32(bases.levels[at + np.uint64(256 + i)])
                values[into + np.uint64(i)] = value + following * second
        else:
            for i in range(found):
                values[into + np.uint64(i)] += factor * np.float32(bases.levels[at + np.uint64(i)])
    if zero:
        for i in range(found):
            values[into + np.uint64(i)] = np.float32(0.0)


@kernel(inline=True)
def _coefficient(tables: Array, part: Number, layer: Number, k: Number) -> Number:
    """a_k(s) of a layer's attribute, linear between two knots: `BakedField.coefficients`."""
    at = part.table + layer.right * (1 + part.rank) + k
    right = tables[at]
    if layer.at_knot != 0:
        return right
    left = tables[at - 1 - part.rank]
    return left + layer.share * (right - left)


@kernel(inline=True)
def _write(
    out: Array, first: Number, rows: Array, begin: Number, count: Number, width: Number, values: Array
) -> None:
    """Channels side by side again, into their rows."""
    if width == 3:
        for i in range(count):
            to = first + rows[np.uint64(begin + i)] * np.uint64(3)
            for c in range(3):
                out[to + np.uint64(c)] = values[c * 256 + i]
    elif width == 4:
        for i in range(count):
            to = first + rows[np.uint64(begin + i)] * np.uint64(4)
            for c in range(4):
                out[to + np.uint64(c)] = values[c * 256 + i]
    else:
        for c in range(width):
            for i in range(count):
                to = first + rows[np.uint64(begin + i)] * np.uint64(width) + np.uint64(c)
                out[to] = values[c * 256 + i]
