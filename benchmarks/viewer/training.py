"""A training such as the window starts, which a benchmark lets go on and halts."""

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

_STARTED = "optimize "
_POLL_S = 0.2
_LONGEST_S = 600.0  # a busy machine takes minutes to import what a training needs


class Training:
    """The window's own child, which trains all of a small scene; halted but while it `runs`.

    Not for Windows, where no process is halted.
    """

    def __init__(self, child: Child) -> None:
        self._child = child
        self._send("SIGSTOP")

    @contextmanager
    def runs(self) -> Iterator[None]:
        """Let it go on meanwhile."""
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
    """Start a training of `scene`, and yield it at its first steps.

    Args:
        scene: trained in whole
        effort: further options of `progdf train`, such as `"--views", "5"`

    Raises:
        ProgdfError: it does not.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_ply(folder / "scene.ply", scene)
        words = ["train", str(folder / "scene.ply"), "--out", str(folder / "run"), "--region", "all"]
        # a descent, which does not end before its steps do
        words += ["--editor", "stripes:#20a040", "--preset", "paper", "--field", "auto", "--steps", "100000"]
        words += effort
        child = Child(words, folder / "log")
        try:
            began = time.monotonic()
            while _STARTED not in child.log.read_text("utf-8"):
                if child.status is not None or time.monotonic() - began > _LONGEST_S:
                    raise ProgdfError(f"the training beside did not start: {child.error()}")
                time.sleep(_POLL_S)
            yield Training(child)
        finally:
            child.kill()
            child.close()
