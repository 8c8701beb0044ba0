"""How far a run is, as programs read it that wait for the run."""

from __future__ import annotations

import ast
import json
from pathlib import Path

from trainer.store.progress import STAGES, RunLog

TRAINER = Path(__file__).parents[3] / "trainer"


def test_every_long_stage_of_the_trainer_has_its_label_and_share() -> None:
    stages = {
        node.args[0].value
        for path in TRAINER.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
        if node.func.attr in ("steps", "looks") and node.args and isinstance(node.args[0], ast.Constant)
    }
    assert stages == set(STAGES)
    assert all(label and 0.0 < begin < end < 1.0 for label, begin, end in STAGES.values())


def test_the_progress_file_says_how_far_the_whole_run_is(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "log.txt", quiet=True, progress=tmp_path / "progress.json")
    found = []
    for stage, done, word in (
        ("edit", 3, ""),
        ("optimize", 10, "loss to the edit 0.0123"),
        ("field", 10, "loss 1"),
        ("even the slider", 5, "strengths"),
    ):
        with log.steps(stage, 10) as advance:
            log._written = 0.0  # each is written
            advance(done, word)
        found.append(json.loads((tmp_path / "progress.json").read_text("utf-8")))
    log.close()
    assert [(line["label"], round(line["share"], 2), line["loss"]) for line in found] == [
        ("Editing views", 0.17, ""),
        ("Training", 0.64, "0.0123"),
        ("Packing", 0.82, ""),
        ("Evening the slider", 0.82, ""),
    ], "it never goes back"
