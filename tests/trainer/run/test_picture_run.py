"""A run on one changed picture: `progdf train --editor pictures:A.png`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from progdf.compose.reference import Layer, compose_layers
from progdf.errors import ProgdfError
from progdf.formats.ply import load_ply
from progdf.gdf.file import load_gdf
from progdf.io.images import to_picture
from progdf.io.picture_camera import camera_chunk, find_picture_camera
from progdf.metrics.image import decibels
from progdf.region import Region
from progdf.scene.regions import parse_region
from tests.helpers.trained import quick_options, train
from trainer.editors import make_editor
from trainer.evaluate.command import evaluate
from trainer.options import EditorOptions, EvaluateOptions, TrainingViewOptions, with_values
from trainer.report.measures import PaintReproduction, measure_paint
from trainer.run.run import RunResult
from trainer.setup import make_training_setup
from trainer.views.view import View, render_view

SPEC = "recolor:#3060d0"


@pytest.fixture(scope="module")
def views(folder: Path) -> tuple[View, ...]:
    """Views of the bear's region, the first of which is the picture's."""
    scene, region = bear(folder)
    setup = make_training_setup(TrainingViewOptions(views=12, image_size=96), scene, region)
    return tuple(setup.views)


def bear(folder: Path) -> tuple:  # type: ignore[type-arg]
    scene = load_ply(folder / "scene.ply")
    return scene, parse_region(quick_options(folder).region.region, scene)


@pytest.fixture(scope="module")
def picture(folder: Path, views: tuple[View, ...]) -> Path:
    """The first view, recolored, as a .png that carries its camera."""
    scene, region = bear(folder)
    edited = make_editor(EditorOptions(SPEC), scene, region, views).edit(views[0], 1.0)
    to_picture(edited).save(folder / "A.png", pnginfo=camera_chunk(views[0].camera))
    return folder / "A.png"


@pytest.fixture(scope="module")
def done(folder: Path, picture: Path) -> RunResult:
    options = with_values(quick_options(folder), out=folder / "one", editor=f"pictures:{picture}", name="")
    return train(options, quiet=True)


def test_other_sides_follow_a_fill_from_one_picture(
    folder: Path, done: RunResult, views: tuple[View, ...]
) -> None:
    scene, region = bear(folder)
    edited = compose_layers(scene, [Layer(load_gdf(done.gdf, scene), 1.0)])
    truth = make_editor(EditorOptions(SPEC), scene, region, views)
    for view in views[1:]:
        shown = render_view(edited, view.camera, torch.ones(3)).clamp(0, 1)
        counts = view.mask > 0.05
        error = decibels(float((shown - truth.edit(view, 1.0))[counts].square().mean()))
        unedited = decibels(float((view.image - truth.edit(view, 1.0))[counts].square().mean()))
        assert error > unedited + 6.0  # 7.5 at the least when written


def test_the_report_says_that_nothing_was_held_out(done: RunResult) -> None:
    views = done.report["views"]
    assert views["held_out"] is False
    assert views["edit"] == ["A"]
    log = done.folder.log.read_text()
    assert "no view is held out: all figures are of the views that were trained on" in log
    assert "the views trained on: " in log
    assert json.loads(done.folder.report.read_text())["trajectory"]["slider"] == "even"


def test_a_fill_that_took_is_reported_without_a_warning(done: RunResult) -> None:
    assert done.report["paint"]["reached"] > 0.9
    assert done.report["paint"]["warning"] == ""
    log = done.folder.log.read_text()
    assert "warning:" not in log
    assert "% of the paint was reproduced" in log.splitlines()[-1]


@pytest.mark.parametrize("background", [(1.0, 1.0, 1.0), (0.1, 0.2, 0.4)])
@pytest.mark.parametrize("all_of_it", [False, True])
def test_painting_a_thing_away_is_said_to_remove_nothing(
    folder: Path, background: tuple[float, float, float], all_of_it: bool
) -> None:
    scene, region = bear(folder)
    setup = make_training_setup(TrainingViewOptions(views=6, image_size=96), scene, region)
    others = torch.ones(len(scene), dtype=torch.bool).index_fill(0, region.members, False)
    # all of it: with what the members hide, which are then less than was painted away
    left = scene[:0] if all_of_it else scene[others.nonzero()[:, 0]]
    behind = torch.tensor(background)
    painted = [
        view.image
        + render_view(left, view.camera, behind).clamp(0, 1)
        - render_view(scene, view.camera, behind).clamp(0, 1)
        for view in setup.train
    ]
    found = measure_paint(setup, painted, [behind] * len(painted), scene)
    assert found.reached == pytest.approx(0.0, abs=0.01)
    assert found.warning.startswith("0 % of the paint was reproduced: the paint shows the background")
    assert "painting removes nothing" in found.warning
    originals = [view.image for view in setup.train]
    kept = measure_paint(setup, originals, [behind] * len(painted), scene)
    assert (kept.pixels, kept.warning) == (0, "")


@pytest.mark.parametrize("color", [(0.9, 0.9, 0.9), (0.8, 0.1, 0.1)])
def test_a_thing_painted_in_a_color_of_its_own_is_not_told_as_removed(
    folder: Path, color: tuple[float, float, float]
) -> None:
    scene, region = bear(folder)
    setup = make_training_setup(TrainingViewOptions(views=6, image_size=96), scene, region)
    painted = [
        torch.where(view.mask[..., None] > 0.5, torch.tensor(color), view.image) for view in setup.train
    ]
    assert not measure_paint(setup, painted, [setup.background] * len(painted), scene).removes


def test_what_saving_does_beside_the_members_is_not_counted_as_painted(folder: Path) -> None:
    scene, region = bear(folder)
    setup = make_training_setup(TrainingViewOptions(views=6, image_size=96), scene, region)
    noise = torch.rand(96, 96, 3, generator=torch.Generator().manual_seed(0)) * 0.04
    saved = [torch.where(view.mask[..., None] > 0.5, view.image, view.image - noise) for view in setup.train]
    assert measure_paint(setup, saved, [setup.background] * len(saved), scene).pixels == 0


def test_detail_finer_than_the_splats_is_said_with_both_counts() -> None:
    assert PaintReproduction(0.37, 0.2, 2074, 457, False).warning == (
        "37 % of the paint was reproduced: 457 Gaussians for 2 074 painted pixels; "
        "the detail is finer than the Gaussians"
    )


def test_a_faint_paint_warns_where_the_larger_part_is_missing() -> None:
    assert PaintReproduction(0.49, 0.01, 100, 90, False).warning
    assert not PaintReproduction(0.51, 0.01, 100, 90, False).warning


def test_the_way_is_neither_gray_nor_raw(done: RunResult) -> None:
    assert len(done.trajectory) > 4  # straight in OKLab, not two keyframes
    assert done.report["slider"]["uniformity"] > 0.7


def test_such_a_run_can_be_evaluated(done: RunResult, capsys: pytest.CaptureFixture[str]) -> None:
    evaluate(EvaluateOptions(done.folder.root))
    said = capsys.readouterr().out
    assert "no other view shares enough pixels with a held-out view" in said
    assert "to the run's own pictures, trained on, at 1, PSNR" in said


def test_a_finished_run_of_another_picture_is_not_taken_for_this_one_s(
    folder: Path, done: RunResult, picture: Path
) -> None:
    options = with_values(quick_options(folder), out=folder / "one", editor=f"pictures:{picture}", name="")
    assert train(replace(options, resume=True), quiet=True).gdf == done.gdf
    was = picture.read_bytes()
    try:
        to_picture(torch.ones(96, 96, 3)).save(picture, pnginfo=camera_chunk(find_picture_camera(picture)))
        with pytest.raises(
            ProgdfError, match=r"A\.png has changed since .* leave out --resume to train again"
        ):
            train(replace(options, resume=True), quiet=True)
    finally:
        picture.write_bytes(was)


def test_a_picture_without_camera_is_refused_before_the_scene_is_read(folder: Path) -> None:
    to_picture(torch.ones(8, 8, 3)).save(folder / "bare.png")
    options = with_values(
        quick_options(folder), out=folder / "bare", editor=f"pictures:{folder / 'bare.png'}"
    )
    with pytest.raises(ProgdfError, match="has no stored camera"):
        train(options, quiet=True)
    assert not (folder / "bare").exists()


def test_a_picture_that_does_not_show_the_region_is_one_line(folder: Path, picture: Path) -> None:
    scene, region = bear(folder)
    away = Region("nothing there", region.members, region.score)
    far = replace(scene, means=scene.means + 1e4)
    with pytest.raises(ProgdfError, match="does not show the region 'nothing there'; leave it out"):
        make_training_setup(TrainingViewOptions(pictures=(picture,)), far, away)
