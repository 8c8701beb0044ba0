"""Kernels: the order of depth, by radix sort of the Gaussians.

Sorting N Gaussians once is much less than sorting their intersections with tiles; the sort is stable, so the
result does not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.jit import kernel
from progdf.rasterize.shares import Team, claim, enter, leave

Array = NDArray[Any]

_DIGIT = 11  # bits
DIGITS = 3
"""Digits of a key, least significant first."""

BUCKETS = 1 << _DIGIT
"""Values of a digit."""

_WORTH_A_THREAD = 65_536  # keys below which handing half of them over takes longer than moving them


@kernel(cache=True)
def gather_keys(depths: Array, candidates: Array) -> tuple[Array, Array, Array]:
    """The candidates, ready to be sorted.

    Args:
        depths: > 0. [N] float32
        candidates: [N] bool

    Returns:
        their indices, ascending [V] int64; keys that sort as their depths do [V] uint32; 0, 1, 2, … [V] int32
    """
    count = 0
    for i in range(depths.size):
        count += candidates[i]
    bits = depths.view(np.uint32)  # positive floats sort as their bits
    ids, keys, items = np.empty(count, np.int64), np.empty(count, np.uint32), np.empty(count, np.int32)
    at = 0
    for i in range(depths.size):
        if candidates[i]:
            ids[at], keys[at], items[at] = i, bits[i], at
            at += 1
    return ids, keys, items


@kernel(cache=True)
def count_digits(keys: Array, digit: int, places: Array, claims: Array) -> None:
    """How often each value of a digit occurs in each part of the keys; places: out, [parts, BUCKETS]."""
    parts = places.shape[0]
    step = (keys.size + parts - 1) // parts
    shift = np.uint32(digit * _DIGIT)
    seat = enter(claims)
    part = claim(claims, seat, parts)
    while part < parts:
        places[part] = 0
        for k in range(part * step, min(keys.size, (part + 1) * step)):
            places[part, (keys[k] >> shift) & np.uint32(BUCKETS - 1)] += 1
        part = claim(claims, seat, parts)
    leave(claims)


@kernel(cache=True)
def place_digits(places: Array) -> None:
    """Turn counts into the places where each part puts its keys, bucket by bucket; in place."""
    total = 0
    for bucket in range(BUCKETS):
        for part in range(places.shape[0]):
            here = places[part, bucket]
            places[part, bucket] = total
            total += here


@kernel(cache=True)
def move_digits(
    keys: Array, items: Array, digit: int, places: Array, new_keys: Array, new_items: Array, claims: Array
) -> None:
    """Put keys and items where `places` says, which is used up."""
    parts = places.shape[0]
    step = (keys.size + parts - 1) // parts
    shift = np.uint32(digit * _DIGIT)
    seat = enter(claims)
    part = claim(claims, seat, parts)
    while part < parts:
        for k in range(part * step, min(keys.size, (part + 1) * step)):
            bucket = (keys[k] >> shift) & np.uint32(BUCKETS - 1)
            at = places[part, bucket]
            places[part, bucket] = at + 1
            new_keys[at], new_items[at] = keys[k], items[k]
        part = claim(claims, seat, parts)
    leave(claims)


@kernel(cache=True)
def rank_items(items: Array) -> Array:
    """The place of each item. [V] int64"""
    ranks = np.empty(items.size, np.int64)
    for place in range(items.size):
        ranks[items[place]] = place
    return ranks


def depth_order(depths: Array, candidates: Array, team: Team) -> tuple[Array, Array]:
    """The candidates and their places in the order of depth, ties by index.

    Args:
        depths: > 0. [N] float32
        candidates: [N] bool
        team: who takes part

    Returns:
        indices of the candidates, ascending [V] int64; rank of each, 0 is nearest [V] int64
    """
    ids, keys, items = gather_keys(depths, candidates)
    new_keys, new_items = np.empty_like(keys), np.empty_like(items)
    team = team.at_most(1 + len(keys) // _WORTH_A_THREAD)
    places = np.empty((team.workers, BUCKETS), np.int64)
    for digit in range(DIGITS):
        team.share(count_digits, keys, digit, places)
        place_digits(places)
        team.share(move_digits, keys, items, digit, places, new_keys, new_items)
        keys, new_keys, items, new_items = new_keys, keys, new_items, items
    return ids, rank_items(items)
