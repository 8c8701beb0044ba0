"""A training process as the window starts it, which a benchmark can pause and resume."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from progdf.gaussians import Gaussians
from viewer.jobs.child import Child

_STARTED = "optimize "  # in the log once the first steps are done
_POLL_INTERVAL_S = 0.2
_START_TIMEOUT_S = 600.0  # a busy machine takes minutes to import the libraries


class Training:
    """The window's training process on a whole small scene, paused except inside `runs`.

    On Windows it is never paused.
    """

    def __init__(self, child: Child) -> None:
        self._child = child
        self._send("SIGSTOP")

    @contextmanager
    def runs(self) -> Iterator[None]:
        """Resume the training for the duration of the block."""
        self._send("SIGCONT")
        try:
            yield
        finally:
            self._send("SIGSTOP")

    def _send(self, name: str) -> None:
        if sys.platform != "win32" and self._child.status is None:
            os.killpg(self._child.pid, signal.Signals[name])


@contextmanager
def begin_training(scene: Gaussians, *effort: str) -> Iterator[Training]:
    """Start a training of `scene`, and yield it once its first steps are done.

    Args:
        scene: the scene, which is the region too
        effort: further options of `progdf train`, such as `"--views", "5"`

    Raises:
        ProgdfError: the training does not start.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_ply(folder / "scene.ply", scene)
        words = ["train", str(folder / "scene.ply"), "--out", str(folder / "run"), "--region", "all"]
        # gradient descent, which runs through all of its steps
        words += ["--editor", "stripes:#20a040", "--preset", "paper", "--field", "auto", "--steps", "100000"]
        words += effort
        child = Child(words, folder / "log")
        try:
            began = time.monotonic()
            while _STARTED not in child.log.read_text("utf-8"):
                if child.status is not None or time.monotonic() - began > _START_TIMEOUT_S:
                    raise ProgdfError(f"the background training did not start: {child.error()}")
                time.sleep(_POLL_INTERVAL_S)
            yield Training(child)
        finally:
            child.kill()
            child.close()
