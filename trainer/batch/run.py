"""Run jobs side by side on Ray, or one after another without it; what is lost is begun again elsewhere."""

from __future__ import annotations

import logging
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import chdir, contextmanager, suppress
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from importlib.util import find_spec
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, Protocol

from progdf.errors import ProgdfError
from progdf.io.atomic import LOCK, LockedError, hold_lock, make_folder
from progdf.terminal import escape_text, file_size, format_count, print_line
from trainer.options import BatchOptions, check_ranges
from trainer.run.resume import find_run
from trainer.run.threads import count_threads

from .jobs import Cost, Job, estimate_cost, read_catalogue
from .report import CSV, PAGE, Row, Screen, duration, make_row, read_rows, write_page, write_rows
from .worker import Finding, Outcome, inspect_scene, run_job

_log = logging.getLogger(__name__)

MOST_ATTEMPTS = 4
"""How often a job is begun whose worker, node or machine was lost."""

_FAILED = 3  # exit status where some jobs failed
_PAGE_EVERY_S = 10.0
_STOP_S = 20.0  # in which what runs saves its state when all is stopped
_STORE_BYTES = 80 * 2**20  # of Ray's object store, through which only words go


@dataclass(frozen=True)
class Lost:
    """What comes back instead of a result when a worker, its node or its machine ends."""

    reason: str
    from_memory: bool = False  # it was ended as memory ran out


@dataclass(frozen=True)
class Need:
    """What a task takes of a machine."""

    threads: int = 1
    memory: int = 0  # bytes; 0: unknown
    gpu: bool = False


class Pool(Protocol):
    """Workers. Tokens stand for what was started."""

    name: str

    def capacity(self, threads: int) -> int:
        """How many tasks of so many threads can run at once."""

    def start(self, function: Callable[[Any], Any], argument: Any, need: Need) -> object:
        """Begin `function(argument)` in a worker; a token."""

    def wait(self, seconds: float) -> list[tuple[object, Any]]:
        """What has ended: token and result, `Lost` or the exception. At once, or after so many seconds."""

    def stop(self) -> None:
        """End all that runs, as Ctrl-C does, and wait until it has saved its state."""


def _serve(connection: Connection) -> None:
    """A worker of `LocalPool`: tasks in, results out, until the other side is gone."""
    parent = multiprocessing.parent_process()
    if hasattr(os, "setsid"):
        os.setsid()  # Ctrl-C reaches it once, by `stop`

    def watch() -> None:
        if parent is not None:
            parent.join()
            os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()
    with suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            function, argument = connection.recv()
            try:
                result = function(argument)
            except Exception as error:
                result = Lost(f"{type(error).__name__}: {error}")
            connection.send(result)


class LocalPool:
    """One worker process, and another one when it is lost."""

    name = "one worker process"

    def __init__(self) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._process: SpawnProcess | None = None
        self._connection: Connection | None = None
        self._token: object | None = None

    def capacity(self, threads: int) -> int:
        """See `Pool`."""
        return 1

    def start(self, function: Callable[[Any], Any], argument: Any, need: Need) -> object:
        """See `Pool`."""
        if self._process is None or self._connection is None:
            self._connection, theirs = self._context.Pipe()
            self._process = self._context.Process(target=_serve, args=(theirs,), daemon=False)
            self._process.start()
            theirs.close()
        self._connection.send((function, argument))
        self._token = object()
        return self._token

    def wait(self, seconds: float) -> list[tuple[object, Any]]:
        """See `Pool`."""
        if self._token is None or self._connection is None or not self._connection.poll(seconds):
            return []
        token, self._token = self._token, None
        try:
            return [(token, self._connection.recv())]
        except (EOFError, OSError):
            return [(token, Lost(f"its worker ended ({self._end()})"))]

    def stop(self) -> None:
        """See `Pool`."""
        if self._process is not None:
            if self._token is not None and self._process.is_alive() and self._process.pid is not None:
                with suppress(ProcessLookupError):
                    os.kill(self._process.pid, signal.SIGINT)
                self.wait(_STOP_S)
            self._end()

    def _end(self) -> str:
        """End the worker; how it ended."""
        process, self._process = self._process, None
        if self._connection is not None:
            self._connection.close()  # an idle worker ends by this
            self._connection = None
        if process is None:
            return ""
        process.join(2.0)
        if process.is_alive():
            process.kill()
            process.join()
        code = process.exitcode or 0
        return signal.Signals(-code).name if code < 0 else f"exit status {code}"


