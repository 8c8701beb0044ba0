"""Delivery of an edit before its report, and reports of every extent."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from progdf.formats.ply import load_ply
from progdf.gdf.file import load_gdf
from tests.helpers.paths import ROOT
from tests.helpers.stopped import OUT, bits, small_run
from tests.helpers.trained import train
from trainer.options import FitOptions
from trainer.run import finish
from trainer.run.finish import refit
from trainer.run.run import train as train_run

pytest_plugins = ["tests.helpers.stopped_runs"]
pytestmark = pytest.mark.usefixtures("elsewhere")

KILLED = """
import os, signal, sys
from pathlib import Path
from tests.helpers.stopped import small_run
from tests.helpers.trained import train
from trainer.run import finish

finish.measure = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
train(small_run(Path(sys.argv[1])))
"""
"""Script that trains and is killed when the report begins to measure."""


def report() -> dict[str, Any]:
    """Return the content of the run's report.json."""
    read: dict[str, Any] = json.loads((OUT / "report.json").read_text(encoding="utf-8"))
    return read


def without_costs(figures: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a report that do not depend on the machine's load."""
    return {name: value for name, value in figures.items() if name not in ("time", "memory_mb")}


def stop_at_report(patch: pytest.MonkeyPatch, number: signal.Signals) -> None:
    """Send a signal to this process when the report begins to measure."""
    patch.setattr(finish, "measure", lambda *_: os.kill(os.getpid(), number))


@pytest.mark.usefixtures("default_signals")
def test_interrupted_report_leaves_the_finished_edit(
    bear_folder: Path, uninterrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        stop_at_report(patch, signal.SIGINT)
        with pytest.raises(KeyboardInterrupt, match=r"complete, its report is not; .* --resume"):
            train(small_run(bear_folder))
    expected = (uninterrupted / "run.gdf").read_bytes()
    assert (OUT / "run.gdf").read_bytes() == expected
    assert not (OUT / "draft.gdf").exists()
    short = report()
    assert short["report"] == "none"
    assert short["edit"]["psnr_to_views"] == load_gdf(OUT / "run.gdf").report["edit"]["psnr_to_views"]
    assert short["file"]["bytes"] == len(expected)
    with monkeypatch.context() as patch:
        for name in ("fit_field", "fit_grades", "fit_network", "equalize_slider"):
            patch.setattr(finish, name, lambda *_, **__: pytest.fail("fitted again"))
        train(replace(small_run(bear_folder), resume=True))
    assert bits(OUT) == bits(uninterrupted)
    assert not (OUT / "state").exists()
    whole = json.loads((uninterrupted / "report.json").read_text(encoding="utf-8"))
    assert without_costs(report()) == without_costs(whole)


@pytest.mark.slow  # the fast test interrupts a report
def test_killed_report_is_completed_by_resume(bear_folder: Path, uninterrupted: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", KILLED, str(bear_folder)]
    assert subprocess.run(command, env=environment, check=False).returncode == -signal.SIGKILL
    assert (OUT / "run.gdf").read_bytes() == (uninterrupted / "run.gdf").read_bytes()
    train(replace(small_run(bear_folder), resume=True))
    assert bits(OUT) == bits(uninterrupted)


@pytest.mark.usefixtures("default_signals")
def test_delivered_edit_may_be_trained_again_without_resume(
    bear_folder: Path, uninterrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        stop_at_report(patch, signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            train(small_run(bear_folder))
    train(small_run(bear_folder))
    assert bits(OUT) == bits(uninterrupted)


def test_callback_comes_with_the_file_and_before_the_report(bear_folder: Path) -> None:
    seen = []

    def look() -> None:
        seen.append(((OUT / "run.gdf").is_file(), report()["report"], (OUT / "report.png").exists()))

    train_run(small_run(bear_folder), quiet=True, on_delivery=look)
    assert seen == [(True, "none", False)]
    assert (report()["report"], (OUT / "report.png").exists()) == ("full", True)


def test_every_extent_of_report_has_the_same_edit(bear_folder: Path, uninterrupted: Path) -> None:
    expected = (uninterrupted / "run.gdf").read_bytes()
    figures = {}
    for level in ("none", "short", "full"):
        resume = level != "none"  # a longer report completes a finished run
        train(replace(small_run(bear_folder), report=level, resume=resume))
        assert (OUT / "run.gdf").read_bytes() == expected
        assert (OUT / "report.png").exists() == (level == "full")
        figures[level] = report()
    assert [one["report"] for one in figures.values()] == ["none", "short", "full"]
    assert "slider" not in figures["none"]
    assert "ssim_to_views" not in figures["short"]["edit"]
    assert figures["short"]["slider"] == figures["full"]["slider"]
    assert figures["short"]["between"] == figures["full"]["between"]
    assert figures["full"]["edit"].keys() > figures["short"]["edit"].keys() - {"clip_reason"}
    assert "--resume" not in (OUT / "log.txt").read_text(encoding="utf-8")
    before = (OUT / "report.json").read_bytes()
    train(replace(small_run(bear_folder), report="short", resume=True))
    assert (OUT / "report.json").read_bytes() == before, "a shorter report replaces none"


def test_refit_writes_the_requested_report(bear_folder: Path, uninterrupted: Path) -> None:
    train(replace(small_run(bear_folder), report="none"))
    refit(FitOptions(OUT, field=small_run(bear_folder).field, report="short", threads=1), quiet=True)
    assert report()["report"] == "short"
    scene = load_ply(bear_folder / "scene.ply")
    found = load_gdf(OUT / "run.gdf", scene).field.offsets(1.0)
    assert torch.equal(found, load_gdf(uninterrupted / "run.gdf", scene).field.offsets(1.0))
