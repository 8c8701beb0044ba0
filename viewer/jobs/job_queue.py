"""The queue of child processes: one training run at a time, and deliveries (exports, pictures, films).

Children are looked at now and then, never waited for.
"""

from __future__ import annotations

import itertools
import re
import tempfile
import time
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal

from progdf.errors import ProgdfError, without_commands
from viewer.camera.view_camera import SHAPES

from .child import Child, Progress, last_line
from .training import EditOrder

POLL_S = 0.3
"""Between two looks at whether a child has ended."""

LOOK_S = 1.0
"""Between two at how far it is: the window draws its card at each."""

Status = Literal["queued", "running", "stopping", "stopped", "failed", "done"]


FORMATS = {".mp4": "MP4", ".gif": "GIF", ".webp": "WebP", "": "PNG frames"}
"""Of films: three kinds of files, and a folder of frames."""
SIDES = (720, 1080, 1440, 2160)
"""Of pictures and films: the shorter one, pixels."""
FPS = (12, 24, 25, 30, 60)


ALL_SLIDERS = "\0sliders"
TURNTABLE = "\0turntable"
"""Films of no layer's own, in `DeliverOptions.moves`."""


def picture_size(side: int, shape: str) -> tuple[int, int]:
    """Width and height of a picture of one of `SHAPES` whose shorter side has so many pixels."""
    return round(side * max(SHAPES[shape], 1.0)), round(side / min(SHAPES[shape], 1.0))


def film_title(moves: str) -> str:
    """What a film shows, for a person."""
    whole = {"timeline": "The timeline", ALL_SLIDERS: "All sliders in turn", TURNTABLE: "Once around"}
    return whole.get(moves, f"The slider of {moves}, there and back")


@dataclass(frozen=True)
class DeliverOptions:
    """What a picture or a film is asked for."""

    width: int = 1920  # pixels
    height: int = 1080
    alpha: bool = False  # the background is transparent
    fps: int = 24  # frames a second
    seconds: float = 4.0  # of a film that moves a slider there and back
    format: str = ".mp4"  # of `FORMATS`
    moves: str = ""  # "timeline", the name of the layer whose slider moves, or one of these two
    can_move: tuple[str, ...] = ()  # what there is to choose from


_COUNT = re.compile(r"^((?:frame )?(\d+)(?:/| of )(\d+)(?:: [^:\n]+)?)", re.MULTILINE)
"""What a line begins with that says which frame is drawn, or edit of the demo trained, and of how many."""


@dataclass(frozen=True)
class Delivery:
    """A command that writes a file or a folder; stopped, it leaves nothing."""

    name: str  # of its card
    out: Path
    words: tuple[str, ...]  # after `progdf`
    log: Path  # what it prints
    scene: Path  # the file that it is made from

    is_begun: ClassVar[bool] = False
    is_locked: ClassVar[bool] = False

    @property
    def result(self) -> Path:
        """What is there once it is done."""
        return self.out

    def arguments(self, resumes: bool) -> tuple[str, ...]:
        """Words after `progdf`."""
        return self.words

    def read_progress(self, before: Progress) -> Progress:
        """How far it is, by the line with a count that it printed last."""
        with suppress(OSError):
            if counts := _COUNT.findall(self.log.read_text("utf-8", "replace")):
                label, number, count = counts[-1]
                return Progress((int(number) - 1) / int(count), label)
        return Progress(before.share, last_line(self.log))

    def lock(self) -> AbstractContextManager[None]:
        """Nothing: each is one window's own."""
        return nullcontext()

    def save(self) -> None:
        """Nothing: it does not go on another day."""

    def discard(self) -> None:
        """Nothing: the command writes all or none."""

    def warning(self) -> str:
        """No warning."""
        return ""


