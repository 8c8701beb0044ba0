"""Child process for a `progdf` command: low priority, its own process group, stopped with the window.

As a program, python -P -m viewer.jobs.child [--talks] COMMAND …, this module runs a command with a parent
watchdog. The command is interrupted when its standard input closes. The window holds the other end, so the
command never outlives the window, however the window ends. A command with --talks reads its input itself and
ends when the input ends.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Annotated

from msgspec import Meta

from progdf.system.processes import child_options, kill_group, lower_priority, signal_main_thread

GRACE_S = 8.0
"""Seconds between a stop request and the kill; the child may be saving its state."""

PICTURES_GRACE_S = 330.0
"""The same for a child that waits for pictures of a server, which may be paid: one call's time limit."""

_TALKS = "--talks"


@dataclass(frozen=True)
class Progress:
    """Progress of a command; the trainer writes it to RUN/state/progress.json."""

    share: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0  # finished share of the whole run
    label: str = ""  # current step, "" while it starts
    loss: str = ""  # loss of the training, "" without one
    seconds: Annotated[float, Meta(ge=0.0, le=1e9)] = 0.0  # time spent on a run in all its sessions
    count: str = ""  # pictures of this step that are done, such as "4 of 12"; "" for other steps


class Child:
    """Running command.

    Args:
        arguments: command-line arguments after `progdf`
        log: file for its output
        talks: the command reads its standard input, and `output` returns what it prints; it must end by
            itself when its input ends. The user waits for it, so it keeps the window's priority

    Raises:
        OSError: it cannot be started, or the log cannot be written.
    """

    def __init__(self, arguments: Sequence[str], log: Path, talks: bool = False) -> None:
        log.parent.mkdir(parents=True, exist_ok=True)
        if talks:
            arguments = [_TALKS, *arguments]
        with log.open("wb") as sink:
            self._process = subprocess.Popen(
                # -P: do not run a module in the current folder, which may be a third-party scene
                [sys.executable, "-P", "-m", "viewer.jobs.child", *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE if talks else sink,
                stderr=sink if talks else subprocess.STDOUT,
                env={**os.environ, "NO_COLOR": "1", "COLUMNS": "4096"},
                **child_options(low_priority=not talks),
            )
        if not talks:
            lower_priority(self._process.pid)
        self.log = log
        self._killed_at = math.inf
        self._grace_s: float | None = None  # None before a stop request

    @property
    def status(self) -> int | None:
        """Exit status; None while it runs. A command that ignores a stop request is killed."""
        status = self._process.poll()
        if status is None and time.monotonic() > self._killed_at:
            self.kill()
        return status

    @property
    def pid(self) -> int:
        """Id of its process, and of its process group on systems that have one."""
        return self._process.pid

    @property
    def output(self) -> IO[bytes]:
        """Its standard output."""
        assert self._process.stdout is not None
        return self._process.stdout

    def send(self, line: str) -> None:
        """Write a line to its standard input; ignore a command that has ended."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError, ValueError):
            self._process.stdin.write(line.encode() + b"\n")
            self._process.stdin.flush()

    def stop(self, grace_s: float = GRACE_S) -> None:
        """Request a stop: the command saves its state, and is killed after `grace_s` seconds."""
        if self._grace_s is None:
            self._grace_s = grace_s
            self._killed_at = time.monotonic() + grace_s
            if self._process.stdin is not None:
                with contextlib.suppress(OSError):
                    self._process.stdin.close()

    def kill(self) -> None:
        """Kill the command and all its child processes at once."""
        kill_group(self._process)

    def close(self) -> None:
        """Stop the command and wait until it has ended.

        A command that was stopped with a longer grace than `GRACE_S` is left to end by itself.
        """
        self.stop()
        try:
            self._process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            if self._grace_s is None or self._grace_s <= GRACE_S:
                self.kill()
                self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def error(self) -> str:
        """Return the last line of its log, without the program's name."""
        return last_line(self.log)


def last_line(log: Path) -> str:
    """Return the last line of a file, "" if there is none."""
    try:
        lines = log.read_text("utf-8", "replace").strip().splitlines()
    except OSError:
        return ""
    return lines[-1].removeprefix("progdf: ").strip() if lines else ""


def main() -> int:
    """Run the child and return the exit status of its command."""
    talks = sys.argv[1:2] == [_TALKS]
    if not talks:
        # a window started by `&` in a script ignores SIGINT, and its child would inherit that
        signal.signal(signal.SIGINT, signal.default_int_handler)
        threading.Thread(target=_watch_parent, daemon=True).start()
    from progdf.__main__ import main as run

    return run(sys.argv[1 + talks :])


def _watch_parent() -> None:
    """Wait until the other end of the standard input closes, then stop as by Ctrl+C."""
    with contextlib.suppress(OSError):
        while os.read(0, 4096):
            pass
    signal_main_thread()


if __name__ == "__main__":
    sys.exit(main())
