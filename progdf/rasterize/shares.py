"""How several threads share the work of a kernel.

A kernel that can be shared takes counters as its last argument and claims from them what to do next until
nothing is left, step by step. So one thread or several run the same machine code, a thread that is late
leaves its share to the others, and as no two pieces write to the same place, the result is the same bits.
numba's own `prange` costs about 0.1 ms a launch (its threads doze between launches) and aborts when two
Python threads launch at once.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from queue import SimpleQueue
from typing import Any

import numpy as np
from llvmlite import binding as llvm
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from progdf.rasterize.jit import Number, kernel

Array = NDArray[Any]

_STEPS = 15  # of a kernel, at most
_ENTERED, _LEFT = 0, 1  # threads that have
_TAKEN, _DONE = 2, 3  # pieces of a step's work
_COUNTERS = 2  # of a step
_FROM_THE_BACK = 1 << 32  # what a piece from the back adds to those taken; one from the front adds 1
_CLAIMS = 2 + _COUNTERS * _STEPS

_LOOKS = 64  # at a counter, before a thread lets others have its processor for a moment
_PATIENCE = 2000  # such moments before it goes to sleep: a millisecond or so

_threads: _Crew | None = None


class Team:
    """The threads of one pass of the rasteriser, this one among them.

    To be woken takes a thread about 50 µs, as long as a small kernel: so they are called while the kernel's
    arguments are still being made, and one that comes too late is not waited for.
    """

    def __init__(self, workers: int) -> None:
        """workers: how many threads, ≥ 1"""
        self.workers = workers
        self._called: deque[_Job] = deque()

    def call(self, kernels: int = 1) -> None:
        """Wake the others; they stand by for each of the next kernels for a millisecond or two."""
        self._called.extend(_Job(self.workers - 1) for _ in range(kernels))

    def share(self, kernel: Callable[..., None], *arguments: Any) -> None:
        """Run `kernel(*arguments, claims)` on all threads at once.

        Args:
            kernel: between `enter` and `leave` it gets its work from `pieces`; claims: as `new_claims`
        """
        job = self._called.popleft() if self._called else _Job(self.workers - 1)
        job.run(partial(kernel, *arguments, job.claims))


class _Job:
    """A kernel that several threads run."""

    def __init__(self, others: int) -> None:
        self.claims = new_claims()
        self._run: Callable[[], None] | None = None
        self._error: BaseException | None = None
        self._others = min(others, _crew().count) if others else 0
        for _ in range(self._others):
            _crew().put(self.help)

    def run(self, call: Callable[[], None]) -> None:
        self._run = call
        call()
        while self._others and not _has_left(self.claims):
            if self._error is not None:
                raise self._error
            time.sleep(0.001)

    def help(self) -> None:
        if _has_entered(self.claims) and self._run is not None:
            try:
                self._run()
            except BaseException as error:
                self._error = error


class _Crew:
    """Threads that wait for jobs, one for each processor but the caller's, so that they take them in turn.

    An executor's would hold the interpreter's lock for 20 µs with each job.
    """

    def __init__(self, count: int) -> None:
        jobs: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self.put, self.count = jobs.put, count
        for k in range(count):
            threading.Thread(target=_work, args=(jobs,), name=f"rasterize-{k}", daemon=True).start()


def _work(jobs: SimpleQueue[Callable[[], None]]) -> None:
    while True:
        jobs.get()()


def _crew() -> _Crew:
    global _threads
    if _threads is None:
        _threads = _Crew(max(1, (os.cpu_count() or 1) - 1))
    return _threads


def _forget_threads() -> None:
    """A forked process has its parent's crew without the threads."""
    global _threads
    _threads = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_threads)


def _system_yield() -> int:
    """Where in memory the system's function is that lets other threads have the processor."""
    if sys.platform == "win32":
        return ctypes.cast(ctypes.windll.kernel32.SwitchToThread, ctypes.c_void_p).value or 0
    return ctypes.cast(ctypes.CDLL(None).sched_yield, ctypes.c_void_p).value or 0


# a thread that waits must not keep from the processor the one that it waits for
llvm.add_symbol("progdf_make_way", _system_yield())
_make_way = types.ExternalFunction("progdf_make_way", types.int32())


def new_claims() -> Array:
    """The counters of a shared kernel. int64"""
    return np.zeros(_CLAIMS, np.int64)


@kernel(inline=True)
def enter(claims: Array) -> Number:
    """The first thing that a shared kernel does: the thread's seat."""
    return _take(claims, _ENTERED, 1)


@kernel(inline=True)
def leave(claims: Array) -> None:
    """The last thing that a shared kernel does."""
    _take(claims, _LEFT, 1)


@kernel()
def pieces(claims: Array, step: int, seat: int, count: int) -> Iterator[Number]:
    """Inside a kernel: the pieces of a step's work that this thread is to do, of so many (< 2³¹); then it
    waits until the others have done theirs, so that what they wrote may be read.

    Every other thread begins at the last piece: so of one pass and the next, and of forward and backward, a
    processor has much of the same memory. What is waited for is at most a piece of each of the others:
    shorter than to sleep and be woken.
    """
    taken, done = _COUNTERS * step + _TAKEN, _COUNTERS * step + _DONE
    one = 1 if seat % 2 == 0 else _FROM_THE_BACK
    own = 0
    while True:
        before = _take(claims, taken, one)
        front, back = before & (_FROM_THE_BACK - 1), before >> 32
        if front + back >= count:
            break
        yield front if one == 1 else count - 1 - back
        own += 1
    _take(claims, done, own)
    looks = 0
    while _seen(claims, done) < count:
        looks += 1
        if looks % _LOOKS == 0:
            _make_way()


@intrinsic  # type: ignore[untyped-decorator]
def _take(typingctx: Any, claims: Any, place: Any, amount: Any) -> Any:
    """Add to a counter; what it was before. What was written before is seen by who sees the counter."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        counter = _counter(context, builder, sig, *args[:2])
        return builder.atomic_rmw("add", counter, args[2], "release")

    return types.int64(claims, types.int64, types.int64), generate


@intrinsic  # type: ignore[untyped-decorator]
def _seen(typingctx: Any, claims: Any, place: Any) -> Any:
    """A counter."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return builder.load_atomic(_counter(context, builder, sig, *args), "acquire", 8)

    return types.int64(claims, types.int64), generate


def _counter(context: Any, builder: ir.IRBuilder, sig: Any, claims: ir.Value, place: ir.Value) -> ir.Value:
    return builder.gep(context.make_array(sig.args[0])(context, builder, claims).data, [place])


@kernel(cache=True)
def _has_entered(claims: Array) -> bool:
    """Wait until a thread has entered; False: it was not worth waiting."""
    for _ in range(_PATIENCE):
        for _ in range(_LOOKS):
            if _seen(claims, _ENTERED) > 0:
                return True
        _make_way()
    return False


@kernel(cache=True)
def _has_left(claims: Array) -> bool:
    """Wait until all who have entered have left; False: it was not worth waiting."""
    for _ in range(_PATIENCE):
        for _ in range(_LOOKS):
            if _seen(claims, _LEFT) == _seen(claims, _ENTERED):
                return True
        _make_way()
    return False
