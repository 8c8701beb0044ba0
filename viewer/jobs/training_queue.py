"""The queue of training runs: one child at a time, looked at now and then, never waited for."""

from __future__ import annotations

import itertools
import os
import time
from dataclasses import replace

from . import run_files
from .child import Child
from .training_job import EditOrder, Progress, TrainingJob

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
        run_files.keep_order(order)
        return self._append(TrainingJob(next(self._numbers), order))

    def add_stopped(self, order: EditOrder) -> None:
        """Show a run that was stopped another day, unless it is there."""
        if all(job.order.out != order.out for job in self.jobs):
            self._append(TrainingJob(next(self._numbers), order, "stopped", resumes=True))

    def resume(self, number: int) -> None:
        """Go on with a run that was stopped, or try again one that failed."""
        job = self.job(number)
        if job is not None and job.status in ("stopped", "failed"):
            resumes = (job.order.out / "state" / "run.json").is_file()
            self._change(replace(job, status="queued", resumes=resumes, error="", seconds=0.0))

    def stop(self, number: int) -> None:
        """Stop a run; what is done of it is kept. One that waits is taken out."""
        job = self.job(number)
        if job is None:
            return
        if job.status == "queued":
            self._drop(job)
        elif job.status == "running" and self._child is not None:
            self._child.stop()
            self._change(replace(job, status="stopping"))

    def discard(self, number: int) -> None:
        """Forget a run that does not run; what it wrote is removed, unless it is finished."""
        job = self.job(number)
        if job is not None and job.status in ("stopped", "failed", "done"):
            self._drop(job)

    def dismiss(self, number: int) -> None:
        """Take a finished run off the list; its files stay."""
        self.jobs = tuple(job for job in self.jobs if job.number != number)

    def poll(self) -> list[TrainingJob]:
        """Look at the child and start the next one; those that have just ended, well or not."""
        ended = []
        job = self.job(self._running)
        if self._child is not None and job is not None:
            status = self._child.status
            if status is not None:
                ended.append(self._end(job, status))
            elif (now := time.monotonic()) >= self._look_at:
                self._look_at = now + LOOK_S
                progress = run_files.read_progress(job.order, job.progress)
                if progress.share == job.began_at:  # it is still starting, which takes as long as it takes
                    self._began = now
                self._change(replace(job, progress=progress, seconds=now - self._began))
        if self._child is None:
            waiting = next((job for job in self.jobs if job.status == "queued"), None)
            if waiting is not None and (failed := self._start(waiting)) is not None:
                ended.append(failed)
        return ended

    def next_poll(self) -> float | None:
        """Seconds until the next look; None while nothing is trained."""
        return POLL_S if self.busy else None

    def close(self) -> None:
        """Stop what runs, and wait until it has saved its state and gone; what waits is forgotten."""
        for job in self.jobs:
            if job.status == "queued" and not job.resumes:
                self._drop(job)
        if self._child is not None:
            self._child.close()
            self._child = None

    def _start(self, job: TrainingJob) -> TrainingJob | None:
        """Start a run; what became of it where that cannot be."""
        self._running, self._began = job.number, time.monotonic()
        try:
            self._child = Child(job.order.arguments(job.resumes), run_files.log_of(job.order))
        except OSError as error:
            line = f"training cannot start: {error.strerror or error}"
            return self._change(replace(job, status="failed", error=line))
        progress = job.progress if job.resumes else Progress()
        self._change(replace(job, status="running", progress=progress, began_at=progress.share, seconds=0.0))
        return None

    def _end(self, job: TrainingJob, status: int) -> TrainingJob:
        assert self._child is not None
        child, self._child = self._child, None
        child.close()
        stopped = (job.order.out / "state" / "run.json").is_file()
        if status == 0 and job.order.gdf.is_file():
            return self._change(replace(job, status="done", progress=Progress(1.0)))
        if job.status == "stopping":
            if not stopped:  # nothing was done yet
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
        run_files.discard(job.order)
        self.dismiss(job.number)


def spare_threads() -> int:
    """How many threads a child shall use: all but the one that the window needs."""
    return max(1, (os.cpu_count() or 2) - 1)
