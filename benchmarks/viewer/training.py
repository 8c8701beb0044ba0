"""A training such as the window starts, which a benchmark lets go on and halts."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from progdf.gaussians import Gaussians

_STARTED, _POLL_S, _LONGEST_S = "optimize ", 0.2, 120.0


class Training:
    """`progdf train` of a whole scene, at the priority of the window's; halted but while it `runs`.

    Raises:
        ProgdfError: it does not come to its first steps.
    """

    def __init__(self, scene: Gaussians) -> None:
        self._folder = tempfile.TemporaryDirectory()
        folder = Path(self._folder.name)
        save_ply(folder / "scene.ply", scene)
        words = ["train", str(folder / "scene.ply"), "--out", str(folder / "run"), "--region", "all"]
        words += ["--editor", "stripes:#20a040", "--steps", "100000"]
        log = folder / "log"
        with log.open("wb") as sink:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "viewer.jobs.leash", *words],
                stdin=subprocess.PIPE,
                stdout=sink,
                stderr=subprocess.STDOUT,
                process_group=0,
            )
        began = time.monotonic()
        while _STARTED not in log.read_text("utf-8"):
            if self._process.poll() is not None or time.monotonic() - began > _LONGEST_S:
                said = log.read_text("utf-8")
                self.close()
                raise ProgdfError(f"the training beside did not start: {said.strip()}")
            time.sleep(_POLL_S)
        self._send(signal.SIGSTOP)

    def __enter__(self) -> Training:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @contextmanager
    def runs(self) -> Iterator[None]:
        """Let it go on meanwhile."""
        self._send(signal.SIGCONT)
        try:
            yield
        finally:
            self._send(signal.SIGSTOP)

    def close(self) -> None:
        """End it, and remove what it wrote."""
        self._send(signal.SIGKILL)
        self._process.communicate()
        self._folder.cleanup()

    def _send(self, number: int) -> None:
        if self._process.poll() is None:
            os.killpg(self._process.pid, number)