class RayPool:
    """Tasks on Ray: a cluster that runs, or one of this machine's cores that ends with the batch.

    Args:
        address: of a running cluster; "" starts one
        cpus: cores of the one that is started
    """

    def __init__(self, address: str, cpus: int) -> None:
        import ray

        self._ray = ray
        self._folder = None if address else tempfile.mkdtemp(prefix="progdf-ray-")
        quiet = {"log_to_driver": False, "logging_level": "error"}
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # a warning about what comes
        try:
            if address:
                ray.init(address=address, **quiet)
            else:
                ray.init(
                    num_cpus=cpus,
                    include_dashboard=False,
                    object_store_memory=_STORE_BYTES,
                    _temp_dir=self._folder,
                    **quiet,
                )
        except (ConnectionError, RuntimeError, OSError, ValueError) as error:
            self._remove_folder()
            where = f"the Ray cluster at {address}" if address else "Ray"
            raise ProgdfError(f"{where} cannot be used ({str(error).splitlines()[0]})") from error
        self._tasks: dict[Any, object] = {}
        self._looked, self._resources = 0.0, dict[str, float]()
        self.name = f"Ray on {len(self._nodes())} machines" if address else "Ray on this machine"

    def capacity(self, threads: int) -> int:
        """See `Pool`."""
        if time.monotonic() - self._looked > 2.0:
            self._looked, self._resources = time.monotonic(), self._ray.cluster_resources()
        return max(1, int(self._resources.get("CPU", 0)) // threads)

    def start(self, function: Callable[[Any], Any], argument: Any, need: Need) -> object:
        """See `Pool`."""
        most = max((node["Resources"].get("memory", 0) for node in self._nodes()), default=0)
        options = {"num_cpus": need.threads, "memory": int(min(need.memory, 0.9 * most))}
        if need.gpu and self._resources.get("GPU"):
            options["num_gpus"] = 1
        task = self._ray.remote(function).options(max_retries=0, **options)
        reference = task.remote(argument)
        self._tasks[reference] = token = object()
        return token

    def wait(self, seconds: float) -> list[tuple[object, Any]]:
        """See `Pool`."""
        if not self._tasks:
            return []
        ready, _ = self._ray.wait(list(self._tasks), num_returns=1, timeout=seconds)
        return [(self._tasks.pop(reference), self._result(reference)) for reference in ready]

    def stop(self) -> None:
        """See `Pool`."""
        with suppress(self._ray.exceptions.RayError):
            for reference in self._tasks:
                self._ray.cancel(reference, force=False)
            if self._tasks:
                self._ray.wait(list(self._tasks), num_returns=len(self._tasks), timeout=_STOP_S)
        self._tasks.clear()
        self._ray.shutdown()
        self._remove_folder()

    def _result(self, reference: Any) -> Any:
        errors = self._ray.exceptions
        try:
            return self._ray.get(reference)
        except errors.OutOfMemoryError:
            return Lost("its worker was ended as memory ran out", from_memory=True)
        except errors.RayTaskError as error:
            return ProgdfError(f"internal error: {error.cause!s}")
        except errors.RayError as error:
            return Lost(f"its worker ended ({type(error).__name__})")

    def _nodes(self) -> list[dict[str, Any]]:
        return [node for node in self._ray.nodes() if node["Alive"]]

    def _remove_folder(self) -> None:
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)


