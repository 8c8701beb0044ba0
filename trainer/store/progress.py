"""Progress reports of a run: a bar with loss and remaining time on a terminal, plain lines elsewhere."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn

from progdf.errors import ProgdfError
from progdf.io.atomic import write_file
from progdf.rasterize.first_start import kernel_bar
from progdf.system.processes import peak_mb
from progdf.terminal import escape_text

from .memory import release_memory
from .state import Saved

Advance = Callable[[int, str], None]
"""Callback with the number of finished steps and a short status text (the loss)."""

STAGES = {
    "views": "Choosing the views",
    "fill": "Filling the hole",
    "texture": "Continuing the texture around the hole",
    "try kinds": "Choosing the kind of edit",
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
    "even the slider": "Equalizing the slider",
    "measure the edit": "Measuring",
    "draw": "",
}
"""Long stages of a run in order, with their labels in the window; stages without a label report no steps."""

LATER = {
    "time the slider": 0.15,
    "picture the edit": 0.2,
    "weigh the members": 0.2,
    "fit the field": 0.7,
    "even the slider": 0.3,
    "measure the edit": 1.7,
    "draw": 0.5,
}
"""Work per view of the stages after the optimization, see `RunLog.expect`."""


_EDITOR_STAGES = ("try kinds", "edit")  # the editor's own work, whose pace differs from the other stages

_LINE_INTERVAL_S = 5.0  # between two lines of a stage without a terminal
_FILE_INTERVAL_S = 0.4  # between two writes of the progress file


class RunLog:
    """Log of a run in log.txt and, unless quiet, on stderr, with the seconds of each stage.

    The seconds are part of a run's saved state (`state.Resumable`), so that all its sessions add up.

    Args:
        path: log.txt; lines are appended
        quiet: write to the file only
        refits: a later command on a finished run, whose time is counted separately
        progress: JSON file for programs that wait for the run, rewritten a few times a second: elapsed share
            of the time, label of the stage, edited views, loss, and seconds so far; None writes no file
    """

    def __init__(
        self, path: Path, quiet: bool = False, refits: bool = False, progress: Path | None = None
    ) -> None:
        self.seconds: dict[str, float] = {}
        self.refits = refits
        self._earlier = 0.0
        self._progress = progress
        self._written = 0.0
        self._state: dict[str, Any] = {"share": 0.0, "label": "", "count": "", "loss": "", "seconds": 0.0}
        self._waits = 0  # waits in progress, in all threads
        self._lock = threading.Lock()  # any thread may report a wait
        self._work: Mapping[str, float] = {"views": 1.0, "edit": 1.0, "optimize": 5.0, **LATER}
        self._ended_seconds: dict[str, float] = {}  # seconds of finished stages
        self._begun_at: dict[str, float] = {}
        self._earlier_mb = 0
        self._start = time.perf_counter()
        self._file = path.open("a", encoding="utf-8", buffering=1)
        self._console = Console(stderr=True, quiet=quiet, highlight=False)
        self._bar = self._console.is_terminal and not quiet

    def rounded_seconds(self) -> dict[str, float]:
        """Return the seconds by stage, plus "total" over all sessions of the run or "refit" for a refit."""
        whole = {"refit" if self.refits else "total": self._total()}
        return {name: round(seconds, 2) for name, seconds in {**self.seconds, **whole}.items()}

    def capture_state(self) -> Saved:
        """Return the seconds so far, including those of unfinished stages."""
        now = time.perf_counter()
        running = {name: now - begun for name, begun in self._begun_at.items()}
        seconds = {
            name: self.seconds.get(name, 0.0) + running.get(name, 0.0) for name in self.seconds | running
        }
        return Saved({}, {"seconds": seconds, "total": self._total(), "memory": self.peak_mb()})

    def restore(self, saved: Saved) -> None:
        """Add the seconds of earlier sessions and remember their peak memory."""
        for name, seconds in saved.values["seconds"].items():
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        self._earlier = saved.values["total"]
        self._earlier_mb = saved.values["memory"] or 0

    def peak_mb(self) -> int | None:
        """Return the peak memory over all sessions of the run, MB, see `peak_mb`; None if unknown."""
        return max(round(peak_mb()), self._earlier_mb) or None

    def expect(self, work: Mapping[str, float]) -> None:
        """Set the expected work of the stages in any common unit; the pace is measured.

        Args:
            work: amount of work by stage, for those of `STAGES` that the run has
        """
        self._work = work

    def seconds_left(self, stage: str, share: float, elapsed: float) -> float:
        """Return the estimated seconds until the run ends.

        Remaining work is estimated at the pace of all finished work. The editor's work is left out, as its
        pace differs. The stage's own pace is weighted by its finished share.

        Args:
            stage: the running stage
            share: finished share of the stage, 0 to 1
            elapsed: seconds since the stage began
        """
        stage_work = self._work.get(stage, 0.0)
        position = list(STAGES).index(stage)
        ahead = sum(work for name, work in self._work.items() if list(STAGES).index(name) > position)
        spent_seconds = 0.0
        work = 0.0
        for name, seconds in self._ended_seconds.items() | {(stage, elapsed)}:
            if name not in _EDITOR_STAGES:
                spent_seconds += seconds
                work += self._work.get(name, 0.0) * (share if name == stage else 1.0)
        pace = spent_seconds / work if work else elapsed / max(share * stage_work, 1e-9)
        return (1.0 - share) * ((1.0 - share) * pace * stage_work + elapsed) + pace * ahead

    def note(self, text: str) -> None:
        """Write a line to the file only."""
        self._file.write(f"{time.perf_counter() - self._start:8.1f} s  {escape_text(text)}\n")

    def say(self, text: str) -> None:
        """Write a line to the file and to stderr."""
        self.note(text)
        if self._bar:
            self._console.print(f"[dim]{time.perf_counter() - self._start:6.1f} s[/dim]  {_escape(text)}")
        else:
            self._console.print(_escape(text), soft_wrap=True)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure the seconds of a stage; repeated stages of one name add up."""
        begun = self._begun_at[name] = time.perf_counter()
        try:
            yield
        finally:
            del self._begun_at[name]
            release_memory()
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begun
            if not STAGES.get(name, name):
                self._ended_seconds[name] = time.perf_counter() - begun

    @contextmanager
    def steps(self, what: str, total: int) -> Iterator[Advance]:
        """Report one of `STAGES` in `total` steps, with the seconds until the run ends.

        A terminal shows a bar; other outputs get a line every few seconds.
        """
        release_memory()
        begun = last = time.perf_counter()
        label = "Waiting for picture" if what == "edit" else STAGES[what]
        self._write_state(label=label, count=f"1 of {total}" if what == "edit" else "", loss="")

        def report_step(done: int, word: str) -> float:
            share = min(done / max(total, 1), 1.0)
            left = self.seconds_left(what, share, time.perf_counter() - begun)
            count = f"{done} of {total}" if what == "edit" else ""
            self._write_progress(what, left, word, done >= total, count)
            return left

        def advance(done: int, word: str) -> None:
            nonlocal last
            left = report_step(done, word)
            now = time.perf_counter()
            if now - last >= _LINE_INTERVAL_S and done < total:
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
                    progress.update(
                        task, completed=done, word=f"{word}  {report_step(done, word):.0f} s left"
                    )

                yield move_bar
        else:
            yield advance
        self._ended_seconds[what] = time.perf_counter() - begun

    @contextmanager
    def kernels(self) -> Iterator[Callable[[int, int], None]]:
        """Report the compilation of kernels, by the yielded function of ready kernels and of all.

        A terminal shows a bar; the progress file gets a label and a count.
        """
        with kernel_bar() if self._bar else nullcontext() as bar:

            def report(done: int, total: int) -> None:
                self._write_state(label="Compiling kernels", count=f"{done} of {total}")
                if bar is not None:
                    bar(done, total)

            yield report

    @contextmanager
    def looks(self, what: str, total: int) -> Iterator[Callable[[], None]]:
        """Report a stage of about `total` equal parts; call the yielded function at each part."""
        done = 0
        lock = threading.Lock()  # any thread may call it
        with self.steps(what, total) as advance:

            def count_part() -> None:
                nonlocal done
                with lock:
                    done += 1
                    advance(min(done, total), "")

            yield count_part

    @contextmanager
    def waiting(self, text: str) -> Iterator[None]:
        """Report a wait by a line, and as the current step until it ends.

        Of several waits at the same time only the first is reported.
        """
        with self._lock:
            self._waits += 1
            is_reported = self._waits == 1
            step = {name: self._state[name] for name in ("label", "count")}
            if is_reported:
                self.say(text)
                self._write_state(label=text, count="")
        try:
            yield
        finally:
            with self._lock:
                self._waits -= 1
                if is_reported and self._state["label"] == text:  # else another step was reported meanwhile
                    self._write_state(**step)

    def close(self) -> None:
        """Close the file."""
        with suppress(OSError):  # a full disk, already reported
            self._file.close()

    def _write_progress(self, what: str, left: float, word: str, ends: bool, count: str) -> None:
        """Rewrite the progress file at most every `_FILE_INTERVAL_S` seconds; ignore a failed write."""
        now = time.perf_counter()
        if self._progress is None or (now - self._written < _FILE_INTERVAL_S and not ends):
            return
        self._written = now
        total = self._total()
        # a field's loss is on another scale
        loss = word.removeprefix("loss to the edit ") if what == "optimize" else ""
        share = max(self._state["share"], total / max(total + left, 1e-9))
        self._write_state(share=share, label=STAGES[what], count=count, loss=loss)

    def _write_state(self, **changes: Any) -> None:
        """Rewrite the progress file with changed values; ignore a failed write."""
        self._state |= {**changes, "seconds": self._total()}
        if self._progress is not None:
            with suppress(OSError, ProgdfError):
                write_file(self._progress, json.dumps(self._state, ensure_ascii=False))

    def _total(self) -> float:
        return self._earlier + time.perf_counter() - self._start


def _escape(text: str) -> str:
    return escape_text(text).replace("[", "\\[")
