"""Runs in turn: real children on a tiny scene, and what becomes of those that fail or are stopped."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from progdf.formats.ply import save_ply
from progdf.gdf.file import load_gdf
from tests.helpers.count import Count
from tests.helpers.demo_scenes import bear
from viewer.jobs import run_files
from viewer.jobs.training_job import EditOrder, TrainingJob
from viewer.jobs.training_queue import LOOK_S, TrainingQueue

PATIENCE_S = 600.0
EARS = "sphere:0,1.9,0,0.6"
"""A small region, which trains in half of the time."""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    save_ply(tmp_path / "bear.ply", bear(400).gaussians)
    return tmp_path / "bear.ply"


def order(scene: Path, name: str, region: str = "all") -> EditOrder:
    out = run_files.free_run(run_files.edits_folder(scene), name)
    return EditOrder(scene, out, name, region, "tint:#3060d0", quick=True, threads=1)


def wait(queue: TrainingQueue, until: str = "") -> list[TrainingJob]:
    """What has ended once nothing is busy, or one job says that it does `until`."""
    ended, begun = [], time.monotonic()
    while queue.busy and time.monotonic() - begun < PATIENCE_S:
        ended += queue.poll()
        if until and any(job.progress.doing == until for job in queue.jobs):
            break
        time.sleep(0.05)
    return ended


def test_runs_train_in_turn_and_a_failure_is_one_line(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    queue = TrainingQueue()
    queue.add(order(scene, "nowhere", "sphere:99,99,99,1"))
    number = queue.add(order(scene, "blue", EARS))
    queue.poll()
    assert [job.status for job in queue.jobs] == ["running", "queued"]
    shown, begun = Count(monkeypatch, TrainingQueue, "_change"), time.monotonic()
    failed, done = wait(queue)
    # the training would have half of the processor otherwise: each change is drawn
    assert shown.calls <= (time.monotonic() - begun) / LOOK_S + 4, "its card changes once a second"
    assert failed.status == "failed"
    assert failed.error.startswith("region 'sphere:99,99,99,1' holds no Gaussian")
    assert done.number == number
    assert done.status == "done"
    assert load_gdf(done.order.gdf).name == "blue"
    queue.discard(failed.number)
    assert not failed.order.out.with_name("nowhere.train.json").exists()
    queue.close()


@pytest.mark.slow
def test_a_run_that_is_stopped_goes_on_another_day(scene: Path) -> None:
    queue = TrainingQueue()
    number = queue.add(order(scene, "blue"))
    wait(queue, until="edit")
    queue.stop(number)
    (stopped,) = wait(queue)
    queue.close()
    assert stopped.status == "stopped"
    later = TrainingQueue()
    (found,) = run_files.stopped_orders(stopped.order.out.parent, scene)
    later.add_stopped(found)
    later.add_stopped(found)
    assert [job.status for job in later.jobs] == ["stopped"]
    later.resume(later.jobs[0].number)
    (done,) = wait(later)
    assert done.status == "done", done.error
    assert "continue" not in done.error
    later.close()


def test_closing_leaves_no_child_and_forgets_what_waits(scene: Path) -> None:
    queue = TrainingQueue()
    queue.add(order(scene, "blue"))
    waiting = order(scene, "red")
    queue.add(waiting)
    queue.poll()
    queue.close()
    assert not waiting.out.with_name("red.train.json").exists()
    found = run_files.stopped_orders(waiting.out.parent, scene)
    assert all(order.out != waiting.out for order in found), "it had not begun"
