"""Tests of the rasterizer benchmark: minimum speed and maximum error of the CPU engine."""

from __future__ import annotations

import pytest

from benchmarks import rasterizer as bench_rasterize
from benchmarks.rasterizer import RasterCase, hard_tables, measure, tables, warp_tables
from tests.helpers import drawn
from tests.helpers.camera_tables import REFUSED_VIEWMATS
from tests.helpers.drawn import NEEDS_WARP


def test_rasterizer_benchmark_reports_an_error_beside_every_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_rasterize, "CASES", (RasterCase(60, 32), RasterCase(90, 40, baseline=False)))
    monkeypatch.setattr(bench_rasterize, "measure", lambda case: measure(case, rounds=1, torch_rounds=1))
    table, lists = tables()
    assert all(float(row[-2]) <= float(row[-1]) for row in lists.rows)
    cells = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    assert [(row["Gaussians"], row["threads"]) for row in cells] == [
        ("60", "1"), ("60", "2"), ("90", "1"), ("90", "2"),
    ]  # fmt: skip
    assert all(float(row["image error"]) <= 2e-6 for row in cells)
    for row in cells[:2]:
        assert row["ratio"].endswith("×")
        assert float(row["worst gradient error"].split()[0]) <= 2e-5
    assert cells[2]["tiled torch (ms)"] == cells[3]["ratio"] == "not run"
    assert table.without_wall().rows[0][3] == "–"


def test_every_hard_case_has_a_row_with_its_largest_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    some = {name: drawn.CASES[name] for name in ("no gaussians", "equal depths", "NaN in means")}
    monkeypatch.setattr(drawn, "CASES", some)
    (table,) = hard_tables()
    drawn_rows = table.rows[:3]
    assert [row[0] for row in drawn_rows] == list(some)
    assert table.title == f"{3 + len(REFUSED_VIEWMATS)} hard cases"
    assert all(float(row[2]) <= 2e-6 and float(row[3].split()[0]) <= 2e-5 for row in drawn_rows)
    refused = {row[0]: row[2] for row in table.rows[3:]}
    assert refused["viewmat scaled by 1.7"] == "refused: the viewmat scales by 1.7"
    assert refused["viewmat mirrored"] == "refused: the viewmat mirrors"
    assert all(len(row) == len(table.columns) for row in table.rows)
    assert float(table.rows[1][2]) > 0.0


@NEEDS_WARP
def test_warp_row_names_its_device_and_errors() -> None:
    (table,) = warp_tables([RasterCase(60, 32), RasterCase(90, 40, False, 24)], rounds=1)
    cells = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    assert [row["pixels"] for row in cells] == ["32×32", "40×24"]
    assert [bool(row["its image error"]) for row in cells] == [True, False]
    for row in cells:
        assert row["device"]
        assert float(row["image error"]) <= 2e-6
        assert float(row["worst gradient error"].split()[0]) <= 2e-5
    assert bench_rasterize._step_time(RasterCase(60, 40), 6) > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("case", [RasterCase(2_000, 128), RasterCase(20_000, 256)], ids=["2k", "20k"])
def test_cpu_engine_is_40_times_faster_than_tiled_torch(case: RasterCase) -> None:
    """Compare both on one thread each, as a busy machine slows both alike. 90 and 105 times were measured."""
    assert measure(case).duels[0].ratio >= 40.0


@pytest.mark.parametrize("case", [RasterCase(2_000, 128), RasterCase(20_000, 256)], ids=["2k", "20k"])
@pytest.mark.slow
def test_cpu_engine_keeps_its_error_limits_at_full_speed(case: RasterCase) -> None:
    result = measure(case, rounds=1, torch_rounds=1)
    assert result.image_error <= 2e-6
    assert max(result.gradient_errors.values()) <= 2e-5, result.gradient_errors
