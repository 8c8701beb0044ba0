"""How a run reports its progress: a bar with loss and time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import ctypes
import json
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn

from progdf.errors import ProgdfError
from progdf.io.atomic import write_file
from progdf.terminal import escape_text

from .state import Saved

Advance = Callable[[int, str], None]
"""Steps done so far, and a short word about them (the loss)."""

STAGES = {
    "views": "",
    "try kinds": "Choosing what moves",
    "edit": "Editing views",
    "weights": "",
    "model": "",
    "move parts": "Moving parts",
    "optimize": "Training",
    "time the slider": "Timing the slider",
    "picture the edit": "Finishing",
    "weigh the members": "Packing",
    "fit the field": "Packing",
    "field": "Packing",
    "even the slider": "Making the slider's steps alike",
    "measure the edit": "Measuring",
    "draw": "",
}
"""The long stages of a run in their order, with their labels in the window; those without tell no steps."""

LATER = {
    "time the slider": 0.15,
    "picture the edit": 0.2,
    "weigh the members": 0.2,
    "fit the field": 0.7,
    "even the slider": 0.3,
    "measure the edit": 1.7,
    "draw": 0.5,
}
"""Work for each view of the stages that follow the optimization, see `RunLog.expect`."""


_EDITOR = ("try kinds", "edit")

_TRIM = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None

_EVERY_S = 5.0
_FILE_EVERY_S = 0.4


class RunLog:
    """Writes what happens to log.txt and, unless quiet, to stderr; measures each stage's seconds.

    The seconds are part of a run's saved state (`state.Resumable`): those of all its sessions add up.

    Args:
        path: log.txt; what is in it stays
        quiet: the file only
        refits: a later command on a finished run, whose own time counts apart
        progress: a file for programs that wait for the run: the share of its time that has passed, a label of
            what it does, its loss, and its seconds so far, as JSON, rewritten a few times a second; None
            writes none
    """

    def __init__(
        self, path: Path, quiet: bool = False, refits: bool = False, progress: Path | None = None
    ) -> None:
        self.seconds: dict[str, float] = {}
        self.refits = refits
        self._earlier = 0.0
        self._progress = progress
        self._written = 0.0
        self._share = 0.0
        self._work: Mapping[str, float] = {"views": 1.0, "edit": 1.0, "optimize": 5.0, **LATER}
        self._took: dict[str, float] = {}  # seconds of the stages that have ended
        self._running: dict[str, float] = {}
        self._earlier_mb = 0
        self._start = time.perf_counter()
        self._file = path.open("a", encoding="utf-8", buffering=1)
        self._console = Console(stderr=True, quiet=quiet, highlight=False)
        self._bar = self._console.is_terminal and not quiet

    def rounded_seconds(self) -> dict[str, float]:
        """Seconds by stage, and of all sessions of the run together: the total, or of a refit its own."""
        all_of_it = {"refit" if self.refits else "total": self._total()}
        return {name: round(seconds, 2) for name, seconds in {**self.seconds, **all_of_it}.items()}

    def capture_state(self) -> Saved:
        """Seconds so far; those of the stages that have not ended too."""
        now = time.perf_counter()
        running = {name: now - begun for name, begun in self._running.items()}
        seconds = {
            name: self.seconds.get(name, 0.0) + running.get(name, 0.0) for name in self.seconds | running
        }
        return Saved({}, {"seconds": seconds, "total": self._total(), "memory": self.peak_mb()})

    def restore(self, saved: Saved) -> None:
        """Add the seconds of the sessions before, and remember their peaks of memory."""
        for name, seconds in saved.values["seconds"].items():
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        self._earlier = saved.values["total"]
        self._earlier_mb = saved.values["memory"] or 0

    def peak_mb(self) -> int | None:
        """Of the process and of earlier sessions of the same run, see `peak_mb`; None where it is unknown."""
        return max(round(peak_mb()), self._earlier_mb) or None

    def expect(self, work: Mapping[str, float]) -> None:
        """How much work the stages of this run are, in any unit; how fast it goes is measured.

        Args:
            work: of `STAGES`, those that the run has
        """
        self._work = work

    def seconds_left(self, stage: str, share: float, elapsed: float) -> float:
        """Until the run ends, as far as it can be told.

        What is to come is taken to go at the pace of all that was, but for the editor's work, which is of
        another kind; a stage's own pace counts as far as it is.

        Args:
            stage: that runs
            share: of it that is done, 0..1
            elapsed: seconds of it so far
        """
        own = self._work.get(stage, 0.0)
        place = list(STAGES).index(stage)
        ahead = sum(work for name, work in self._work.items() if list(STAGES).index(name) > place)
        took = 0.0
        work = 0.0
        for name, seconds in self._took.items() | {(stage, elapsed)}:
            if name not in _EDITOR:
                took += seconds
                work += self._work.get(name, 0.0) * (share if name == stage else 1.0)
        pace = took / work if work else elapsed / max(share * own, 1e-9)
        return (1.0 - share) * ((1.0 - share) * pace * own + elapsed) + pace * ahead

    def note(self, text: str) -> None:
        """A line for the file alone."""
        self._file.write(f"{time.perf_counter() - self._start:8.1f} s  {escape_text(text)}\n")

    def say(self, text: str) -> None:
        """One line."""
        self.note(text)
        if self._bar:
            self._console.print(f"[dim]{time.perf_counter() - self._start:6.1f} s[/dim]  {_escape(text)}")
        else:
            self._console.print(_escape(text), soft_wrap=True)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure a part of the run under `name`; a name that comes again adds up."""
        begun = self._running[name] = time.perf_counter()
        try:
            yield
        finally:
            del self._running[name]
            release_memory()
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begun
            if not STAGES.get(name, name):
                self._took[name] = time.perf_counter() - begun

    @contextmanager
    def steps(self, what: str, total: int) -> Iterator[Advance]:
        """One of `STAGES` in `total` steps: a bar on a terminal, a line every few seconds elsewhere, with the
        seconds until the run ends."""
        release_memory()
        begun = last = time.perf_counter()

        def tell(done: int, word: str) -> float:
            share = min(done / max(total, 1), 1.0)
            left = self.seconds_left(what, share, time.perf_counter() - begun)
            self._write_progress(what, left, word, done >= total)
            return left

        def advance(done: int, word: str) -> None:
            nonlocal last
            left = tell(done, word)
            now = time.perf_counter()
            if now - last >= _EVERY_S and done < total:
                last = now
                self.say(f"{what} {done}/{total}  {word}  {left:.0f} s left")

        if self._bar:
            columns = (
                SpinnerColumn(),
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[word]}"),
            )
            with Progress(*columns, console=self._console, transient=True) as progress:
                task = progress.add_task(what, total=total, word="")

                def move_bar(done: int, word: str) -> None:
                    progress.update(task, completed=done, word=f"{word}  {tell(done, word):.0f} s left")

                yield move_bar
        else:
            yield advance
        self._took[what] = time.perf_counter() - begun

    @contextmanager
    def looks(self, what: str, total: int) -> Iterator[Callable[[], None]]:
        """The same for a stage whose work comes in about `total` equal parts: call it at each."""
        done, lock = 0, threading.Lock()  # any thread may look
        with self.steps(what, total) as advance:

            def count_look() -> None:
                nonlocal done
                with lock:
                    done += 1
                    advance(min(done, total), "")

            yield count_look

    def close(self) -> None:
        """End the file."""
        with suppress(OSError):  # a full disk, which has been reported already
            self._file.close()

    def _write_progress(self, what: str, left: float, word: str, ends: bool) -> None:
        """Rewrite the progress file, not too often; who cannot write it goes on all the same."""
        now = time.perf_counter()
        if self._progress is None or (now - self._written < _FILE_EVERY_S and not ends):
            return
        self._written = now
        total = self._total()
        self._share = max(self._share, total / max(total + left, 1e-9))
        state = {
            "share": self._share,
            "label": STAGES[what],
            # that of a field is on another scale
            "loss": word.removeprefix("loss to the edit ") if what == "optimize" else "",
            "seconds": total,
        }
        with suppress(OSError, ProgdfError):
            write_file(self._progress, json.dumps(state, ensure_ascii=False))

    def _total(self) -> float:
        return self._earlier + time.perf_counter() - self._start


def _escape(text: str) -> str:
    return escape_text(text).replace("[", "\\[")


def release_memory() -> None:
    """Between two pieces of work: glibc keeps what was freed between what was not, .8 GB after the views of
    200 000 members. Where the process has grown by less than a tenth since, nothing is done."""
    global _resident
    if _TRIM is not None and _resident_pages() > 1.1 * _resident:
        _TRIM(0)
        _resident = _resident_pages()


_resident = 0  # pages, after the last time


def _resident_pages() -> int:
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])


_STATUS = Path("/proc/self/status")


def peak_mb() -> float:
    """Peak resident memory since the process began, MB (2²⁰ bytes), as VmHWM; 0 where it is unknown.

    On Linux not `getrusage`, whose figure begins with what the parent held when it started this process.
    """
    if sys.platform == "win32":
        return 0.0
    if sys.platform == "linux":
        for line in _STATUS.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)
