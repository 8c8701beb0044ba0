"""Threads that share a kernel's work do each piece once, whoever does it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from progdf.rasterize.atomics import seen
from progdf.rasterize.crew import HELPERS, make_way
from progdf.rasterize.jit import kernel
from progdf.rasterize.order import Sorting, depth_order, new_sorting
from progdf.rasterize.shares import _ENTERED, Team, enter, leave, pieces

Array = NDArray[Any]


@kernel()
def _tick(times: Array, claims: Array) -> None:
    seat = enter(claims)
    for piece in pieces(claims, 0, seat, times.size):
        times[piece] += 1
    leave(seat, claims)


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_every_piece_of_work_is_done_once(workers: int) -> None:
    times = np.zeros(100_000, np.int64)
    Team(workers).share(_tick, times)
    assert (times == 1).all()


@kernel(allocates=True)
def _tick_and_add(times: Array, sums: Array, claims: Array) -> None:
    seat = enter(claims)
    for piece in pieces(claims, 0, seat, times.size):
        times[piece] = piece
    for piece in pieces(claims, 1, seat, sums.size):
        sums[piece] = times.sum()
    leave(seat, claims)


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


def test_a_team_without_helpers_does_all_by_itself() -> None:
    everyone = Team(1 + HELPERS)  # and stands by
    times = np.zeros(100, np.int64)
    Team(2).share(_tick, times)
    assert (times == 1).all()
    everyone.share(_tick, times)
    assert (times == 2).all()


@kernel()
def _count_threads(patience: int, found: Array, claims: Array) -> None:
    seat = enter(claims)
    for _ in range(patience):
        if seen(claims.ctypes.data + 8 * _ENTERED) > 1:
            found[seat] = 1
            break
        make_way()
    leave(seat, claims)


def _meet(team: Team) -> bool:
    """Whether a helper comes to a kernel that gives it the time to."""
    found = np.zeros(2 + HELPERS, np.int64)
    team.share(_count_threads, 100_000, found)
    return bool(found[1:].any())


def test_helpers_come() -> None:
    assert _soon(lambda: _meet(Team(2)))
    team = Team(2, launches=3)
    assert all([_meet(team), _meet(team), _meet(team)])


def test_helpers_that_were_called_for_nothing_give_up_and_belong_to_who_calls_next() -> None:
    assert _soon(lambda: _meet(Team(2)))
    forgotten = Team(1 + HELPERS)  # as where a scene is refused before its second launch
    assert _soon(lambda: _meet(Team(2)))

    def keeps_them() -> bool:
        team, times = Team(2, launches=2), np.zeros(100, np.int64)
        first = _meet(team)
        forgotten.share(_tick, times)
        assert (times == 1).all()
        return first and _meet(team)

    assert _soon(keeps_them)


def _soon(holds: Callable[[], bool]) -> bool:
    """Whether something holds within a few tries: a helper may have something else to do for a moment."""
    return any(holds() or time.sleep(0.05) for _ in range(40))


@kernel()
def _fail_at(failing: int, patience: int, times: Array, claims: Array) -> None:
    seat = enter(claims)
    for _ in range(patience):
        if seen(claims.ctypes.data + 8 * _ENTERED) < 2:
            make_way()
    for piece in pieces(claims, 0, seat, times.size):
        if seat == failing:
            raise ValueError("there")
        times[piece] += 1
    leave(seat, claims)


@pytest.mark.parametrize(("failing", "error"), [(0, ValueError), (1, MemoryError)])
def test_an_error_in_one_thread_ends_all(failing: int, error: type[Exception]) -> None:
    def fails() -> bool:
        try:
            Team(2).share(_fail_at, failing, 100_000, np.zeros(1_000_000, np.int64))
        except error:
            return True
        return False

    assert _soon(fails)
    assert _soon(lambda: _meet(Team(2)))


_ENDS = """
from progdf.rasterize.shares import Team
Team(2, launches=2)
"""


def test_python_ends_while_helpers_stand_by() -> None:
    for _ in range(3):
        assert subprocess.run([sys.executable, "-c", _ENDS], timeout=600).returncode == 0


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


@kernel(allocates=True)
def _order(
    depths: Array, candidates: Array, sorting: Sorting, ids: Array, ranks: Array, found: Array, claims: Array
) -> None:
    seat = enter(claims)
    depth_order(depths, candidates, sorting, ids, ranks, found, seat, claims, 0)
    leave(seat, claims)


@pytest.mark.parametrize("values", ["equal", "many", "of all sizes"])
@pytest.mark.parametrize("count", [0, 1, 1000, 200_000])
@pytest.mark.parametrize("workers", [1, 2, 3])
def test_depth_order_is_numpys_stable_sort_for_every_number_of_threads(
    workers: int, count: int, values: str
) -> None:
    rng = np.random.default_rng(0)
    kinds = {
        "equal": [3.0],
        "many": np.linspace(0.02, 90.0, 5000),
        "of all sizes": np.geomspace(1e-38, 3e38, 999),
    }
    depths = rng.choice(np.asarray(kinds[values], np.float32), count)
    candidates = rng.random(count) < 0.9
    ids, ranks, found = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(1, np.int64)
    Team(workers).share(_order, depths, candidates, new_sorting(count, workers), ids, ranks, found)
    np.testing.assert_array_equal(ids[: found[0]], np.flatnonzero(candidates))
    expected = np.argsort(depths[candidates], kind="stable")
    np.testing.assert_array_equal(np.argsort(ranks[: found[0]]), expected)
