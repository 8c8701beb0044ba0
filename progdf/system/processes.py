"""Processes on each system: signals, priority, groups of programs, memory and processor cores."""

from __future__ import annotations

import _thread
import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from types import FrameType
from typing import Any

ENDINGS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that request the end of the process, or report a closed terminal. Windows has no SIGHUP."""


_BELOW_NORMAL_PRIORITY_CLASS = 0x4000  # of the Windows API

REDELIVERY_DELAY_S = 0.02  # long enough for the callback that lost a signal to return

_lost_signals = SimpleQueue[int]()  # a queue whose `put` is safe inside weakref callbacks


@dataclass
class _Delivery:
    """State of the signals of the main thread."""

    number: int = signal.SIGINT  # the latest signal
    depth: int = 0  # number of open `handle_signals` blocks; lost signals are sent again only inside one
    thread: threading.Thread | None = None  # runs `_send_lost_signals`


_delivery = _Delivery()


@contextmanager
def handle_signals(
    signals: tuple[signal.Signals, ...], handler: Callable[[int, FrameType | None], None]
) -> Iterator[None]:
    """Handle signals inside the block. Ignored signals stay ignored, as under nohup.

    Python ignores an exception that leaves a weakref callback, a `__del__` or a ctypes callback. A
    KeyboardInterrupt lost in this way is detected by `sys.unraisablehook`, and its signal is sent again.

    Python lets only the main thread handle signals. In other threads the block changes nothing.

    Args:
        signals: the signals to handle
        handler: called with the signal's number and the interrupted frame; may raise KeyboardInterrupt
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: FrameType | None) -> None:
        _delivery.number = number
        if frame is not None and frame.f_code is note_lost_interrupt.__code__:
            _lost_signals.put(number)  # an exception here would be lost, too
            return
        handler(number, frame)

    def note_lost_interrupt(unraisable: sys.UnraisableHookArgs) -> None:
        if unraisable.exc_type is not KeyboardInterrupt:
            earlier_hook(unraisable)
            return
        _lost_signals.put(_delivery.number)

    if _delivery.thread is None or not _delivery.thread.is_alive():  # none, or of a parent process
        _delivery.thread = threading.Thread(target=_send_lost_signals, daemon=True)
        _delivery.thread.start()
    earlier_hook = sys.unraisablehook
    sys.unraisablehook = note_lost_interrupt
    _delivery.depth += 1
    handled = [number for number in signals if signal.getsignal(number) != signal.SIG_IGN]
    earlier = {number: signal.signal(number, handle) for number in handled}
    try:
        yield
    finally:
        _delivery.depth -= 1
        for number, earlier_handler in earlier.items():
            signal.signal(number, earlier_handler)
        sys.unraisablehook = earlier_hook


def _send_lost_signals() -> None:
    """Send each lost signal again, once the callback that lost it has had time to return."""
    while True:
        number = _lost_signals.get()
        time.sleep(REDELIVERY_DELAY_S)
        if _delivery.depth:
            signal_main_thread(number)


def signal_main_thread(number: int = signal.SIGINT) -> None:
    """Send a signal to the main thread, which wakes it where it waits (not on Windows)."""
    if sys.platform == "win32":
        _thread.interrupt_main(signal.Signals(number))
    else:
        signal.pthread_kill(threading.main_thread().ident or 0, number)


NICENESS = 10
"""Niceness that `lower_priority` adds, as by nice(1): a tenth of a core that another program keeps busy.

SCHED_IDLE would give it nothing, and an unprivileged process cannot leave that policy again.
"""


def lower_priority(process: int | None = None) -> None:
    """Lower the priority of a process for good; do nothing where the system refuses.

    Linux keeps a niceness per thread, so all threads that run now get it. New threads inherit it.

    Args:
        process: id of a child that has just started; None: this process. On Windows, start a child with
            BELOW_NORMAL_PRIORITY_CLASS instead
    """
    if sys.platform == "win32":
        if process is None:
            this_process = ctypes.c_void_p(-1)  # as GetCurrentProcess returns it
            ctypes.windll.kernel32.SetPriorityClass(this_process, _BELOW_NORMAL_PRIORITY_CLASS)
        return
    with suppress(OSError):
        niceness = os.getpriority(os.PRIO_PROCESS, 0) + NICENESS
        threads = [process or 0]
        if process is None and sys.platform == "linux":
            threads = [int(name) for name in os.listdir("/proc/self/task")]
        for thread in threads:
            os.setpriority(os.PRIO_PROCESS, thread, niceness)


def child_options(low_priority: bool) -> dict[str, Any]:
    """Return the options of `subprocess.Popen` for a child that heads its own group.

    Args:
        low_priority: also lower its priority on Windows; elsewhere call `lower_priority` with its id
    """
    if sys.platform == "win32":
        flags = subprocess.BELOW_NORMAL_PRIORITY_CLASS if low_priority else 0
        return {"creationflags": flags | subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"process_group": 0}


def kill_group(process: subprocess.Popen[bytes]) -> None:
    """Kill a child that heads a group, and all programs that it started; ignore one that has ended."""
    if process.poll() is not None:
        return
    if sys.platform == "win32":
        command = ["taskkill", "/T", "/F", "/PID", str(process.pid)]
        try:
            subprocess.run(command, capture_output=True, check=False)
        except OSError:
            process.kill()  # taskkill is missing
        return
    with suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()


def is_running(process: int) -> bool | None:
    """Return whether a process of this machine runs, by its id; None if the system cannot tell.

    On Windows, the signal 0 of `os.kill` would end the process.
    """
    if sys.platform == "win32":
        return None
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def usable_cores() -> int:
    """Return the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


_STATUS_FILE = Path("/proc/self/status")


def peak_mb() -> float:
    """Return the peak resident memory of the process (VmHWM), MB of 2²⁰ bytes; 0 if unknown.

    `getrusage` is not used on Linux: its figure starts at the parent's memory when this process was started.
    """
    if sys.platform == "win32":
        return 0.0
    if sys.platform == "linux":
        return _status_kilobytes("VmHWM") / 1024
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)


def resident_bytes() -> int:
    """Return the resident memory of the process, bytes; 0 if the system does not report it."""
    return 1024 * _status_kilobytes("VmRSS") if sys.platform == "linux" else 0


def _status_kilobytes(field: str) -> int:
    for line in _STATUS_FILE.read_text(encoding="ascii", errors="replace").splitlines():
        if line.startswith(f"{field}:"):
            return int(line.split()[1])
    return 0


def c_library() -> ctypes.CDLL | None:
    """Return the C library of Linux, which may be glibc or another one; None on other systems."""
    return ctypes.CDLL(None) if sys.platform == "linux" else None
