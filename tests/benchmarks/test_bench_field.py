"""The field benchmark runs, puts an error beside every speed, and draws both."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks import __main__ as bench
from benchmarks import field as bench_field
from benchmarks.field_forms import Form
from benchmarks.field_plot import PAPER, draw_forms
from progdf.errors import ProgdfError


def _form(edit: str, kind: str, bytes_per_member: float, worst: float, ms: float) -> Form:
    curve = (worst + 5, worst)
    return Form(edit, 100, kind, f"4 {kind}", 900, bytes_per_member, curve, worst, 0.1, (ms, 2 * ms))


def _forms(edit: str) -> list[Form]:
    return [
        _form(edit, "keyframes, int8", 84, 31.0, 0.1),
        _form(edit, "separable", 84, 44.0, 0.2),
        _form(edit, "joint SVD", 200, 25.0, 4.0),
    ]


def test_the_field_table_names_error_bytes_and_time_and_the_plot_is_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(bench_field, "BEAR", 2_000)
    monkeypatch.setattr(bench_field, "SIDE", 48)
    monkeypatch.setattr(bench_field, "SNAPSHOTS", 5)
    monkeypatch.setattr(bench_field, "EDITS", ("tilted ears",))
    monkeypatch.setattr(bench_field, "CLOUDS", ((30, 300),))
    fields, steps = bench_field.tables(plot=tmp_path / "pareto.png")
    labels = [row[1] for row in fields.rows]
    assert {"2 keyframes, float32", "4 keyframes, int8", "joint SVD, rank 2"} < set(labels)
    assert any(label.startswith("auto at 40 dB") for label in labels)
    assert all(float(row[3]) > 0 and float(row[7]) > 0 and float(row[8]) > 0 for row in fields.rows)
    assert "tilted ears +" in fields.note or "tilted ears -" in fields.note
    assert steps.rows[0][-1] == "0"
    with Image.open(tmp_path / "pareto.png") as picture:
        assert picture.width > 900


def test_the_note_compares_forms_of_the_same_bytes_edit_by_edit() -> None:
    table = bench_field.field_table([*_forms("bear"), *_forms("robot")])
    assert "bear +13.0 dB, robot +13.0 dB" in table.note


def test_the_plot_has_a_panel_for_every_edit_and_grows_by_rows_of_three() -> None:
    three = draw_forms([form for edit in "abc" for form in _forms(edit)])
    four = draw_forms([form for edit in "abcd" for form in _forms(edit)])
    assert four.width == three.width
    assert four.height > 1.8 * three.height
    corner = three.crop((three.width * 2 // 3, three.height // 2, three.width, three.height))
    assert any(color != PAPER for _, color in corner.getcolors(maxcolors=100_000) or [])


def test_a_separable_point_lies_higher_where_its_error_is_smaller() -> None:
    def height(worst: float) -> float:
        picture = draw_forms([_form("bear", "separable", 84, worst, 0.1)]).crop((0, 60, 340, 250))
        return float((np.asarray(picture) == (34, 84, 180)).all(2).nonzero()[0].mean())

    assert height(50.0) < height(30.0)


def test_runs_and_a_plot_are_refused_where_no_fields_are_measured(tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="use python -m benchmarks field"):
        bench.main(["rasterize", "--plot", str(tmp_path / "x.png")])


def test_a_folder_that_is_no_run_is_refused_before_anything_is_measured(tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match=r"holds no trajectory\.safetensors"):
        bench.main(["field", "--runs", str(tmp_path)])
