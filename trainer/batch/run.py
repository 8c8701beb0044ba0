"""Run jobs side by side on Ray, or one after another without it; what is lost is begun again elsewhere."""

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
from progdf.terminal import escape_text, file_size, format_count, format_duration, print_line
from trainer.options import BatchOptions, check_ranges
from trainer.resolve import count_threads
from trainer.run.resume import find_run
from trainer.store.state import defer_signals

from .jobs import BatchJob, Cost, estimate_cost, read_catalogue
from .report import SOME_FAILED, JobRow, Screen, finished_row, read_rows, write_page, write_rows
from .worker import Finding, Lost, inspect_scene, run_job

_log = logging.getLogger(__name__)

MAX_ATTEMPTS = 4
"""How often a job is begun whose worker, node or machine was lost."""

_PACE = 40.0  # times what writing a table took pass before it is written again
_LOOK_S = 2.0  # between two looks at a cluster's cores
_STOP_S = 20.0  # in which what runs saves its state when all is stopped
_ANSWER_S = 10.0  # in which a cluster takes a connection; Ray itself retries for many minutes
_STORE_BYTES = 80 * 2**20  # of Ray's object store, through which only words go


@dataclass(frozen=True)
class Task:
    """What a worker is given, and what it takes of a machine."""

    function: Callable[[Any], Any]
    argument: Any  # pickled on the way
    key: str = ""  # of the job, or of the scene that is looked at
    threads: int = 1
    memory: int = 0  # bytes; 0: unknown
    gpu: bool = False
    attempt: int = 1
    alone: bool = False  # nothing runs beside it, as it ran out of memory


class Pool(Protocol):
    """Workers."""

    name: str

    def capacity(self, threads: int) -> int:
        """How many tasks of so many threads can run at once."""

    def submit(self, task: Task) -> Future[Any]:
        """Begin a task in a worker. Its result may be `Lost`; an exception is a worker that ended, too."""

    def stop(self) -> None:
        """End all that runs, as Ctrl-C does, and wait until it has saved its state."""


class LocalPool:
    """One worker process, and another one when it is lost."""

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
                start_new_session=True,  # Ctrl-C reaches it once, by `stop`
            )
        try:
            pickle.dump((task.function, task.argument), cast(BinaryIO, self._worker.stdin))
            cast(BinaryIO, self._worker.stdin).flush()
            return pickle.load(cast(BinaryIO, self._worker.stdout))
        except (EOFError, OSError, pickle.UnpicklingError):
            code = self._worker.wait()
            self._worker = None
            return Lost(f"its worker ended ({signal.Signals(-code).name if code < 0 else f'status {code}'})")

    def stop(self) -> None:
        """See `Pool`."""
        if (worker := self._worker) is not None:
            if self._future.running():
                worker.send_signal(signal.SIGINT)
                wait([self._future], _STOP_S)
            worker.kill()
            worker.wait()
        self._thread.shutdown()


