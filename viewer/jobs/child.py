"""A `progdf` command as a child process: at low priority, in its own group, stopped with the window.

As a program of its own, python -P -m viewer.jobs.child [--talks] COMMAND …, this runs a command with a parent
watchdog: it is interrupted when its standard input closes, and so never outlives the window that holds the
other end, however that ended. One that talks reads its input itself, and ends with it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Annotated, Any

from msgspec import Meta

from progdf.terminal import signal_main_thread

GRACE_S = 8.0
"""After which a child that was asked to stop is killed: it may be saving its state."""

NICE = 10
"""As by nice(1): a child gets a tenth of a core that the window, or another program, keeps busy. SCHED_IDLE
would give it nothing, and a process without privileges cannot leave that again."""

_TALKS = "--talks"


@dataclass(frozen=True)
class Progress:
    """How far a command is; the trainer writes it to RUN/state/progress.json."""

    share: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0  # of its whole time
    label: str = ""  # what it does, "" while it starts
    loss: str = ""  # of the training, "" where there is none
    seconds: Annotated[float, Meta(ge=0.0, le=1e9)] = 0.0  # that were spent on a run, in all its sessions


class Child:
    """One running command.

    Args:
        arguments: words after `progdf`
        log: file that takes what it prints
        talks: it reads its standard input, and what it prints is read here, by `output`; it has to end by
            itself when its input does. Somebody waits for it: it keeps the window's priority

    Raises:
        OSError: it cannot be started, or the log not written.
    """

    def __init__(self, arguments: Sequence[str], log: Path, talks: bool = False) -> None:
        log.parent.mkdir(parents=True, exist_ok=True)
        options: dict[str, Any] = {"process_group": 0}
        if sys.platform == "win32":
            flags = 0 if talks else subprocess.BELOW_NORMAL_PRIORITY_CLASS
            options = {"creationflags": flags | subprocess.CREATE_NEW_PROCESS_GROUP}
        with log.open("wb") as sink:
            self._process = subprocess.Popen(
                # -P: a module in the current folder, which may be a stranger's scene, is not run
                [sys.executable, "-P", "-m", "viewer.jobs.child", *[_TALKS] * talks, *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE if talks else sink,
                stderr=sink if talks else subprocess.STDOUT,
                env={**os.environ, "NO_COLOR": "1", "COLUMNS": "4096"},
                **options,
            )
        if sys.platform != "win32" and hasattr(os, "setpriority") and not talks:
            with contextlib.suppress(OSError):
                nice = os.getpriority(os.PRIO_PROCESS, 0) + NICE
                os.setpriority(os.PRIO_PROCESS, self._process.pid, nice)
        self.log = log
        self._stopped_at: float | None = None

    @property
    def status(self) -> int | None:
        """The exit status; None while it runs. One that will not stop is killed."""
        status = self._process.poll()
        if status is None and self._stopped_at is not None and time.monotonic() - self._stopped_at > GRACE_S:
            self.kill()
        return status

    @property
    def pid(self) -> int:
        """Of its process, and of its group where there are such."""
        return self._process.pid

    @property
    def output(self) -> IO[bytes]:
        """What it writes to standard output."""
        assert self._process.stdout is not None
        return self._process.stdout

    def send(self, line: str) -> None:
        """A line for its standard input; what does not take it any more has ended."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError, ValueError):
            self._process.stdin.write(line.encode() + b"\n")
            self._process.stdin.flush()

    def stop(self) -> None:
        """Ask it to stop: it saves what it has done."""
        if self._stopped_at is None:
            self._stopped_at = time.monotonic()
            if self._process.stdin is not None:
                with contextlib.suppress(OSError):
                    self._process.stdin.close()

    def kill(self) -> None:
        """End it and all that it started, at once."""
        with contextlib.suppress(OSError):
            if sys.platform != "win32" and hasattr(os, "killpg"):
                os.killpg(self._process.pid, signal.SIGKILL)
            else:
                self._process.kill()

    def close(self) -> None:
        """Stop it and wait until it is gone."""
        self.stop()
        try:
            self._process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            self.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def error(self) -> str:
        """The line with which it ended, without the program's name."""
        return last_line(self.log)


def last_line(log: Path) -> str:
    """The last line of a file, "" where there is none."""
    try:
        lines = log.read_text("utf-8", "replace").strip().splitlines()
    except OSError:
        return ""
    return lines[-1].removeprefix("progdf: ").strip() if lines else ""


def main() -> int:
    """The child: the exit status of its command."""
    talks = sys.argv[1:2] == [_TALKS]
    if not talks:
        # ignored where the window was started by `&` in a script, and then nothing would stop this
        signal.signal(signal.SIGINT, signal.default_int_handler)
        threading.Thread(target=_watch_parent, daemon=True).start()
    from progdf.__main__ import main as run

    return run(sys.argv[1 + talks :])


def _watch_parent() -> None:
    """Wait until the other end is closed; then stop as by Ctrl+C."""
    with contextlib.suppress(OSError):
        while os.read(0, 4096):
            pass
    signal_main_thread()


if __name__ == "__main__":
    sys.exit(main())
