"""Parallel jobs on Ray, or one after another without it; jobs of lost workers are restarted."""

from __future__ import annotations

import logging
import math
import pickle
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import chdir, contextmanager, redirect_stdout, suppress
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO, Protocol, cast

from progdf.errors import ProgdfError
from progdf.io.atomic import LOCK, LockedError, hold_lock, make_folder
from progdf.system.packages import install_extra
from progdf.terminal import escape_text, file_size, format_count, format_duration, print_line, shorten
from trainer.editors import editor_row
from trainer.options import BatchOptions, check_ranges
from trainer.resolve import count_threads
from trainer.run.resume import find_run
from trainer.store.state import defer_signals

from .jobs import BatchJob, Cost, estimate_cost, read_catalogue
from .report import SOME_FAILED, JobRow, Screen, finished_row, read_rows, write_page, write_rows
from .worker import Finding, Lost, inspect_scene, run_job

_log = logging.getLogger(__name__)

MAX_ATTEMPTS = 4
"""Attempts at a job whose worker, node or machine was lost."""

_WRITE_INTERVAL_FACTOR = 40.0  # a table is rewritten after this many times its last write duration
_CAPACITY_INTERVAL_S = 2.0  # between two queries of a cluster's cores
_STOP_TIMEOUT_S = 20.0  # for running jobs to save their state when the batch is stopped
_CONNECT_TIMEOUT_S = 10.0  # for a cluster to accept a connection; Ray itself retries for many minutes
_STORE_BYTES = 80 * 2**20  # size of Ray's object store; it transports short texts only


@dataclass(frozen=True)
class Task:
    """A call for a worker, with the resources it needs."""

    function: Callable[[Any], Any]
    argument: Any  # pickled for the worker
    key: str = ""  # key of the job; "" for an inspection
    threads: int = 1
    memory: int = 0  # bytes; 0: unknown
    gpu: bool = False
    attempt: int = 1
    alone: bool = False  # run without other tasks, after it ran out of memory


class Pool(Protocol):
    """Pool of worker processes that run tasks."""

    name: str

    def capacity(self, threads: int) -> int:
        """Return the number of tasks with `threads` threads each that can run at once."""

    def submit(self, task: Task) -> Future[Any]:
        """Start a task in a worker. A `Lost` result or an exception means that the worker ended."""

    def stop(self) -> None:
        """Stop all running tasks as Ctrl-C does, and wait until they have saved their state."""


