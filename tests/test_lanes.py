"""Eight numbers at once inside kernels do what numpy does to arrays of eight."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from progdf.rasterize.gathers import first, gather, rows_at, rows_from, scatter
from progdf.rasterize.jit import Number, kernel
from progdf.rasterize.lanes import (
    WIDTH,
    Lanes,
    any_of,
    choose,
    count,
    load,
    spread,
    store,
    times_power,
    total,
    totals,
    whole,
    widen,
)
from progdf.rasterize.pixels import exp2, new_cards

Array = NDArray[Any]


def numbers(seed: int, rows: int = 1) -> Array:
    return np.random.default_rng(seed).normal(size=(rows, WIDTH)).astype(np.float32) * 3


@kernel(fast=True)
def _arithmetic(a: Array, b: Array, single: Number, out: Array) -> None:
    x, y = load(a, np.uint64(0)), load(b, np.uint64(0))
    store(out, np.uint64(0), x + y)
    store(out, np.uint64(8), x - y)
    store(out, np.uint64(16), single * x)
    store(out, np.uint64(24), x / y)
    added = x
    added += single
    store(out, np.uint64(32), added)


def test_arithmetic_is_lane_by_lane_and_a_single_number_stands_for_eight() -> None:
    a, b = numbers(0)[0], numbers(1)[0]
    out = np.zeros(40, np.float32)
    _arithmetic(a, b, np.float32(1.5), out)
    expected = [a + b, a - b, np.float32(1.5) * a, a / b, a + np.float32(1.5)]
    np.testing.assert_allclose(out.reshape(5, 8), expected, rtol=2e-7)


@kernel(fast=True)
def _comparisons(a: Array, b: Array, out: Array) -> None:
    x, y, one, zero = load(a, np.uint64(0)), load(b, np.uint64(0)), np.float32(1.0), np.float32(0.0)
    store(out, np.uint64(0), choose(x < y, spread(one), spread(zero)))
    store(out, np.uint64(8), choose(x <= y, one, zero))
    store(out, np.uint64(16), choose(x > y, one, zero))
    store(out, np.uint64(24), choose((zero < x) & (x < y), x, y))


def test_comparisons_choose_lane_by_lane_and_tell_less_from_equal() -> None:
    a, b = numbers(2)[0], numbers(3)[0]
    b[:3] = a[:3]
    out = np.zeros(32, np.float32)
    _comparisons(a, b, out)
    expected = [a < b, a <= b, a > b, np.where((a > 0) & (a < b), a, b)]
    np.testing.assert_array_equal(out.reshape(4, 8), np.array(expected, np.float32))


@kernel(fast=True)
def _at(source: Array, start: Number, out: Array) -> None:
    store(out, start, load(source, start) + count())


def test_loads_and_stores_begin_at_any_place_and_leave_the_rest_alone() -> None:
    source, out = np.arange(20, dtype=np.float32), np.full(20, -1, np.float32)
    _at(source, np.uint64(5), out)
    np.testing.assert_array_equal(out[5:13], np.arange(5, 13) + np.arange(8))
    assert (out[:5] == -1).all()
    assert (out[13:] == -1).all()


@kernel(fast=True)
def _sums(rows: Array, out: Array) -> None:
    flat = rows.reshape(-1)
    r = (
        load(flat, np.uint64(0)), load(flat, np.uint64(8)), load(flat, np.uint64(16)),
        load(flat, np.uint64(24)), load(flat, np.uint64(32)), load(flat, np.uint64(40)),
        load(flat, np.uint64(48)), load(flat, np.uint64(56)),
    )  # fmt: skip
    store(out, np.uint64(0), totals(r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7]))
    for k in range(8):
        out[8 + k] = total(load(flat, np.uint64(8 * k)))


def test_eight_sums_at_once_are_eight_sums_one_by_one() -> None:
    rows, out = numbers(4, rows=8), np.zeros(16, np.float32)
    _sums(rows, out)
    np.testing.assert_allclose(out[:8], rows.sum(axis=1, dtype=np.float64), rtol=1e-5)
    np.testing.assert_allclose(out[8:], rows.sum(axis=1, dtype=np.float64), rtol=1e-5)


@kernel(fast=True)
def _wholes(a: Array, out: Array) -> None:
    x = load(a, np.uint64(0))
    store(out, np.uint64(0), whole(x))
    store(out, np.uint64(8), times_power(spread(np.float32(0.75)), whole(x)))


def test_whole_numbers_are_cut_towards_zero_and_scale_by_powers_of_two() -> None:
    a, out = np.array([-125.5, -3.999, -1, -0.5, 0, 0.5, 3.999, 100], np.float32), np.zeros(16, np.float32)
    _wholes(a, out)
    np.testing.assert_array_equal(out[:8], np.trunc(a))
    np.testing.assert_array_equal(out[8:], 0.75 * 2.0 ** np.trunc(a))


@kernel(fast=True)
def _exp2(a: Array, out: Array) -> None:
    cards = new_cards()
    for k in range(a.size // 8):
        at = np.uint64(8 * k)
        powers: Lanes = exp2(load(a, at), cards)
        store(out, at, powers)


def test_powers_of_two_are_right_to_the_last_bits_and_exact_at_whole_numbers() -> None:
    a = np.concatenate([np.linspace(-20, 0, 4000), -np.arange(120.0), np.zeros(8)]).astype(np.float32)
    out = np.empty_like(a)
    _exp2(a, out)
    np.testing.assert_allclose(out, np.exp2(a.astype(np.float64)), rtol=2.5e-7)
    np.testing.assert_array_equal(out[4000:4120], np.exp2(-np.arange(120.0)))


def test_lanes_of_another_type_are_refused_when_the_kernel_is_compiled() -> None:
    from numba.core.errors import TypingError

    with pytest.raises(TypingError):
        _arithmetic(numbers(0)[0], numbers(1)[0], "one", np.zeros(40, np.float32))


@kernel(contract=True)
def _in_double(a: Array, b: Array, out: Array) -> None:
    x, y = load(a, np.uint64(0)), load(b, np.uint64(0))
    lanes = (
        x / y, -x, abs(x), math.sqrt(abs(x)), math.log2(abs(x)), np.floor(x), np.ceil(x), min(x, y),
        max(0.5, x), choose(x == y, 1.0, x), choose(x >= y, x, 0.0),
    )  # fmt: skip
    for k in range(len(lanes)):
        store(out, np.uint64(k * 8), lanes[k])
    out[88] = total(x)


def test_float64_lanes_are_as_exact_as_numbers_one_by_one() -> None:
    a, b = numbers(5)[0].astype(np.float64) / 3, numbers(6)[0].astype(np.float64)
    b[:2] = a[:2]
    out = np.zeros(89)
    _in_double(a, b, out)
    size = np.abs(a)
    expected = [
        a / b, -a, size, np.sqrt(size), np.log2(size), np.floor(a), np.ceil(a), np.minimum(a, b),
        np.maximum(0.5, a), np.where(a == b, 1.0, a), np.where(a >= b, a, 0.0),
    ]  # fmt: skip
    np.testing.assert_allclose(out[:88].reshape(11, 8), expected, rtol=3e-16)
    assert out[88] == pytest.approx(a.sum(), rel=1e-15)


@kernel()
def _nans(a: Array, out: Array) -> None:
    x = load(a, np.uint64(0))
    store(out, np.uint64(0), min(max(x, -1.0), 1.0))
    out[8] = any_of(x > 2.0)
    out[9] = any_of(x > 1e3)


def test_what_is_not_a_number_stays_in_its_lane() -> None:
    a, out = np.array([np.nan, 3.0, -3.0, 0.5, np.inf, -np.inf, np.nan, 0.0]), np.zeros(10)
    _nans(a[:8], out)
    np.testing.assert_array_equal(out[:8], [np.nan, 1.0, -1.0, 0.5, 1.0, -1.0, np.nan, 0.0])
    assert out[8:].tolist() == [1.0, 1.0]
    _nans(np.full(8, np.nan), out)
    assert out[8:].tolist() == [0.0, 0.0]


@kernel()
def _one_or_eight(x: Number, y: Number) -> Number:
    return choose(x < y, math.sqrt(y - x), max(x, 2.0))


@kernel()
def _both_ways(a: Array, b: Array, out: Array) -> None:
    store(out, np.uint64(0), _one_or_eight(load(a, np.uint64(0)), load(b, np.uint64(0))))
    for k in range(8):
        out[8 + k] = _one_or_eight(a[k], b[k])


def test_one_function_serves_one_number_and_eight() -> None:
    a, b, out = numbers(7)[0].astype(np.float64), numbers(8)[0].astype(np.float64), np.zeros(16)
    _both_ways(a, b, out)
    np.testing.assert_array_equal(out[:8], out[8:])


@kernel()
def _moved(source: Array, ids: Array, begin: int, out: Array, marks: Array) -> None:
    i, k = rows_at(ids, begin, ids.size), rows_from(begin, ids.size)
    scatter(out, k, 1, gather(source, i, 2))
    scatter(marks, i, 0, first(ids.size - begin))


def test_rows_are_gathered_and_scattered_and_past_the_end_the_last_is_repeated() -> None:
    source = numbers(9, rows=6)[:, :3].copy()
    ids = np.array([4, 0, 3, 5, 1])
    out, marks = np.full((7, 2), -9.0), np.zeros(6, np.bool_)
    _moved(source, ids, 2, out, marks)
    np.testing.assert_array_equal(out[2:5, 1], source[[3, 5, 1], 2].astype(np.float64))
    assert (out[[0, 1, 5, 6]] == -9.0).all()
    assert (out[:, 0] == -9.0).all()
    assert marks.tolist() == [False, False, False, True, False, True]  # row 1: overwritten by a surplus lane


@kernel()
def _wide(a: Array, out: Array) -> None:
    store(out, np.uint64(0), widen(load(a, np.uint64(0))))


def test_widening_is_exact() -> None:
    a, out = numbers(10)[0], np.zeros(8)
    _wide(a, out)
    np.testing.assert_array_equal(out, a.astype(np.float64))
