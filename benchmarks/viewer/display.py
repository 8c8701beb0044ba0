"""The real window for benchmarks: `progdf view` in a separate process on a virtual X display."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from progdf.errors import ProgdfError

PATIENCE_S = 120.0  # limit of waiting for the window to open or close
PROGRAMS = ("Xvfb", "xdotool")
_FIRST_DISPLAY = 1000
_DISPLAYS = 50_000


def missing_tools() -> str:
    """Return the missing programs for a window without a screen; "" if all are installed."""
    return " and ".join(program for program in PROGRAMS if shutil.which(program) is None)


@contextmanager
def display(width: int = 1400, height: int = 900) -> Iterator[str]:
    """Start a virtual display for the duration of the block and yield its name.

    Raises:
        ProgdfError: Xvfb or xdotool is not installed.
    """
    if missing_tools():
        raise ProgdfError(
            f"{missing_tools()} is not installed; install xvfb and xdotool to measure the window"
        )
    receive, send = os.pipe()
    # a number per process: servers that search for a free one at the same time may find the same
    own = (f":{_FIRST_DISPLAY + os.getpid() % _DISPLAYS}", "-displayfd", str(send))
    # -r turns key repeat off: on a busy machine a key may stay down long enough to repeat. -noreset: else the
    # server starts over when its last client leaves, as xdotool does, and refuses a window at that moment
    command = ["Xvfb", *own, "-screen", "0", f"{width}x{height}x24", "-nolisten", "tcp", "-r", "-noreset"]
    server = subprocess.Popen(command, pass_fds=[send], stderr=subprocess.DEVNULL)
    os.close(send)
    try:
        with os.fdopen(receive, encoding="ascii") as server_output:
            yield f":{server_output.readline().strip()}"
    finally:
        server.terminate()
        server.wait()


@dataclass
class Opened:
    """An open window: its process and the figures that it reports."""

    process: subprocess.Popen[str]  # runs `benchmarks.viewer.watched`
    environment: dict[str, str]  # environment with the display
    figures: dict[str, Any] = field(default_factory=dict)  # figures reported so far (see `watched`)
    name: str = ""  # id of the window, set by `focus`

    def listen(self) -> None:
        """Wait for the next line and read its figures.

        Raises:
            ProgdfError: the window has closed.
        """
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            assert self.process.stderr is not None
            errors = self.process.stderr.read().strip().splitlines() or ["no error message"]
            raise ProgdfError(f"the window closed while it was measured: {errors[-1]}; try `progdf view`")
        self.figures |= json.loads(line)

    def xdotool(self, *arguments: object) -> str:
        """Call xdotool and return its output."""
        run = subprocess.run(
            ["xdotool", *map(str, arguments)], env=self.environment, capture_output=True, text=True
        )
        return run.stdout.strip()

    def focus(self) -> None:
        """Find the window and give it the keyboard focus."""
        end = time.monotonic() + PATIENCE_S
        while not self.name and time.monotonic() < end:
            self.name = self.xdotool("search", "--onlyvisible", "--name", ". ProGDF Studio").split("\n")[0]
        self.xdotool("windowfocus", self.name)

    def processor_s(self) -> float:
        """Return the processor time of all threads of the window, seconds."""
        if sys.platform == "win32":
            raise NotImplementedError("Xvfb is not for Windows")
        numbers = Path(f"/proc/{self.process.pid}/stat").read_text("utf-8").rpartition(")")[2].split()
        return (int(numbers[11]) + int(numbers[12])) / os.sysconf("SC_CLK_TCK")

    def memory_mb(self) -> float:
        """Return the resident memory of the window, MB of 1e6 bytes."""
        if sys.platform == "win32":
            raise NotImplementedError("Xvfb is not for Windows")
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text("ascii").split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    def close(self) -> None:
        """End the window like Ctrl+C in a terminal, and read its last figures.

        Raises:
            ProgdfError: the process does not end in time.
        """
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        try:
            output, _ = self.process.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.communicate()
            raise ProgdfError(
                f"the window did not close within {PATIENCE_S:g} s; try `progdf view`"
            ) from None
        for line in output.splitlines():
            self.figures |= json.loads(line)


@contextmanager
def window(
    screen: str, arguments: Sequence[object], size: tuple[int, int], folder: Path, leave: bool = False
) -> Iterator[Opened]:
    """Open `progdf view` for the duration of the block.

    Args:
        screen: name of the display, from `display`
        arguments: arguments of `progdf view`
        size: window size, pixels
        folder: working directory, which also holds the list of recent files
        leave: close the window after the first picture is on the screen

    Raises:
        ProgdfError: the window closed before its first picture.
    """
    environment = os.environ | {"DISPLAY": screen, "XDG_STATE_HOME": str(folder)}
    environment.pop("WAYLAND_DISPLAY", None)
    own = [str(time.time()), f"{size[0]}x{size[1]}", "leave" if leave else "stay"]
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "benchmarks.viewer.watched", *own, *map(str, arguments)],
        env=environment,
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    opened = Opened(process, environment)
    try:
        opened.listen()
        yield opened
    finally:
        if process.poll() is None:
            opened.close()
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()