class LocalPool:
    """One worker process, replaced if it is lost."""

    name = "one worker process"

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1)
        self._worker: subprocess.Popen[bytes] | None = None
        self._future: Future[Any] = Future()

    def capacity(self, threads: int) -> int:
        """See `Pool`."""
        return 1

    def submit(self, task: Task) -> Future[Any]:
        """See `Pool`."""
        self._future = self._thread.submit(self._run, task)
        return self._future

    def _run(self, task: Task) -> Any:
        if self._worker is None:
            self._worker = subprocess.Popen(
                [sys.executable, "-P", "-c", "from trainer.batch.worker import serve; serve()"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,  # so that Ctrl-C reaches it only through `stop`
            )
        try:
            pickle.dump((task.function, task.argument), cast(BinaryIO, self._worker.stdin))
            cast(BinaryIO, self._worker.stdin).flush()
            return pickle.load(cast(BinaryIO, self._worker.stdout))
        except (EOFError, OSError, pickle.UnpicklingError):
            code = self._worker.wait()
            self._worker = None
            return Lost(f"the worker ended ({signal.Signals(-code).name if code < 0 else f'status {code}'})")

    def stop(self) -> None:
        """See `Pool`."""
        worker = self._worker
        if worker is not None:
            if self._future.running():
                worker.send_signal(signal.SIGINT)
                wait([self._future], _STOP_TIMEOUT_S)
            worker.kill()
            worker.wait()
        self._thread.shutdown()


class RayPool:
    """Ray workers on a running cluster, or on a local one that ends with the batch.

    Args:
        address: address of a running cluster; "" starts a local one
        cpus: cores of the local cluster
    """

    def __init__(self, address: str, cpus: int) -> None:
        _check_address(address)
        import ray

        self._ray = ray
        self._references = list[Any]()
        self._folder = "" if address else tempfile.mkdtemp(prefix="progdf-ray-")
        own = {"num_cpus": cpus, "object_store_memory": _STORE_BYTES, "_temp_dir": self._folder}
        where: dict[str, Any] = {"address": address} if address else {**own, "include_dashboard": False}
        before = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(log_to_driver=False, logging_level="error", **where)
        except Exception as error:  # Ray raises a bare Exception if its start takes too long
            shutil.rmtree(self._folder, ignore_errors=True)
            hint = "; if the cluster requires a token, set RAY_AUTH_MODE=token" if address else ""
            reason = str(error).partition("\n")[0] or type(error).__name__
            raise ProgdfError(f"Ray cannot be used ({reason}){hint}") from error
        finally:
            if signal.getsignal(signal.SIGTERM) is not before:
                signal.signal(signal.SIGTERM, before)  # Ray's own handler would end the batch without a word
        self._checked_at = 0.0
        self._cpus = 0
        machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        self._memory = max(machine.get("memory", 0.0) for machine in machines)
        self._has_gpu = any(machine.get("GPU") for machine in machines)
        self.name = f"Ray, {format_count(len(machines), 'machine')}"

    def capacity(self, threads: int) -> int:
        """See `Pool`. The number of machines can change."""
        if time.monotonic() - self._checked_at > _CAPACITY_INTERVAL_S:
            self._checked_at = time.monotonic()
            self._cpus = int(self._ray.cluster_resources().get("CPU", 0))
        return max(1, self._cpus // threads)

    def submit(self, task: Task) -> Future[Any]:
        """See `Pool`."""
        remote = self._ray.remote(task.function).options(
            num_cpus=task.threads,
            num_gpus=int(task.gpu and self._has_gpu),
            memory=int(min(task.memory, 0.9 * self._memory)),  # a larger request would wait forever
            max_retries=0,
            name=task.key,
        )
        reference = remote.remote(task.argument)
        self._references.append(reference)
        future: Future[Any] = reference.future()
        future.add_done_callback(lambda _: self._references.remove(reference))
        return future

    def stop(self) -> None:
        """See `Pool`."""
        running = list(self._references)
        for reference in running:
            with suppress(self._ray.exceptions.RayError):
                self._ray.cancel(reference, force=False)
        if running:
            self._ray.wait(running, num_returns=len(running), timeout=_STOP_TIMEOUT_S)
        self._ray.shutdown()
        shutil.rmtree(self._folder, ignore_errors=True)


def _check_address(address: str) -> None:
    """Raise ProgdfError if HOST:PORT accepts no connection; Ray checks other forms of an address."""
    parts = re.fullmatch(r"([^:/]+):(\d{1,5})", address)
    if parts is None:
        return
    host = parts[1]
    port = int(parts[2])
    try:
        socket.create_connection((host, port), _CONNECT_TIMEOUT_S).close()
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ProgdfError(
            f"no Ray cluster answers at {address} ({reason}); check the address, "
            f"or start one with 'ray start --head --port {port}'"
        ) from None


@contextmanager
def open_pool(workers: int, address: str, threads: int, jobs: int) -> Iterator[Pool]:
    """Open a pool of workers for jobs with `threads` threads each.

    Args:
        workers: number of workers; 0: as many as the cores allow
        address: address of a running Ray cluster; "": this machine
        threads: threads of one job
        jobs: number of jobs

    Raises:
        ProgdfError: Ray is needed but not installed, or cannot be reached.
    """
    has_ray = find_spec("ray") is not None
    workers = min(jobs, workers or max(1, count_threads(0) // threads))
    if not has_ray and address:
        raise ProgdfError(f"--address needs Ray; {install_extra('cluster')}")
    if not has_ray and workers > 1:
        _log.warning("one worker process; for %d at once, %s", workers, install_extra("cluster"))
    pool = RayPool(address, workers * threads) if has_ray and (workers > 1 or address) else LocalPool()
    try:
        yield pool
    finally:
        pool.stop()


def run_tasks(
    tasks: Sequence[Task],
    pool: Pool,
    tell: Callable[[str, Task, str], None] = lambda event, task, reason: None,
    tick: Callable[[Sequence[Task]], None] = lambda running: None,
) -> Iterator[tuple[Task, Any]]:
    """Run tasks and restart those of lost workers.

    Args:
        tasks: in order
        pool: workers
        tell: called with "start" or "retry", the task, and the reason of a retry
        tick: called about twice a second with the running tasks

    Yields:
        Task and result in the order of completion; `Lost` after the last attempt at a task.
    """
    waiting = deque(tasks)
    running = dict[Future[Any], Task]()
    while waiting or running:
        while waiting and _may_start(waiting[0], running, pool):
            task = waiting.popleft()
            tell("start", task, "")
            running[pool.submit(task)] = task
        for future in wait(running, 0.5, FIRST_COMPLETED).done:
            task = running.pop(future)
            result = _result(future)
            lost = isinstance(result, Lost) and not (task.alone and result.from_memory)
            if lost and task.attempt < MAX_ATTEMPTS:
                tell("retry", task, result.reason)
                # a worker that is lost twice may have been killed by the system for its memory
                alone = result.from_memory or task.attempt > 1
                again = replace(task, attempt=task.attempt + 1, alone=alone)
                waiting.append(again) if alone else waiting.appendleft(again)
            else:
                yield task, result
        tick(list(running.values()))


def _may_start(task: Task, running: Mapping[Future[Any], Task], pool: Pool) -> bool:
    if task.alone or any(other.alone for other in running.values()):
        return not running
    return len(running) < pool.capacity(task.threads)


def _result(future: Future[Any]) -> Any:
    """Return a task's result; `Lost` for an error of Ray and after running out of memory."""
    error = future.exception()
    if error is not None:
        kind = type(error).__name__
        return Lost(f"the worker ended ({kind})", from_memory=kind == "OutOfMemoryError")
    result = future.result()
    if isinstance(result, JobRow) and result.status == "memory":
        return Lost(result.reason, from_memory=True)
    return result


def check_jobs(jobs: Sequence[BatchJob], pool: Pool) -> dict[str, Finding]:
    """Check all jobs, scene by scene, before any starts; return the findings by key."""
    scenes: dict[tuple[Path, Path], list[BatchJob]] = {}
    for job in jobs:
        scenes.setdefault((job.folder, job.options.scene), []).append(job)
    findings = list[Finding]()
    for task, result in run_tasks([Task(inspect_scene, group) for group in scenes.values()], pool):
        if isinstance(result, Lost):
            result = [
                Finding(job.key, f"checking its scene failed: {result.reason}") for job in task.argument
            ]
        findings += result
    return {finding.key: finding for finding in findings}


def run_jobs(
    tasks: Sequence[Task],
    pool: Pool,
    tell: Callable[[str, Task, str], None] = lambda event, task, reason: None,
    tick: Callable[[Sequence[Task]], None] = lambda running: None,
) -> Iterator[JobRow]:
    """Run tasks of `train_task`; yield each job's row when it ends. See `run_tasks`."""
    for task, result in run_tasks(tasks, pool, tell, tick):
        if isinstance(result, Lost):
            result = JobRow(task.key, "failed", result.reason)
        yield replace(result, attempts=task.attempt)


def train_task(job: BatchJob, memory: int = 0) -> Task:
    """Return a job as a task; memory in bytes, 0: unknown."""
    runs_model = editor_row(job.options.editor).model is not None
    gpu = runs_model or "text:" in job.options.region.region
    return Task(run_job, job, job.key, count_threads(job.options.threads), memory, gpu)


def run(jobs: Sequence[BatchJob], workers: int = 0, address: str = "") -> Iterator[JobRow]:
    """Train jobs in parallel, for Python programs. The jobs are not checked first, see `check_jobs`.

    Args:
        jobs: runs; finished runs stay unchanged, stopped runs resume
        workers: number of workers; 0: cores / threads
        address: address of a running Ray cluster; "": this machine

    Yields:
        Every job's row when it ends.
    """
    tasks = [train_task(job) for job in jobs]
    threads = max((task.threads for task in tasks), default=1)
    with open_pool(workers, address, threads, len(jobs)) as pool:
        yield from run_jobs(tasks, pool)


def _outside_fault(job: BatchJob) -> str:
    """Return the fault of a job that runs a program or sends pictures, as the catalogue says; else ""."""
    row = editor_row(job.options.editor)
    trust = "if you trust the catalogue, add --allow-commands"
    if row.runs_program:
        return f"it runs a program ({shorten(job.options.editor.editor)}); {trust}"
    if row.sends_pictures:
        return f"it sends pictures to {job.options.editor.api_url or 'a server'}; {trust}"
    return ""


def batch(options: BatchOptions) -> int:
    """Run `progdf batch`.

    Returns:
        0 if all jobs are done, 2 if nothing was started because some cannot be trained (one line each), 3 if
        some failed.

    Raises:
        ProgdfError: the catalogue or the folder cannot be used.
        KeyboardInterrupt: interrupted; the message names the command to continue.
    """
    check_ranges(("--workers", options.workers, 0, 4096))
    jobs, faults = read_catalogue(options.catalogue, options.out)
    if not options.allow_commands:
        refused = {job.key: fault for job in jobs if (fault := _outside_fault(job))}
        jobs = [job for job in jobs if job.key not in refused]
        faults += [f"{key}: {fault}" for key, fault in refused.items()]
    rows = read_rows(options.out)
    if rows and not (options.resume or options.dry_run):
        raise ProgdfError(f"{options.out} holds a batch; add --resume to continue it")
    selected = [job for job in jobs if _is_selected(job, options.only)]
    if not selected and not faults:
        raise ProgdfError("no job matches --only; --dry-run without --only lists all jobs")
    finished = [job for job in jobs if _is_finished(job)]
    finished_keys = {job.key for job in finished}
    found = _found_rows(finished, rows)
    faults += [f"{row.job}: {row.reason}" for row in found.values() if row.status == "failed"]
    pending = [job for job in selected if job.key not in finished_keys]
    threads = max((count_threads(job.options.threads) for job in pending), default=1)
    stdout = sys.stdout
    with (
        redirect_stdout(sys.stderr),  # Ray prints notices about machines
        open_pool(options.workers, options.address, threads, len(pending)) as pool,
    ):
        findings = check_jobs(pending, pool)
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
            with redirect_stdout(stdout):
                _print_plan(selected, finished_keys, costs, pool.capacity(threads))
        if faults and not (options.keep_going and healthy and not options.dry_run):
            return 2
        if options.dry_run:
            return 0
        tasks = [train_task(job, costs[job.key].memory) for job in healthy]
        rows |= {f.key: JobRow(f.key, "failed", f.fault) for f in findings.values() if f.fault}
        rows |= {job.key: JobRow(job.key, "waiting") for job in healthy}
        rows |= found
        seconds = {key: cost.seconds for key, cost in costs.items()}
        by_key = {job.key: job for job in healthy}
        screen = Screen(by_key, seconds, pool.capacity(threads), stdout if options.json else None)
        screen.say(
            f"{format_count(len(tasks), 'job')} on {pool.name}, {format_count(threads, 'thread')} each"
        )
        for job in selected:
            if job.key in found:
                screen.event("end", **asdict(found[job.key]))
        make_folder(options.out)
        try:
            with hold_lock(options.out / LOCK):
                _run_batch(options, jobs, tasks, rows, pool, screen)
        except LockedError:
            raise ProgdfError(f"another batch is running in {options.out}; wait for it, or stop it") from None
        return screen.total([rows[job.key] for job in selected], options.out) or (
            SOME_FAILED if faults else 0
        )


def _run_batch(
    options: BatchOptions,
    jobs: Sequence[BatchJob],
    tasks: Sequence[Task],
    rows: dict[str, JobRow],
    pool: Pool,
    screen: Screen,
) -> None:
    """Run the tasks and rewrite batch.csv and batch.html as they end, in at most 5 % of the time."""

    def tell(event: str, task: Task, reason: str) -> None:
        screen.event(event, job=task.key, attempt=task.attempt, reason=reason)
        if event == "retry":
            screen.say(f"{task.key}: {reason}; restarting it from its saved state")

    writers: list[Callable[[Path, Sequence[JobRow]], None]] = [write_rows, partial(write_page, jobs=jobs)]
    due = [0.0, 0.0]  # a row not yet written is recovered from its run folder

    def write(now: float = math.inf) -> None:
        ordered = [rows[job.key] for job in jobs if job.key in rows]
        for index, writer in enumerate(writers):
            if now >= due[index]:
                begun = time.monotonic()
                writer(options.out, ordered)
                due[index] = begun + _WRITE_INTERVAL_FACTOR * (time.monotonic() - begun)

    try:
        write()
        for row in run_jobs(tasks, pool, tell, lambda running: screen.tick([task.key for task in running])):
            with defer_signals():  # so that an interrupted session has reported every row that it wrote
                rows[row.job] = row
                screen.end(row)
                write(time.monotonic())
    except KeyboardInterrupt:
        again = "--resume" if options.resume else "--resume added"
        raise KeyboardInterrupt(
            f"finished jobs are saved in {options.out}; run the same command with {again} to continue"
        ) from None
    finally:
        screen.close()
        write()


def _is_selected(job: BatchJob, only: str) -> bool:
    return not only or any(fnmatchcase(text, only) for text in (job.key, job.key.rpartition("/")[2]))


def _is_finished(job: BatchJob) -> bool:
    with chdir(job.folder):
        try:
            return find_run(job.options) == "finished"
        except ProgdfError:  # a broken run: training it reports the fault
            return False


def _found_rows(finished: Sequence[BatchJob], rows: Mapping[str, JobRow]) -> dict[str, JobRow]:
    """Return the rows of finished runs that the table lacks or does not list as done, by key.

    They are runs of `progdf train`, or ended just when the earlier session was interrupted. A run with a
    damaged report gets a failed row in any case.
    """
    found = {}
    for job in finished:
        known = rows.get(job.key)
        try:
            row = finished_row(job)
        except ProgdfError as error:
            row = JobRow(job.key, "failed", str(error))
        if known is None or known.status != "done" or row.status != "done":
            found[job.key] = row
    return found


def _disk_faults(out: Path, costs: Mapping[str, Cost]) -> list[str]:
    """Return one line if the jobs will not fit on the disk."""
    folder = out.absolute()
    while not folder.is_dir():
        folder = folder.parent
    needed = sum(cost.disk for cost in costs.values())
    free = shutil.disk_usage(folder).free
    if needed <= free:
        return []
    return [f"{out}: the runs need about {file_size(needed)}, but only {file_size(free)} are free"]


def _print_plan(
    jobs: Sequence[BatchJob], kept: Collection[str], costs: Mapping[str, Cost], workers: int
) -> None:
    """Print the jobs as commands, and their total time, disk space and memory."""
    for job in jobs:
        if job.key in kept:
            plan = "finished"
        elif job.key in costs:
            plan = job.command
        else:
            plan = "cannot be trained"
        print_line(f"{job.key}: {plan}")
    seconds = sum(cost.seconds for cost in costs.values()) / max(1, workers)
    longest = max((cost.seconds for cost in costs.values()), default=0.0)
    print_line(
        f"{format_count(len(costs), 'job')} to train, about {format_duration(max(seconds, longest))} with "
        f"{format_count(workers, 'worker')} and {file_size(sum(cost.disk for cost in costs.values()))}; "
        f"the largest takes {file_size(max((cost.memory for cost in costs.values()), default=0))} of memory"
    )