@dataclass(frozen=True)
class QueuedTask:
    """A task in the queue, as its card shows it."""

    number: int  # what requests call it by
    task: EditOrder | Delivery
    status: Status = "queued"
    progress: Progress = Progress()
    seconds: float = 0.0  # that it has run, in this session of it
    error: str = ""  # the one line of a failure
    warning: str = ""  # the one line of a run that came out poor
    resumes: bool = False  # it goes on with what was stopped
    began_at: float = 0.0  # the share that was done when this session of it began
    elsewhere: str = ""  # the name of its scene where another one is open

    @property
    def busy(self) -> bool:
        """Whether it runs, or waits to."""
        return self.status in ("queued", "running", "stopping")

    @property
    def seconds_left(self) -> float | None:
        """By how long it should still take at this pace; None before anything is known."""
        done = self.progress.share - self.began_at
        if self.status != "running" or done < 0.05 or self.seconds < 2.0:
            return None
        return self.seconds * (1.0 - self.progress.share) / done


class JobQueue:
    """Does what is asked for. `close` it: what runs then is stopped, and training can be resumed."""

    def __init__(self) -> None:
        self.jobs: tuple[QueuedTask, ...] = ()
        self._numbers = itertools.count(1)
        self._children: dict[int, Child] = {}
        self._began: dict[int, float] = {}
        self._locks: dict[int, ExitStack] = {}  # of jobs that no other window may touch
        self._look_at = 0.0
        self._folder = tempfile.TemporaryDirectory(prefix="progdf-jobs-")

    @property
    def folder(self) -> Path:
        """For files that commands read and write; gone with the window."""
        return Path(self._folder.name)

    def busy(self, kind: type = object) -> QueuedTask | None:
        """The first job of this kind of task that runs, or waits to."""
        return next((job for job in self.jobs if job.busy and isinstance(job.task, kind)), None)

    def job(self, number: int) -> QueuedTask:
        """The job of that number.

        Raises:
            ProgdfError: it is not in the queue any more.
        """
        for job in self.jobs:
            if job.number == number:
                return job
        raise ProgdfError("this job is not in the queue any more")

    def add(self, task: EditOrder | Delivery) -> int:
        """Queue a task; its number.

        Raises:
            ProgdfError: its folder cannot be written to.
        """
        job = QueuedTask(next(self._numbers), task)
        self._lock(job)
        try:
            task.save()
        except ProgdfError:
            self._unlock(job)
            raise
        self.jobs = (*self.jobs, job)
        return job.number

    def add_stopped(self, order: EditOrder) -> None:
        """Show a run that was stopped another day, unless it is there, or another process has it."""
        if not order.is_locked and all(job.task.out != order.out for job in self.jobs):
            job = QueuedTask(
                next(self._numbers), order, "stopped", order.read_progress(Progress()), resumes=True
            )
            self.jobs = (*self.jobs, job)

    def resume(self, number: int) -> None:
        """Go on with a run that was stopped, or try again one that failed.

        Raises:
            ProgdfError: another window trains it, or has discarded it.
        """
        job = self.job(number)
        if job.status in ("stopped", "failed"):
            self._lock(job)
            resumes = job.task.is_begun
            if job.status == "stopped" and not resumes:
                self._unlock(job)
                self.dismiss(number)
                raise ProgdfError(f"{job.task.name} is not there any more; it was discarded or is finished")
            self._change(replace(job, status="queued", resumes=resumes, error="", seconds=0.0))

    def stop(self, number: int) -> None:
        """Stop a job; what is done of a run is kept. One that waits is taken out."""
        job = self.job(number)
        if job.status == "queued" and job.resumes:
            self._unlock(job)
            self._change(replace(job, status="stopped"))
        elif job.status == "queued":
            self._drop(job)
        elif job.status == "running":
            self._children[number].stop()
            self._change(replace(job, status="stopping"))

    def discard(self, number: int) -> None:
        """Forget a job that does not run; what a run wrote is removed, unless it is finished.

        Raises:
            ProgdfError: another window trains it, or it cannot be removed.
        """
        job = self.job(number)
        if job.status in ("stopped", "failed", "done"):
            self._lock(job)
            try:
                self._drop(job)
            finally:
                self._unlock(job)

    def dismiss(self, number: int) -> None:
        """Take a job that has ended off the list; its files stay."""
        self.jobs = tuple(job for job in self.jobs if job.number != number)

    def poll(self) -> list[QueuedTask]:
        """Look at the jobs and start those whose turn it is; those that have just ended, well or not."""
        ended: list[QueuedTask | None] = []
        looks = time.monotonic() >= self._look_at
        if looks:
            self._look_at = time.monotonic() + LOOK_S
        for job in self.jobs:
            child = self._children.get(job.number)
            if child is not None and (status := child.status) is not None:
                ended.append(self._end(job, child, status))
            elif child is not None and looks:
                self._follow(job)
        for job in self.jobs:
            trains = any(isinstance(j.task, EditOrder) and j.number in self._children for j in self.jobs)
            if job.status == "queued" and not (trains and isinstance(job.task, EditOrder)):
                ended.append(self._start(job))
        return [job for job in ended if job is not None]

    def next_poll(self) -> float | None:
        """Seconds until the next look; None while there is nothing to see."""
        return POLL_S if self.busy() else None

    def close(self) -> None:
        """Stop what runs, and wait until it has saved its state and gone; what waits is forgotten."""
        for job in self.jobs:
            if job.status == "queued" and not job.resumes:
                with suppress(ProgdfError):
                    self._drop(job)
        for child in self._children.values():
            child.stop()
        for child in self._children.values():
            child.close()
        self._children.clear()
        for job in self.jobs:
            self._unlock(job)
        self._folder.cleanup()

    def _follow(self, job: QueuedTask) -> None:
        progress = job.task.read_progress(job.progress)
        now = time.monotonic()
        if progress.share == job.began_at:  # it is still starting, which takes as long as it takes
            self._began[job.number] = now
        seconds = now - self._began[job.number]
        self._change(replace(job, progress=progress, seconds=seconds))

    def _start(self, job: QueuedTask) -> QueuedTask | None:
        """Start a job; what became of it where that cannot be."""
        try:
            self._children[job.number] = Child(job.task.arguments(job.resumes), job.task.log)
        except (OSError, ValueError) as error:  # the latter of a word that no command line can have
            self._unlock(job)
            line = f"the command cannot start: {getattr(error, 'strerror', None) or error}"
            return self._change(replace(job, status="failed", error=line))
        self._began[job.number] = time.monotonic()
        progress = job.progress if job.resumes else Progress()
        self._change(replace(job, status="running", progress=progress, began_at=progress.share, seconds=0.0))
        return None

    def _end(self, job: QueuedTask, child: Child, status: int) -> QueuedTask:
        self._children.pop(job.number).close()
        begun = job.task.is_begun
        if begun or job.status != "stopping":  # else it is discarded first
            self._unlock(job)
        if status == 0 and job.task.result.exists():
            warning = without_commands(job.task.warning())
            return self._change(replace(job, status="done", progress=Progress(1.0), warning=warning))
        if job.status == "stopping" and begun:
            return self._change(replace(job, status="stopped", resumes=True))
        if job.status == "stopping":  # nothing was done yet
            with suppress(ProgdfError):
                self._drop(job)
            return replace(job, status="stopped")
        error = without_commands(child.error()) or f"the command ended with status {status}"
        return self._change(replace(job, status="failed", error=error, resumes=begun))

    def _change(self, job: QueuedTask) -> QueuedTask:
        self.jobs = tuple(job if old.number == job.number else old for old in self.jobs)
        return job

    def _drop(self, job: QueuedTask) -> None:
        """Raises ProgdfError where it cannot be removed."""
        job.task.discard()
        self._unlock(job)
        self.dismiss(job.number)

    def _lock(self, job: QueuedTask) -> None:
        """Keep other windows from the run. Raises ProgdfError where one has it."""
        with ExitStack() as locks:
            locks.enter_context(job.task.lock())
            self._locks[job.number] = locks.pop_all()

    def _unlock(self, job: QueuedTask) -> None:
        if locks := self._locks.pop(job.number, None):
            locks.close()
