"""Training commands stopped in every possible way.

    python -m tests.helpers.stopped SCENE_FOLDER OPTIONS MOMENT[,MOMENT…]

trains with these OPTIONS, a JSON table that may have `save_every` in seconds, into the folder `run` of the
current one, repeatedly with --resume. Each process is killed with -9. A whole MOMENT kills it just before
(even) or after (odd) that many files were put in place, a fractional one after that many seconds. The
processes are forked from one that has imported everything. After the last moment nothing is killed. Each
line of the output has a moment and the exit status.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import trainer.store.state
from tests.helpers.blank_plots import blank_plots
from tests.helpers.trained import quick_options, train
from trainer.options import TrainOptions

OUT = Path("run")


def small_run(scene_folder: Path, **more: object) -> TrainOptions:
    """Return the options of a run of about two seconds into `run`, on the bear in `scene_folder`."""
    settings = {"views": 6, "image_size": 48, "steps": 24, "stages": 2, "field": "lossless"}
    settings |= {"perceptual_weight": 0.1, **more}  # optimizes view by view, in steps of a few milliseconds
    return replace(quick_options(scene_folder, **settings), out=OUT)


def bits(root: Path) -> dict[str, str]:
    """Return hashes of all files of a run; of the report, everything except times and memory."""
    found = {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file() and path.name not in ("log.txt", "report.json")
    }
    report = json.loads((root / "report.json").read_text(encoding="utf-8"))
    return found | {"report": json.dumps(_timeless(report), sort_keys=True)}


def _timeless(report: Mapping[str, object]) -> dict[str, object]:
    return {name: value for name, value in report.items() if not name.startswith(("time", "memory"))}


def _killed_at_file(number: int) -> None:
    """Let this process kill itself at its N-th `os.replace`: before it if N is even, else after it."""
    put = os.replace
    calls = 0

    def counting(source: str, target: str) -> None:
        nonlocal calls
        calls += 1
        if calls == number and number % 2 == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        put(source, target)
        if calls == number:
            os.kill(os.getpid(), signal.SIGKILL)

    os.replace = counting  # type: ignore[assignment]


def killed_again_and_again(options: TrainOptions, moments: Sequence[float]) -> list[int]:
    """Return the exit status of each process, −9 if killed. Stop at the first that finishes."""
    ended: list[int] = []
    for number, moment in enumerate([*moments, 0.0]):
        child = os.fork()
        if child == 0:
            status = 1
            try:
                if moment and moment == int(moment):
                    _killed_at_file(int(moment))
                train(replace(options, resume=number > 0), quiet=True)
                status = 0
            except BaseException as error:
                print(f"{type(error).__name__}: {error}", flush=True)
            os._exit(status)
        if moment != int(moment):
            time.sleep(moment)
            os.kill(child, signal.SIGKILL)
        ended.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
        print(moment, ended[-1], flush=True)
        if ended[-1] >= 0:
            break
    return ended


if __name__ == "__main__":
    asked = json.loads(sys.argv[2])
    trainer.store.state.SAVE_EVERY = asked.pop("save_every", trainer.store.state.SAVE_EVERY)
    run = small_run(Path(sys.argv[1]), **asked)
    with blank_plots():
        ends = killed_again_and_again(run, [float(at) for at in sys.argv[3].split(",") if at])
    sys.exit(ends[-1])
