"""Full runs of `progdf train` and `progdf fit` on a small bear."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.cli.options import parse_options
from progdf.compose.reference import Layer, compose_layers
from progdf.errors import ProgdfError
from progdf.field import FieldEvaluator
from progdf.field.trajectory import load_trajectory
from progdf.formats.ply import load_ply
from progdf.gaussians import ATTRIBUTES, pack
from progdf.gdf.file import load_gdf, read_gdf
from tests.helpers.trained import quick_options, train
from trainer import cli
from trainer.evaluate.command import evaluate
from trainer.evaluate.opened import open_run
from trainer.fit.fit import fit_baselines
from trainer.options import EvaluateOptions, FitOptions, TrainOptions, with_values
from trainer.report.plots import LINES, draw_plot
from trainer.resolve import resolve
from trainer.run import training
from trainer.run.finish import load_evaluator, refit
from trainer.run.record import render_run_views, reopen_run
from trainer.run.run import RunResult

WHOLE = {"views": 10, "image_size": 72}
"""Views numerous and large enough that their halves differ and that a map alone is insufficient."""


@pytest.fixture(scope="module")
def done(folder: Path) -> RunResult:
    """Return a finished run of a few seconds with its curves drawn, for tests that only read it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("trainer.report.report.draw_plot", draw_plot)
        return train(quick_options(folder, **WHOLE), quiet=True)


@pytest.fixture(scope="module")
def brief(folder: Path) -> RunResult:
    """Return a run of few steps with a lossless field; tests that change it use a copy."""
    return train(quick_options(folder, "brief", steps=16, stages=2, field="lossless", **WHOLE), quiet=True)


def copy_of(run: RunResult, folder: Path) -> Path:
    """Return a copy of the run in another folder."""
    return shutil.copytree(run.folder.root, folder / run.folder.root.name)


@pytest.mark.slow
def test_report_picture_ends_with_curves(done: RunResult) -> None:
    with Image.open(done.folder.root / "report.png") as picture:
        last = np.asarray(picture.convert("RGB"), dtype=int)[-200:]
    for line in LINES[:2]:
        assert (np.abs(last - line).max(axis=2) <= 12).sum() > 50


def test_training_lowers_the_loss_and_matches_held_out_views(done: RunResult) -> None:
    _, _, recorded = load_trajectory(done.folder.trajectory)
    losses = recorded["losses"]["left"]
    assert losses[-1] < 0.2 * sum(losses[:3]) / 3
    assert done.report["edit"]["psnr_to_views"] > 32.0  # 35.8 when written; 16 before the edit


def test_slider_is_closer_to_the_editor_than_two_keyframes(done: RunResult) -> None:
    assert len(done.report["between"]) == 3
    for s, between in done.report["between"].items():
        assert between["psnr"] > between["keyframes2"] + 4.0, s


def test_report_compares_with_the_keyframes_of_the_evaluation(done: RunResult) -> None:
    opened = open_run(done.folder.root)
    baseline = done.report["baselines"]["keyframes2"]
    assert baseline["kind"] == ("oklab" if opened.keyframes.in_oklab else "raw")
    pictures = opened.evaluator.course(opened.keyframes)
    for s, between in done.report["between"].items():
        psnr = opened.evaluator.psnr(pictures(float(s)), opened.evaluator.edited[between["strength"]])
        assert between["keyframes2"] == pytest.approx(psnr, abs=0.02)  # s has 4 digits


@pytest.mark.slow
def test_figure_from_a_single_held_out_view_is_labeled(
    folder: Path, done: RunResult, capsys: pytest.CaptureFixture[str]
) -> None:
    few = quick_options(folder, out=folder / "few", views=4, image_size=48, steps=16, stages=1)
    log = train(few, quiet=True).folder.log.read_text()
    assert re.search(r"worst .* dB against \d+ recordings in 1 view\n", log)
    assert "one held-out view alone: " in log
    evaluate(EvaluateOptions(few.out))
    assert "to the one edited view held out, at 1, PSNR" in capsys.readouterr().out
    assert re.search(r"\d+ held-out views: .* dB, ", done.folder.log.read_text())


def test_equal_slider_steps_look_equally_large(done: RunResult) -> None:
    assert done.report["slider"]["uniformity"] > 0.7  # 0.9 when written; 0.5 with pinned strengths


