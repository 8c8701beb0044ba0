"""Queue of child processes: one training run at a time, and deliveries (exports, pictures, films).

A run trains until its edit is written. Its report goes on at low priority beside the next run.

Children are polled. Only `JobQueue.close` waits for them.
"""

from __future__ import annotations

import itertools
import re
import tempfile
import time
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from progdf.errors import ProgdfError, without_commands
from viewer.state.forms import CHANGED
from viewer.state.workspace import JobCard, JobStatus

from .child import GRACE_S, PICTURES_GRACE_S, Child, Progress, last_line
from .consent import check_allowed
from .training import EditOrder

POLL_S = 0.3
"""Seconds between two checks for ended children."""

PROGRESS_INTERVAL_S = 1.0
"""Seconds between two reads of the jobs' progress; the window redraws their cards at each."""


_COUNT = re.compile(r"^((?:frame )?(\d+)(?:/| of )(\d+)(?:: [^:\n]+)?)", re.MULTILINE)
"""Start of a progress line: the number of the current frame (or of the demo's edit), and the total."""


@dataclass(frozen=True)
class Delivery:
    """Command that writes a file or a folder. It leaves no files if it is stopped."""

    title: str  # of its card
    out: Path
    words: tuple[str, ...]  # command-line arguments after `progdf`
    log: Path  # file for its output
    scene: Path  # the source file

    is_begun: ClassVar[bool] = False
    is_locked: ClassVar[bool] = False
    sends_pictures: ClassVar[bool] = False

    @property
    def result(self) -> Path:
        """File or folder that exists once it is done."""
        return self.out

    def arguments(self, resumes: bool) -> tuple[str, ...]:
        """Return the command-line arguments after `progdf`."""
        return self.words

    def read_progress(self, before: Progress) -> Progress:
        """Return the progress by the last printed line with a count."""
        with suppress(OSError):
            if counts := _COUNT.findall(self.log.read_text("utf-8", "replace")):
                label, number, count = counts[-1]
                return Progress((int(number) - 1) / int(count), label)
        return Progress(before.share, last_line(self.log))

    def lock(self) -> AbstractContextManager[None]:
        """Return a context that locks nothing: a delivery belongs to one window."""
        return nullcontext()

    def save(self) -> None:
        """Save nothing: a delivery cannot be resumed."""

    def discard(self) -> None:
        """Remove nothing: the command writes all or nothing."""

    def offer(self) -> str:
        """Return no offer."""
        return ""

    def warning(self) -> str:
        """Return no warning."""
        return ""


@dataclass(frozen=True)
class QueuedTask:
    """Task in the queue, with its progress."""

    number: int  # id in requests
    task: EditOrder | Delivery
    status: JobStatus = "queued"
    progress: Progress = Progress()
    seconds: float = 0.0  # running time of this session
    error: str = ""  # one line about a failure
    warning: str = ""  # one line about a poor result
    offer: str = ""  # one line about a possible continuation
    resumes: bool = False  # it continues a stopped run
    began_at: float = 0.0  # share done at the start of this session

    @property
    def busy(self) -> bool:
        """True if it runs or is queued."""
        return self.status in ("queued", "running", "stopping")

    @property
    def seconds_left(self) -> float | None:
        """Estimated remaining time at the current pace; None before there is an estimate."""
        done = self.progress.share - self.began_at
        if self.status != "running" or done < 0.05 or self.seconds < 2.0:
            return None
        return self.seconds * (1.0 - self.progress.share) / done


def job_card(job: QueuedTask) -> JobCard:
    """Return a job as the panel shows it."""
    task = job.task
    training = ""
    starting = "Starting"
    keepable = False
    delivered = False
    label = " ".join(filter(None, (job.progress.label, job.progress.count)))
    if isinstance(task, EditOrder):
        delivered = task.is_delivered
        training = f"{task.editor} on {task.region}"
        keepable = job.status == "stopped" and task.is_keepable
        if task.region == CHANGED:
            starting = "Finding the changes"
    return JobCard(
        job.number,
        task.title,
        task.out,
        job.status,
        training,
        label or starting,
        job.progress.share,
        job.progress.loss,
        seconds_left=job.seconds_left,
        error=job.error,
        warning=job.warning,
        keepable=keepable,
        delivered=delivered,
        sends_pictures=task.sends_pictures,
        offer=job.offer,
    )


