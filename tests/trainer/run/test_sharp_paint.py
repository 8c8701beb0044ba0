"""Changed pictures with paint finer than the Gaussians: the remainder of recoloring becomes discs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from progdf.camera import Camera
from progdf.compose.reference import Layer, compose_layers
from progdf.formats.ply import load_ply, save_ply
from progdf.gaussians import Gaussians
from progdf.gdf.file import load_gdf
from progdf.io.images import to_picture
from progdf.io.picture_camera import camera_chunk
from progdf.metrics.image import psnr
from progdf.surface.find import find_surface, orbit
from tests.helpers.edits import bits
from tests.helpers.trained import train
from tests.trainer.painted_wall import CAMERA, letters, paint_on, picture, wall
from trainer.evaluate.command import evaluate
from trainer.options import EditorOptions, EvaluateOptions, RegionOptions, TrainOptions, with_values
from trainer.paint.discs import MIN_ALPHA, PaintedView, composite_over, place_discs, project_paint
from trainer.run.finish import RunResult
from trainer.run.paint import DiscLayout, PaintGoal, choose_discs, lay_discs, make_goal
from trainer.views.view import BACKGROUND, render_view


def save(folder: Path, name: str, image: torch.Tensor, camera: Camera = CAMERA) -> Path:
    to_picture(image).save(folder / f"{name}.png", pnginfo=camera_chunk(camera))
    return folder / f"{name}.png"


def options(folder: Path, pictures: Path, out: str) -> TrainOptions:
    plain = TrainOptions(
        folder / "wall.ply", folder / out, RegionOptions("changed"), EditorOptions(f"pictures:{pictures}")
    )
    return with_values(plain, threads=1)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wall")
    save_ply(folder / "wall.ply", wall())
    return folder


@pytest.fixture(scope="module")
def lettered(place: Path) -> RunResult:
    image = letters(load_ply(place / "wall.ply")).picture
    return train(options(place, save(place, "letters", image), "lettered"), quiet=True)


def test_letters_on_a_picture_are_as_sharp_as_painted(place: Path, lettered: RunResult) -> None:
    scene = load_ply(place / "wall.ply")
    gdf = load_gdf(lettered.gdf, scene)
    assert gdf.added is not None
    paint = letters(scene)
    assert psnr(picture(compose_layers(scene, [Layer(gdf, 1.0)])), paint.picture, paint.mask) > 32.0
    assert bits(compose_layers(scene, [Layer(gdf, 0.0)])[: len(scene)]) == bits(scene)
    log = lettered.folder.log.read_text()
    assert "painted pixels are finer than the Gaussians" in log
    assert " from the sides: added" in log
    assert "warning" not in log
    assert lettered.report["edit"]["psnr_to_views"] > 30.0


def test_run_with_discs_is_measured_as_shipped(lettered: RunResult) -> None:
    (found,) = evaluate(EvaluateOptions(lettered.folder.root))
    assert found.curves["slider"].psnr[-1] == pytest.approx(lettered.report["edit"]["psnr_to_views"], abs=0.1)


def test_run_stopped_at_its_discs_resumes_to_the_same_bits(
    place: Path, lettered: RunResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    again = options(place, place / "letters.png", "stopped")
    again = with_values(again, name="lettered")
    with monkeypatch.context() as patch:
        patch.setattr("trainer.run.finish.sharpen", stop)
        with pytest.raises(KeyboardInterrupt):
            train(again, quiet=True)
    resumed = train(replace(again, resume=True), quiet=True)
    assert resumed.gdf.read_bytes() == lettered.gdf.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("fills", [True, False])
def test_fill_below_discs_stays_and_gaps_between_letters_are_restored(
    place: Path, fills: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Keep the base that matches the picture beside the sharp paint; the sides show it below the paint."""
    bases = list[Gaussians]()

    def choose(goal: PaintGoal, *rest: Any) -> DiscLayout:
        bases.append(goal.scene)
        return choose_discs(goal, *rest)

    monkeypatch.setattr("trainer.run.paint.choose_discs", choose)
    scene = load_ply(place / "wall.ply")
    image = letters(scene).picture
    if fills:
        rows, columns = torch.meshgrid(*(torch.arange(n) for n in image.shape[:2]), indexing="ij")
        image = torch.where(
            (columns > 50 + rows // 8 % 2 * 8)[..., None], 0.3 * picture(scene), picture(scene)
        )
    name = "fill" if fills else "letters"
    done = train(options(place, save(place, f"{name}_below", image), f"{name}_below"), quiet=True)
    monkeypatch.setattr("trainer.run.finish.sharpen", lambda *_: None)
    plain = train(options(place, place / f"{name}_below.png", f"{name}_plain"), quiet=True)
    assert load_gdf(done.gdf, scene).added is not None
    recolored = compose_layers(scene, [Layer(load_gdf(plain.gdf, scene), 1.0)])
    assert (float((bases[0].sh0 - recolored.sh0).abs().max()) < 1e-4) is fills


@pytest.mark.slow
def test_change_reproduced_by_recoloring_adds_nothing(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_ply(place / "wall.ply")
    colors = scene.sh0 - 0.5 * torch.exp(-4 * scene.means.square().sum(dim=1, keepdim=True))
    image = save(place, "shade", picture(replace(scene, sh0=colors)))
    done = train(with_values(options(place, image, "shaded"), name="shade"), quiet=True)
    assert "finer than" not in done.folder.log.read_text()
    monkeypatch.setattr("trainer.run.finish.sharpen", lambda *_: None)
    plain = train(with_values(options(place, image, "plain"), name="shade"), quiet=True)
    assert done.gdf.read_bytes() == plain.gdf.read_bytes()


@pytest.mark.slow
def test_discs_that_are_worse_from_the_sides_are_not_added(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lift(scene: Gaussians, paint: object, *rest: object) -> object:
        discs = place_discs(scene, paint, *rest)  # type: ignore[arg-type]
        toward = 0.2 * (CAMERA.position - discs.added.means)
        return replace(discs, added=replace(discs.added, means=discs.added.means + toward))

    monkeypatch.setattr("trainer.run.paint.place_discs", lift)
    done = train(options(place, save(place, "lifted", letters(wall()).picture), "lifted"), quiet=True)
    assert " from the sides: not added" in done.folder.log.read_text()
    assert load_gdf(done.gdf, load_ply(place / "wall.ply")).added is None


@pytest.mark.slow
def test_two_pictures_of_one_stripe_share_one_set_of_rows() -> None:
    scene = wall(rough=0.01)
    stripe = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    stripe[40:90, 58:66] = True
    first = paint_on(scene, stripe)
    camera = orbit(CAMERA, torch.zeros(3), 20.0)
    seen = project_paint(scene, first.surface, first.drawn, camera)
    image = composite_over(render_view(scene, camera, torch.tensor(BACKGROUND)).clamp(0, 1), seen)
    surface = find_surface(scene, camera, (seen[..., 3] > MIN_ALPHA).numpy())
    second = PaintedView(camera, image, seen, surface)
    alone, both = (lay_discs(make_goal(scene, paints), 4.0) for paints in ([first], [first, second]))
    assert len(both.added) <= 1.05 * len(alone.added)
    other = torch.zeros_like(stripe)
    other[40:90, 30:38] = True
    apart = lay_discs(make_goal(scene, [first, paint_on(scene, other)]), 4.0)
    assert len(apart.added) > 1.8 * len(alone.added)
    for paint in (first, second):
        shown = render_view(both.end, paint.camera, torch.tensor(BACKGROUND)).clamp(0, 1)
        assert psnr(shown, paint.picture, paint.mask) > 26.0
