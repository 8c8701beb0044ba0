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
from progdf.rasterize.shares import Team, claim, enter, finish, leave, wait

Array = NDArray[Any]


@kernel()
def _tick(times: Array, claims: Array) -> None:
    seat = enter(claims)
    piece = claim(claims, 0, seat, times.size)
    while piece < times.size:
        times[piece] += 1
        piece = claim(claims, 0, seat, times.size)
    leave(claims)


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_every_piece_of_work_is_done_once(workers: int) -> None:
    times = np.zeros(100_000, np.int64)
    Team(workers).share(_tick, times)
    assert (times == 1).all()


@kernel()
def _tick_and_add(times: Array, sums: Array, claims: Array) -> None:
    seat = enter(claims)
    piece = claim(claims, 0, seat, times.size)
    while piece < times.size:
        times[piece] = piece
        finish(claims, 0)
        piece = claim(claims, 0, seat, times.size)
    wait(claims, 0, times.size)
    piece = claim(claims, 1, seat, sums.size)
    while piece < sums.size:
        sums[piece] = times.sum()
        piece = claim(claims, 1, seat, sums.size)
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
