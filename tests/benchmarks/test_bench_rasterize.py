"""The rasterizer's benchmark runs, and the engine keeps its floor of speed at its ceiling of error."""

from __future__ import annotations

import pytest

from benchmarks import rasterizer as bench_rasterize
from benchmarks.rasterizer import RasterCase, measure, tables


def test_the_rasterizer_benchmark_names_an_error_beside_every_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_rasterize, "CASES", (RasterCase(60, 32), RasterCase(90, 40, baseline=False)))
    monkeypatch.setattr(bench_rasterize, "measure", lambda case: measure(case, rounds=1, torch_rounds=1))
    (table,) = tables()
    assert [row[0] for row in table.rows] == ["60", "90"]
    assert table.rows[0][5].endswith("×")
    assert float(table.rows[0][7]) <= 2e-6
    assert float(table.rows[1][7]) <= 2e-6
    assert float(table.rows[0][8].split()[0]) <= 2e-5
    assert "not run" in table.rows[1]


@pytest.mark.slow
@pytest.mark.parametrize("case", [RasterCase(2_000, 128), RasterCase(20_000, 256)], ids=["2k", "20k"])
def test_the_cpu_engine_is_40_times_faster_than_a_tiled_torch_renderer(case: RasterCase) -> None:
    """On one thread each, where a busy machine slows both alike; 90 and 105 times were measured."""
    assert measure(case).duels[-1].ratio >= 40.0


@pytest.mark.parametrize("case", [RasterCase(2_000, 128), RasterCase(20_000, 256)], ids=["2k", "20k"])
@pytest.mark.slow
def test_the_cpu_engine_is_that_fast_at_the_error_it_promises(case: RasterCase) -> None:
    result = measure(case, rounds=1, torch_rounds=1)
    assert result.image_error <= 2e-6
    assert max(result.gradient_errors.values()) <= 2e-5, result.gradient_errors
