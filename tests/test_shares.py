"""Threads that share a kernel's work do each piece once, whoever does it."""

from __future__ import annotations

import os
import threading
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from progdf.rasterize.jit import kernel
from progdf.rasterize.order import Sorting, depth_order, new_sorting
from progdf.rasterize.shares import _ENTERED, Team, _crew, _make_way, _seen, enter, leave, pieces

Array = NDArray[Any]


@kernel()
def _tick(times: Array, claims: Array) -> None:
    seat = enter(claims)
    for piece in pieces(claims, 0, seat, times.size):
        times[piece] += 1
    leave(claims)


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_every_piece_of_work_is_done_once(workers: int) -> None:
    times = np.zeros(100_000, np.int64)
    Team(workers).share(_tick, times)
    assert (times == 1).all()


@kernel()
def _tick_and_add(times: Array, sums: Array, claims: Array) -> None:
    seat = enter(claims)
    for piece in pieces(claims, 0, seat, times.size):
        times[piece] = piece
    for piece in pieces(claims, 1, seat, sums.size):
        sums[piece] = times.sum()
    leave(claims)


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_a_second_step_sees_all_of_the_first(workers: int) -> None:
    for _ in range(20):
        times, sums = np.zeros(5000, np.int64), np.zeros(20, np.int64)
        Team(workers).share(_tick_and_add, times, sums)
        assert (sums == 5000 * 4999 // 2).all()


def test_two_python_threads_may_share_out_work_at_the_same_time() -> None:
    done = [np.zeros(200_000, np.int64) for _ in range(4)]
    callers = [threading.Thread(target=Team(2).share, args=(_tick, times)) for times in done]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert all((times == 1).all() for times in done)


def test_a_helper_that_comes_too_late_is_not_waited_for() -> None:
    busy = threading.Event()
    for _ in range(os.cpu_count() or 1):
        _crew().put(busy.wait)  # all helpers have something else to do
    times = np.zeros(100, np.int64)
    Team(2).share(_tick, times)
    busy.set()
    assert (times == 1).all()


@kernel()
def _fail_unless_first(patience: int, claims: Array) -> None:
    seat = enter(claims)
    if seat > 0:
        raise ValueError("there")
    for _ in range(patience):
        if _seen(claims, _ENTERED) < 2:
            _make_way()
    leave(claims)


def test_an_error_in_a_helper_arrives() -> None:
    Team(1).share(_fail_unless_first, 0)  # is compiled
    with pytest.raises(ValueError, match="there"):
        Team(2).share(_fail_unless_first, 10_000_000)


def test_helpers_that_were_called_for_nothing_give_up() -> None:
    Team(2).call(3)  # as where a scene is refused between two launches
    times = np.zeros(100, np.int64)
    Team(2).share(_tick, times)
    assert (times == 1).all()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_gets_threads_of_its_own() -> None:
    times = np.zeros(1000, np.int64)
    Team(2).share(_tick, times)
    child = os.fork()
    if child == 0:
        Team(2).share(_tick, times)
        os._exit(0 if (times == 2).all() else 1)
    _, status = os.waitpid(child, 0)
    assert status == 0


@kernel()
def _order(
    depths: Array, candidates: Array, sorting: Sorting, ids: Array, ranks: Array, found: Array, claims: Array
) -> None:
    seat = enter(claims)
    depth_order(depths, candidates, sorting, ids, ranks, found, seat, claims, 0)
    leave(claims)


@pytest.mark.parametrize("count", [0, 1000, 200_000])
@pytest.mark.parametrize("workers", [1, 2, 3])
def test_depth_order_is_numpys_stable_sort_for_every_number_of_threads(workers: int, count: int) -> None:
    rng = np.random.default_rng(0)
    depths = rng.choice(np.linspace(0.02, 90.0, 5000).astype(np.float32), count)
    candidates = rng.random(count) < 0.9
    ids, ranks, found = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(1, np.int64)
    Team(workers).share(_order, depths, candidates, new_sorting(count, workers), ids, ranks, found)
    np.testing.assert_array_equal(ids[: found[0]], np.flatnonzero(candidates))
    expected = np.argsort(depths[candidates], kind="stable")
    np.testing.assert_array_equal(np.argsort(ranks[: found[0]]), expected)
