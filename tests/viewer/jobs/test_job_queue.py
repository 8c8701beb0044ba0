"""Job queue: real children on a tiny scene, including failed and stopped runs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from progdf.gdf.file import read_gdf
from progdf.io.atomic import LOCK, LockedError, hold_lock
from progdf.terminal import format_duration
from tests.helpers.count import Count
from tests.helpers.demo_scenes import bear
from viewer.jobs import job_queue, training
from viewer.jobs.child import Progress
from viewer.jobs.job_queue import PROGRESS_INTERVAL_S, Delivery, JobQueue, QueuedTask
from viewer.jobs.training import EditOrder

PATIENCE_S = 600.0


@pytest.fixture(autouse=True)
def children_as_urgent_as_the_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run children at normal priority. On a busy machine low priority takes ten times as long."""
    monkeypatch.setattr("progdf.system.processes.NICENESS", 0)


class Waiting:
    """Stub of a child process that saves state at once and trains until `stop`."""

    def __init__(self, arguments: Sequence[str], log: Path) -> None:
        self.status: int | None = None
        out = Path(next(word for word in arguments if word.startswith("--out=")).removeprefix("--out="))
        if arguments[0] == "train":
            begin(out)

    def stop(self, grace_s: float = 0.0) -> None:
        self.status = 130

    def close(self) -> None:
        self.status = 130


def begin(out: Path) -> None:
    """Write the files that a stopped run leaves."""
    (out / "state").mkdir(parents=True, exist_ok=True)
    (out / "state" / "run.json").touch()


def deliver(edit_order: EditOrder) -> None:
    """Write the files of an edit whose report is not complete."""
    edit_order.result.touch()
    (edit_order.out / "report.json").touch()


@pytest.fixture
def stopped(scene: Path, monkeypatch: pytest.MonkeyPatch) -> EditOrder:
    """Return the order of a stopped run. Children are stubs and every poll checks all jobs."""
    monkeypatch.setattr(job_queue, "Child", Waiting)
    monkeypatch.setattr(job_queue, "PROGRESS_INTERVAL_S", 0.0)
    edit_order = order(scene, "blue")
    edit_order.save()
    begin(edit_order.out)
    return edit_order


def window(stopped: EditOrder) -> JobQueue:
    """Return the queue of a window that has opened the scene."""
    queue = JobQueue()
    queue.add_stopped(stopped)
    return queue


def status(queue: JobQueue) -> str:
    (job,) = queue.jobs
    return job.status


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    save_ply(tmp_path / "bear.ply", bear(400).gaussians)
    return tmp_path / "bear.ply"


def order(scene: Path, name: str, region: str = "all") -> EditOrder:
    out = training.free_run(training.edits_folder(scene), name)
    return EditOrder(scene, out, name, region, "tint:#3060d0", quick=True, threads=1)


def wait(queue: JobQueue) -> list[QueuedTask]:
    """Poll until nothing is busy; return the finished tasks."""
    ended = []
    begun = time.monotonic()
    while queue.busy() and time.monotonic() - begun < PATIENCE_S:
        ended += queue.poll()
        time.sleep(0.05)
    return ended


def wait_for_progress(queue: JobQueue) -> None:
    """Poll until the file of the running job shows progress. The queue itself reads it once a second."""
    begun = time.monotonic()
    while (job := queue.busy()) and not job.task.read_progress(job.progress).share:
        assert not queue.poll()
        assert time.monotonic() - begun < PATIENCE_S
        time.sleep(0.01)


