"""Table of a batch: rows left by an interrupted session, and damaged reports."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from progdf.errors import ProgdfError
from tests.helpers.hostile import JSON_TEXTS
from tests.helpers.trained import write_bear
from trainer import cli
from trainer.batch.jobs import BatchJob, read_catalogue
from trainer.batch.report import JobRow, read_report, read_rows, write_page, write_rows
from trainer.options import EditorOptions, RegionOptions, TrainOptions

CATALOGUE = """
[defaults]
views = 3
image-size = 32
steps = 24
stages = 2
[[scenes]]
path = "scene.ply"
name = "bear"
[[scenes.edits]]
name = "all"
region = "all"
editor = "recolor:#3060d0"
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Train a batch of one job; return the command line that resumes it."""
    folder = tmp_path_factory.mktemp("bear")
    write_bear(folder, 400)
    (folder / "jobs.toml").write_text(CATALOGUE, encoding="utf-8")
    command = [str(folder / "jobs.toml"), "--out", str(folder / "runs"), "--workers", "1"]
    assert cli.batch(command) == 0
    return [*command, "--resume"]


def out_of(command: list[str]) -> Path:
    return Path(command[2])


def events_of(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


@pytest.mark.slow
@pytest.mark.parametrize("status", ["waiting", "stopped", "failed"])
def test_row_of_a_finished_run_becomes_done_on_resume(
    finished: list[str], status: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    write_rows(out_of(finished), [JobRow("bear/all", status)])
    assert cli.batch([*finished, "--json"]) == 0
    events = events_of(capsys)
    assert [(event["event"], event.get("job")) for event in events] == [("end", "bear/all"), ("total", None)]
    assert events[-1]["done"] == 1
    (row,) = read_rows(out_of(finished)).values()
    assert (row.status, bool(row.bytes)) == ("done", True)


def test_finished_run_is_reported_once(finished: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.batch(finished) == 0
    capsys.readouterr()
    assert cli.batch([*finished, "--json"]) == 0
    assert [event["event"] for event in events_of(capsys)] == ["total"]


def with_report(command: list[str], text: str) -> Path:
    report = out_of(command) / "bear" / "all" / "report.json"
    report.write_text(text, encoding="utf-8")
    return report


DAMAGE = {
    "curves": 5,
    "curves.against_editor": [1],
    "curves.against_editor.slider": "a",
    "curves.against_editor.slider.psnr": {"a": 1},
    "curves.against_editor.slider.s": ["a"],
    "edit": None,
    "edit.psnr_to_views": "9" * 3000,
    "file": [],
    "file.bytes": -0.5,
    "time.total": {},
    "memory_mb": [[]],
}


@pytest.mark.parametrize("place", DAMAGE)
def test_damaged_report_is_a_one_line_error_on_resume(
    finished: list[str], place: str, capsys: pytest.CaptureFixture[str]
) -> None:
    report = out_of(finished) / "bear" / "all" / "report.json"
    whole = report.read_text(encoding="utf-8")
    table = json.loads(whole)
    inner = table
    *above, last = place.split(".")
    for name in above:
        inner = inner[name]
    inner[last] = DAMAGE[place]
    try:
        with_report(finished, json.dumps(table))
        assert cli.batch(finished) == 2
        (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("progdf: ")]
        assert f"{report} is damaged (" in line
        assert len(line) < 400 + 2 * len(str(report))
    finally:
        report.write_text(whole, encoding="utf-8")


@pytest.mark.parametrize("content", [*JSON_TEXTS.values(), "[]", "5", "", '{"curves": 5}'])
def test_page_is_written_despite_a_damaged_report(tmp_path: Path, content: str) -> None:
    options = TrainOptions(Path("a.ply"), tmp_path / "a" / "b", RegionOptions("all"), EditorOptions("night"))
    job = BatchJob("a/b", options)
    options.out.mkdir(parents=True)
    (options.out / "report.json").write_text(content, encoding="utf-8")
    write_page(tmp_path, [JobRow("a/b", "done")], [job])
    with pytest.raises(ProgdfError, match=r"report\.json is damaged"):
        read_report(job)


@pytest.mark.parametrize(
    "content", ['{"share": "a"}', '{"share": 7}', "[]", '{"seconds": []}', '{"label": 5}']
)
def test_damaged_progress_counts_as_zero(
    finished: list[str], tmp_path: Path, content: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from trainer.batch.report import Screen

    (job,), _ = read_catalogue(Path(finished[0]), tmp_path)
    progress = job.options.out / "state" / "progress.json"
    progress.parent.mkdir(parents=True)
    progress.write_text(content, encoding="utf-8")
    screen = Screen({job.key: job}, {job.key: 1.0}, 1, sys.stdout)
    screen._told = -1e9
    screen.tick([job.key])
    (event,) = events_of(capsys)
    assert event["running"] == {job.key: {"share": 0.0, "label": "", "loss": "", "seconds": 0.0}}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize("content", [b"", b"no task", b"ctrainer.batch.jobs\nAbsent\n."])
def test_worker_exits_on_unreadable_tasks(content: bytes) -> None:
    words = [sys.executable, "-P", "-c", "from trainer.batch.worker import serve; serve()"]
    worker = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert worker.communicate(content, timeout=300)[0] == b""
    assert worker.returncode == 0
