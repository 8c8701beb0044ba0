"""How far a run is, as the panel shows it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from viewer.jobs.training_job import EditOrder, Progress, TrainingJob, duration

JOB = TrainingJob(1, EditOrder(Path("a.ply"), Path("out"), "a", "all", "night"), "running")


def test_time_left_is_told_once_something_is_done() -> None:
    assert JOB.seconds_left is None
    half = replace(JOB, progress=Progress(0.5), seconds=20.0)
    assert half.seconds_left == 20.0
    resumed = replace(half, began_at=0.4)
    assert abs((resumed.seconds_left or 0.0) - 100.0) < 1e-6
    assert replace(half, status="stopped").seconds_left is None


def test_durations_are_read_at_a_glance() -> None:
    assert [duration(s) for s in (0.2, 75.0, 200.0, 5400.0)] == ["1 s", "75 s", "3 min", "1 h 30 min"]
