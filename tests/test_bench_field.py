"""The field benchmark runs and puts an error beside every speed."""

from __future__ import annotations

import pytest

from progdf import bench_field, bench_network
from progdf.field import NeuralSettings


def test_the_field_tables_name_error_bytes_and_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_field, "BEAR", 2_000)
    monkeypatch.setattr(bench_field, "SIDE", 48)
    monkeypatch.setattr(bench_field, "SNAPSHOTS", 5)
    monkeypatch.setattr(bench_field, "EDITS", ("tilted ears",))
    monkeypatch.setattr(bench_field, "CLOUDS", ((30, 300),))
    monkeypatch.setattr(
        bench_network, "NETWORKS", (("tiny", NeuralSettings("tiny", "position", steps=3, batch=16)),)
    )
    fields, networks, steps = bench_field.tables()
    labels = [row[1] for row in fields.rows]
    assert {"2 keyframes, float32", "4 keyframes, int8"} < set(labels)
    assert labels[-1].startswith("auto at 40 dB")
    assert all(float(row[2]) > 0 and float(row[4]) > 0 for row in fields.rows)
    (network,) = networks.rows
    assert all(float(network[i]) >= 0 for i in (1, 2, 5, 6, 7))
    assert "do not: means" in networks.note
    assert steps.rows[0][-1] == "0"
