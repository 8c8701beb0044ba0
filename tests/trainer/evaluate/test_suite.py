"""The suite `sliders`: methods, measures, confidence intervals, and the same file for the same seed."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import sliders
from progdf.__main__ import main
from progdf.errors import ProgdfError
from progdf.sh import rgb_to_sh0, sh0_to_rgb
from tests.helpers.demo_scenes import bear
from tests.helpers.paths import ROOT
from trainer.evaluate.suite.analytic_edits import FORMULAS, fade_edit
from trainer.evaluate.suite.edits import SUITES, EditTask, Suite, make_task
from trainer.evaluate.suite.methods import METHODS, Slider, find_methods
from trainer.evaluate.suite.results import (
    EditResult,
    bootstrap,
    edit_rows,
    read_results,
    suite_picture,
    summary_rows,
)
from trainer.evaluate.suite.run import run_suite
from trainer.evaluate.suite.scenes import CAPTURES, FOLDER, MADE, load_suite_scene
from trainer.optimize.losses import GradientL1
from trainer.run.demo import Effort
from trainer.views.view import render_view

_FIRST = SUITES["sliders-1"]
_SMALL = replace(
    _FIRST,
    edits=tuple(edit for edit in _FIRST.edits if edit.name in ("blue scarf", "tilted ears")),
    sizes={"bear": 1500},
    effort=Effort(views=6, image_size=64, steps=32),
)


def _original(task: EditTask) -> Slider:
    return lambda strength: task.scene


def _run(folder: Path) -> list[EditResult]:
    methods = {**find_methods(["field", "keyframes", "matrix"]), "original": _original}
    return run_suite(folder, methods, GradientL1(), 0, 1, suite=_SMALL)


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[EditResult]]:
    folder = tmp_path_factory.mktemp("suite")
    return folder, _run(folder)


def _without_seconds(path: Path) -> Any:
    content = json.loads((path / "sliders.json").read_text())
    for edit in content["edits"].values():
        for method in edit["methods"].values():
            del method["seconds"]
    return content


@pytest.mark.slow
def test_every_method_is_exact_at_zero_and_the_field_is_best(
    suite: tuple[Path, list[EditResult]],
) -> None:
    for result in suite[1]:
        assert list(result.errors) == ["field", "keyframes", "matrix", "original", "cross-fade"]
        between = {name: errors["psnr"][:, 1:-1].mean() for name, errors in result.errors.items()}
        for name, errors in result.errors.items():
            assert errors["psnr"][:, 0].min() > 80, name  # the file's pictures have no rounding here
            assert name == "field" or between[name] < between["field"]
    assert [row["edit"] for row in edit_rows(suite[1])] == [edit.name for edit in _SMALL.edits]
    assert [row["method"] for row in summary_rows(suite[1], "lpips")] == list(result.errors)
    assert suite_picture(suite[1]).shape[2] == 3


@pytest.mark.slow
def test_same_seed_gives_the_same_file_apart_from_times(
    suite: tuple[Path, list[EditResult]], tmp_path: Path
) -> None:
    folder = suite[0]
    first = _without_seconds(folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.gdf")}
    _run(folder)  # trains nothing again
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.gdf")} == before
    assert _without_seconds(folder) == first
    _run(tmp_path)
    assert _without_seconds(tmp_path) == first
    assert (first["suite"], first["version"]) == ("sliders", 1)


def _small_task(folder: Path, monkeypatch: pytest.MonkeyPatch) -> EditTask:
    monkeypatch.setitem(MADE, "bear", bear)  # type: ignore[arg-type]  # built once for many tests
    made = load_suite_scene(folder, "bear", 700)
    return make_task(_SMALL.edits[0], made, folder, Effort(views=6, image_size=64, steps=0), 1, 0)[0]


def test_matrix_recovers_an_affine_edit_of_the_colors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = _small_task(tmp_path, monkeypatch)
    members = task.region.members
    part = task.scene[members]
    change = torch.tensor([[0.9, 0.05, 0.0], [0.0, 0.8, 0.1], [0.02, 0.0, 0.9]])
    rgb = sh0_to_rgb(part.sh0) @ change + 0.03
    scene = replace(
        task.scene,
        sh0=task.scene.sh0.index_copy(0, members, rgb_to_sh0(rgb)),
        shN=task.scene.shN.index_copy(0, members, part.shN @ change),
    )
    edited = [render_view(scene, view.camera, task.background) for view in task.views]
    half = [torch.lerp(view.image, picture, 0.5) for view, picture in zip(task.views, edited, strict=True)]
    slider = METHODS["matrix"](replace(task, pictures={0.5: half, 1.0: edited}))
    # colors that the renderer clamps at 0 are not affine, so the fit is not exact
    assert (sh0_to_rgb(slider(1.0).sh0[members]) - rgb).abs().max() < 0.01
    quarter = torch.lerp(sh0_to_rgb(part.sh0), rgb, 0.25)
    assert (sh0_to_rgb(slider(0.25).sh0[members]) - quarter).abs().max() < 0.01
    assert torch.equal(slider(0.0).means, task.scene.means)


def test_interval_narrows_with_edits_and_vanishes_without_variation() -> None:
    random = np.random.default_rng(1)
    few = bootstrap([random.normal(30, 2, 4) for _ in range(4)])
    many = bootstrap([random.normal(30, 2, 4) for _ in range(64)])
    assert few.low < few.mean < few.high
    assert many.high - many.low < 0.5 * (few.high - few.low)
    same = bootstrap([np.full(3, 31.5), np.full(4, 31.5)])
    assert (same.low, same.mean, same.high) == (31.5, 31.5, 31.5)


def test_interval_covers_the_mean_of_the_population() -> None:
    random = np.random.default_rng(2)
    covered = 0
    for _ in range(20):
        edits = random.normal(30, 3, 12)
        estimate = bootstrap([random.normal(edit, 1, 4) for edit in edits])
        covered += estimate.low <= 30 <= estimate.high
    assert covered >= 16  # 19 of 20 in the limit of many edits


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("--suite", "sliders", "--methods", "nothing"), "unknown method 'nothing'"),
        (("--suite", "sliders", "--methods", "no_module:slider"), "cannot be imported"),
        (("--suite", "sliders", "--methods", "json:slider"), "json has no function 'slider'"),
        (("--suite", "sliders", "--seed", "-1"), "--seed must be between 0"),
        (("--methods", "field"), "add --suite sliders"),
    ],
)
def test_wrong_options_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], problem: str
) -> None:
    assert main(["evaluate", str(tmp_path / "suite"), *words]) == 2
    errors = capsys.readouterr().err
    assert problem in errors
    assert errors.count("\n") == 1
    assert not (tmp_path / "suite").exists()


def test_failing_method_is_one_line_with_its_name(tmp_path: Path) -> None:
    def broken(task: EditTask) -> Slider:
        raise IndexError("no such view")

    def wrong(task: EditTask) -> Slider:
        return lambda strength: strength  # type: ignore[return-value]

    small = _one_edit(Effort(views=6, image_size=48, steps=0))
    with pytest.raises(ProgdfError, match=r"broken failed at blue scarf .IndexError: no such view"):
        run_suite(tmp_path, {"broken": broken}, GradientL1(), suite=small)
    with pytest.raises(ProgdfError, match="returned a float"):
        run_suite(tmp_path, {"wrong": wrong}, GradientL1(), suite=small)


def _one_edit(effort: Effort) -> Suite:
    return replace(_SMALL, edits=_SMALL.edits[:1], sizes={"bear": 700}, effort=effort)


def test_results_are_read_back_from_their_file(tmp_path: Path) -> None:
    small = _one_edit(Effort(views=6, image_size=48, steps=0))
    written = run_suite(tmp_path, {"original": _original}, GradientL1(), suite=small)
    read, rest = read_results(tmp_path / "sliders.json")
    assert edit_rows(read) == edit_rows(written)
    assert rest["version"] == 1
    cells = [list(row.values())[:-1] for row in summary_rows(read, "lpips")]  # the last are seconds
    assert cells == [list(row.values())[:-1] for row in summary_rows(written, "lpips")]
    by_method, by_edit = sliders.tables([tmp_path])
    assert [row[0] for row in by_method.rows] == ["original", "cross-fade"]
    assert [row[0] for row in by_edit.rows] == ["blue scarf"]
    with pytest.raises(ProgdfError, match="name one folder"):
        sliders.tables()
    (tmp_path / "sliders.json").write_text("{}")
    with pytest.raises(ProgdfError, match="is damaged"):
        read_results(tmp_path / "sliders.json")
    with pytest.raises(ProgdfError, match="does not exist"):
        read_results(tmp_path / "other.json")


@pytest.mark.parametrize("name", sorted(SUITES))
def test_every_analytic_edit_of_a_suite_has_a_formula(name: str) -> None:
    edits = SUITES[name].edits
    scenes = {edit.scene for edit in edits}
    labeled = {one: bear(1500) if one == "bear" else CAPTURES[one].load() for one in scenes - {"room"}}
    for edit in edits:
        if not edit.editor:
            assert edit.name in FORMULAS[edit.scene](labeled[edit.scene])
    assert len({edit.folder for edit in edits}) == len(edits)


def test_first_version_is_as_it_was_published() -> None:
    """Version 1 is fixed: this is the digest of its edits, sizes and effort."""
    text = repr((_FIRST.version, _FIRST.edits, dict(_FIRST.sizes), _FIRST.effort))
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == "9c365eb965815967"


@pytest.mark.parametrize("name", sorted(CAPTURES))
def test_capture_is_the_credited_file_of_the_tutorials(name: str) -> None:
    capture = CAPTURES[name]
    for file in filter(None, (capture.file, capture.labels)):
        assert (FOLDER / file).read_bytes() == (ROOT / "assets/scenes" / file).read_bytes()
        assert f"| {file} |" in (FOLDER / "CREDITS.md").read_text(encoding="utf-8")
    scene = capture.load()
    for edit in SUITES["sliders"].edits:
        if edit.scene == name:
            # the paper's network takes processor time with the number of members
            assert 300 < len(scene.members(*edit.parts)) < 1200


def test_another_capture_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trainer.evaluate.suite.scenes.FOLDER", tmp_path)
    shutil.copy(FOLDER / "robot.compressed.ply", tmp_path / "box.sog")
    with pytest.raises(ProgdfError, match="is not the file of the suite"):
        CAPTURES["box"].load()


def test_faded_part_is_gone_at_one_and_whole_at_zero() -> None:
    scene = bear(700).gaussians
    members = torch.arange(50)
    half = fade_edit().apply(scene, members, 0.5)
    assert torch.allclose(half.opacities[:50], 0.5 * scene.opacities[:50], atol=1e-5)
    assert torch.equal(half.logit_opacities[50:], scene.logit_opacities[50:])
    assert fade_edit().apply(scene, members, 1.0).opacities[:50].max() < 1e-5