class JobQueue:
    """Queue of tasks. `close` it: running tasks are stopped, and training can be resumed."""

    def __init__(self) -> None:
        self.jobs: tuple[QueuedTask, ...] = ()
        self._numbers = itertools.count(1)
        self._children: dict[int, Child] = {}
        self._began: dict[int, float] = {}
        self._locks: dict[int, ExitStack] = {}  # locks of jobs that no other window may change
        self._look_at = 0.0
        self._folder = tempfile.TemporaryDirectory(prefix="progdf-jobs-")

    @property
    def folder(self) -> Path:
        """Folder for files that commands read and write; deleted with the window."""
        return Path(self._folder.name)

    def busy(self, kind: type = object) -> QueuedTask | None:
        """Return the first running or queued job of this kind of task."""
        return next((job for job in self.jobs if job.busy and isinstance(job.task, kind)), None)

    def job(self, number: int) -> QueuedTask:
        """Return the job of this number.

        Raises:
            ProgdfError: it is no longer in the queue.
        """
        for job in self.jobs:
            if job.number == number:
                return job
        raise ProgdfError("this job is no longer in the queue")

    def add(self, task: EditOrder | Delivery) -> int:
        """Queue a task and return its number.

        Raises:
            ProgdfError: its folder cannot be written to, or the user has not allowed its editor.
        """
        if isinstance(task, EditOrder):
            check_allowed(task.editor, task.api_url)
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
        """Add a run that was stopped in an earlier session, unless it is listed or another process has it."""
        if not order.is_locked and all(job.task.out != order.out for job in self.jobs):
            job = QueuedTask(
                next(self._numbers), order, "stopped", order.read_progress(Progress()), resumes=True
            )
            self.jobs = (*self.jobs, job)

    def resume(self, number: int) -> None:
        """Resume a stopped run, or retry a failed one.

        Raises:
            ProgdfError: another window trains it or has discarded it, or the user has not allowed its editor.
        """
        job = self.job(number)
        if isinstance(job.task, EditOrder):
            check_allowed(job.task.editor, job.task.api_url)
        if job.status in ("stopped", "failed"):
            self._lock(job)
            resumes = job.task.is_begun
            if job.status == "stopped" and not resumes:
                self._unlock(job)
                self.dismiss(number)
                raise ProgdfError(f"{job.task.title} no longer exists; it was discarded or has finished")
            self._change(replace(job, status="queued", resumes=resumes, error="", seconds=0.0))

    def stop(self, number: int) -> None:
        """Stop a job; a run keeps its progress. A queued job is removed, a stopping one is killed."""
        job = self.job(number)
        if job.status == "queued" and job.resumes:
            self._unlock(job)
            self._change(replace(job, status="stopped"))
        elif job.status == "queued":
            self._drop(job)
        elif job.status == "running":
            self._children[number].stop(_grace_s(job))
            self._change(replace(job, status="stopping"))
        elif job.status == "stopping":
            self._children[number].kill()

    def discard(self, number: int) -> None:
        """Remove a job that does not run, and the files of a run unless it is finished.

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
        """Remove an ended job from the list; its files stay."""
        self.jobs = tuple(job for job in self.jobs if job.number != number)

    def poll(self) -> list[QueuedTask]:
        """Poll the children and start the next jobs; return the jobs that have just ended or failed."""
        ended: list[QueuedTask | None] = []
        reads_progress = time.monotonic() >= self._look_at
        if reads_progress:
            self._look_at = time.monotonic() + PROGRESS_INTERVAL_S
        for job in self.jobs:
            child = self._children.get(job.number)
            if child is not None and (status := child.status) is not None:
                ended.append(self._end(job, child, status))
            elif child is not None and reads_progress:
                self._follow(job)
        for job in self.jobs:
            waits = isinstance(job.task, EditOrder) and self._trains()
            if job.status == "queued" and not waits:
                ended.append(self._start(job))
        return [job for job in ended if job is not None]

    def _trains(self) -> bool:
        """Return True while a run trains, or while two runs write their reports, which take memory too."""
        runs = [job.task for job in self.jobs if job.number in self._children]
        orders = [run for run in runs if isinstance(run, EditOrder)]
        return len(orders) > 1 or any(not order.is_delivered for order in orders)

    def next_poll(self) -> float | None:
        """Return the seconds until the next poll; None if no job is busy."""
        return POLL_S if self.busy() else None

    def close(self) -> None:
        """Stop the running jobs and wait until they have saved their state; discard queued ones."""
        for job in self.jobs:
            if job.status == "queued" and not job.resumes:
                with suppress(ProgdfError):
                    self._drop(job)
        for job in self.jobs:
            if child := self._children.get(job.number):
                child.stop(_grace_s(job))
        for child in self._children.values():
            child.close()
        self._children.clear()
        for job in self.jobs:
            self._unlock(job)
        self._folder.cleanup()

    def _follow(self, job: QueuedTask) -> None:
        progress = job.task.read_progress(job.progress)
        now = time.monotonic()
        if progress.share == job.began_at:  # the estimate starts after the startup
            self._began[job.number] = now
        seconds = now - self._began[job.number]
        self._change(replace(job, progress=progress, seconds=seconds))

    def _start(self, job: QueuedTask) -> QueuedTask | None:
        """Start a job; return it if it failed to start."""
        try:
            self._children[job.number] = Child(job.task.arguments(job.resumes), job.task.log)
        except (OSError, ValueError) as error:  # ValueError: a word that no command line can contain
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
        if begun or job.status != "stopping":  # otherwise `_drop` unlocks it after discarding it
            self._unlock(job)
        if status == 0 and job.task.result.exists():
            warning = without_commands(job.task.warning())
            done = replace(job, status="done", progress=Progress(1.0), warning=warning)
            return self._change(replace(done, offer=job.task.offer()))
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
        """Discard a job. Raises ProgdfError if it cannot be removed."""
        job.task.discard()
        self._unlock(job)
        self.dismiss(job.number)

    def _lock(self, job: QueuedTask) -> None:
        """Lock the run against other windows. Raises ProgdfError if one has it."""
        with ExitStack() as locks:
            locks.enter_context(job.task.lock())
            self._locks[job.number] = locks.pop_all()

    def _unlock(self, job: QueuedTask) -> None:
        if locks := self._locks.pop(job.number, None):
            locks.close()


def _grace_s(job: QueuedTask) -> float:
    """Return the seconds between a stop request and the kill."""
    return PICTURES_GRACE_S if job.task.sends_pictures else GRACE_S
