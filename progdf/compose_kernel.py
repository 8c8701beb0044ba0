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
        ("members", "i8"),  # M of its edit
        ("moves", "i8"),  # 0: it does not move this attribute, but may cover what lies below
        ("full", "i8"),  # where basis 0 begins, [M,c] float32
        ("rest", "i8"),  # where bases 1..R begin, [R,M,c], int8 or float32
        ("rest_is_float", "i8"),
        ("rank", "i8"),  # R
        ("factors", "i8"),  # the line of `factors` for basis 0; those of the others follow
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
    width: int,
    rows: NDArray[np.int64],
    layers: NDArray[Any],
    bounds: NDArray[np.int64],
    list_members: NDArray[np.int32],
    list_rows: NDArray[np.int32],
    floats: NDArray[np.float32],
    bytes_: NDArray[np.int8],
    factors: NDArray[np.float32],
    weights: NDArray[np.float32],
    over: bool,
    crowded: bool,
    measure: bool,
    first_block: int,
    last_block: int,
) -> float:
    """Write base + blend of the layers' offsets into `out`, for blocks of `rows`, as `compose` does.

    Args:
        base, out: the scene's and the edited attribute, N rows of `width` numbers
        rows: what is written, ascending. [U]
        layers: the stack, lowest first. [L] of `LAYER`
        bounds: where each block begins in each layer's list. [L,B+1]
        list_members, list_rows: a layer's members among `rows`, and where these are in it; lists back to back
        floats, bytes_: bases as they are stored
        factors: of each basis at the present strengths, for each channel
        weights: per member
        over: the blend rule "over"
        crowded: the blend rule "normalised", and strengths may add up to more than 1 somewhere
        measure: find the largest step
        first_block, last_block: which blocks of 256 rows

    Returns:
        The largest squared distance between new and old rows of `out`; 0 where not measured.
    """
    total = np.empty(256 * width, np.float32)
    offset = np.empty(256 * width, np.float32)
    crowd = np.empty(256, np.float32)
    one = np.float32(1.0)
    # every factor repeated over a block, so that the sums below run along memory as it lies
    tiles = np.empty((len(factors) // width, 256 * width), np.float32)
    for line in range(len(tiles)):
        for j in range(256 * width):
            tiles[line, j] = factors[line * width + j % width]
    largest = 0.0
    for block in range(first_block, last_block):
        begin = block * 256
        count = min(256, len(rows) - begin)
        for j in range(count * width):
            total[j] = np.float32(-0.0)  # added to anything, it leaves every bit as it was
        for i in range(count):
            crowd[i] = np.float32(0.0)
        for index in range(len(layers)):
            layer = layers[index]
            first = bounds[index, block]
            found = bounds[index, block + 1] - first
            if found == 0:
                continue
            start = layer.places + first
            if layer.moves != 0:
                tile = tiles[layer.factors]
                if layer.dense != 0:
                    numbers = found * width
                    skip = list_members[start] * width
                    part = floats[layer.full + skip : layer.full + skip + numbers]
                    for j in range(numbers):
                        offset[j] = tile[j] * part[j]
                    for k in range(layer.rank):
                        tile = tiles[layer.factors + 1 + k]
                        if not tile[:width].any():
                            continue
                        at = layer.rest + k * layer.members * width + skip
                        if layer.rest_is_float != 0:
                            part = floats[at : at + numbers]
                            for j in range(numbers):
                                offset[j] += tile[j] * part[j]
                        else:
                            levels = bytes_[at : at + numbers]
                            for j in range(numbers):
                                offset[j] += tile[j] * np.float32(levels[j])
                else:
                    for i in range(found):
                        at = layer.full + list_members[start + i] * width
                        for channel in range(width):
                            offset[i * width + channel] = tile[channel] * floats[at + channel]
                    for k in range(layer.rank):
                        tile = tiles[layer.factors + 1 + k]
                        if not tile[:width].any():
                            continue
                        for i in range(found):
                            at = layer.rest + (k * layer.members + list_members[start + i]) * width
                            for channel in range(width):
                                if layer.rest_is_float != 0:
                                    offset[i * width + channel] += tile[channel] * floats[at + channel]
                                else:
                                    level = np.float32(bytes_[at + channel])
                                    offset[i * width + channel] += tile[channel] * level
            if found == count and layer.weights < 0 and not over and not crowded:
                if layer.moves != 0:
                    for j in range(count * width):
                        total[j] += layer.gain * offset[j]
                continue
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
                        total[row * width + channel] *= below
                if layer.moves != 0:
                    factor = share * layer.gain
                    for channel in range(width):
                        total[row * width + channel] += factor * offset[i * width + channel]
        if crowded:
            for i in range(count):
                if crowd[i] > one:
                    for channel in range(width):
                        total[i * width + channel] /= crowd[i]
        if measure:
            for i in range(count):
                at = rows[begin + i] * width
                moved = 0.0
                for channel in range(width):
                    value = base[at + channel] + total[i * width + channel]
                    step = float(value) - float(out[at + channel])
                    moved += step * step
                if moved > largest:
                    largest = moved
        if rows[begin + count - 1] - rows[begin] == count - 1:
            at = rows[begin] * width
            source = base[at : at + count * width]
            target = out[at : at + count * width]
            for j in range(count * width):
                target[j] = source[j] + total[j]
        else:
            for i in range(count):
                at = rows[begin + i] * width
                for channel in range(width):
                    out[at + channel] = base[at + channel] + total[i * width + channel]
    return largest
