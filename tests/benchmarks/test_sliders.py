"""The suite of known courses: what is trained is compared with the truth, and trained only once."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.analytic_edits import bear_edits
from benchmarks.sliders import CASES, STRENGTHS, CaseResult, run_suite, suite_json, suite_picture, suite_table
from tests.helpers.demo_scenes import bear
from trainer.optimize.losses import GradientL1
from trainer.run.demo import Effort

_FEW = tuple(case for case in CASES if case.name in ("blue scarf", "tilted ears"))
_SIZES = {"bear": 1500}
_EFFORT = Effort(views=4, image_size=64, steps=32)


def _run(folder: Path) -> list[CaseResult]:
    return run_suite(folder, GradientL1(), 1, cases=_FEW, sizes=_SIZES, effort=_EFFORT)


pytestmark = pytest.mark.slow  # trains its edits


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[CaseResult]]:
    folder = tmp_path_factory.mktemp("suite")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.sliders.bear", bear)  # made once for many tests
        return folder, _run(folder)


def test_every_edit_is_compared_at_eleven_strengths_and_exact_at_the_first(
    suite: tuple[Path, list[CaseResult]],
) -> None:
    for result in suite[1]:
        assert set(result.curves) == {"slider", "2 keyframes", "cross-fade"}
        for curve in result.curves.values():
            assert curve.s == STRENGTHS
            assert curve.psnr[0] > 90
            assert curve.psnr[-1] == result.curves["slider"].psnr[-1]


def test_a_slider_that_has_seen_the_course_follows_it_and_a_cross_fade_does_not(
    suite: tuple[Path, list[CaseResult]],
) -> None:
    for result in suite[1]:
        ours, fade = (sum(result.curves[name].psnr[1:-1]) for name in ("slider", "cross-fade"))
        assert ours > fade + 9 * 3.0, result.case.name


def test_a_second_time_nothing_is_trained_and_all_figures_are_the_same(
    suite: tuple[Path, list[CaseResult]],
) -> None:
    folder, first = suite
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.gdf")}
    again = _run(folder)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.gdf")} == before
    assert [result.curves for result in again] == [result.curves for result in first]


def test_the_table_has_a_row_an_edit_and_the_picture_shows_them(
    suite: tuple[Path, list[CaseResult]],
) -> None:
    results = suite[1]
    table = suite_table(results).splitlines()
    assert [line.split(" | ")[0] for line in table[2:]] == [f"| {case.name}" for case in _FEW]
    assert set(suite_json(results, "gradient-l1")["edits"]) == {case.name for case in _FEW}
    assert suite_picture(results).shape[2] == 3


def test_every_analytic_edit_of_the_suite_is_one_of_the_bears() -> None:
    edits = bear_edits(bear(1500))
    assert {case.name for case in CASES if not case.editor} <= set(edits)
    assert len({case.folder for case in CASES}) == len(CASES)
