"""`progdf batch`: output files, refused catalogues, and recovery from lost workers and machines."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from progdf.__main__ import main
from progdf.errors import ProgdfError
from progdf.io.cameras import save_cameras
from tests.helpers.scenes import orbit_camera
from tests.helpers.trained import quick_options, train, write_bear
from trainer import cli
from trainer.batch.jobs import BatchJob, read_catalogue
from trainer.batch.report import JobRow, read_rows
from trainer.batch.run import LocalPool, RayPool, Task, run, run_jobs, train_task

CLUSTER_ATTEMPTS = 3

BEARS = """
[defaults]
views = 4
image-size = 48
steps = {steps}
stages = 2
[[scenes]]
path = "scene.ply"
name = "bear"
[[scenes.edits]]
name = "scarf"
region = "labels:labels.npy:{scarf}"
editor = "recolor:#3060d0"
[[scenes.edits]]
name = "body"
region = "labels:labels.npy:{body}"
editor = "darken:.5"
"""


@pytest.fixture(scope="module")
def catalogue(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a catalogue of two edits of a small bear; return its path."""
    from progdf.demo_scenes.bear import LABELS

    folder = tmp_path_factory.mktemp("bears")
    write_bear(folder)
    text = BEARS.format(steps=24, scarf=LABELS.index("scarf"), body=LABELS.index("body"))
    (folder / "catalogue.toml").write_text(text, encoding="utf-8")
    return folder / "catalogue.toml"


