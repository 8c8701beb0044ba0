"""How several threads share the work of a kernel.

A kernel that can be shared claims what to do next from counters until nothing is left, step by step. So one
thread or several run the same machine code, a thread that is late leaves its share to the others, and as no
two pieces write to the same place, the result is the same bits. numba's own `prange` costs about 0.1 ms a
launch (its threads doze between launches) and aborts when two Python threads launch at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from .atomics import add, put, seen
from .crew import ENTRY, HELPERS, LOOKS, call, call_back, engage, make_way
from .jit import Number, kernel

Array = NDArray[Any]

_STEPS = 15  # of a kernel, at most
_LAUNCHES, _HELPERS = 0, 1  # kernels to come; helpers
_FAILED, _ENTERED = 2, 3  # whether a thread has failed; threads that run the kernel
_TAKEN, _DONE = 4, 5  # pieces of a step's work
_COUNTERS = 2  # of a step
_CONTEXT = 4 + _COUNTERS * _STEPS  # what the kernel's arguments are to the machine
_ENGAGED = _CONTEXT + 1024  # the helpers, as `crew.engage` gives them
_FROM_THE_BACK = 1 << 32  # what a piece from the back adds to those taken; one from the front adds 1


class Team:
    """The threads of one pass of the rasteriser, this one among them.

    To be woken takes a thread about 50 µs, as long as a small kernel: so a team is made before its kernels'
    arguments are, and a helper that comes too late is not waited for.
    """

    def __init__(self, workers: int, launches: int = 1) -> None:
        """workers: how many threads, ≥ 1; launches: kernels that they will share"""
        self.workers = workers
        wanted = min(workers - 1, HELPERS)
        self._claims = np.zeros(_ENGAGED + 2 * wanted, np.int64)
        if wanted:
            self._claims[_LAUNCHES] = launches
            self._claims[_HELPERS] = engage(wanted, self._claims[_ENGAGED:])

    def share(self, kernel: Callable[..., None], *arguments: Any) -> None:
        """Run `kernel(*arguments, claims)` on all threads at once.

        Args:
            kernel: between `enter` and `leave` it gets its work from `pieces`

        Raises:
            MemoryError: a thread found none
        """
        try:
            kernel(*arguments, self._claims)
        except BaseException:
            _fail(self._claims)
            raise


@intrinsic  # type: ignore[untyped-decorator]
def enter(typingctx: Any, claims: Any) -> Any:
    """The first thing that a shared kernel does: the thread's seat. The first to enter calls the helpers."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        seat = context.compile_internal(builder, _take_seat, types.int64(claims), args)
        with builder.if_then(builder.icmp_signed("==", seat, ir.Constant(seat.type, 0))):
            numbers = context.make_array(claims)(context, builder, args[0]).data
            code = _put_arguments(context, builder, builder.gep(numbers, [ir.Constant(seat.type, _CONTEXT)]))
            context.compile_internal(builder, _call_all, types.none(claims, types.int64), [args[0], code])
        return seat

    return types.int64(claims), generate


def _put_arguments(context: Any, builder: ir.IRBuilder, place: ir.Value) -> ir.Value:
    """Put those of the function that is built into memory; the address of code that calls it with them."""
    function = builder.function
    given = ir.LiteralStructType([argument.type for argument in function.args[2:]])
    if context.get_abi_sizeof(given) > 8 * (_ENGAGED - _CONTEXT):
        raise ValueError(f"{function.name} has more arguments than there is room for")
    for k, argument in enumerate(function.args[2:]):
        field = builder.gep(builder.bitcast(place, given.as_pointer()), [_index(0), _index(k)])
        builder.store(argument, field)
    kind = context.call_conv.get_function_type(types.none, ENTRY)
    code = ir.Function(builder.module, kind, builder.module.get_unique_name(f"{function.name}.help"))
    code.linkage = "internal"
    inside = ir.IRBuilder(code.append_basic_block())
    fields = inside.load(inside.bitcast(code.args[2], given.as_pointer()))
    values = [inside.extract_value(fields, k) for k in range(len(given.elements))]
    inside.ret(inside.call(function, [*code.args[:2], *values]))
    return builder.ptrtoint(code, ir.IntType(64))


def _index(number: int) -> ir.Constant:
    return ir.Constant(ir.IntType(32), number)


def _take_seat(claims: Array) -> int:
    seat: int = add(claims.ctypes.data + 8 * _ENTERED, 1)
    return seat


def _call_all(claims: Array, code: int) -> None:
    numbers = claims.ctypes.data
    for k in range(_ENGAGED, _ENGAGED + 2 * claims[_HELPERS], 2):
        call(claims[k], claims[k + 1], code, numbers + 8 * _CONTEXT, numbers + 8 * _FAILED)


@kernel(inline=True)
def leave(seat: int, claims: Array) -> None:
    """The last thing that a shared kernel does: the first to enter waits for the others."""
    if seat == 0:
        _call_all_back(claims)
        if claims[_FAILED]:
            raise MemoryError("a thread of the rasteriser found no memory")
        claims[_ENTERED:_CONTEXT] = 0


@kernel()
def _call_all_back(claims: Array) -> None:
    claims[_LAUNCHES] -= 1
    for k in range(_ENGAGED, _ENGAGED + 2 * claims[_HELPERS], 2):
        call_back(claims[k], claims[k + 1], claims[_LAUNCHES] <= 0)


@kernel(cache=True)
def _fail(claims: Array) -> None:
    """The kernel has failed in the thread that called it: wait for the others."""
    put(claims.ctypes.data + 8 * _FAILED, 1)
    _call_all_back(claims)


@kernel()
def pieces(claims: Array, step: int, seat: int, count: int) -> Iterator[Number]:
    """Inside a shared kernel: the pieces of a step's work that this thread is to do, of so many (< 2³¹); then
    it waits until the others have done theirs, so that what they wrote may be read.

    Every other thread begins at the last piece: so of one pass and the next, and of forward and backward, a
    processor has much of the same memory. What is waited for is at most a piece of each of the others:
    shorter than to sleep and be woken.
    """
    counters = claims.ctypes.data + 8 * _COUNTERS * step
    taken, done, failed = counters + 8 * _TAKEN, counters + 8 * _DONE, claims.ctypes.data + 8 * _FAILED
    one = 1 if seat % 2 == 0 else _FROM_THE_BACK
    own = 0
    while True:
        before = add(taken, one)
        front, back = before & (_FROM_THE_BACK - 1), before >> 32
        if front + back >= count:
            break
        yield front if one == 1 else count - 1 - back
        own += 1
    add(done, own)
    looks = 0
    while seen(done) < count:
        looks += 1
        if looks % LOOKS == 0:
            make_way()
            if seen(failed):
                raise MemoryError("another thread of the rasteriser found no memory")
