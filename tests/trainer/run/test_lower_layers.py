"""Edits painted over other layers: only the paint is trained, and the lower layers stay as they are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.compose.layers import Layer
from progdf.compose.picture_layers import compose_picture, find_layer_files, open_picture_layers
from progdf.compose.reference import compose_layers
from progdf.errors import ProgdfError
from progdf.field.separable import course_field
from progdf.formats.ply import load_ply, save_ply
from progdf.gaussians import BASE_CHANNELS, ZERO, Gaussians
from progdf.gdf.anchors import free_anchors
from progdf.gdf.file import ADDED_LOGIT, Gdf, fingerprint, load_gdf, save_gdf
from progdf.io.images import to_picture
from progdf.io.picture_camera import (
    PictureLayer,
    PictureLayers,
    camera_chunk,
    find_picture_camera,
    layers_in_picture,
    save_picture_camera,
)
from progdf.io.session import sha256
from progdf.metrics.image import psnr
from progdf.region import from_mask
from tests.helpers.edits import bits
from tests.helpers.trained import train
from tests.trainer.painted_wall import CAMERA, SIDE, picture, wall
from trainer.options import EditorOptions, RegionOptions, TrainOptions, with_values
from trainer.run.finish import RunResult
from trainer.run.record import reopen_run
from trainer.views.lower_layers import open_lower_layers

STRENGTH = 0.6
SOFT = (slice(40, 90), slice(40, 90))  # pixels with the new paint


def left_half(scene: Gaussians, change: torch.Tensor, name: str) -> Gdf:
    """Return an edit of the wall's left half by the same packed change everywhere. [14]"""
    mask = scene.means[:, 0] > 0.0
    region = from_mask(name, mask)
    offsets = torch.zeros(2, len(region), BASE_CHANNELS)
    offsets[1] = change
    return Gdf(name, region, course_field(torch.tensor([0.0, 1.0]), offsets), fingerprint(scene))


def blue(scene: Gaussians) -> Gdf:
    change = torch.zeros(BASE_CHANNELS)
    change[11:14] = torch.tensor([-1.8, -1.0, 0.9])
    return left_half(scene, change, "blue")


def layers_of(path: Path, strength: float = STRENGTH, blend: str = "adjust") -> PictureLayers:
    return PictureLayers(blend, (PictureLayer(path.stem, path.name, sha256(path), strength),))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wall")
    scene = wall()
    save_ply(folder / "wall.ply", scene)
    save_gdf(folder / "blue.gdf", blue(scene))
    return folder


def paint(place: Path, name: str, layers: PictureLayers) -> Path:
    """Save the wall as seen with its layers, and a soft red square painted on it."""
    seen = see(place, layers)
    image = picture(seen)
    soft = torch.zeros(SIDE, SIDE)
    soft[SOFT] = 0.8
    image = torch.lerp(image, torch.tensor([0.8, 0.2, 0.1]), soft[..., None])
    to_picture(image).save(place / f"{name}.png", pnginfo=camera_chunk(CAMERA, ["blue"], layers=layers))
    return place / f"{name}.png"


def see(place: Path, layers: PictureLayers, further: Gdf | None = None) -> Gaussians:
    scene = load_ply(place / "wall.ply")
    files = find_layer_files(layers, place / "A.png", place / "wall.ply")
    return compose_picture(scene, open_picture_layers(layers, files, scene, "wall"), layers.blend, further)


def options(place: Path, path: Path, out: str) -> TrainOptions:
    region = RegionOptions("changed")
    plain = TrainOptions(place / "wall.ply", place / out, region, EditorOptions(f"pictures:{path}"))
    return with_values(plain, threads=1, image_size=96)


@pytest.fixture(scope="module")
def done(place: Path) -> RunResult:
    layers = layers_of(place / "blue.gdf")
    return train(options(place, paint(place, "A", layers), "red"), quiet=True)


def test_paint_over_a_layer_shows_the_picture_above_it(place: Path, done: RunResult) -> None:
    layers = layers_of(place / "blue.gdf")
    gdf = load_gdf(done.gdf, load_ply(place / "wall.ply"))
    target = picture(see(place, layers))
    soft = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    soft[SOFT] = True
    shown = picture(see(place, layers, gdf))
    assert psnr(shown, target, ~soft) > 34.0, "the lower layer stays"
    painted = torch.lerp(target, torch.tensor([0.8, 0.2, 0.1]), 0.8)
    assert psnr(shown, painted, soft) > 26.0
    assert psnr(target, painted, soft) < 12.0
    figures = done.report["lower_layers"]
    assert figures["strengths"] == {"blue": STRENGTH}
    assert figures["psnr"]["painted"] > 26.0
    assert f"the pictures show blue {STRENGTH:g}: only the difference" in done.folder.log.read_text()