def test_report_records_the_strengths_requested_from_the_editor(done: RunResult) -> None:
    report = done.report
    asked = [between["strength"] for between in report["between"].values()]
    assert asked == report["trajectory"]["stages"][:-1] == list(done.trajectory.strengths[:-1])
    assert [float(s) for s in report["between"]] == report["trajectory"]["stages_at"][:-1]
    for s, quarter in zip(report["trajectory"]["stages_at"], (0.25, 0.5, 0.75, 1.0), strict=True):
        assert s == pytest.approx(quarter, abs=0.06)
    assert asked != [0.25, 0.5, 0.75], "this editor's strengths are not evenly visible"


def test_field_stores_the_strengths_of_its_recordings(folder: Path, done: RunResult) -> None:
    gdf = load_gdf(done.gdf, load_ply(folder / "scene.ply"))
    trajectory, _, _ = load_trajectory(done.folder.trajectory)
    assert gdf.field.recorded == pytest.approx(done.trajectory.s.tolist(), abs=1e-6)
    assert not torch.equal(trajectory.s, done.trajectory.s), "the recording is as it was made"
    assert torch.equal(gdf.field.offsets(1.0), done.trajectory.end)
    assert float((done.trajectory.end - trajectory.end).square().mean().sqrt()) < 0.05


def test_default_effort_is_chosen_from_the_scene_and_reported(folder: Path, done: RunResult) -> None:
    free = train(
        quick_options(folder, "free", stages=0, views=0, image_size=40, editor="darken:0.4"), quiet=True
    )
    effort = free.report["effort"]
    given = done.report["effort"]
    assert effort["strengths"] == free.report["trajectory"]["stages"]
    assert effort["strengths"] != given["strengths"]
    assert len(given["strengths"]) == 4
    assert len(effort["steps"]) == (len(effort["strengths"]) if effort["sh_functions"] else 0)
    assert max(given["steps"]) <= given["most_steps"] == 25
    assert effort["views"] == 17  # of 34; with these the remainder is invisible
    assert len(free.report["views"]["edit"]) == 6
    how = "in " if effort["steps"] else "by color maps alone"
    assert f"{len(effort['strengths'])} strengths {how}" in free.folder.log.read_text()
    assert free.report["edit"]["psnr_to_views"] > 32.0


def test_slider_with_stages_is_the_strength_of_the_editor(folder: Path) -> None:
    result = train(quick_options(folder, "pinned", slider="stages", steps=24), quiet=True)
    assert set(result.report["between"]) == {"0.25", "0.5", "0.75"}
    assert all(float(s) == found["strength"] for s, found in result.report["between"].items())
    assert result.report["trajectory"]["stages_at"] == [0.25, 0.5, 0.75, 1.0]


def test_strength_zero_is_the_scene_and_one_is_the_stored_end(folder: Path, done: RunResult) -> None:
    scene = load_ply(folder / "scene.ply")
    gdf = load_gdf(done.gdf, scene)
    at_zero = compose_layers(scene, [Layer(gdf, 0.0)])
    assert all(torch.equal(getattr(at_zero, name), getattr(scene, name)) for name in ATTRIBUTES)
    members = gdf.region.members
    end = gdf.field.offsets(1.0)
    with_sh = end.shape[1] > 14
    at_one = compose_layers(scene, [Layer(gdf, 1.0)])
    assert torch.equal(pack(at_one[members], with_shN=with_sh), pack(scene[members], with_shN=with_sh) + end)
    assert done.report["field"]["endpoint_error"] == 0.0


def test_rows_outside_the_region_are_identical_at_any_strength(folder: Path, done: RunResult) -> None:
    scene = load_ply(folder / "scene.ply")
    gdf = load_gdf(done.gdf, scene)
    outside = torch.ones(len(scene), dtype=torch.bool)
    outside[gdf.region.members] = False
    for strength in (0.1, 0.5, 1.0):
        edited = compose_layers(scene, [Layer(gdf, strength)])
        for name in ATTRIBUTES:
            assert torch.equal(getattr(edited, name)[outside], getattr(scene, name)[outside])
    assert done.report["field"]["outside_change"] == 0.0


