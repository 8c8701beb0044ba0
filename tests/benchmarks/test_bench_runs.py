"""Tests of the benchmarks of finished runs: edits against simpler baselines, and fully trained networks."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from benchmarks import edits as bench_edits
from benchmarks import networks as bench_networks
from progdf.camera import Camera, intrinsics, look_at
from progdf.errors import ProgdfError
from progdf.field import NeuralSettings
from tests.helpers.trained import quick_options, train, write_bear


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a finished run of a few seconds."""
    folder = tmp_path_factory.mktemp("bear")
    write_bear(folder)
    options = quick_options(folder, steps=24, stages=2, views=10, image_size=72)
    return train(options, quiet=True).folder.root


def test_far_cameras_are_raised_lowered_and_zoomed_at_the_region() -> None:
    center = torch.tensor([1.0, 2.0, 3.0])
    up = torch.tensor([0.0, 1.0, 0.0])
    eye = center + torch.tensor([4.0, 0.0, 0.0])
    camera = Camera(look_at(eye, center, up), intrinsics(0.9, 64, 64), 64, 64)
    raised, lowered, zoomed = bench_edits.far_cameras(camera, center, up)
    assert float(raised.position[1] - center[1]) == pytest.approx(4.0 * 0.5, abs=1e-4)
    assert float(lowered.position[1] - center[1]) == pytest.approx(-4.0 * 0.2588, abs=1e-3)
    assert torch.allclose(zoomed.position, eye, atol=1e-5)
    assert float(zoomed.K[0, 0] / camera.K[0, 0]) == pytest.approx(3.0)
    for far in (raised, lowered, zoomed):
        seen = far.viewmat[:3, :3] @ center + far.viewmat[:3, 3]
        assert torch.allclose(seen[:2], torch.zeros(2), atol=1e-4)
        assert float(seen[2]) == pytest.approx(4.0, abs=1e-4)


@pytest.mark.slow
def test_edits_are_compared_with_baselines_at_all_strengths(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench_edits, "VALUES", 11)
    edits, values = bench_edits.tables([run])
    assert edits.rows[0][0] == values.rows[0][0]
    field, file = (float(size) for size in edits.rows[0][10].split(" / "))
    assert file > field > 0
    lowest = [float(cell.split(" at ")[0]) for cell in edits.rows[0][4:7]]
    assert lowest[0] <= min(float(quarter) for quarter in edits.rows[0][1].split(" / ")) + 0.05
    assert lowest[0] <= float(edits.rows[0][7]) + 0.05, "the end is one of the strengths"
    worst = float(values.rows[0][1].split(" / ")[1])
    assert float(values.rows[0][3]) <= worst + 2.0
    assert "-" not in values.rows[0], "this editor can be asked for views from elsewhere"


def test_networks_are_trained_once_and_long_ones_only_timed(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    networks = {"tiny": NeuralSettings("tiny", steps=4), "long": NeuralSettings("tiny", steps=10**7)}
    monkeypatch.setattr(bench_networks, "NETWORKS", networks)
    monkeypatch.setattr(bench_networks, "ROUNDS", 1)
    (table,) = bench_networks.tables([run])
    rows = {row[1]: row for row in table.rows}
    assert rows["tiny"][4] == "4"
    assert rows["long"][4:8] == ("-", "-", "-", "-")
    assert all(float(rows[name][8]) > 0 and rows[name][11].endswith("×") for name in networks)
    assert any(label.startswith("auto at 40 dB") for label in rows)
    assert [path.name for path in (run / "networks").iterdir()] == ["tiny.gdf"]
    modified_ns = (run / "networks" / "tiny.gdf").stat().st_mtime_ns
    (again,) = bench_networks.tables([run])
    assert {row[1]: row[5:8] for row in again.rows}["tiny"] == rows["tiny"][5:8]
    assert (run / "networks" / "tiny.gdf").stat().st_mtime_ns == modified_ns


@pytest.mark.parametrize("tables", [bench_edits.tables, bench_networks.tables])
def test_benchmarks_of_runs_without_a_run_are_refused(tables: object) -> None:
    with pytest.raises(ProgdfError, match="name some with --runs"):
        tables()  # type: ignore[operator]