def test_new_edit_at_zero_leaves_the_lower_layers_bit_for_bit(place: Path, done: RunResult) -> None:
    scene = load_ply(place / "wall.ply")
    lower = load_gdf(place / "blue.gdf", scene)
    gdf = load_gdf(done.gdf, scene)
    below = compose_layers(scene, [Layer(lower, STRENGTH)], "adjust")
    both = compose_layers(scene, [Layer(lower, STRENGTH), Layer(gdf, 0.0)], "adjust")
    assert bits(both[: len(scene)]) == bits(below)


@pytest.mark.parametrize("blend", ["adjust", "over", "sum"])
def test_rebased_color_edit_gives_the_trained_colors(place: Path, blend: str) -> None:
    layers = layers_of(place / "blue.gdf", blend=blend)
    lower = open_lower_layers([paint(place, blend, layers)], place / "wall.ply", load_ply(place / "wall.ply"))
    assert lower is not None
    generator = torch.Generator().manual_seed(3)
    region = from_mask("new", lower.base.means[:, 1] > -0.5)
    offsets = torch.zeros(2, len(region), BASE_CHANNELS)
    sizes = torch.rand(len(region), 1, generator=generator)
    offsets[1, :, 11:] = 2.0 * sizes * torch.randn(len(region), 3, generator=generator)
    field = course_field(torch.tensor([0.0, 1.0]), offsets)
    trained = Gdf("new", region, field, fingerprint(lower.base))
    expected = compose_layers(lower.base, [Layer(trained)])
    found = lower.compose(lower.rebase(trained))
    error = (found.sh0 - expected.sh0).abs()
    assert float(error.max()) < 0.05
    assert float(error.mean()) < 3e-4
    assert torch.equal(found.means, expected.means)


@pytest.mark.slow
def test_paint_on_a_moved_object_is_where_it_was_painted(place: Path) -> None:
    scene = load_ply(place / "wall.ply")
    change = torch.zeros(BASE_CHANNELS)
    change[:3] = torch.tensor([0.0, 0.3, -0.4])
    save_gdf(place / "moved.gdf", left_half(scene, change, "moved"))
    layers = layers_of(place / "moved.gdf", 1.0)
    seen = see(place, layers)
    image = picture(seen)
    image[50:78, 85:105] = torch.tensor([0.1, 0.15, 0.5])
    image[50:78, 92:97] = torch.tensor([0.9, 0.85, 0.1])
    path = place / "M.png"
    to_picture(image).save(path, pnginfo=camera_chunk(CAMERA, layers=layers))
    found = train(options(place, path, "bars"), quiet=True)
    gdf = load_gdf(found.gdf, scene)
    assert gdf.added is not None
    bars = (image - picture(seen)).abs().amax(dim=2) > 0.02
    assert psnr(picture(see(place, layers, gdf)), image, bars) > 28.0
    home = compose_layers(scene, [Layer(gdf)])
    assert psnr(picture(home), image, bars) < 20.0, "the paint goes home with the object"


@pytest.mark.slow
def test_brushed_paint_covers_seen_layers_and_leaves_them(place: Path) -> None:
    scene = load_ply(place / "wall.ply")
    red = brush(place, "first", layers_of(place / "blue.gdf"), (200, 30, 40, 255), (slice(52, 76),) * 2)
    shown = PictureLayers("adjust", (*layers_of(place / "blue.gdf").layers, *layers_of(red, 0.7).layers))
    upper = brush(place, "second", shown, (30, 160, 60, 128), (slice(64, 90),) * 2)
    below = picture(see(place, shown))
    expected = below.clone()
    inside = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    inside[64:90, 64:90] = True
    expected[inside] = torch.lerp(below[inside], torch.tensor([30.0, 160.0, 60.0]) / 255.0, 128 / 255)
    found = picture(see(place, shown, load_gdf(upper, scene)))
    assert psnr(found, expected, inside) > 30.0
    assert psnr(found, below, ~inside) > 38.0, "the lower layers stay"