def test_report_has_its_documented_keys(done: RunResult) -> None:
    report = json.loads(done.folder.report.read_text(encoding="utf-8"))
    expected = {
        "field": {"kind", "bytes_per_gaussian", "parameters", "psnr_mean", "psnr_worst", "endpoint_error"},
        "baselines": {"keyframes2", "keyframes4"},
        "slider": {"monotone", "uniformity", "largest_jump", "t50", "t90"},
        "between": {f"{s:g}" for s in done.report["trajectory"]["stages_at"][:-1]},
        "edit": {"psnr_to_views", "edge_psnr_to_views", "lpips_to_views", "perceptual", "clip_direction"},
        "curves": {"against_trajectory", "against_editor", "change", "clip_direction"},
        "time": {"views", "edit", "optimize", "fit", "total"},
        "plan": {"scene", "editor", "optimize", "field"},
    }
    for part, keys in expected.items():
        assert keys <= set(report[part]), part
    assert report["memory_mb"] > 0
    assert report["field"]["psnr_worst"] >= 40.0
    assert set(report["baselines"]["keyframes4"]) >= {"psnr_mean", "psnr_worst", "bytes_per_gaussian"}
    assert set(report["baselines"]["keyframes2"]) >= {"psnr_mean", "psnr_worst", "bytes_per_gaussian"}


def test_field_errors_are_reported_on_views_unseen_by_the_choice(done: RunResult) -> None:
    views = done.report["views"]
    report = done.report
    assert set(views["field_chosen"]) & set(views["field"]) == set()
    assert sorted([*views["field_chosen"], *views["field"]]) == sorted(views["edit"])
    assert "box" in views["lpips_over"]
    run = reopen_run(done.folder.root)
    trajectory = run.trajectory
    setup = render_run_views(run)
    halves = load_evaluator(run.folder, setup, setup.held_out, trajectory).halves()
    offsets = torch.stack([trajectory.node(i) for i in range(len(trajectory))])
    field = fit_baselines(trajectory)["keyframes4"]
    chosen, reported = (
        min(FieldEvaluator(trajectory.s, offsets, half.counted_pixels).curve(field)) for half in halves
    )
    assert abs(chosen - reported) > 0.02
    assert report["baselines"]["keyframes4"]["psnr_worst"] == pytest.approx(reported, abs=0.006)
    tried = {t["field"]: t["psnr_worst"] for t in report["choice"]["tried"]}
    assert tried[report["choice"]["chosen"]] != report["field"]["psnr_worst"]


def test_bytes_per_gaussian_are_given_with_and_without_the_header(done: RunResult) -> None:
    file = done.report["file"]
    members = len(read_gdf(done.gdf).region)
    assert file["bytes"] == done.gdf.stat().st_size
    assert file["bytes_per_gaussian"] == pytest.approx(file["bytes"] / members, abs=0.06)
    assert file["bytes_per_gaussian"] > done.report["field"]["bytes_per_gaussian"]


def test_every_view_is_saved_before_and_after(done: RunResult) -> None:
    views = done.folder.root / "views"
    names = {path.name for path in (views / "original").glob("*.png")}
    assert len(names) == 10
    edited = [f"edited/{s:g}" for s in done.trajectory.strengths[:-1]]
    for kind in ("edited", *edited, "mask", "final"):
        assert {path.name for path in (views / kind).glob("*.png")} == names, kind
    with Image.open(done.folder.picture) as picture:
        assert picture.width > 600


def test_half_strength_is_solved_even_on_a_straight_path(folder: Path) -> None:
    """Keep the half, because an S-shaped path also crosses the straight line there."""
    options = quick_options(folder, "straight", editor="grade:exposure=0.2", stages=0, views=6)
    strengths = train(options, quiet=True).report["effort"]["strengths"]
    assert strengths == [0.5, 1.0]


def test_saved_edited_views_can_be_trained_from(folder: Path, done: RunResult) -> None:
    options = quick_options(
        folder, "again", editor=f"folder:{done.folder.root / 'views' / 'edited'}", kind="color", **WHOLE
    )
    result = train(options, quiet=True)
    assert result.report["edit"]["psnr_to_views"] > 32.0
    given = {f"{s:g}" for s in done.trajectory.strengths[:-1]}
    assert set(result.report["between"]) == given, "pinned where they were given"


def test_same_seed_gives_the_same_bits(folder: Path, brief: RunResult) -> None:
    again = train(quick_options(folder, "twice", steps=16, stages=2, field="lossless", **WHOLE), quiet=True)
    first, second = (load_trajectory(run.folder.trajectory)[0].offsets for run in (brief, again))
    assert torch.equal(first, second)


