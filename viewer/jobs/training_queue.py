"""The queue of training runs: one child at a time, looked at now and then, never waited for."""

from __future__ import annotations

import itertools
import os
import time
from contextlib import ExitStack, suppress
from dataclasses import replace

from progdf.errors import ProgdfError
from progdf.io.atomic import LockedError

from . import run_files
from .child import Child
from .training_job import EditOrder, Progress, Status, TrainingJob

POLL_S = 0.4
"""Between two looks at a child."""

LOOK_S = 1.0
"""Between two at how far it is: the window draws its card at each."""


class TrainingQueue:
    """Trains what is asked for, in turn. `close` it: what runs then is stopped and can be resumed."""

    def __init__(self) -> None:
        self.jobs: tuple[TrainingJob, ...] = ()
        self._numbers = itertools.count(1)
        self._child: Child | None = None
        self._running = 0  # the number of the job that the child is
        self._began = self._look_at = 0.0
        self._held: dict[int, ExitStack] = {}  # jobs that no other window may touch

    @property
    def busy(self) -> bool:
        """Whether something is trained, or waits to be."""
        return any(job.status in ("queued", "running", "stopping") for job in self.jobs)

    def job(self, number: int) -> TrainingJob | None:
        """The job of that number."""
        return next((job for job in self.jobs if job.number == number), None)

    def add(self, order: EditOrder) -> int:
        """Queue a new edit; its number.

        Raises:
            ProgdfError: its folder cannot be written to.
        """
        job = TrainingJob(next(self._numbers), order)
        self._hold(job)
        try:
            run_files.keep_order(order)
        except ProgdfError:
            self._release(job)
            raise
        return self._append(job)

    def add_stopped(self, order: EditOrder) -> None:
        """Show a run that was stopped another day, or is trained elsewhere, unless it is there."""
        if all(job.order.out != order.out for job in self.jobs):
            progress = run_files.read_progress(order, Progress())
            status: Status = "elsewhere" if run_files.is_held(order) else "stopped"
            self._append(TrainingJob(next(self._numbers), order, status, progress, resumes=True))

    def resume(self, number: int) -> None:
        """Go on with a run that was stopped, or try again one that failed.

        Raises:
            ProgdfError: another window trains it, or has discarded it.
        """
        job = self.job(number)
        if job is not None and job.status in ("stopped", "failed"):
            self._hold(job)
            resumes = run_files.is_begun(job.order.out)
            if job.status == "stopped" and not resumes:
                self._release(job)
                self.dismiss(number)
                raise ProgdfError(f"{job.order.name} is not there any more; it was discarded or is finished")
            self._change(replace(job, status="queued", resumes=resumes, error="", seconds=0.0))

    def stop(self, number: int) -> None:
        """Stop a run; what is done of it is kept. One that waits is taken out."""
        job = self.job(number)
        if job is None:
            return
        if job.status == "queued" and job.resumes:
            self._release(job)
            self._change(replace(job, status="stopped"))
        elif job.status == "queued":
            self._drop(job)
        elif job.status == "running" and self._child is not None:
            self._child.stop()
            self._change(replace(job, status="stopping"))

    def discard(self, number: int) -> None:
        """Forget a run that does not run; what it wrote is removed, unless it is finished.

        Raises:
            ProgdfError: another window trains it, or it cannot be removed.
        """
        job = self.job(number)
        if job is not None and job.status in ("stopped", "failed", "done"):
            self._hold(job)
            try:
                self._drop(job)
            finally:
                self._release(job)

    def dismiss(self, number: int) -> None:
        """Take a finished run off the list; its files stay."""
        self.jobs = tuple(job for job in self.jobs if job.number != number)

    def poll(self) -> list[TrainingJob]:
        """Look at the runs and start the next one; those that have just ended, well or not."""
        ended = []
        job, now = self.job(self._running), time.monotonic()
        looks = now >= self._look_at
        if looks:
            self._look_at = now + LOOK_S
        for other in self.jobs if looks else ():
            if other.status == "elsewhere":
                ended += self._look_elsewhere(other)
        if self._child is not None and job is not None:
            status = self._child.status
            if status is not None:
                ended.append(self._end(job, status))
            elif looks:
                progress = run_files.read_progress(job.order, job.progress)
                if progress.share == job.began_at:  # it is still starting, which takes as long as it takes
                    self._began = now
                starved = self._child.starved
                self._change(replace(job, progress=progress, seconds=now - self._began, starved=starved))
        if self._child is None:
            waiting = next((job for job in self.jobs if job.status == "queued"), None)
            if waiting is not None and (failed := self._start(waiting)) is not None:
                ended.append(failed)
        return ended

    def next_poll(self) -> float | None:
        """Seconds until the next look; None while nothing is trained."""
        if self.busy:
            return POLL_S
        return LOOK_S if any(job.status == "elsewhere" for job in self.jobs) else None

    def close(self) -> None:
        """Stop what runs, and wait until it has saved its state and gone; what waits is forgotten."""
        for job in self.jobs:
            if job.status == "queued" and not job.resumes:
                with suppress(ProgdfError):
                    self._drop(job)
        if self._child is not None:
            self._child.close()
            self._child = None
        for job in self.jobs:
            self._release(job)

    def _look_elsewhere(self, job: TrainingJob) -> list[TrainingJob]:
        """How far a run is that another window trains, and what became of it when it does no more."""
        progress = run_files.read_progress(job.order, job.progress)
        if run_files.is_held(job.order):
            self._change(replace(job, progress=progress))
        elif run_files.is_begun(job.order.out):
            self._change(replace(job, progress=progress, status="stopped"))
        else:  # finished, or discarded
            self.dismiss(job.number)
            return [job]
        return []

    def _start(self, job: TrainingJob) -> TrainingJob | None:
        """Start a run; what became of it where that cannot be."""
        self._running, self._began = job.number, time.monotonic()
        try:
            self._child = Child(job.order.arguments(job.resumes), run_files.log_of(job.order))
        except (OSError, ValueError) as error:  # the latter of a word that no command line can have
            self._release(job)
            line = f"training cannot start: {getattr(error, 'strerror', None) or error}"
            return self._change(replace(job, status="failed", error=line))
        progress = job.progress if job.resumes else Progress()
        self._change(replace(job, status="running", progress=progress, began_at=progress.share, seconds=0.0))
        return None

    def _end(self, job: TrainingJob, status: int) -> TrainingJob:
        assert self._child is not None
        child, self._child = self._child, None
        child.close()
        job = replace(job, starved=False)
        stopped = run_files.is_begun(job.order.out)
        if stopped or job.status != "stopping":  # else it is discarded first
            self._release(job)
        if status == 0 and job.order.gdf.is_file():
            warning = run_files.warning_of(job.order)
            return self._change(replace(job, status="done", progress=Progress(1.0), warning=warning))
        if job.status == "stopping":
            if not stopped:  # nothing was done yet
                with suppress(ProgdfError):
                    self._drop(job)
                return replace(job, status="stopped")
            return self._change(replace(job, status="stopped", resumes=True))
        error = child.error() or f"training ended with status {status}"
        return self._change(replace(job, status="failed", error=error, resumes=stopped))

    def _append(self, job: TrainingJob) -> int:
        self.jobs = (*self.jobs, job)
        return job.number

    def _change(self, job: TrainingJob) -> TrainingJob:
        self.jobs = tuple(job if old.number == job.number else old for old in self.jobs)
        return job

    def _drop(self, job: TrainingJob) -> None:
        """Raises ProgdfError where it cannot be removed."""
        run_files.discard(job.order)
        self._release(job)
        self.dismiss(job.number)

    def _hold(self, job: TrainingJob) -> None:
        """Keep other windows from the run. Raises ProgdfError where one has it; its card says so then."""
        with ExitStack() as held:
            try:
                held.enter_context(run_files.hold_run(job.order))
            except LockedError:
                self._change(replace(job, status="elsewhere"))
                raise
            self._held[job.number] = held.pop_all()

    def _release(self, job: TrainingJob) -> None:
        if held := self._held.pop(job.number, None):
            held.close()


def spare_threads() -> int:
    """How many threads a child shall use: all but the one that the window needs."""
    return max(1, (os.cpu_count() or 2) - 1)
