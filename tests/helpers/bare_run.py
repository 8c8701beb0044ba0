"""Typical commands or jobs of the program, in a process that `bare_system` has stripped."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from progdf.__main__ import main
from progdf.formats.ply import save_ply
from tests.helpers.demo_scenes import bear
from viewer.files import document, session
from viewer.files.session import WindowSession
from viewer.jobs import training
from viewer.jobs.job_queue import JobQueue
from viewer.jobs.training import EditOrder
from viewer.state.view_state import LayerState, ViewState

EARS = "sphere:0,1.9,0,0.6"
TRAIN = (
    "--editor=tint:#3060d0",
    "--steps=32",
    "--views=3",
    "--image-size=48",
    "--threads=1",
    "--field=separable",
)


def run(*arguments: str) -> None:
    status = main(list(arguments))
    assert status == 0, (arguments, status)


def commands() -> None:
    run("info", "bear.ply")
    run("info", "bear.ply")
    run("render", "bear.ply", "--size=64x48", "--engine=cpu", "--out=a.png")
    run("train", "bear.ply", "--out=run", f"--region={EARS}", *TRAIN)
    run("info", "run/run.gdf")
    for _ in range(2):  # the second replaces the files of the first
        run("export", "bear.ply", "run/run.gdf", "--out=edited.ply")
        opened = document.load(Path("bear.ply"), [Path("run/run.gdf")])
        view = ViewState(layers=(LayerState(0, "run", 0.25),))
        session.save(Path("work.session.json"), WindowSession(opened, view))
    assert session.open_session(Path("work.session.json")).view.layers[0].strength == 0.25
    run("render", "work.session.json", "--size=64x48", "--engine=cpu", "--out=b.png")


def jobs() -> None:
    def order(name: str) -> EditOrder:
        out = training.free_run(training.edits_folder(Path("bear.ply")), name)
        return EditOrder(Path("bear.ply"), out, name, EARS, "tint:#3060d0", quick=True, threads=1)

    def wait_for_end() -> str:
        """Wait until a job ends. Return its status and its error."""
        while True:
            for ended in queue.poll():
                return ended.status + ended.error
            time.sleep(0.05)

    def wait_for_pictures() -> None:
        """Wait until the running job has edited a picture. The queue itself reads progress once a second."""
        while (job := queue.busy(EditOrder)) and job.task.read_progress(job.progress).share == 0.0:
            assert not queue.poll()
            time.sleep(0.01)

    queue = JobQueue()
    number = queue.add(order("blue"))
    wait_for_pictures()
    queue.stop(number)
    assert (status := wait_for_end()) == "stopped", status
    queue.resume(number)
    assert (status := wait_for_end()) == "done", status
    queue.add(order("red"))
    wait_for_pictures()
    (child,) = queue._children.values()
    child.kill()
    assert wait_for_end().startswith("failed")
    queue.close()


if __name__ == "__main__":
    save_ply("bear.ply", bear(400).gaussians)
    {"commands": commands, "jobs": jobs}[sys.argv[1]]()
