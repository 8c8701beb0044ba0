"""Threads that help with kernels and never touch the interpreter.

A thread that has to come by the interpreter's lock for every kernel arrives 20 to 40 µs late, and keeps the
lock from its caller: a tenth of a small pass. So each stays in one compiled function for good, where it
sleeps on a lock of the system's until a team engages it, and then stands by for the team's calls.

A helper's state is a phase and how many times it was engaged, so that a team that a helper has given up on
cannot take it from the next one.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from typing import Any

import numpy as np
from llvmlite import binding as llvm
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.callconv import RETCODE_NONE, RETCODE_OK
from numba.extending import intrinsic
from numpy.typing import NDArray

from .atomics import change, put, seen
from .jit import kernel

Array = NDArray[Any]

ENTRY: tuple[Any, ...] = (types.voidptr,)
"""What code that a helper runs takes, in numba's calling convention: an address."""

_STATE, _CODE, _CONTEXT, _FAILED, _LOCK = range(0, 40, 8)  # bytes from a record's beginning
_RECORD = 16  # int64 numbers from one record to the next: two cache lines
_IDLE, _READY, _LOADING, _CALLED, _BUSY, _STARTING = range(6)
_PHASES = 8  # a state is a phase + _PHASES · engagements

LOOKS = 64
"""At a number that another thread will change, before one lets others have its processor for a moment."""

_PATIENCE = 2000  # such moments until a helper that is not called goes to sleep: a millisecond or so


def _address(function: Any) -> int:
    return ctypes.cast(function, ctypes.c_void_p).value or 0


def _system_yield() -> int:
    """Where in memory the system's function is that lets other threads have the processor."""
    if sys.platform == "win32":
        return _address(ctypes.windll.kernel32.SwitchToThread)
    return _address(ctypes.CDLL(None).sched_yield)


# Python's own locks of the system: the same everywhere, and to be used without the interpreter's
llvm.add_symbol("progdf_make_way", _system_yield())
llvm.add_symbol("progdf_acquire", _address(ctypes.pythonapi.PyThread_acquire_lock))
llvm.add_symbol("progdf_release", _address(ctypes.pythonapi.PyThread_release_lock))
make_way = types.ExternalFunction("progdf_make_way", types.int32())
_acquire = types.ExternalFunction("progdf_acquire", types.int32(types.int64, types.int32))
_release = types.ExternalFunction("progdf_release", types.void(types.int64))

HELPERS = max(1, (os.cpu_count() or 1) - 1)
"""How many helpers there are."""

_threads: _Crew | None = None


@kernel(cache=True)
def _help(record: int) -> None:
    """What a helper does; it never returns."""
    put(record + _STATE, _IDLE)
    while True:
        while seen(record + _STATE) % _PHASES == _IDLE:
            _acquire(seen(record + _LOCK), 1)
        looks = 0
        while True:
            state = seen(record + _STATE)
            phase, engaged = state % _PHASES, state - state % _PHASES
            if phase == _IDLE:
                break
            if phase == _CALLED and change(record + _STATE, state, engaged + _BUSY):
                if not _run(seen(record + _CODE), seen(record + _CONTEXT)):
                    put(seen(record + _FAILED), 1)
                put(record + _STATE, engaged + _READY)
                looks = 0
            looks += 1
            if looks % LOOKS == 0:
                make_way()
            if looks > LOOKS * _PATIENCE:
                change(record + _STATE, engaged + _READY, engaged + _IDLE)


@kernel(cache=True)
def _engage(records: Array, wanted: int, engaged: Array) -> int:
    """Wake idle helpers, and put the address and the state of each into `engaged`; how many there are."""
    count = 0
    for k in range(records.shape[0]):
        record = records[k].ctypes.data
        state = seen(record + _STATE)
        ready = state + _PHASES + _READY
        if count < wanted and state % _PHASES == _IDLE and change(record + _STATE, state, ready):
            engaged[2 * count], engaged[2 * count + 1] = record, ready
            count += 1
            _release(records[k, _LOCK // 8])
    return count


@kernel()
def call(record: int, ready: int, code: int, context: int, failed: int) -> None:
    """Have an engaged helper run some code, if it still stands by.

    Args:
        record, ready: as from `engage`
        code, context: what to run and what with, see `ENTRY`
        failed: where to put 1 if it fails
    """
    if change(record + _STATE, ready, ready - _READY + _LOADING):
        put(record + _CODE, code)
        put(record + _CONTEXT, context)
        put(record + _FAILED, failed)
        put(record + _STATE, ready - _READY + _CALLED)


@kernel()
def call_back(record: int, ready: int, dismissed: bool) -> None:
    """Wait until a helper has done what it was called for, unless it has not begun: then it need not."""
    engaged = ready - _READY
    change(record + _STATE, engaged + _CALLED, ready)
    looks = 0
    while seen(record + _STATE) == engaged + _BUSY:
        looks += 1
        if looks % LOOKS == 0:
            make_way()
    if dismissed:
        change(record + _STATE, ready, engaged + _IDLE)


@intrinsic  # type: ignore[untyped-decorator]
def _run(typingctx: Any, code: Any, address: Any) -> Any:
    """Call code by its address; whether it came to its end."""

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        kind = context.call_conv.get_function_type(types.none, ENTRY)
        outs = [cgutils.alloca_once(builder, pointer.pointee) for pointer in kind.args[:2]]
        callee = builder.inttoptr(args[0], kind.as_pointer())
        status = builder.call(callee, [*outs, builder.inttoptr(args[1], kind.args[2])])
        return builder.or_(
            builder.icmp_signed("==", status, RETCODE_OK), builder.icmp_signed("==", status, RETCODE_NONE)
        )

    return types.boolean(types.int64, types.int64), generate


class _Crew:
    """A helper for each processor but the caller's."""

    def __init__(self, count: int) -> None:
        api = ctypes.pythonapi
        api.PyThread_allocate_lock.restype = ctypes.c_void_p
        api.PyThread_acquire_lock.argtypes = [ctypes.c_void_p, ctypes.c_int]
        self.records = np.zeros((count, _RECORD), np.int64)
        api.Py_IncRef(ctypes.py_object(self.records))  # the helpers outlive all else when Python ends
        for k, record in enumerate(self.records):
            record[_STATE // 8], record[_LOCK // 8] = _STARTING, api.PyThread_allocate_lock()
            api.PyThread_acquire_lock(int(record[_LOCK // 8]), 1)
            name, own = f"rasterize-{k}", record.ctypes.data
            threading.Thread(target=_help, args=(own,), name=name, daemon=True).start()


def engage(wanted: int, engaged: Array) -> int:
    """Wake helpers that have nothing to do; each stands by for a millisecond after every call.

    Args:
        wanted: how many, at most
        engaged: out, the address of each one's record and its state. [≥ 2 · wanted] int64

    Returns:
        how many there are
    """
    global _threads
    if _threads is None:
        _threads = _Crew(HELPERS)
    count: int = _engage(_threads.records, wanted, engaged)
    return count


def _forget_threads() -> None:
    """A forked process has its parent's crew without the threads."""
    global _threads
    _threads = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_threads)
