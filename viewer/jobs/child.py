"""A `progdf` command as a child process: niced, in its own group, stopped with the window."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

from .leash import TALKS

GRACE_S = 8.0
"""After which a child that was asked to stop is killed: it may be saving its state."""


class Child:
    """One running command.

    Args:
        arguments: words after `progdf`
        log: file that takes what it prints
        talks: it reads its standard input, and what it prints is read here, by `output`; it has to end by
            itself when its input does

    Raises:
        OSError: it cannot be started, or the log not written.
    """

    def __init__(self, arguments: Sequence[str], log: Path, talks: bool = False) -> None:
        log.parent.mkdir(parents=True, exist_ok=True)
        options: dict[str, Any] = {"process_group": 0} if sys.platform != "win32" else {}
        if sys.platform == "win32":
            flags = subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.BELOW_NORMAL_PRIORITY_CLASS
            options["creationflags"] = flags
        with log.open("wb") as sink:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "viewer.jobs.leash", *[TALKS] * talks, *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE if talks else sink,
                stderr=sink if talks else subprocess.STDOUT,
                env={**os.environ, "NO_COLOR": "1", "COLUMNS": "4096"},
                **options,
            )
        self.log = log
        self._asked_at: float | None = None

    @property
    def status(self) -> int | None:
        """The exit status; None while it runs. One that will not stop is killed."""
        found = self._process.poll()
        if found is None and self._asked_at is not None and time.monotonic() - self._asked_at > GRACE_S:
            self.kill()
        return found

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
        if self._asked_at is None:
            self._asked_at = time.monotonic()
            if self._process.stdin is not None:
                with contextlib.suppress(OSError):
                    self._process.stdin.close()

    def kill(self) -> None:
        """End it and all that it started, at once."""
        with contextlib.suppress(OSError):
            if sys.platform == "win32":
                self._process.kill()
            else:
                os.killpg(self._process.pid, signal.SIGKILL)

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