@contextmanager
def open_pool(workers: int, address: str, threads: int, jobs: int) -> Iterator[Pool]:
    """Workers for jobs of so many threads.

    Args:
        workers: how many at once; 0: as many as the cores allow
        address: of a running Ray cluster; "": this machine
        threads: of a job
        jobs: how many there are

    Raises:
        ProgdfError: Ray is needed and not installed, or cannot be reached.
    """
    has_ray = find_spec("ray") is not None
    if address and not has_ray:
        raise ProgdfError("--address needs Ray; pip install progdf-studio[cluster]")
    workers = min(jobs, workers or max(1, count_threads(0) // threads))
    if not has_ray and workers > 1:
        _log.warning("one worker process; pip install progdf-studio[cluster] for %d at once", workers)
    pool = RayPool(address, workers * threads) if has_ray and (workers > 1 or address) else LocalPool()
    try:
        yield pool
    finally:
        pool.stop()


@dataclass(frozen=True)
class Attempt:
    """A job that waits or runs."""

    job: Job
    need: Need = Need()
    number: int = 1
    alone: bool = False  # nothing runs beside it, as it ran out of memory
    begun: float = 0.0


def inspect(jobs: Sequence[Job], pool: Pool) -> list[Finding]:
    """Look at all jobs, scene by scene; what is wrong with each before anything starts."""
    scenes: dict[tuple[Path, Path], list[Job]] = {}
    for job in jobs:
        scenes.setdefault((job.folder, job.options.scene), []).append(job)
    waiting, running = deque(scenes.values()), dict[object, list[Job]]()
    findings: dict[str, Finding] = {}
    while waiting or running:
        while waiting and len(running) < pool.capacity(1):
            group = waiting.popleft()
            running[pool.start(inspect_scene, group, Need())] = group
        for token, result in pool.wait(0.5):
            group = running.pop(token)
            if isinstance(result, Lost | Exception):
                reason = result.reason if isinstance(result, Lost) else str(result)
                result = [Finding(job.key, f"its scene cannot be looked at: {reason}") for job in group]
            findings |= {finding.key: finding for finding in result}
    return [findings[job.key] for job in jobs]


def run_attempts(
    attempts: Sequence[Attempt],
    pool: Pool,
    tell: Callable[[str, Attempt, str], None] = lambda event, attempt, reason: None,
    tick: Callable[[Sequence[Attempt]], None] = lambda running: None,
) -> Iterator[Outcome]:
    """Run jobs; what a lost worker had is begun again and goes on from its saved state.

    Args:
        attempts: in order
        pool: workers
        tell: hears of "start" and "retry", with the reason of the latter
        tick: called about twice a second with what runs

    Yields:
        every job's end, as it comes.
    """
    waiting, running = deque(attempts), dict[object, Attempt]()
    while waiting or running:
        while waiting and _may_start(waiting[0], running, pool):
            attempt = replace(waiting.popleft(), begun=time.time())
            tell("start", attempt, "")
            running[pool.start(run_job, attempt.job, attempt.need)] = attempt
        for token, result in pool.wait(0.5):
            attempt = running.pop(token)
            if isinstance(result, Exception):
                result = Outcome(attempt.job.key, "failed", str(result))
            lost = result if isinstance(result, Lost) else None
            if result.status == "memory" if lost is None else lost.from_memory:
                lost = lost or Lost(result.reason, from_memory=True)
            if lost is None:
                yield replace(result, attempts=attempt.number)
            elif attempt.number == MOST_ATTEMPTS or (attempt.alone and lost.from_memory):
                yield Outcome(attempt.job.key, "failed", lost.reason, attempts=attempt.number)
            else:
                # who dies a second time may have been ended by the system for its memory
                alone = lost.from_memory or attempt.number > 1
                tell("retry", attempt, lost.reason)
                again = replace(attempt, number=attempt.number + 1, alone=alone)
                waiting.append(again) if alone else waiting.appendleft(again)
        tick(list(running.values()))


def _may_start(attempt: Attempt, running: dict[object, Attempt], pool: Pool) -> bool:
    if attempt.alone or any(other.alone for other in running.values()):
        return not running
    return len(running) < pool.capacity(attempt.need.threads)


def run(jobs: Sequence[Job], workers: int = 0, address: str = "") -> Iterator[Outcome]:
    """Train jobs side by side; for Python programs. Nothing is looked at before the start, see `inspect`.

    Args:
        jobs: runs; finished ones are left as they are, stopped ones go on
        workers: how many at once; 0: cores / threads
        address: of a running Ray cluster; "": this machine

    Yields:
        every job's end, as it comes.
    """
    threads = max((count_threads(job.options.threads) for job in jobs), default=1)
    with open_pool(workers, address, threads, len(jobs)) as pool:
        attempts = [Attempt(job, Need(count_threads(job.options.threads))) for job in jobs]
        yield from run_attempts(attempts, pool)


def batch(options: BatchOptions) -> int:
    """Run `progdf batch`.

    Returns:
        0 all jobs are done; 2 some cannot be trained, a line each, and nothing was started; 3 some failed.

    Raises:
        ProgdfError: the catalogue or the folder cannot be used.
        KeyboardInterrupt: interrupted; the message says how to go on.
    """
    check_ranges(("--workers", options.workers, 0, 4096))
    jobs, faults = read_catalogue(options.catalogue, options.out)
    rows = read_rows(options.out)
    if rows and not (options.resume or options.failed or options.dry_run):
        raise ProgdfError(f"{options.out} holds a batch; add --resume to go on with it")
    selected = [job for job in jobs if _is_selected(job, options, rows)]
    if not selected and not faults:
        raise ProgdfError("no job matches; --dry-run lists them")
    kept = {job.key for job in selected if _is_finished(job)}
    pending = [job for job in selected if job.key not in kept]
    threads = max((count_threads(job.options.threads) for job in pending), default=1)
    with open_pool(options.workers, options.address, threads, len(pending)) as pool:
        findings = {finding.key: finding for finding in inspect(pending, pool)}
        faults += [f"{f.key}: {f.fault}" for f in findings.values() if f.fault]
        healthy = [job for job in pending if not findings[job.key].fault]
        costs = {
            job.key: estimate_cost(job.options, findings[job.key].gaussians, findings[job.key].members)
            for job in healthy
        }
        faults += _disk_faults(options.out, costs)
        for fault in faults:
            print(f"progdf: {escape_text(fault)}", file=sys.stderr)
        if options.dry_run:
            _print_plan(selected, kept, costs, pool.capacity(threads))
        if faults and not (options.keep_going and healthy and not options.dry_run):
            return 2
        if options.dry_run:
            return 0
        make_folder(options.out)
        try:
            with hold_lock(options.out / LOCK):
                return _run_batch(options, jobs, selected, healthy, rows, findings, costs, pool) or (
                    _FAILED if faults else 0
                )
        except LockedError:
            raise ProgdfError(f"another batch works in {options.out}; wait for it, or stop it") from None


def _run_batch(
    options: BatchOptions,
    jobs: Sequence[Job],
    selected: Sequence[Job],
    pending: Sequence[Job],
    rows: dict[str, Row],
    findings: Mapping[str, Finding],
    costs: Mapping[str, Cost],
    pool: Pool,
) -> int:
    """Train the pending jobs; batch.csv after each, batch.html from time to time. The exit status."""
    by_key = {job.key: job for job in jobs}
    rows |= {key: Row(key, "failed", finding.fault) for key, finding in findings.items() if finding.fault}
    rows |= {job.key: Row(job.key, "waiting") for job in pending}
    for job in jobs:
        if job.key not in rows and _is_finished(job):  # a run of train's, or one whose row was lost
            rows[job.key] = make_row(job, Outcome(job.key, "done"))
    attempts = [Attempt(job, _need(job, costs[job.key])) for job in pending]
    threads = max((attempt.need.threads for attempt in attempts), default=1)
    screen = Screen(
        {job.key: job for job in pending},
        {key: cost.seconds for key, cost in costs.items()},
        pool.capacity(threads),
        options.json,
    )

    def tell(event: str, attempt: Attempt, reason: str) -> None:
        screen.event(event, job=attempt.job.key, attempt=attempt.number, reason=reason)
        if event == "retry":
            screen.say(f"{attempt.job.key}: {reason}; it is begun again and goes on where it was")

    def write(with_page: bool) -> None:
        ordered = [rows[job.key] for job in jobs if job.key in rows]
        write_rows(options.out, ordered)
        if with_page:
            write_page(options.out, by_key, ordered)

    begun = page_at = time.monotonic()
    screen.say(f"{format_count(len(pending), 'job')} on {pool.name}, {format_count(threads, 'thread')} each")
    ends = run_attempts(attempts, pool, tell, lambda running: screen.tick([a.job.key for a in running]))
    try:
        with screen:
            write(with_page=True)
            for outcome in ends:
                rows[outcome.key] = make_row(by_key[outcome.key], outcome)
                screen.end(rows[outcome.key])
                late = time.monotonic() - page_at > _PAGE_EVERY_S
                write(with_page=late)
                page_at = time.monotonic() if late else page_at
    except KeyboardInterrupt:
        again = "--resume" if options.resume else "--resume added"
        raise KeyboardInterrupt(
            f"what is done is kept in {options.out}; give the same command with {again} to go on"
        ) from None
    finally:
        write(with_page=True)
    statuses = [rows[job.key].status for job in selected]
    done, failed = statuses.count("done"), statuses.count("failed")
    screen.event("total", done=done, failed=failed, jobs=len(selected), seconds=time.monotonic() - begun)
    screen.say(
        f"{done} of {format_count(len(selected), 'job')} done{f', {failed} failed' if failed else ''} "
        f"in {duration(time.monotonic() - begun)}; see {options.out / PAGE} and {CSV}"
    )
    return _FAILED if failed else 0


def _is_selected(job: Job, options: BatchOptions, rows: Mapping[str, Row]) -> bool:
    name = job.key.rpartition("/")[2]
    if options.only and not any(fnmatchcase(text, options.only) for text in (job.key, name)):
        return False
    return not options.failed or (job.key in rows and rows[job.key].status == "failed")


def _is_finished(job: Job) -> bool:
    with chdir(job.folder):
        try:
            return find_run(job.options) == "finished"
        except ProgdfError:  # a broken run: training it says what is wrong
            return False


def _need(job: Job, cost: Cost) -> Need:
    gpu = job.options.editor.family == "instruct" or "text:" in job.options.region.region
    return Need(count_threads(job.options.threads), cost.memory, gpu)


def _disk_faults(out: Path, costs: Mapping[str, Cost]) -> list[str]:
    """One line where the jobs will not fit on the disk."""
    folder = out.absolute()
    while not folder.is_dir():
        folder = folder.parent
    needed, free = sum(cost.disk for cost in costs.values()), shutil.disk_usage(folder).free
    if needed <= free:
        return []
    return [f"{out}: the runs will take about {file_size(needed)}, and {file_size(free)} are free"]


def _print_plan(jobs: Sequence[Job], kept: Collection[str], costs: Mapping[str, Cost], workers: int) -> None:
    """The jobs as commands, and what all of them will take."""
    for job in jobs:
        state = "finished" if job.key in kept else "" if job.key in costs else "cannot be trained"
        print_line(f"{job.key}: {state or job.command}")
    seconds = sum(cost.seconds for cost in costs.values()) / max(1, workers)
    longest = max((cost.seconds for cost in costs.values()), default=0.0)
    print_line(
        f"{format_count(len(costs), 'job')} to train, about {duration(max(seconds, longest))} with "
        f"{format_count(workers, 'worker')} and {file_size(sum(cost.disk for cost in costs.values()))}; "
        f"the largest takes {file_size(max((cost.memory for cost in costs.values()), default=0))} of memory"
    )