def test_refit_changes_only_the_field(brief: RunResult, tmp_path: Path) -> None:
    before = brief.folder.trajectory.read_bytes()
    options = FitOptions(copy_of(brief, tmp_path))
    again = refit(with_values(options, field="separable", threads=1), quiet=True)
    assert again.report["field"]["kind"] == "separable"
    assert read_gdf(again.gdf).field.kind == "separable"
    tried = again.report["choice"]["tried"]
    assert again.report["choice"]["chosen"] in [field["field"] for field in tried]
    assert "the smallest of" in again.report["choice"]["why"]
    assert again.folder.trajectory.read_bytes() == before, "a recording is written once"
    assert again.report["losses"] == brief.report["losses"]
    for stage in ("optimize", "total"):
        assert again.report["time"][stage] == brief.report["time"][stage]


def test_interrupted_run_leaves_the_earlier_edit_intact(
    folder: Path, brief: RunResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = copy_of(brief, tmp_path)
    kept = brief.gdf.read_bytes()
    options = quick_options(folder, out=root, steps=16, stages=2, field="lossless")

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "solve", interrupt)
    with pytest.raises(KeyboardInterrupt, match="with --resume to continue"):
        train(options, quiet=True)
    assert (root / brief.gdf.name).read_bytes() == kept
    assert not [path for path in root.rglob("*") if path.name.startswith(".")]


def test_folder_with_other_files_or_another_edit_is_refused(
    folder: Path, done: RunResult, tmp_path: Path
) -> None:
    (tmp_path / "thesis.txt").write_text("important")
    with pytest.raises(ProgdfError, match="neither empty nor a run"):
        train(replace(quick_options(folder), out=tmp_path), quiet=True)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
    kept = done.gdf.read_bytes()
    with pytest.raises(ProgdfError, match="another editor"):
        train(quick_options(folder, editor="darken:0.5"), quiet=True)
    assert done.gdf.read_bytes() == kept


@pytest.mark.parametrize(
    "arguments",
    [
        "nowhere.ply --out r --region all --editor night",
        "{scene} --out r --region labels:{labels}:99 --editor night",
        "{scene} --out r --region all --editor paint:#fff",
        "{scene} --out r --region all --editor recolor:blue",
        "{scene} --out r --region all --editor night --views 2",
        "{scene} --out r --region all --editor night --steps 3",
        "{scene} --out r --region all --editor night --steps many",
        "{scene} --out r --region all --editor night --image-size 8",
        "{scene} --out r --region all --editor night --name a/b",
        "{scene} --out r --region all --editor night --cameras nowhere.json",
        "{scene} --out {scene} --region all --editor night",
        "{scene} --out r --region all --editor night --color blue",
        "{scene} --out r --region all",
        "--out r",
    ],
)
def test_bad_input_is_a_one_line_error_and_leaves_no_edit(
    folder: Path, tmp_path: Path, arguments: str
) -> None:
    words = arguments.format(scene=folder / "scene.ply", labels=folder / "labels.npy").split()
    words = [str(tmp_path / "r") if word == "r" else word for word in words]
    with pytest.raises(ProgdfError, match=r"; |must be between") as caught:
        cli.train(words)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.rglob("*.gdf"))


def test_edit_without_effect_is_reported_before_training(folder: Path, done: RunResult) -> None:
    originals = done.folder.root / "views" / "original"
    same = {"editor": f"folder:{originals}", "cameras": done.folder.cameras}
    with pytest.raises(ProgdfError, match="changes none of the views; "):
        train(quick_options(folder, "nothing", **same, **WHOLE), quiet=True)


def test_fit_of_a_folder_without_a_run_is_a_one_line_error(tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="progdf train"):
        cli.fit([str(tmp_path)])


def test_command_line_sets_every_given_option(folder: Path) -> None:
    words = (
        f"{folder / 'scene.ply'} --out r --region all --editor night --quick --seed 7 --slider even".split()
    )
    plan = resolve(parse_options(TrainOptions, words, "progdf train"))
    assert (plan.optimize.seed, plan.optimize.slider, plan.name) == (7, "even", "r")
    assert (plan.optimize.steps, plan.views.views) == (240, 12)


def test_single_member_is_enough(folder: Path) -> None:
    labels = np.zeros(1500, dtype=np.uint8)
    scene = load_ply(folder / "scene.ply")
    labels[int(scene.means[:, 1].argmax())] = 1
    np.save(folder / "one.npy", labels)
    options = quick_options(folder, "one", steps=8, stages=1, views=5)
    result = train(with_values(options, region=f"labels:{folder / 'one.npy'}:1"), quiet=True)
    assert len(read_gdf(result.gdf).region) == 1