@pytest.mark.slow
def test_runs_train_in_order_and_a_failure_is_one_line(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = EditOrder.arguments
    smaller = ["--views=3", "--image-size=48", "--steps=8", "--stages=1"]  # smaller than in the window
    monkeypatch.setattr(EditOrder, "arguments", lambda *asked: arguments(*asked) + smaller)
    queue = JobQueue()
    queue.add(order(scene, "nowhere", "sphere:99,99,99,1"))
    number = queue.add(order(scene, "blue", "sphere:0,1.9,0,0.6"))
    queue.poll()
    assert [job.status for job in queue.jobs] == ["running", "queued"]
    shown = Count(monkeypatch, JobQueue, "_change")
    begun = time.monotonic()
    failed, done = wait(queue)
    # redrawing every change would cost half of the processor
    assert shown.calls <= (time.monotonic() - begun) / PROGRESS_INTERVAL_S + 4, (
        "its card changes once a second"
    )
    assert failed.status == "failed"
    assert failed.error.startswith("region 'sphere:99,99,99,1' holds no Gaussian")
    assert done.number == number
    assert done.status == "done"
    assert read_gdf(done.task.result).name == "blue"
    queue.discard(failed.number)
    assert not failed.task.out.with_name("nowhere.train.json").exists()
    queue.close()


@pytest.mark.slow
def test_stopped_run_resumes_in_a_new_queue(scene: Path) -> None:
    queue = JobQueue()
    number = queue.add(order(scene, "blue"))
    wait_for_progress(queue)
    queue.stop(number)
    (stopped,) = wait(queue)
    queue.close()
    assert stopped.status == "stopped"
    later = JobQueue()
    (found,) = training.stopped_orders(stopped.task.out.parent, scene)
    later.add_stopped(found)
    later.add_stopped(found)
    assert [job.status for job in later.jobs] == ["stopped"]
    later.resume(later.jobs[0].number)
    (done,) = wait(later)
    assert done.status == "done", done.error
    assert "continue" not in done.error
    later.close()


def test_close_leaves_no_child_and_drops_queued_runs(scene: Path) -> None:
    queue = JobQueue()
    queue.add(order(scene, "blue"))
    waiting = order(scene, "red")
    queue.add(waiting)
    queue.poll()
    queue.close()
    assert not waiting.out.with_name("red.train.json").exists()
    found = training.stopped_orders(waiting.out.parent, scene)
    assert all(order.out != waiting.out for order in found), "it had not begun"


def test_next_run_starts_at_the_delivery_of_the_one_before(
    scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job_queue, "Child", Waiting)
    queue = JobQueue()
    orders = [order(scene, name) for name in ("blue", "red", "green")]
    for edit_order in orders:
        queue.add(edit_order)
    queue.poll()
    assert [job.status for job in queue.jobs] == ["running", "queued", "queued"]
    deliver(orders[0])
    queue.poll()
    assert [job.status for job in queue.jobs] == ["running", "running", "queued"]
    deliver(orders[1])
    queue.poll()
    assert [job.status for job in queue.jobs] == ["running", "running", "queued"], "two reports are written"
    queue.stop(1)
    queue.poll()
    assert [job.status for job in queue.jobs] == ["stopped", "running", "running"]
    queue.close()


def test_run_of_another_window_cannot_be_resumed_or_discarded(stopped: EditOrder) -> None:
    first = window(stopped)
    second = window(stopped)
    first.resume(1)
    assert status(first) == "queued", "it waits, and is the first window's already"
    assert window(stopped).jobs == (), "a window that opens now does not show it"
    for act in (second.resume, second.discard):
        with pytest.raises(LockedError, match="blue trains in another window; stop it there first"):
            act(1)
    second.stop(1)
    second.poll()
    assert (status(second), second.busy()) == ("stopped", None)
    assert stopped.is_begun
    first.poll()
    assert status(first) == "running"
    first.stop(1)
    first.poll()
    assert status(first) == "stopped"
    second.discard(1)
    assert [*stopped.out.parent.iterdir()] == []
    with pytest.raises(ProgdfError, match="blue no longer exists"):
        first.resume(1)
    assert first.jobs == ()


def test_run_locked_by_a_command_cannot_be_discarded(stopped: EditOrder) -> None:
    queue = window(stopped)
    with hold_lock(stopped.out / LOCK):
        assert window(stopped).jobs == ()
        with pytest.raises(LockedError, match="blue trains in another window; stop it there first"):
            queue.discard(1)
    queue.poll()
    assert status(queue) == "stopped"


def test_two_windows_cannot_queue_the_same_run(stopped: EditOrder, scene: Path) -> None:
    first = JobQueue()
    second = JobQueue()
    edit_order = order(scene, "red")
    first.add(edit_order)
    with pytest.raises(LockedError):
        second.add(edit_order)
    assert second.jobs == ()
    first.close()


def test_resumed_run_is_kept_when_removed_from_the_queue(stopped: EditOrder) -> None:
    queue = window(stopped)
    queue.resume(1)
    queue.stop(1)
    assert status(queue) == "stopped"
    assert stopped.is_begun
    queue.resume(1)
    queue.close()
    assert stopped.is_begun
    assert not stopped.is_locked, "closing lets go of it"


def test_run_that_cannot_start_fails_with_one_line(
    stopped: EditOrder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(arguments: Sequence[str], log: Path) -> None:
        raise ValueError("embedded null byte")

    monkeypatch.setattr(job_queue, "Child", refuse)
    queue = window(stopped)
    queue.resume(1)
    (failed,) = queue.poll()
    assert (failed.status, failed.error) == ("failed", "the command cannot start: embedded null byte")
    assert not stopped.is_locked


def test_stopped_delivery_beside_a_training_leaves_no_files(stopped: EditOrder, tmp_path: Path) -> None:
    queue = window(stopped)
    queue.resume(1)
    out = tmp_path / "film.mp4"
    log = tmp_path / "film.log"
    queue.add(Delivery("Film film.mp4", out, ("render", f"--out={out}"), log, stopped.scene))
    queue.poll()
    assert [job.status for job in queue.jobs] == ["running", "running"]
    log.write_text("frame 3/12\n")
    queue.poll()
    assert queue.jobs[1].progress == Progress(2 / 12, "frame 3/12")
    queue.stop(2)
    assert [(job.number, job.status) for job in queue.poll()] == [(2, "stopped")]
    assert [job.number for job in queue.jobs] == [1]
    queue.close()
    assert not queue.folder.exists()


def test_time_left_is_estimated_from_progress() -> None:
    order = EditOrder(Path("a.ply"), Path("out"), "a", "all", "night")
    half = replace(QueuedTask(1, order, "running"), progress=Progress(0.5), seconds=20.0)
    assert half.seconds_left == 20.0
    resumed = replace(half, began_at=0.4)
    assert abs((resumed.seconds_left or 0.0) - 100.0) < 1e-6
    assert replace(half, status="stopped").seconds_left is None


def test_durations_have_rounded_units() -> None:
    assert [format_duration(s) for s in (0.2, 75.0, 200.0, 5400.0)] == ["1 s", "75 s", "3 min", "1 h 30 min"]