def brush(
    place: Path, name: str, layers: PictureLayers, color: tuple[int, ...], box: tuple[slice, ...]
) -> Path:
    """Train a rectangle of paint over layers; return its edit, beside the scene."""
    pixels = np.zeros((SIDE, SIDE, 4), np.uint8)
    pixels[box] = color
    path = place / f"{name}.png"
    Image.fromarray(pixels).save(path, pnginfo=camera_chunk(CAMERA, layers=layers))
    command = TrainOptions(
        place / "wall.ply", place / name, RegionOptions("sphere:0,0,0,9"), EditorOptions(f"paint:{path}")
    )
    edit = train(with_values(command, threads=1), quiet=True).gdf
    return edit.rename(place / edit.name)


def test_colors_that_make_way_for_discs_leave_lower_colors_whole(place: Path) -> None:
    layers = layers_of(place / "blue.gdf")
    lower = open_lower_layers([paint(place, "way", layers)], place / "wall.ply", load_ply(place / "wall.ply"))
    assert lower is not None
    region = from_mask("new", lower.base.means[:, 1] > -0.5)
    offsets = torch.zeros(2, len(region) + 1, BASE_CHANNELS)
    offsets[1, :, 11:] = 0.2
    anchors = replace(free_anchors(1), pushes=frozenset({"geometry", "opacity", "color"}))
    field = course_field(torch.tensor([0.0, 1.0]), offsets)
    base = lower.base
    added = replace(base[:1], logit_opacities=torch.full((1,), ADDED_LOGIT))
    edit = Gdf("new", region, field, fingerprint(base), added=added, anchors=anchors)
    change = lower.compose(lower.rebase(edit)).sh0[: len(base)] - base.sh0
    expected = torch.zeros_like(change)
    expected[region.members] = 0.2
    assert torch.allclose(change, expected, atol=1e-4)


def test_missing_or_changed_layer_is_refused_by_name(place: Path, tmp_path: Path) -> None:
    layers = layers_of(place / "blue.gdf")
    path = paint(place, "B", layers)
    alone = tmp_path / "wall.ply"
    alone.write_bytes((place / "wall.ply").read_bytes())
    picture_file = tmp_path / "B.png"
    picture_file.write_bytes(path.read_bytes())
    command = replace(options(place, picture_file, "none"), scene=alone, out=tmp_path / "none")
    with pytest.raises(ProgdfError, match=r"B\.png shows layers whose files are missing: blue \(blue\.gdf\)"):
        train(command)
    (tmp_path / "blue.gdf").write_bytes(b"another")
    with pytest.raises(ProgdfError, match=r"B\.png shows other versions of .*blue\.gdf"):
        train(command)
    assert not (tmp_path / "none").exists()
    (tmp_path / "blue.gdf").write_bytes((place / "blue.gdf").read_bytes())
    assert find_layer_files(layers, picture_file, alone) == [tmp_path / "blue.gdf"]


def test_pictures_with_different_strengths_are_refused(place: Path) -> None:
    first = paint(place, "C", layers_of(place / "blue.gdf"))
    second = paint(place, "D", layers_of(place / "blue.gdf", 0.2))
    with pytest.raises(ProgdfError, match=r"D\.png shows blue 0\.2, .*C\.png shows blue 0\.6; take"):
        open_lower_layers([first, second], place / "wall.ply", load_ply(place / "wall.ply"))


def test_layers_survive_a_program_that_drops_the_metadata(place: Path, tmp_path: Path) -> None:
    layers = layers_of(place / "blue.gdf")
    path = tmp_path / "A.png"
    to_picture(torch.zeros(8, 8, 3)).save(path, pnginfo=camera_chunk(CAMERA, ["blue"], layers=layers))
    assert layers_in_picture(path) == layers
    save_picture_camera(path, CAMERA, ZERO, layers)
    to_picture(torch.ones(8, 8, 3)).save(path)
    assert layers_in_picture(path) == layers
    assert torch.equal(find_picture_camera(path).viewmat, CAMERA.viewmat)
    save_picture_camera(path, CAMERA, ZERO)
    assert layers_in_picture(path) is None


def test_run_over_layers_cannot_be_fitted_alone(done: RunResult) -> None:
    with pytest.raises(ProgdfError, match=r"was trained over other layers \(blue 0\.6\)"):
        reopen_run(done.folder.root)