@pytest.fixture(scope="module")
def singly(catalogue: Path) -> dict[str, bytes]:
    """Return the .gdf bytes of each job trained alone, by job key."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(catalogue.parent)
        jobs, _ = read_catalogue(catalogue, catalogue.parent / "alone")
        return {job.key: train(job.options).gdf.read_bytes() for job in jobs}


def gdf_bytes(folder: Path) -> dict[str, bytes]:
    return {f"{path.parts[-3]}/{path.parts[-2]}": path.read_bytes() for path in folder.glob("*/*/*.gdf")}


def children(of: int) -> list[int]:
    """Return the ids of all descendants of a process."""
    listed = subprocess.run(["ps", "-eo", "pid=,ppid="], capture_output=True, text=True, check=True).stdout
    parents = {int(pid): int(parent) for pid, parent in (line.split() for line in listed.splitlines())}
    below = [pid for pid, parent in parents.items() if parent == of]
    return below + [deeper for pid in below for deeper in children(pid)]


def kill_workers() -> None:
    for pid in children(os.getpid()):
        with contextlib.suppress(OSError):
            if b"serve()" in Path(f"/proc/{pid}/cmdline").read_bytes():
                os.kill(pid, signal.SIGKILL)


def ends(tasks: list[Task], pool: LocalPool | RayPool, **more: object) -> dict[str, JobRow]:
    return {row.job: row for row in run_jobs(tasks, pool, **more)}  # type: ignore[arg-type]


@pytest.mark.slow
def test_batch_writes_runs_table_and_page_and_reports_broken_scenes(
    catalogue: Path, singly: dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = catalogue.read_text(encoding="utf-8")
    text += '\n[[scenes]]\npath="broken.ply"\n[[scenes.edits]]\nname="a"\nregion="all"\neditor="night"'
    (catalogue.parent / "broken.ply").write_bytes(b"ply\nnothing")
    (catalogue.parent / "one_broken.toml").write_text(text, encoding="utf-8")
    out = tmp_path / "runs"
    command = [str(catalogue.parent / "one_broken.toml"), "--out", str(out), "--workers", "1"]
    assert cli.batch([*command, "--keep-going", "--json"]) == 3
    assert gdf_bytes(out) == singly
    rows = list(read_rows(out).values())
    assert [row.status for row in rows] == ["done", "done", "failed"]
    assert all(row.psnr_end and row.bytes and row.memory_mb and row.cpu_seconds for row in rows[:2])
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert events[-1] | {"seconds": 0} == {"event": "total", "done": 2, "failed": 1, "jobs": 3, "seconds": 0}
    page = (out / "batch.html").read_text(encoding="utf-8")
    assert page.count("data:image/jpeg") == 2
    assert page.count("<polyline") == 2
    assert "http" not in page.replace("http-equiv", "")

    with pytest.raises(ProgdfError, match="holds a batch; add --resume"):
        cli.batch([str(catalogue), *command[1:]])
    before = {path: path.stat().st_mtime_ns for path in out.glob("*/*/*.gdf")}
    assert cli.batch([str(catalogue), *command[1:], "--resume"]) == 0
    assert {path: path.stat().st_mtime_ns for path in out.glob("*/*/*.gdf")} == before
    assert cli.batch([*command, "--dry-run", "--only", "body"]) == 0
    assert "bear/body: finished" in capsys.readouterr().out


@pytest.mark.slow
def test_all_faults_are_reported_before_any_job_starts(
    catalogue: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = catalogue.read_text(encoding="utf-8").replace("recolor:#3060d0", "recolour:#3060d0")
    text = text.replace("darken:.5", "pictures:absent.png")
    text += '\n[[scenes.edits]]\nname="empty"\nregion="sphere:900,0,0,1"\neditor="night"'
    text += '\n[[scenes.edits]]\nname="far"\nregion="all"\neditor="night"\ncameras="far.json"'
    text += '\n[[scenes]]\npath="broken.ply"\n[[scenes.edits]]\nname="a"\nregion="all"\neditor="night"'
    save_cameras(catalogue.parent / "far.json", [orbit_camera()], (500.0, 0.0, 0.0))
    (catalogue.parent / "broken.ply").write_bytes(b"ply\nnothing")
    (catalogue.parent / "faulty.toml").write_text(text, encoding="utf-8")
    out = tmp_path / "runs"
    assert cli.batch([str(catalogue.parent / "faulty.toml"), "--out", str(out), "--workers", "1"]) == 2
    lines = capsys.readouterr().err.splitlines()
    faults = [line for line in lines if line.startswith("progdf: ")]
    assert len(faults) == 5
    expected = (
        "unknown editor 'recolour'",
        "absent.png",
        "holds no Gaussian",
        "far.json is not",
        "broken.ply",
    )
    for words in expected:
        assert any(words in line for line in faults), faults
    assert not out.exists()


@pytest.mark.slow  # the fast tests cover retries with a job that always dies
def test_job_of_a_killed_worker_continues_in_another(
    catalogue: Path, singly: dict[str, bytes], tmp_path: Path
) -> None:
    jobs, _ = read_catalogue(catalogue, tmp_path / "runs")
    retried: list[str] = []
    pool = LocalPool()

    def kill(running: list[Task]) -> None:
        if not retried and any((a.argument.options.out / "state" / "run.json").is_file() for a in running):
            kill_workers()

    try:
        outcomes = ends(
            [train_task(job) for job in jobs],
            pool,
            tell=lambda event, attempt, reason: retried.append(reason) if event == "retry" else None,
            tick=kill,
        )
    finally:
        pool.stop()
    assert "SIGKILL" in retried[0]
    assert {outcome.status for outcome in outcomes.values()} == {"done"}
    assert gdf_bytes(tmp_path / "runs") == singly


def test_job_that_always_dies_fails_after_four_attempts(tmp_path: Path) -> None:
    write_bear(tmp_path)
    pool = LocalPool()
    try:
        task = train_task(BatchJob("one", quick_options(tmp_path)))
        (outcome,) = run_jobs([task], pool, tick=lambda running: kill_workers())
    finally:
        pool.stop()
    assert (outcome.status, outcome.attempts) == ("failed", 4)
    assert "SIGKILL" in outcome.reason


@pytest.mark.slow  # 30 seconds; the fast tests cover Ctrl+C of a single run
@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_ctrl_c_stops_all_workers_and_resume_yields_the_same_bytes(
    catalogue: Path, singly: dict[str, bytes], tmp_path: Path
) -> None:
    out = tmp_path / "runs"
    command = [sys.executable, "-P", "-m", "progdf", "batch", str(catalogue), "--out", str(out)]
    process = subprocess.Popen(
        [*command, "--workers", "1"],
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        deadline = time.monotonic() + 60
        while not (out / "bear" / "scarf" / "state" / "run.json").is_file() and time.monotonic() < deadline:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        error = process.communicate(timeout=30)[1]
    finally:
        process.kill()
    assert process.returncode == 130
    assert "with --resume added to continue" in error
    assert [row.status for row in read_rows(out).values()] != ["done", "done"]
    assert not children(process.pid)
    assert cli.batch([str(catalogue), "--out", str(out), "--workers", "1", "--resume"]) == 0
    assert gdf_bytes(out) == singly


def test_rows_round_trip_and_the_page_escapes_html(tmp_path: Path) -> None:
    from trainer.batch.report import write_page, write_rows

    rows = [
        JobRow('a,"b"/c', "failed", "it; <script>alert(1)</script>", attempts=4),
        JobRow("d/e", "done", psnr_end=30.25),
    ]
    write_rows(tmp_path, rows)
    assert list(read_rows(tmp_path).values()) == rows
    write_page(tmp_path, rows, [])
    assert "<script>alert" not in (tmp_path / "batch.html").read_text(encoding="utf-8")


def test_unreachable_cluster_is_named(
    catalogue: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("ray")
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # nothing listens on this port
        address = f"127.0.0.1:{closed.getsockname()[1]}"
        for host in (address, "no-such-host.invalid:6379", "127.0.0.1:99999"):
            assert main(["batch", str(catalogue), "--out", str(tmp_path / "runs"), "--address", host]) == 2
            error = capsys.readouterr().err
            assert error.startswith(f"progdf: no Ray cluster answers at {host} (")
            assert error.count("\n") == 1


@pytest.mark.slow  # imports Ray
def test_failed_ray_start_is_a_one_line_error(monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray")

    def time_out(**_: object) -> None:
        raise Exception("The current node timed out during startup.\nMore lines.")

    monkeypatch.setattr(ray, "init", time_out)
    with pytest.raises(
        ProgdfError, match=r"^Ray cannot be used \(The current node timed out during startup\.\)$"
    ):
        RayPool("", 1)


@pytest.fixture
def cluster() -> Iterator[object]:
    """Start a simulated cluster of one machine with one core; shut it down after the test."""
    pytest.importorskip("ray")
    made = start_cluster()
    yield made
    made.shutdown()


def start_cluster() -> Any:
    """Start the head of a cluster, in up to `CLUSTER_ATTEMPTS` attempts.

    Ray gives up after 30 seconds, which is too short on a busy machine.
    """
    from ray.cluster_utils import Cluster

    arguments = {"num_cpus": 1, "object_store_memory": 80 * 2**20}
    for _ in range(CLUSTER_ATTEMPTS - 1):
        with contextlib.suppress(Exception):  # Ray raises no other type
            return Cluster(initialize_head=True, head_node_args=arguments)
    return Cluster(initialize_head=True, head_node_args=arguments)


def add_machine(cluster: Any) -> Any:
    """Add a machine to a cluster, with the attempts of `start_cluster`."""
    for _ in range(CLUSTER_ATTEMPTS - 1):
        with contextlib.suppress(Exception):
            return cluster.add_node(num_cpus=1, object_store_memory=80 * 2**20)
    return cluster.add_node(num_cpus=1, object_store_memory=80 * 2**20)


@pytest.mark.slow
def test_workers_train_jobs_in_parallel(tmp_path: Path) -> None:
    write_bear(tmp_path)
    sizes: dict[str, object] = {"views": 4, "image_size": 48, "steps": 24, "stages": 2}
    jobs = [BatchJob(part, quick_options(tmp_path, part, part, **sizes)) for part in ("scarf", "ears")]
    before = signal.getsignal(signal.SIGTERM)
    assert {(row.job, row.status) for row in run(jobs, workers=2)} == {
        ("scarf", "done"),
        ("ears", "done"),
    }
    assert signal.getsignal(signal.SIGTERM) == before, "Ray would replace it"


@pytest.mark.slow
def test_twelve_jobs_survive_killed_worker_lost_machine_and_ctrl_c(
    catalogue: Path, tmp_path: Path, cluster: object
) -> None:
    second = add_machine(cluster)
    text = catalogue.read_text(encoding="utf-8") + "\n[sweep]\nsteps = [200, 400]\nseed = [0, 1, 2]\n"
    (catalogue.parent / "twelve.toml").write_text(text, encoding="utf-8")
    out = tmp_path / "runs"
    command = [sys.executable, "-P", "-m", "progdf", "batch", str(catalogue.parent / "twelve.toml")]
    command += ["--out", str(out), "--address", cluster.address, "--json"]  # type: ignore[attr-defined]
    events: list[dict[str, object]] = []

    def follow(more: list[str], stop: bool) -> int:
        nonlocal second
        with subprocess.Popen(
            [*command, *more],
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        ) as process:
            assert process.stdout is not None
            for line in process.stdout:
                events.append(json.loads(line))
                ended = sum(event["event"] == "end" for event in events)
                if events[-1]["event"] == "end" and ended == 2:
                    workers = [pid for pid in children(os.getpid()) if b"ray::bear" in command_of(pid)]
                    os.kill(workers[0], signal.SIGKILL)
                if events[-1]["event"] == "end" and ended == 4:
                    cluster.remove_node(second, allow_graceful=False)  # type: ignore[attr-defined]
                if stop and events[-1]["event"] == "end" and ended == 6:
                    process.send_signal(signal.SIGINT)
        return process.returncode

    assert follow([], stop=True) == 130
    assert follow(["--resume"], stop=False) == 0
    ends = [event["job"] for event in events if event["event"] == "end" and event["status"] == "done"]
    assert len(ends) == len(set(ends)) == 12  # no job ran twice
    assert any(event["event"] == "retry" for event in events)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(catalogue.parent)
        jobs = read_catalogue(catalogue.parent / "twelve.toml", tmp_path / "alone")[0]
        retried = {event["job"] for event in events if event["event"] == "retry"}
        for job in [job for job in jobs if job.key in retried] + jobs[:2]:
            assert train(job.options).gdf.read_bytes() == gdf_bytes(out)[job.key], job.key


def command_of(pid: int) -> bytes:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    return b""
