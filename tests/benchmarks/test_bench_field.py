"""Tests of the training and field benchmarks: every speed has an error, and both are plotted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks import field, training
from benchmarks.colors import packing
from benchmarks.layers import gains
from benchmarks.training import Point, TimedEdit, TrainingTask, save_plot, table, tasks
from tests.helpers.small_benchmarks import shrink_field
from trainer.report.plots import LINES


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "BEAR", 700)
    monkeypatch.setattr(
        training, "OPTION_SETS", ("--quick --views 5 --image-size 48 --stages 2 --threads 1",)
    )


@pytest.mark.slow
def test_training_benchmark_reports_time_and_held_out_error(small: None, tmp_path: Path) -> None:
    (result,) = training.tables(plot=tmp_path / "training.png")
    ((edit, arguments, at_1, worst, between, processor, wall, size),) = result.rows
    assert (edit, arguments) == ("bear, stripes:#20a040", f"`{training.OPTION_SETS[0]}`")
    assert 20.0 < float(worst) <= min(map(float, between.split())) + 0.05
    assert 20.0 < float(at_1) < 70.0
    assert float(processor) >= 1
    assert float(wall) >= 1
    assert float(size) >= 0
    assert "progdf train bear.ply --region labels:bear_labels.npy:5 --editor stripes:#20a040" in result.note
    assert result.without_wall().rows[0][-2] == "–"
    with Image.open(tmp_path / "training.png") as picture:
        assert picture.width == 380


@pytest.mark.slow
def test_all_field_forms_are_compared_and_the_shipped_form_is_marked(
    small: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shrink_field(monkeypatch)
    fields, steps = field.tables(plot=tmp_path / "field.png")
    labels = [row[1] for row in fields.rows]
    grades = [label for label in labels if label.startswith("grade of degree")]
    masked = [label for label in grades if ", a mask" in label]
    assert len(grades) - len(masked) == 9, "three degrees, each with residuals of rank 0, 1 and 2"
    assert len(masked) in (0, 9), "the same again where the run chooses a mask"
    assert {"2 keyframes, raw", "2 keyframes, OKLab", "separable of rank 2, float32 ends"} < set(labels)
    assert sum(label.startswith("**") for label in labels) >= 1
    sizes = {label: float(row[2]) for label, row in zip(labels, fields.rows, strict=True)}
    assert sizes[labels[0]] == 0.0 < sizes[labels[1]] < sizes[labels[2]]
    assert all(float(row[3]) <= min(map(float, row[4].split())) + 0.05 for row in fields.rows)
    assert steps.rows[0][-2] == "0"
    assert "–" in steps.without_wall().rows[0]
    with Image.open(tmp_path / "field.png") as picture:
        assert picture.width == 2 * 380


def test_labeled_scenes_are_recolored_and_others_tinted(small: None, tmp_path: Path) -> None:
    (tmp_path / "robot_labels.npy").touch()
    robot = tmp_path / "robot.ply"
    guitar = tmp_path / "guitar.splat"
    bear, *given = tasks(tmp_path, [robot, guitar])
    assert bear.scene.is_file()
    assert given == [
        TrainingTask(robot, f"labels:{tmp_path}/robot_labels.npy:1", training.BLUE),
        TrainingTask(guitar, "all", training.TINT),
    ]


def test_training_table_names_the_worst_intermediate_strength() -> None:
    runs = [TimedEdit("", 9.6, 12.3, (31.0, 30.0, 33.0, 34.0, 35.0), 6.0)]
    (row,) = table({TrainingTask(Path("a.ply"), "all", "tint:#c08040"): runs}).rows
    assert row == ("a, tint:#c08040", "(default)", "35.0", "30.0", "31.0 30.0 33.0 34.0", "12", "10", "6")


def test_plot_places_points_by_error(tmp_path: Path) -> None:
    def height(psnr: float) -> float:
        """Return the row of the second of two points; the first is at 30 dB."""
        points = [Point("a", 3.0, (30.0, 30.0)), Point("b", 6.0, (psnr, psnr), True)]
        save_plot({"bear": points, "robot": points}, "bytes", tmp_path / "two.png")
        with Image.open(tmp_path / "two.png") as picture:
            pixels = np.asarray(picture.convert("RGB").crop((0, 0, 380, 285))).astype(int)
        return float((abs(pixels - LINES[1]).sum(axis=2) < 40).nonzero()[0].mean())

    assert height(50.0) < height(20.0)
    assert (tmp_path / "two.png").stat().st_size < 40_000


def test_gains_benchmark_reports_time_and_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gains, "COUNTS", (40,))
    monkeypatch.setattr(gains, "STEPS", 4)
    (result,) = gains.tables()
    assert [row[1] for row in result.rows] == ["colors", "colors and SH bands to degree 2"]
    assert all(float(row[2]) > 0.0 and float(row[-1]) <= 1e-6 for row in result.rows)


def test_packing_benchmark_reports_equal_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packing, "MEMBERS", 700)
    monkeypatch.setattr(packing, "SIDE", 48)
    monkeypatch.setattr(packing, "PACKINGS", ((0, 0), (1, 8)))
    (result,) = packing.tables()
    assert len(result.rows) == 2
    for row in result.rows:
        assert float(row[3]) == pytest.approx(float(row[4]), rel=0.05, abs=0.02)
