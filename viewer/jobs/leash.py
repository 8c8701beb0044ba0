"""A `progdf` command on a leash: python -m viewer.jobs.leash [--talks] COMMAND …

It takes only what the window leaves of the processor, is interrupted when its standard input closes, and so
never outlives the window that holds the other end, however that ended. One that talks has somebody waiting
for it: it keeps its priority, reads its input itself, and ends with it.
"""

from __future__ import annotations

import _thread
import contextlib
import os
import sys
import threading

LEAST_URGENT = 19
TALKS = "--talks"


def _step_back() -> None:
    """Leave the processor to the window wherever it wants it (docs/benchmarks.md, A scene in the hand)."""
    with contextlib.suppress(OSError):
        if sys.platform != "win32":
            os.nice(LEAST_URGENT)
        if sys.platform == "linux":
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def _hold() -> None:
    """Wait until nobody holds the other end any more; then stop as by Ctrl+C."""
    with contextlib.suppress(OSError):
        while os.read(0, 4096):
            pass
    _thread.interrupt_main()


def main() -> int:
    """The exit status of the command."""
    talks = sys.argv[1:2] == [TALKS]
    if not talks:
        _step_back()
        threading.Thread(target=_hold, daemon=True).start()
    from progdf.__main__ import main as run

    return run(sys.argv[1 + talks :])


if __name__ == "__main__":
    sys.exit(main())
