"""Progress of a run, as programs that wait for it read it."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest

from trainer.store.progress import LATER, STAGES, RunLog

TRAINER = Path(__file__).parents[3] / "trainer"


def test_every_long_stage_of_the_trainer_has_its_label() -> None:
    stages = {
        node.args[0].value
        for path in TRAINER.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
        if node.func.attr in ("steps", "looks") and node.args and isinstance(node.args[0], ast.Constant)
    }
    assert stages == {stage for stage, label in STAGES.items() if label}
    assert set(LATER) <= set(STAGES)


def test_progress_file_reports_the_share_of_the_whole_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr("trainer.store.progress.time.perf_counter", lambda: now)
    log = RunLog(tmp_path / "log.txt", quiet=True, progress=tmp_path / "progress.json")
    log.expect({"edit": 2.0, "optimize": 4.0, "field": 1.0, "even the slider": 3.0})
    found = []
    for stage, seconds, done, word in (
        ("edit", 10.0, 5, ""),
        ("optimize", 30.0, 10, "loss to the edit 0.0123"),
        ("field", 20.0, 10, "loss 1"),
        ("even the slider", 0.0, 0, "strengths"),
    ):
        with log.steps(stage, 10) as advance:
            # writes every update
            log._written = -1.0
            now = now + seconds
            advance(done, word)
        found.append(json.loads((tmp_path / "progress.json").read_text("utf-8")))
    log.close()
    assert [line["count"] for line in found] == ["5 of 10", "", "", ""]
    # 10 s of 100; then, at the pace without editing, 40 of 40 + 7.5 · 4 and 60 of 60 + 10 · 3
    assert [(line["label"], round(line["share"], 2), line["loss"]) for line in found] == [
        ("Editing views", 0.1, ""),
        ("Training", 0.57, "0.0123"),
        ("Packing", 0.67, ""),
        ("Equalizing the slider", 0.67, ""),
    ]


WORK = {"views": 3.0, "edit": 4.0, "optimize": 10.0, "measure the edit": 5.0}


@pytest.mark.parametrize("pace", [0.2, 50.0])
@pytest.mark.parametrize("long", ["views", "edit", "optimize", "measure the edit"])
def test_remaining_time_is_within_a_factor_of_two(
    long: str, pace: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr("trainer.store.progress.time.perf_counter", lambda: now)
    log = RunLog(tmp_path / "log.txt", quiet=True)
    log.expect(WORK)
    now = 100.0  # time before the first stage does not count
    # a machine of any speed; one stage takes 1.6 times its usual time
    takes = {stage: pace * work * (1.6 if stage == long else 1.0) for stage, work in WORK.items()}
    end = now + sum(takes.values())
    worst = 1.0
    with log.stage("views"), log.steps("views", 1):
        now += takes["views"]
    for stage in ("edit", "optimize", "measure the edit"):
        begun = now
        with log.steps(stage, 100):
            for share in (0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98):
                now = begun + share * takes[stage]
                left = log.seconds_left(stage, share, now - begun)
                worst = max(worst, left / (end - now), (end - now) / left)
            now = begun + takes[stage]
    log.close()
    assert worst < 2.0


def test_every_stage_is_named_before_its_first_step(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "log.txt", quiet=True, progress=tmp_path / "progress.json")
    with log.steps("views", 1):
        state = json.loads((tmp_path / "progress.json").read_text("utf-8"))
    log.close()
    assert (state["label"], state["count"], state["share"]) == ("Choosing the views", "", 0.0)


def test_stage_that_edits_views_names_the_awaited_picture(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "log.txt", quiet=True, progress=tmp_path / "progress.json")
    with log.steps("edit", 12):
        state = json.loads((tmp_path / "progress.json").read_text("utf-8"))
    log.close()
    assert (state["label"], state["count"]) == ("Waiting for picture", "1 of 12")


def test_wait_is_the_current_step_until_it_ends(tmp_path: Path) -> None:
    def step() -> str:
        state = json.loads((tmp_path / "progress.json").read_text("utf-8"))
        return f"{state['label']} {state['count']}".strip()

    log = RunLog(tmp_path / "log.txt", quiet=True, progress=tmp_path / "progress.json")
    with log.steps("edit", 12) as advance:
        with log.waiting("The server asks to wait 20 s"):
            assert step() == "The server asks to wait 20 s"
            with log.waiting("The server asks to wait 30 s"):  # of another call at the same time
                assert step() == "The server asks to wait 20 s"
        assert step() == "Waiting for picture 1 of 12"
        with log.waiting("The server asks to wait 5 s"):
            log._written = -1.0
            advance(1, "")  # the picture of another call arrives
        assert step() == "Editing views 1 of 12"
    log.close()
    assert (tmp_path / "log.txt").read_text("utf-8").count("asks to wait") == 2


def test_kernels_are_counted_for_the_window(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "log.txt", quiet=True, progress=tmp_path / "progress.json")
    found = []
    with log.kernels() as report:
        for done in range(3):
            report(done, 2)
            found.append(json.loads((tmp_path / "progress.json").read_text("utf-8")))
    log.close()
    assert [(state["label"], state["count"]) for state in found] == [
        ("Compiling kernels", f"{done} of 2") for done in range(3)
    ]
