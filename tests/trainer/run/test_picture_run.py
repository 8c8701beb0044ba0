"""Run on one changed picture: `progdf train --editor pictures:A.png`."""

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
from trainer.views.setup import make_training_setup
from trainer.views.view import View, render_view

SPEC = "recolor:#3060d0"


@pytest.fixture(scope="module")
def views(folder: Path) -> tuple[View, ...]:
    """Return views of the bear's region; the first belongs to the picture."""
    scene, region = bear(folder)
    setup = make_training_setup(TrainingViewOptions(views=12, image_size=96), scene, region)
    return tuple(setup.views)


def bear(folder: Path) -> tuple:  # type: ignore[type-arg]
    scene = load_ply(folder / "scene.ply")
    return scene, parse_region(quick_options(folder).region.region, scene)


@pytest.fixture(scope="module")
def picture(folder: Path, views: tuple[View, ...]) -> Path:
    """Save the first view, recolored, as a .png with its camera; return the path."""
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
        assert error > unedited + 6.0  # at least 7.5 when written


def test_report_states_that_no_view_was_held_out(done: RunResult) -> None:
    views = done.report["views"]
    assert views["held_out"] is False
    assert views["edit"] == ["A"]
    log = done.folder.log.read_text()
    assert "no view is held out; all figures are measured on the training views" in log
    assert "training views: " in log
    assert json.loads(done.folder.report.read_text())["trajectory"]["slider"] == "even"


def test_reproduced_fill_is_reported_without_a_warning(done: RunResult) -> None:
    assert done.report["paint"]["reached"] > 0.9
    assert done.report["paint"]["warning"] == ""
    log = done.folder.log.read_text()
    assert "warning:" not in log
    assert "% of the paint was reproduced" in log


@pytest.mark.parametrize("background", [(1.0, 1.0, 1.0), (0.1, 0.2, 0.4)])
@pytest.mark.parametrize("all_of_it", [False, True])
def test_painting_an_object_away_warns_that_nothing_is_removed(
    folder: Path, background: tuple[float, float, float], all_of_it: bool
) -> None:
    scene, region = bear(folder)
    setup = make_training_setup(TrainingViewOptions(views=6, image_size=96), scene, region)
    others = torch.ones(len(scene), dtype=torch.bool).index_fill(0, region.members, False)
    # `all_of_it` also paints away what the members hide, which is more than the members
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
def test_object_painted_in_another_color_is_not_reported_as_removed(
    folder: Path, color: tuple[float, float, float]
) -> None:
    scene, region = bear(folder)
    setup = make_training_setup(TrainingViewOptions(views=6, image_size=96), scene, region)
    painted = [
        torch.where(view.mask[..., None] > 0.5, torch.tensor(color), view.image) for view in setup.train
    ]
    assert not measure_paint(setup, painted, [setup.background] * len(painted), scene).removes


def test_noise_beside_the_members_is_not_counted_as_paint(folder: Path) -> None:
    scene, region = bear(folder)
    setup = make_training_setup(TrainingViewOptions(views=6, image_size=96), scene, region)
    noise = torch.rand(96, 96, 3, generator=torch.Generator().manual_seed(0)) * 0.04
    saved = [torch.where(view.mask[..., None] > 0.5, view.image, view.image - noise) for view in setup.train]
    assert measure_paint(setup, saved, [setup.background] * len(saved), scene).pixels == 0


def test_detail_finer_than_the_gaussians_is_reported_with_counts() -> None:
    assert PaintReproduction(0.37, 0.2, 2074, 457, False).warning == (
        "37 % of the paint was reproduced: 457 Gaussians for 2 074 painted pixels; "
        "the detail is finer than the Gaussians"
    )


def test_loss_of_a_tenth_is_a_success_with_its_reason() -> None:
    done = PaintReproduction(0.98, 0.08, 2074, 457, False)
    assert done.warning == ""
    assert done.summary.startswith("98 % of the paint was reproduced: 457 Gaussians")
    assert PaintReproduction(0.89, 0.08, 2074, 457, False).warning
    assert PaintReproduction(0.98, 0.01, 2074, 457, True).warning, "what should be removed is still there"


def test_weak_paint_warns_if_most_of_it_is_missing() -> None:
    assert PaintReproduction(0.49, 0.01, 100, 90, False).warning
    assert not PaintReproduction(0.51, 0.01, 100, 90, False).warning


def test_path_of_a_picture_edit_is_even_and_not_two_keyframes(done: RunResult) -> None:
    assert len(done.trajectory) > 4  # straight in OKLab, not two keyframes
    assert done.report["slider"]["uniformity"] > 0.7


def test_picture_run_can_be_evaluated(done: RunResult, capsys: pytest.CaptureFixture[str]) -> None:
    evaluate(EvaluateOptions(done.folder.root))
    output = capsys.readouterr().out
    assert "no other view shares enough pixels with a held-out view" in output
    assert "to the run's own pictures, trained on, at 1, PSNR" in output


def test_finished_run_of_another_picture_is_not_reused(folder: Path, done: RunResult, picture: Path) -> None:
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


def test_picture_without_camera_is_refused_before_the_scene_is_read(folder: Path) -> None:
    to_picture(torch.ones(8, 8, 3)).save(folder / "bare.png")
    options = with_values(
        quick_options(folder), out=folder / "bare", editor=f"pictures:{folder / 'bare.png'}"
    )
    with pytest.raises(ProgdfError, match="has no stored camera"):
        train(options, quiet=True)
    assert not (folder / "bare").exists()


def test_picture_that_does_not_show_the_region_is_refused(folder: Path, picture: Path) -> None:
    scene, region = bear(folder)
    away = Region("nothing there", region.members, region.score)
    far = replace(scene, means=scene.means + 1e4)
    with pytest.raises(ProgdfError, match="does not show the region 'nothing there'; leave it out"):
        make_training_setup(TrainingViewOptions(pictures=(picture,)), far, away)
