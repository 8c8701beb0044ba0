"""Tests of `python -m benchmarks spill`, which measures the change of parts that a picture does not show."""

from __future__ import annotations

import pytest

from benchmarks import spill


def test_ended_edit_changes_less_behind_than_a_carried_one(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {"BEAR_GAUSSIANS": 1500, "ROOM_PARTS": (), "SIZE": 96, "COMPARED_SIZE": 64, "STEPS": 10}
    for name, value in sizes.items():
        monkeypatch.setattr(spill, name, value)
    monkeypatch.setattr(spill, "BEHIND_DEG", (180.0,))
    monkeypatch.setattr(spill, "STROKES", {"half": spill.half})
    (table,) = spill.tables()
    assert [row[:2] for row in table.rows] == [
        (f"{part}, half", edit) for part in ("bear", "scarf") for edit in ("carried on", "ended")
    ]
    carried, ended = (float(row[3]) for row in table.rows[:2])
    assert ended < 0.5 * carried
