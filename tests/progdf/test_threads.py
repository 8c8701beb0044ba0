"""Tests of chunks shared by threads: each chunk runs exactly once."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from progdf.threads import StoppedError, _local, run_chunks, set_threads, stopped_by

pytestmark = pytest.mark.usefixtures("two_threads")


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("chunks", [0, 1, 3, 1000])
def test_every_chunk_runs_once_and_results_are_in_order(threads: int, chunks: int) -> None:
    set_threads(threads)
    done: list[int] = []

    def square(chunk: int) -> int:
        done.append(chunk)
        return chunk * chunk

    assert run_chunks(square, chunks) == [chunk * chunk for chunk in range(chunks)]
    assert sorted(done) == list(range(chunks))


def test_thread_of_the_pool_takes_part() -> None:
    met = threading.Barrier(2, timeout=60)
    run_chunks(lambda _: met.wait(), 2)


def test_concurrent_callers_each_get_their_own_results() -> None:
    with ThreadPoolExecutor(8) as callers:
        found = list(callers.map(lambda n: run_chunks(lambda chunk: n * chunk, 50), range(40)))
    assert found == [[n * chunk for chunk in range(50)] for n in range(40)]


def test_busy_pool_does_not_block_a_caller() -> None:
    release, busy = threading.Event(), threading.Barrier(3, timeout=60)

    def hold(_: int) -> None:
        busy.wait()
        release.wait(60)

    holder = threading.Thread(target=run_chunks, args=(hold, 2), daemon=True)
    caller = threading.Thread(target=lambda: found.extend(run_chunks(lambda n: n, 10)), daemon=True)
    found: list[int] = []
    holder.start()
    busy.wait()  # the holder and, on a machine of two cores, the pool's only thread
    caller.start()
    caller.join(30)
    in_time = list(found)
    release.set()
    holder.join(30)
    assert in_time == list(range(10))


def test_error_in_any_thread_reaches_the_caller_after_all_chunks() -> None:
    met = threading.Barrier(2, timeout=60)
    done = []

    def fail(chunk: int) -> None:
        if chunk < 2:
            met.wait()
            if threading.current_thread() is not threading.main_thread():
                raise MemoryError("none left")
        done.append(chunk)

    with pytest.raises(MemoryError, match="none left"):
        run_chunks(fail, 20)
    assert len(done) == 19


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_forked_process_gets_its_own_threads() -> None:
    run_chunks(lambda chunk: chunk, 2)
    child = os.fork()
    if child == 0:
        try:
            met = threading.Barrier(2, timeout=60)
            os._exit(0 if len(run_chunks(lambda _: met.wait(), 2)) == 2 else 1)
        finally:
            os._exit(1)
    _, status = os.waitpid(child, 0)
    assert status == 0


def test_python_exits_after_threads_ran() -> None:
    code = "from progdf.threads import *; set_threads(2); run_chunks(print, 4)"
    assert subprocess.run([sys.executable, "-c", code], timeout=600, check=False).returncode == 0


@pytest.mark.parametrize("count", [1, 2])
def test_cancelled_work_stops_between_two_chunks(count: int) -> None:
    set_threads(count)
    stop = threading.Event()
    done = []

    def one(chunk: int) -> None:
        done.append(chunk)
        stop.set()

    with stopped_by(stop), pytest.raises(StoppedError):
        run_chunks(one, 100)
    assert len(done) <= count
    assert run_chunks(lambda chunk: chunk, 3) == [0, 1, 2], "the next one goes on"


def test_nested_chunks_run_on_the_thread_that_started_them() -> None:
    """A busy pool would otherwise keep the nested chunks and their arrays until all are done."""
    set_threads(2)
    seen: list[set[str]] = []

    def inner(chunk: int) -> str:
        return threading.current_thread().name

    def outer(chunk: int) -> str:
        seen.append(set(run_chunks(inner, 4)))
        return threading.current_thread().name

    names = run_chunks(outer, 8)
    assert sorted(map(tuple, seen)) == sorted((name,) for name in names)
    assert not _local.is_inner, "what comes after may be shared again"
