"""The inner loop of `progdf.composer`: one attribute of many rows, summed over layers from bases as they
are stored.

Self-contained, because numba's cache on disk notices changes of this file only.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.jit import kernel

BLOCK = 256
"""Rows worked on at once: sums of an attribute stay in the first cache, loops over contiguous members."""

LAYER = np.dtype(
    [
        ("places", "i8"),  # where the layer's list of members and rows begins
        ("dense", "i8"),  # 1: the members of the list follow each other without a gap
        ("members", "i8"),  # M of its edit: the stride between channels
        ("moves", "i8"),  # 0: it does not move this attribute, but may cover what lies below
        ("full", "i8"),  # where basis 0 begins, [c,M] float32
        ("rest", "i8"),  # where bases 1..R begin, [R,c,M], int8 or float32
        ("rest_is_float", "i8"),
        ("rank", "i8"),  # R
        ("coefficients", "i8"),  # where the [1+R,c] factors begin, steps included
        ("weights", "i8"),  # where its [M] weights begin; −1: all 1
        ("gain", "f4"),
        ("cover", "f4"),
    ]
)
"""One layer of the stack, as the kernel reads it; offsets count elements of the flat arrays."""


@kernel(cache=True)
def blend_rows(
    base: NDArray[np.float32],
    out: NDArray[np.float32],
    rows: NDArray[np.int64],
    layers: NDArray[Any],
    bounds: NDArray[np.int64],
    list_members: NDArray[np.int32],
    list_rows: NDArray[np.int32],
    floats: NDArray[np.float32],
    bytes_: NDArray[np.int8],
    coefficients: NDArray[np.float32],
    weights: NDArray[np.float32],
    over: bool,
    normalise: bool,
    measure: bool,
    first_block: int,
    last_block: int,
) -> float:
    """Write base + blend of the layers' offsets into `out`, for blocks of `rows`; see
    `progdf.compose.compose`.

    Args:
        base, out: the scene's and the edited attribute. [N,c]
        rows: what is written, ascending. [U]
        layers: the stack, lowest first. [L] of `LAYER`
        bounds: where each block begins in each layer's list. [L,B+1]
        list_members, list_rows: a layer's members among `rows`, and where in `rows` they are; lists back to
            back
        floats, bytes_: bases, channel by channel
        coefficients: factors of the bases at the present strengths
        weights: per member
        over, normalise: the blend rule; neither is the plain sum
        measure: find the largest step
        first_block, last_block: which blocks of 256 rows

    Returns:
        The largest squared distance between new and old rows of `out`; 0 where not measured.
    """
    width = base.shape[1]
    total = np.empty((width, 256), np.float32)
    offset = np.empty((width, 256), np.float32)
    crowd = np.empty(256, np.float32)
    one = np.float32(1.0)
    largest = 0.0
    for block in range(first_block, last_block):
        begin = block * 256
        count = min(256, len(rows) - begin)
        total[:, :count] = np.float32(-0.0)  # added to anything, it leaves every bit as it was
        crowd[:count] = np.float32(0.0)
        for index in range(len(layers)):
            layer = layers[index]
            first = bounds[index, block]
            found = bounds[index, block + 1] - first
            if found == 0:
                continue
            start = layer.places + first
            member = list_members[start]
            stride = layer.members
            if layer.moves != 0:
                for channel in range(width):
                    line = offset[channel]
                    factor = coefficients[layer.coefficients + channel]
                    at = layer.full + channel * stride
                    if layer.dense != 0:
                        for i in range(found):
                            line[i] = factor * floats[at + member + i]
                    else:
                        for i in range(found):
                            line[i] = factor * floats[at + list_members[start + i]]
                    for k in range(layer.rank):
                        factor = coefficients[layer.coefficients + (1 + k) * width + channel]
                        if factor == 0.0:
                            continue
                        at = layer.rest + (k * width + channel) * stride
                        if layer.rest_is_float != 0:
                            for i in range(found):
                                line[i] += factor * floats[at + list_members[start + i]]
                        elif layer.dense != 0:
                            for i in range(found):
                                line[i] += factor * np.float32(bytes_[at + member + i])
                        else:
                            for i in range(found):
                                line[i] += factor * np.float32(bytes_[at + list_members[start + i]])
            for i in range(found):
                row = list_rows[start + i] - begin
                share = one
                if layer.weights >= 0:
                    share = weights[layer.weights + list_members[start + i]]
                    if share == 0.0:
                        continue
                crowd[row] += share * layer.cover
                if over:
                    below = one - share * layer.cover
                    for channel in range(width):
                        total[channel, row] *= below
                if layer.moves != 0:
                    factor = share * layer.gain
                    for channel in range(width):
                        total[channel, row] += factor * offset[channel, i]
        for i in range(count):
            row = rows[begin + i]
            moved = 0.0
            divisor = crowd[i] if normalise and crowd[i] > one else one
            for channel in range(width):
                value = base[row, channel] + total[channel, i] / divisor
                if measure:
                    step = float(value) - float(out[row, channel])
                    moved += step * step
                out[row, channel] = value
            if moved > largest:
                largest = moved
    return largest
