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

T = TypeVar("T")

_pool: ThreadPoolExecutor | None = None


def at_once(calls: Iterable[Callable[[], T]]) -> list[T]:
    """Make these calls at the same time, the first of them on this thread; their results in order.

    Args:
        calls: at least one; kernels, which release the interpreter's lock
    """
    mine, *others = calls
    pending = [_threads().submit(call) for call in others]
    return [mine(), *(call.result() for call in pending)]


def share(workers: int, kernel: Callable[..., None], *arguments: Any) -> None:
    """Run `kernel(*arguments, claims)` on several threads at once, this one among them.

    Args:
        workers: how many threads, ≥ 1
        kernel: takes its work by `claim`; claims are [3], so that two steps fit in one launch
    """
    call = partial(kernel, *arguments, np.zeros(3, np.int64))
    at_once([call] * workers)


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


@intrinsic  # type: ignore[untyped-decorator]
def claim(typingctx: Any, claims: Any) -> Any:
    """Inside a kernel: the number of the next piece of work, which no other thread gets. int64"""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        counter = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", counter, context.get_constant(types.int64, 1), "monotonic")

    return types.int64(claims), generate


@intrinsic  # type: ignore[untyped-decorator]
def finish(typingctx: Any, claims: Any) -> Any:
    """Inside a kernel: count a claimed piece of work as done."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        one = context.get_constant(types.int64, 1)
        builder.atomic_rmw("add", _done(context, builder, sig, args), one, "release")
        return context.get_dummy_value()

    return types.void(claims), generate


@intrinsic  # type: ignore[untyped-decorator]
def finished(typingctx: Any, claims: Any) -> Any:
    """Inside a kernel: how many pieces of work are done; what they wrote may be read. int64"""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return builder.load_atomic(_done(context, builder, sig, args), "acquire", 8)

    return types.int64(claims), generate


def _done(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
    counter = context.make_array(sig.args[0])(context, builder, args[0]).data
    return builder.gep(counter, [context.get_constant(types.int64, 1)])
