"""Threads that share a kernel's work do each piece once, whoever does it."""

from __future__ import annotations

import os
import threading
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from progdf.rasterize.jit import kernel
from progdf.rasterize.order import depth_order
from progdf.rasterize.shares import SECOND, Team, at_once, claim, enter, finish, finished, leave

Array = NDArray[Any]


@kernel()
def _tick(times: Array, claims: Array) -> None:
    seat = enter(claims)
    piece = claim(claims, seat, times.size)
    while piece < times.size:
        times[piece] += 1
        piece = claim(claims, seat, times.size)
    leave(claims)


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_every_piece_of_work_is_done_once(workers: int) -> None:
    times = np.zeros(100_000, np.int64)
    Team(workers).share(_tick, times)
    assert (times == 1).all()


@kernel()
def _tick_and_add(times: Array, sums: Array, claims: Array) -> None:
    seat = enter(claims)
    piece = claim(claims, seat, times.size)
    while piece < times.size:
        times[piece] = piece
        finish(claims)
        piece = claim(claims, seat, times.size)
    while finished(claims) < times.size:
        pass
    piece = claim(claims[SECOND:], seat, sums.size)
    while piece < sums.size:
        sums[piece] = times.sum()
        piece = claim(claims[SECOND:], seat, sums.size)
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


def test_results_come_in_the_order_of_the_calls_and_the_first_is_made_here() -> None:
    names = at_once(partial(lambda k: (k, threading.get_ident()), k) for k in range(3))
    assert [k for k, _ in names] == [0, 1, 2]
    assert names[0][1] == threading.get_ident()
    assert names[1][1] != threading.get_ident()


def test_an_error_in_another_thread_arrives() -> None:
    def fail() -> None:
        raise ValueError("there")

    with pytest.raises(ValueError, match="there"):
        at_once([lambda: None, fail])


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


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_depth_order_is_numpys_stable_sort_for_every_number_of_threads(workers: int) -> None:
    rng = np.random.default_rng(0)
    depths = rng.choice(np.linspace(0.02, 90.0, 5000).astype(np.float32), 200_000)
    candidates = rng.random(len(depths)) < 0.9
    ids, ranks = depth_order(depths, candidates, Team(workers))
    np.testing.assert_array_equal(ids, np.flatnonzero(candidates))
    np.testing.assert_array_equal(np.argsort(ranks), np.argsort(depths[ids], kind="stable"))
