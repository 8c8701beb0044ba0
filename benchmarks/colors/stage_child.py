"""Script of the benchmark `training-stages`: run `progdf train` and write what each stage takes.

The benchmark starts it by its path, so that it can measure another checkout of the project on PYTHONPATH.
Each line of the file EVENTS is a finished stretch of one stage, as JSON.

    python stage_child.py EVENTS SCENE --region …
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_STATUS_FILE = Path("/proc/self/status")
_RESET_FILE = Path("/proc/self/clear_refs")
_RESET_PEAK = "5"  # Linux: the peak memory starts again at the current memory

IMPORTS = "imports"
SCENE = "scene"
DRAFT = "draft"
OTHER = "other"


class StageRecorder:
    """Writer of stages: the inner of two nested stages counts.

    Args:
        path: file to which lines are appended
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("a", encoding="utf-8", buffering=1)
        self._open = [IMPORTS]
        self._begun = time.monotonic()
        self._used = (0.0, 0.0)

    def enter(self, stage: str) -> None:
        """Begin a stage within the current one."""
        self._write()
        self._open.append(stage)

    def leave(self) -> None:
        """End the current stage and continue the one around it."""
        self._write()
        self._open.pop()

    def turn(self, stage: str) -> None:
        """End the current stage and begin another in its place."""
        self._write()
        self._open[-1] = stage

    def _write(self) -> None:
        """Write the stretch since the last line, and start the peak memory again."""
        now = time.monotonic()
        times = os.times()
        user = times.user + times.children_user
        system = times.system + times.children_system
        line = {
            "stage": self._open[-1],
            "begun": self._begun,
            "ended": now,
            "user": user - self._used[0],
            "system": system - self._used[1],
            "peak_mb": _peak_mb(),
        }
        print(json.dumps(line), file=self._file)
        self._begun = now
        self._used = (user, system)
        if _RESET_FILE.exists():
            _RESET_FILE.write_text(_RESET_PEAK, encoding="ascii")


def _peak_mb() -> float:
    """Return the peak resident memory since it was last reset, MB of 2²⁰ bytes; 0 where Linux is missing."""
    if not _STATUS_FILE.exists():
        return 0.0
    lines = _STATUS_FILE.read_text(encoding="ascii", errors="replace").splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:"))


def main(events: Path, arguments: list[str]) -> int:
    """Run `progdf train` with these arguments and return its exit status."""
    recorder = StageRecorder(events)
    from progdf.__main__ import main as run_command
    from progdf.formats import scene_file
    from trainer.run import run
    from trainer.store.progress import RunLog

    load = scene_file.load_scene
    stage = RunLog.stage

    def load_scene(*given: Any, **named: Any) -> Any:
        scene = load(*given, **named)
        recorder.turn(DRAFT)
        return scene

    @contextmanager
    def record_stage(log: RunLog, name: str) -> Iterator[None]:
        if name == "views":
            recorder.turn(OTHER)
        recorder.enter(name)
        try:
            with stage(log, name):
                yield
        finally:
            recorder.leave()

    patches: list[tuple[Any, str, Callable[..., Any]]] = [
        (run, "load_scene", load_scene),
        (RunLog, "stage", record_stage),
    ]
    for owner, name, replacement in patches:
        setattr(owner, name, replacement)
    recorder.turn(SCENE)
    status = run_command(["train", *arguments])
    recorder.turn(OTHER)
    return status


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1]), sys.argv[2:]))