class RayPool:
    """Tasks on Ray: a cluster that runs, or one of this machine's cores that ends with the batch.

    Args:
        address: of a running cluster; "" starts one
        cpus: cores of the one that is started
    """

    def __init__(self, address: str, cpus: int) -> None:
        _check_address(address)
        import ray

        self._ray, self._references = ray, list[Any]()
        self._folder = "" if address else tempfile.mkdtemp(prefix="progdf-ray-")
        own = {"num_cpus": cpus, "object_store_memory": _STORE_BYTES, "_temp_dir": self._folder}
        where: dict[str, Any] = {"address": address} if address else {**own, "include_dashboard": False}
        try:
            ray.init(log_to_driver=False, logging_level="error", **where)
        except Exception as error:  # Ray raises a bare Exception where its start takes too long
            shutil.rmtree(self._folder, ignore_errors=True)
            hint = "; where the cluster asks for a token, RAY_AUTH_MODE=token sends it" if address else ""
            reason = str(error).partition("\n")[0] or type(error).__name__
            raise ProgdfError(f"Ray cannot be used ({reason}){hint}") from error
        self._looked = 0.0
        self._cpus = 0
        machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        self._memory = max(machine.get("memory", 0.0) for machine in machines)
        self._has_gpu = any(machine.get("GPU") for machine in machines)
        self.name = f"Ray, {format_count(len(machines), 'machine')}"

    def capacity(self, threads: int) -> int:
        """See `Pool`. Machines come and go."""
        if time.monotonic() - self._looked > _LOOK_S:
            self._looked, self._cpus = time.monotonic(), int(self._ray.cluster_resources().get("CPU", 0))
        return max(1, self._cpus // threads)

    def submit(self, task: Task) -> Future[Any]:
        """See `Pool`."""
        remote = self._ray.remote(task.function).options(
            num_cpus=task.threads,
            num_gpus=int(task.gpu and self._has_gpu),
            memory=int(min(task.memory, 0.9 * self._memory)),  # or it would wait for ever
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
            self._ray.wait(running, num_returns=len(running), timeout=_STOP_S)
        self._ray.shutdown()
        shutil.rmtree(self._folder, ignore_errors=True)


def _check_address(address: str) -> None:
    """Raise ProgdfError if HOST:PORT takes no connection; other forms of an address are left to Ray."""
    parts = re.fullmatch(r"([^:/]+):(\d{1,5})", address)
    if parts is None:
        return
    host = parts[1]
    port = int(parts[2])
    try:
        socket.create_connection((host, port), _ANSWER_S).close()
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ProgdfError(
            f"no Ray cluster answers at {address} ({reason}); check the address, "
            f"or start one with 'ray start --head --port {port}'"
        ) from None


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
    workers = min(jobs, workers or max(1, count_threads(0) // threads))
    if not has_ray and address:
        raise ProgdfError("--address needs Ray; pip install progdf-studio[cluster]")
    if not has_ray and workers > 1:
        _log.warning("one worker process; pip install progdf-studio[cluster] for %d at once", workers)
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
    """Run tasks; what a lost worker had is begun again.

    Args:
        tasks: in order
        pool: workers
        tell: hears of "start" and "retry", with the reason of the latter
        tick: called about twice a second with what runs

    Yields:
        task and result as they come, `Lost` where a task was given up.
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
                # who dies a second time may have been ended by the system for its memory
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
    """A task's result; `Lost` for one of Ray's errors, and where memory ran out."""
    if (error := future.exception()) is not None:
        kind = type(error).__name__
        return Lost(f"its worker ended ({kind})", from_memory=kind == "OutOfMemoryError")
    result = future.result()
    if isinstance(result, JobRow) and result.status == "memory":
        return Lost(result.reason, from_memory=True)
    return result


def inspect(jobs: Sequence[BatchJob], pool: Pool) -> dict[str, Finding]:
    """Look at all jobs, scene by scene: what is wrong with each before anything starts, by key."""
    scenes: dict[tuple[Path, Path], list[BatchJob]] = {}
    for job in jobs:
        scenes.setdefault((job.folder, job.options.scene), []).append(job)
    findings = list[Finding]()
    for task, result in run_tasks([Task(inspect_scene, group) for group in scenes.values()], pool):
        if isinstance(result, Lost):
            result = [
                Finding(job.key, f"looking at its scene failed: {result.reason}") for job in task.argument
            ]
        findings += result
    return {finding.key: finding for finding in findings}


def run_jobs(
    tasks: Sequence[Task],
    pool: Pool,
    tell: Callable[[str, Task, str], None] = lambda event, task, reason: None,
    tick: Callable[[Sequence[Task]], None] = lambda running: None,
) -> Iterator[JobRow]:
    """`run_tasks` for tasks of `train_task`; every job's row as it ends."""
    for task, result in run_tasks(tasks, pool, tell, tick):
        if isinstance(result, Lost):
            result = JobRow(task.key, "failed", result.reason)
        yield replace(result, attempts=task.attempt)


def train_task(job: BatchJob, memory: int = 0) -> Task:
    """A job as a task; memory in bytes, 0: unknown."""
    gpu = job.options.editor.family == "instruct" or "text:" in job.options.region.region
    return Task(run_job, job, job.key, count_threads(job.options.threads), memory, gpu)


def run(jobs: Sequence[BatchJob], workers: int = 0, address: str = "") -> Iterator[JobRow]:
    """Train jobs side by side; for Python programs. Nothing is looked at before the start, see `inspect`.

    Args:
        jobs: runs; finished ones are left as they are, stopped ones go on
        workers: how many at once; 0: cores / threads
        address: of a running Ray cluster; "": this machine

    Yields:
        every job's row as it ends.
    """
    tasks = [train_task(job) for job in jobs]
    threads = max((task.threads for task in tasks), default=1)
    with open_pool(workers, address, threads, len(jobs)) as pool:
        yield from run_jobs(tasks, pool)


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
    if rows and not (options.resume or options.dry_run):
        raise ProgdfError(f"{options.out} holds a batch; add --resume to go on with it")
    selected = [job for job in jobs if _is_selected(job, options.only)]
    if not selected and not faults:
        raise ProgdfError("no job matches; --dry-run lists them")
    finished = [job for job in jobs if _is_finished(job)]
    kept = {job.key for job in finished}
    found = _found_rows(finished, rows)
    faults += [f"{row.job}: {row.reason}" for row in found.values() if row.status == "failed"]
    pending = [job for job in selected if job.key not in kept]
    threads = max((count_threads(job.options.threads) for job in pending), default=1)
    stdout = sys.stdout
    with (
        redirect_stdout(sys.stderr),  # Ray prints what it notices of machines
        open_pool(options.workers, options.address, threads, len(pending)) as pool,
    ):
        findings = inspect(pending, pool)
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
                _print_plan(selected, kept, costs, pool.capacity(threads))
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
            raise ProgdfError(f"another batch works in {options.out}; wait for it, or stop it") from None
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
    """Run the tasks; batch.csv and batch.html as they end, in a twentieth of the time at most."""

    def tell(event: str, task: Task, reason: str) -> None:
        screen.event(event, job=task.key, attempt=task.attempt, reason=reason)
        if event == "retry":
            screen.say(f"{task.key}: {reason}; it is begun again and goes on where it was")

    writers: list[Callable[[Path, Sequence[JobRow]], None]] = [write_rows, partial(write_page, jobs=jobs)]
    due = [0.0, 0.0]  # a row that is not written is found again in its run

    def write(now: float = math.inf) -> None:
        ordered = [rows[job.key] for job in jobs if job.key in rows]
        for index, writer in enumerate(writers):
            if now >= due[index]:
                begun = time.monotonic()
                writer(options.out, ordered)
                due[index] = begun + _PACE * (time.monotonic() - begun)

    try:
        write()
        for row in run_jobs(tasks, pool, tell, lambda running: screen.tick([task.key for task in running])):
            with defer_signals():  # an interrupted session has told of each row that it wrote
                rows[row.job] = row
                screen.end(row)
                write(time.monotonic())
    except KeyboardInterrupt:
        again = "--resume" if options.resume else "--resume added"
        raise KeyboardInterrupt(
            f"what is done is kept in {options.out}; give the same command with {again} to go on"
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
        except ProgdfError:  # a broken run: training it says what is wrong
            return False


def _found_rows(finished: Sequence[BatchJob], rows: Mapping[str, JobRow]) -> dict[str, JobRow]:
    """Return the rows of finished runs that the table does not have, or not as done, by key.

    They are runs of `progdf train`, or ended just when the earlier session was interrupted. The row of a run
    whose report is damaged says so, whatever the table has.
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
    """One line where the jobs will not fit on the disk."""
    folder = out.absolute()
    while not folder.is_dir():
        folder = folder.parent
    needed = sum(cost.disk for cost in costs.values())
    free = shutil.disk_usage(folder).free
    if needed <= free:
        return []
    return [f"{out}: the runs will take about {file_size(needed)}, and {file_size(free)} are free"]


def _print_plan(
    jobs: Sequence[BatchJob], kept: Collection[str], costs: Mapping[str, Cost], workers: int
) -> None:
    """The jobs as commands, and what all of them will take."""
    for job in jobs:
        state = "finished" if job.key in kept else "" if job.key in costs else "cannot be trained"
        print_line(f"{job.key}: {state or job.command}")
    seconds = sum(cost.seconds for cost in costs.values()) / max(1, workers)
    longest = max((cost.seconds for cost in costs.values()), default=0.0)
    print_line(
        f"{format_count(len(costs), 'job')} to train, about {format_duration(max(seconds, longest))} with "
        f"{format_count(workers, 'worker')} and {file_size(sum(cost.disk for cost in costs.values()))}; "
        f"the largest takes {file_size(max((cost.memory for cost in costs.values()), default=0))} of memory"
    )
