"""`progdf evaluate` on a finished run: its table, its files and its errors for missing data."""

from __future__ import annotations

import json
import shutil
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from progdf.__main__ import main
from tests.helpers.tiny_clip import tiny_clip
from tests.helpers.trained import quick_options, train, write_bear


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train a small bear; return the run folder."""
    folder = tmp_path_factory.mktemp("evaluate")
    write_bear(folder)
    train(quick_options(folder, steps=40, stages=2, views=12, image_size=56, threads=1), quiet=True)
    return folder / "run"


@pytest.fixture(scope="module")
def printed(run: Path) -> str:
    """Return the output of `progdf evaluate` for the run."""
    with redirect_stdout(StringIO()) as out:
        assert main(["evaluate", str(run), "--threads", "1"]) == 0
    return out.getvalue()


@pytest.fixture(scope="module")
def rows(run: Path, printed: str) -> dict[str, Any]:
    """Return the rows of evaluation.json."""
    found: dict[str, Any] = json.loads((run / "evaluation.json").read_text())["rows"]
    return found


@pytest.mark.slow
def test_figures_agree_with_the_report(run: Path, rows: dict[str, Any]) -> None:
    report = json.loads((run / "report.json").read_text())
    edit = report["edit"]
    slider = report["slider"]
    assert rows["psnr_end"]["slider"] == pytest.approx(edit["psnr_to_views"], abs=0.01)
    assert rows["ssim_end"]["slider"] == pytest.approx(edit["ssim_to_views"], abs=1e-4)
    assert rows["lpips_end"]["slider"] == pytest.approx(edit["lpips_to_views"], abs=1e-4)
    assert rows["evenness"]["slider"] == pytest.approx(slider["uniformity"], abs=1e-3)
    between = [figures["psnr"] for figures in report["between"].values()]
    assert rows["psnr_between"]["slider"] == pytest.approx(sum(between) / len(between), abs=0.01)
    assert rows["psnr_worst"]["slider"] == pytest.approx(min(*between, edit["psnr_to_views"]), abs=0.01)
    assert rows["seconds"]["slider"] == pytest.approx(report["time"]["total"], abs=0.01)


def test_compared_edits_end_at_the_same_picture(rows: dict[str, Any]) -> None:
    for measure in ("psnr_end", "ssim_end", "lpips_end"):
        assert len(set(rows[measure].values())) == 1
        assert set(rows[measure]) == {"slider", "2 keyframes", "cross-fade"}


def test_cross_fade_is_even_and_no_path_is_shorter_than_straight(
    rows: dict[str, Any],
) -> None:
    assert rows["evenness"]["cross-fade"] == pytest.approx(1.0, abs=1e-3)
    assert rows["monotone"]["cross-fade"] == 1.0
    # LPIPS needs weights; the L1 in its place has square roots that add up to more
    assert all(value >= 1.0 for value in rows["triangle_excess"].values())


def test_warped_views_are_compared_and_the_outside_hardly_changes(
    rows: dict[str, Any],
) -> None:
    assert set(rows["warped_lpips"]) == {"slider", "the editor", "unedited"}
    assert all(10 < value < 60 for value in rows["warped_psnr"].values())
    assert rows["outside"]["slider"] < 1.0


def test_table_is_printed_and_picture_is_written(run: Path, printed: str, rows: dict[str, Any]) -> None:
    assert "| slider | 2 keyframes | cross-fade | the editor | unedited |" in printed
    assert "CLIP direction similarity at 1: not measured, --text-before is missing" in printed
    assert (run / "evaluation.png").stat().st_size > 10_000
    assert "missing" in rows["clip_direction"]


@pytest.mark.slow
def test_clip_rows_are_measured_if_weights_are_installed(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("transformers")
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    clip = str(tiny_clip(tmp_path / "clip"))
    for module in ("trainer.report.measures", "trainer.evaluate.consistency"):
        monkeypatch.setattr(f"{module}.CLIP_MODEL", clip)
    words = ["--text-before", "a bear", "--text-after", "a blue bear"]
    assert main(["evaluate", str(copy), "--threads", "1", *words]) == 0
    rows = json.loads((copy / "evaluation.json").read_text())["rows"]
    for name in ("clip_direction", "clip_consistency"):
        assert -1.0 <= rows[name]["slider"] <= 1.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{tmp}"], "holds no trajectory.safetensors"),
        (["{tmp}/nothing"], "holds no trajectory.safetensors"),
        ([], "evaluate"),
        (["{tmp}", "--threads", "-1"], "--threads must be between 0 and 1024"),
    ],
)
def test_invalid_evaluate_command_is_a_one_line_error(
    arguments: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", *(argument.format(tmp=tmp_path) for argument in arguments)]) == 2
    printed = capsys.readouterr().err
    assert words in printed
    assert printed.count("\n") == 1


@pytest.mark.parametrize("file", ["report.json", "run.gdf", "views/edited/"])
def test_run_with_a_missing_file_is_a_one_line_error(
    file: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    (shutil.rmtree if file.endswith("/") else Path.unlink)(copy / file)  # type: ignore[operator]
    assert main(["evaluate", str(copy), "--threads", "1"]) == 2
    assert file.strip("/") in capsys.readouterr().err
