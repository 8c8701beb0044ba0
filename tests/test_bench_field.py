"""The field benchmark runs and puts an error beside every speed."""

from __future__ import annotations

import pytest

from progdf import bench_field


def test_the_field_tables_name_error_bytes_and_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_field, "BEAR", 2_000)
    monkeypatch.setattr(bench_field, "SIDE", 48)
    monkeypatch.setattr(bench_field, "SNAPSHOTS", 5)
    monkeypatch.setattr(bench_field, "EDITS", ("tilted ears",))
    monkeypatch.setattr(bench_field, "CLOUDS", ((30, 300),))
    fields, steps = bench_field.tables()
    labels = [row[1] for row in fields.rows]
    assert {"2 keyframes, float32", "4 keyframes, int8"} < set(labels)
    assert labels[-1].startswith("auto at 40 dB")
    assert all(float(row[2]) > 0 and float(row[4]) > 0 for row in fields.rows)
    assert steps.rows[0][-1] == "0"
