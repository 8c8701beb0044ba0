"""Tests of the suite of known trajectories, which compares edits with the truth and trains them once."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.analytic_edits import bear_edits
from benchmarks.sliders import CASES, STRENGTHS, CaseResult, run_suite, suite_json, suite_picture, suite_table
from tests.helpers.demo_scenes import bear
from trainer.optimize.losses import GradientL1
from trainer.run.demo import Effort

_USED_CASES = tuple(case for case in CASES if case.name in ("blue scarf", "tilted ears"))
_SIZES = {"bear": 1500}
_EFFORT = Effort(views=4, image_size=64, steps=32)


def _run(folder: Path) -> list[CaseResult]:
    return run_suite(folder, GradientL1(), 1, cases=_USED_CASES, sizes=_SIZES, effort=_EFFORT)


pytestmark = pytest.mark.slow  # trains its edits


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[CaseResult]]:
    folder = tmp_path_factory.mktemp("suite")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.sliders.bear", bear)  # built once for many tests
        return folder, _run(folder)


def test_edits_are_compared_at_eleven_strengths_and_exact_at_zero(
    suite: tuple[Path, list[CaseResult]],
) -> None:
    for result in suite[1]:
        assert set(result.curves) == {"slider", "2 keyframes", "cross-fade"}
        for curve in result.curves.values():
            assert curve.s == STRENGTHS
            assert curve.psnr[0] > 90
            assert curve.psnr[-1] == result.curves["slider"].psnr[-1]


def test_trained_slider_follows_the_trajectory_better_than_a_fade(
    suite: tuple[Path, list[CaseResult]],
) -> None:
    for result in suite[1]:
        ours, fade = (sum(result.curves[name].psnr[1:-1]) for name in ("slider", "cross-fade"))
        assert ours > fade + 9 * 3.0, result.case.name


def test_second_suite_run_trains_nothing_and_repeats_the_figures(
    suite: tuple[Path, list[CaseResult]],
) -> None:
    folder, first = suite
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.gdf")}
    again = _run(folder)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.gdf")} == before
    assert [result.curves for result in again] == [result.curves for result in first]


def test_suite_table_and_picture_contain_every_edit(
    suite: tuple[Path, list[CaseResult]],
) -> None:
    results = suite[1]
    table = suite_table(results).splitlines()
    assert [line.split(" | ")[0] for line in table[2:]] == [f"| {case.name}" for case in _USED_CASES]
    assert set(suite_json(results, "gradient-l1")["edits"]) == {case.name for case in _USED_CASES}
    assert suite_picture(results).shape[2] == 3


def test_every_analytic_edit_of_the_suite_is_a_bear_edit() -> None:
    edits = bear_edits(bear(1500))
    assert {case.name for case in CASES if not case.editor} <= set(edits)
    assert len({case.folder for case in CASES}) == len(CASES)
