"""Kernels: the order of depth, by radix sort of the Gaussians.

Sorting N Gaussians once is much less than sorting their intersections with tiles; the sort is stable, so the
result does not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .jit import Number, kernel
from .shares import pieces

Array = NDArray[Any]

_DIGIT = 11  # bits
_DIGITS = 3  # of a key, least significant first
_BUCKETS = 1 << _DIGIT

_WORTH_A_THREAD = 65_536  # keys below which handing half of them over takes longer than moving them

STEPS = 1 + 3 * _DIGITS
"""Steps of `depth_order`, see `shares.pieces`."""


class Sorting(NamedTuple):
    """What the sort works in.

    Args:
        keys, items: keys that sort as depths do, and what they belong to. [N] uint32, [N] int32
        new_keys, new_items: the same after a digit
        places: where each part of the keys puts those with each value of a digit. [≥ threads, 2048] int64
    """

    keys: Array
    items: Array
    new_keys: Array
    new_items: Array
    places: Array


def new_sorting(count: int, workers: int) -> Sorting:
    """For so many Gaussians and threads."""
    return Sorting(
        np.empty(count, np.uint32), np.empty(count, np.int32), np.empty(count, np.uint32),
        np.empty(count, np.int32), np.empty((max(workers, _DIGITS), _BUCKETS), np.int64),
    )  # fmt: skip


@kernel(inline=True)
def _gather_keys(depths: Array, candidates: Array, ids: Array, keys: Array, items: Array) -> int:
    """List the candidates, ready to be sorted; how many there are."""
    bits = depths.view(np.uint32)  # positive floats sort as their bits
    count = 0
    for i in range(depths.size):
        if candidates[i]:
            ids[count], keys[count], items[count] = i, bits[i], count
            count += 1
    return count


@kernel(inline=True)
def _count_digits(keys: Array, begin: int, end: int, shift: Number, mask: Number, places: Array) -> None:
    """How often each value of a digit occurs; places: out, zero on entry."""
    for k in range(begin, end):
        places[keys[k] >> shift & mask] += 1


@kernel(inline=True)
def _place_digits(places: Array) -> None:
    """Turn counts into the places where each part puts its keys, bucket by bucket; in place."""
    total = 0
    for bucket in range(places.shape[1]):
        for part in range(places.shape[0]):
            here = places[part, bucket]
            places[part, bucket] = total
            total += here


@kernel(inline=True)
def _move_digits(
    keys: Array, items: Array, begin: int, end: int, shift: Number, mask: Number, places: Array,
    new_keys: Array, new_items: Array,
) -> None:  # fmt: skip
    """Put keys and items where `places` says, which is used up."""
    for k in range(begin, end):
        bucket = keys[k] >> shift & mask
        at = places[bucket]
        places[bucket] = at + 1
        new_keys[at], new_items[at] = keys[k], items[k]


@kernel(inline=True)
def _rank_digits(
    keys: Array, items: Array, begin: int, end: int, shift: Number, mask: Number, places: Array, ranks: Array
) -> None:
    """As `_move_digits` for the last digit: what an item's place is, is all that is wanted."""
    for k in range(begin, end):
        bucket = keys[k] >> shift & mask
        ranks[items[k]] = places[bucket]
        places[bucket] += 1


@kernel(inline=True)
def _spread_of(keys: Array, count: int) -> tuple[Number, Number]:
    """The least key, and how many bits the others are above it."""
    low, high = keys[0], keys[0]
    for k in range(count):
        low, high = min(low, keys[k]), max(high, keys[k])
    bits = 0
    while (high - low) >> np.uint32(bits) > 0:
        bits += 1
    return low, bits


@kernel(inline=True)
def _sort(sorting: Sorting, count: int, ranks: Array) -> None:
    """On one thread: with digits as small as the keys allow, all of them counted at once."""
    keys, items, new_keys, new_items, places = sorting
    low, bits = _spread_of(keys, count)
    digit = (bits + _DIGITS - 1) // _DIGITS
    mask, second, third = np.uint32((1 << digit) - 1), np.uint32(digit), np.uint32(2 * digit)
    places = places[:_DIGITS, : 1 << digit]
    places[:] = 0
    for k in range(count):
        key = keys[k] - low
        keys[k] = key
        places[0, key & mask] += 1
        places[1, key >> second & mask] += 1
        places[2, key >> third & mask] += 1
    for d in range(_DIGITS):
        _place_digits(places[d : d + 1])
    _move_digits(keys, items, 0, count, np.uint32(0), mask, places[0], new_keys, new_items)
    _move_digits(new_keys, new_items, 0, count, second, mask, places[1], keys, items)
    _rank_digits(keys, items, 0, count, third, mask, places[2], ranks)


@kernel()
def depth_order(
    depths: Array, candidates: Array, sorting: Sorting, ids: Array, ranks: Array, found: Array, seat: int,
    claims: Array, step: int,
) -> int:  # fmt: skip
    """The candidates and their places in the order of depth, ties by index; all threads take part.

    Args:
        depths: > 0. [N] float32
        candidates: [N] bool
        sorting: as from `new_sorting`
        ids: out, indices of the V candidates, ascending. [N] int64
        ranks: out, the place of each, 0 is nearest. [N] int64
        found: out, V. [≥1] int64
        seat, claims: see `shares`
        step: the first of STEPS

    Returns:
        V
    """
    keys, items, new_keys, new_items, places = sorting
    for _ in pieces(claims, step, seat, 1):
        found[0] = _gather_keys(depths, candidates, ids, keys, items)
        if 0 < found[0] < _WORTH_A_THREAD:
            _sort(sorting, found[0], ranks)
    count: int = found[0]
    if count < _WORTH_A_THREAD:
        return count
    parts = min(places.shape[0], 1 + count // _WORTH_A_THREAD)
    size = (count + parts - 1) // parts
    mask = np.uint32(_BUCKETS - 1)
    for digit in range(_DIGITS):
        shift = np.uint32(digit * _DIGIT)
        step += 1
        for part in pieces(claims, step, seat, parts):
            places[part] = 0
            _count_digits(keys, part * size, min(count, (part + 1) * size), shift, mask, places[part])
        step += 1
        for _ in pieces(claims, step, seat, 1):
            _place_digits(places[:parts])
        step += 1
        for part in pieces(claims, step, seat, parts):
            begin, end = part * size, min(count, (part + 1) * size)
            if digit + 1 == _DIGITS:
                _rank_digits(keys, items, begin, end, shift, mask, places[part], ranks)
            else:
                _move_digits(keys, items, begin, end, shift, mask, places[part], new_keys, new_items)
        keys, new_keys, items, new_items = new_keys, keys, new_items, items
    return count
