"""How several threads share the work of a kernel.

A kernel that can be shared takes a counter as its last argument and claims from it what to do next until
nothing is left. So one thread or several run the same machine code, a thread that is late leaves its share to
the others, and as no two pieces write to the same place, the result is the same bits. numba's own `prange`
costs about 0.1 ms a launch (its threads doze between launches) and aborts when two Python threads launch at
once.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, TypeVar

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from progdf.rasterize.jit import kernel

Array = NDArray[Any]
T = TypeVar("T")

CLAIMS = 9
"""Counters of a shared kernel: pieces of work taken, from the front and from the back; the same of a second
step, where there is one; pieces of the first step done; threads that have entered and left."""

SECOND = 3
"""Where a second step's counters begin."""

_TAKEN, _FRONT, _BACK, _DONE, _ENTERED, _LEFT = 0, 1, 2, 6, 7, 8
_PATIENCE = 1 << 20  # looks at a counter before a thread goes to sleep: a millisecond or two

_pool: ThreadPoolExecutor | None = None


def at_once(calls: Iterable[Callable[[], T]]) -> list[T]:
    """Make these calls at the same time, the first of them on this thread; their results in order.

    Args:
        calls: at least one; kernels, which release the interpreter's lock
    """
    mine, *others = calls
    pending = [_threads().submit(call) for call in others]
    return [mine(), *(call.result() for call in pending)]


class Team:
    """The threads of one pass of the rasteriser, this one among them.

    To be woken takes a thread about 50 µs, as long as a small kernel: so they are called while the kernel's
    arguments are still being made, and one that comes too late is not waited for.
    """

    def __init__(self, workers: int) -> None:
        """workers: how many threads, ≥ 1"""
        self.workers = workers
        self._called: _Job | None = None

    def at_most(self, workers: int) -> Team:
        """As many of them as are worth it."""
        return Team(workers) if workers < self.workers else self

    def call(self) -> None:
        """Wake the others; they stand by for the next kernel for a millisecond or two."""
        self._called = _Job(self.workers - 1)

    def share(self, kernel: Callable[..., None], *arguments: Any) -> None:
        """Run `kernel(*arguments, claims)` on all threads at once.

        Args:
            kernel: between `enter` and `leave` it takes its work by `claim`; claims are [CLAIMS]
        """
        job = self._called or _Job(self.workers - 1)
        self._called = None
        job.run(partial(kernel, *arguments, job.claims))


class _Job:
    """A kernel that several threads run."""

    def __init__(self, others: int) -> None:
        self.claims = np.zeros(CLAIMS, np.int64)
        self._run: Callable[[], None] | None = None
        self._others = [_threads().submit(self._help) for _ in range(others)]

    def run(self, call: Callable[[], None]) -> None:
        self._run = call
        call()
        if self._others and not _has_left(self.claims, _PATIENCE):
            for other in self._others:
                if not other.cancel():
                    other.result()

    def _help(self) -> None:
        if _has_entered(self.claims, _PATIENCE) and self._run is not None:
            self._run()


def _threads() -> ThreadPoolExecutor:
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="rasterize")
    return _pool


def _forget_threads() -> None:
    """A forked process has its parent's pool without the threads."""
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_threads)


@kernel(inline=True)
def claim(claims: Array, seat: int, pieces: int) -> int:
    """Inside a kernel: the next of so many pieces of work, which no other thread gets; `pieces` when all are
    taken.

    Every other thread begins at the last piece: so of one pass and the next, and of forward and backward, a
    processor has much of the same memory.
    """
    if _take(claims, _TAKEN) >= pieces:
        return pieces
    if seat % 2 == 0:
        return _take(claims, _FRONT)
    return pieces - 1 - _take(claims, _BACK)


@intrinsic  # type: ignore[untyped-decorator]
def _take(typingctx: Any, claims: Any, place: Any) -> Any:
    """Add one to a counter; what it was before."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        counters = context.make_array(sig.args[0])(context, builder, args[0]).data
        one = context.get_constant(types.int64, 1)
        return builder.atomic_rmw("add", builder.gep(counters, [args[1]]), one, "monotonic")

    return types.int64(claims, types.int64), generate


@intrinsic  # type: ignore[untyped-decorator]
def finish(typingctx: Any, claims: Any) -> Any:
    """Inside a kernel: count a claimed piece of work as done."""
    return _adding(claims, _DONE)


@intrinsic  # type: ignore[untyped-decorator]
def finished(typingctx: Any, claims: Any) -> Any:
    """Inside a kernel: how many pieces of work are done; what they wrote may be read. int64"""
    return _reading(claims, _DONE)


@intrinsic  # type: ignore[untyped-decorator]
def leave(typingctx: Any, claims: Any) -> Any:
    """The last thing that a shared kernel does."""
    return _adding(claims, _LEFT)


@intrinsic  # type: ignore[untyped-decorator]
def _entered(typingctx: Any, claims: Any) -> Any:
    return _reading(claims, _ENTERED)


@intrinsic  # type: ignore[untyped-decorator]
def _left(typingctx: Any, claims: Any) -> Any:
    return _reading(claims, _LEFT)


@kernel(inline=True)
def enter(claims: Array) -> int:
    """The first thing that a shared kernel does: the thread's seat."""
    return _take(claims, _ENTERED)


@kernel(cache=True)
def _has_entered(claims: Array, patience: int) -> bool:
    """Wait until a thread has entered; False: it was not worth waiting."""
    for _ in range(patience):  # noqa: SIM110 - numba has no generators within a kernel
        if _entered(claims) > 0:
            return True
    return False


@kernel(cache=True)
def _has_left(claims: Array, patience: int) -> bool:
    """Wait until all who have entered have left; False: it was not worth waiting."""
    for _ in range(patience):  # noqa: SIM110
        if _left(claims) == _entered(claims):
            return True
    return False


def _adding(claims: Any, place: int) -> Any:
    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        one = context.get_constant(types.int64, 1)
        builder.atomic_rmw("add", _counter(context, builder, sig, args, place), one, "release")
        return context.get_dummy_value()

    return types.void(claims), generate


def _reading(claims: Any, place: int) -> Any:
    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return builder.load_atomic(_counter(context, builder, sig, args, place), "acquire", 8)

    return types.int64(claims), generate


def _counter(context: Any, builder: ir.IRBuilder, sig: Any, args: Any, place: int) -> ir.Value:
    counters = context.make_array(sig.args[0])(context, builder, args[0]).data
    return builder.gep(counters, [context.get_constant(types.int64, place)])
