"""Texture that continues into a hole: its sources, its seams, and the choice of the fill."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.gaussians import Gaussians, concatenate
from progdf.metrics.image import decibels
from progdf.quaternions import matrix_quats
from progdf.region import from_mask
from progdf.sh import rgb_to_sh0
from trainer.fill import holes, texture
from trainer.fill.ground import view_ground
from trainer.fill.holes import Fill, fill_holes, find_holes
from trainer.fill.membrane import membrane
from trainer.fill.texture import (
    VISIBLE_CONTRAST,
    can_continue_texture,
    continue_texture,
    texture_contrast,
)
from trainer.options import TrainingViewOptions
from trainer.views.setup import TrainingSetup, make_training_setup
from trainer.views.view import render_view

WHITE = torch.ones(3)
needs_extra = pytest.mark.skipif(not can_continue_texture(), reason="needs the extra fill (OpenCV contrib)")


def dots(height: int, width: int, period: float = 12.0, tone: float = 0.0) -> Tensor:
    """Return a picture of dark dots on cloth whose tone changes across it. [H,W,3]"""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    wave = (2 * np.pi * x / period).sin() * (2 * np.pi * y / period).sin()
    light = 0.7 - 0.5 * (6 * (wave - 0.4)).sigmoid()
    change = tone * (x / width - 0.5)
    return torch.stack([light + change, light, light - change], dim=2).clamp(0.0, 1.0)


def middle_hole(height: int, width: int) -> np.ndarray:
    hole = np.zeros((height, width), bool)
    hole[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3] = True
    return hole


def smooth_fill(image: Tensor, hole: np.ndarray) -> Tensor:
    return membrane(image, torch.from_numpy(texture.area_to_fill(hole, ~hole)))


def test_contrast_separates_flat_grounds_from_textured_ones() -> None:
    hole = middle_hole(90, 120)
    y, x = torch.meshgrid(torch.linspace(0, 1, 90), torch.linspace(0, 1, 120), indexing="ij")
    shaded = torch.stack([0.4 + 0.2 * x, 0.5 + 0.1 * y, 0.4 + 0.1 * x], dim=2)
    assert texture_contrast(shaded, hole, ~hole) < VISIBLE_CONTRAST
    assert texture_contrast(dots(90, 120), hole, ~hole) > 3 * VISIBLE_CONTRAST
    assert texture_contrast(shaded, np.ones((90, 120), bool), np.zeros((90, 120), bool)) == 0.0


def test_sources_of_copied_pixels_are_recovered() -> None:
    random = np.random.default_rng(0)
    lab = random.integers(0, 255, (40, 60, 3), dtype=np.uint8)
    filled = np.zeros((40, 60), bool)
    filled[10:30, 20:30] = True
    copied = lab.copy()
    copied[10:30, 20:25] = lab[10:30, 5:10]
    copied[10:30, 25:30] = lab[8:28, 45:50]
    source = texture._recover_sources(copied, lab, filled, ~filled)
    rows, columns = np.nonzero(filled)
    left = columns < 25
    expected_rows = np.where(left, rows, rows - 2)
    expected_columns = np.where(left, columns - 15, columns + 20)
    assert (source[0][filled] == expected_rows).mean() > 0.99
    assert (source[1][filled] == expected_columns).mean() > 0.99


def test_seam_solve_keeps_differences_and_removes_a_tone_step() -> None:
    truth = dots(40, 60, tone=0.2).double().numpy()
    filled = np.zeros((40, 60), bool)
    filled[8:32, 24:48] = True
    source = np.full((2, 40, 60), -1)
    rows, columns = np.nonzero(filled)
    source[0][filled] = rows
    source[1][filled] = np.where(columns < 40, columns - 24, columns + 12)  # one or two periods away
    colors = truth.copy()
    colors[filled] = truth[source[0][filled], source[1][filled]]
    step = np.abs(colors - truth)[filled].mean()
    solved = texture._remove_seams(colors, filled, ~filled, source)
    assert np.array_equal(solved[~filled], truth[~filled])
    assert np.abs(solved - truth)[filled].mean() < 0.25 * step


@needs_extra
def test_texture_continues_nearer_to_the_truth_than_a_membrane() -> None:
    truth = dots(96, 132, tone=0.1)
    hole = middle_hole(96, 132)
    image = truth.clone()
    image[torch.from_numpy(hole)] = torch.tensor([1.0, 0.0, 1.0])
    filled = continue_texture(image, hole, ~hole)
    smooth = smooth_fill(image, hole)
    errors = [
        decibels(float((one - truth)[torch.from_numpy(hole)].square().mean())) for one in (smooth, filled)
    ]
    assert errors[1] > errors[0] + 6.0
    known = torch.from_numpy(~texture.area_to_fill(hole, ~hole))
    assert torch.equal(filled[known], image[known])


@needs_extra
def test_edge_of_the_hole_is_no_steeper_than_the_texture() -> None:
    truth = dots(96, 132, tone=0.3)
    hole = middle_hole(96, 132)
    image = truth.clone()
    image[torch.from_numpy(hole)] = 0.0
    filled = continue_texture(image, hole, ~hole).mean(dim=2).numpy()
    area = texture.area_to_fill(hole, ~hole)
    across = np.abs(np.diff(filled, axis=1))
    rim = np.diff(area.astype(int), axis=1) != 0
    outside = ndimage.binary_dilation(area, iterations=12) & ~ndimage.binary_dilation(area, iterations=2)
    own = across[outside[:, 1:] & outside[:, :-1]]
    assert across[rim].mean() < 1.3 * own.mean()


@needs_extra
@pytest.mark.parametrize("visible", ["stripes", "rim"])
def test_ground_without_whole_patches_is_filled(visible: str) -> None:
    image = dots(60, 72)
    hole = middle_hole(60, 72)
    known = np.zeros_like(hole)
    known[:, ::2] = True
    if visible == "rim":
        known = ndimage.binary_dilation(hole, iterations=3)
    filled = continue_texture(image, hole, known & ~hole)
    assert bool(filled.isfinite().all())


def splats(means: Tensor, size: float, rgb: Tensor) -> Gaussians:
    """Return opaque discs that lie flat."""
    frame = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    scales = torch.log(torch.tensor([size, size, size / 10])).repeat(len(means), 1)
    return Gaussians(
        means, matrix_quats(frame.repeat(len(means), 1, 1)), scales, torch.full((len(means),), 4.0),
        rgb_to_sh0(rgb), torch.zeros(len(means), 0, 3),
    )  # fmt: skip


@cache
def cloth(has_dots: bool) -> Gaussians:
    line = torch.linspace(-1.2, 1.2, 80)
    x, z = torch.meshgrid(line, line, indexing="ij")
    means = torch.stack([x.flatten(), torch.zeros(x.numel()), z.flatten()], dim=1)
    wave = (18.0 * means[:, 0]).sin() * (18.0 * means[:, 2]).sin()
    light = 0.75 - 0.6 * (6 * (wave - 0.3)).sigmoid() if has_dots else torch.full((len(means),), 0.6)
    rgb = torch.stack([light + 0.1 * means[:, 0], light, light], dim=1)
    return splats(means, 0.02, rgb)


@cache
def case(has_dots: bool) -> tuple[Gaussians, Gaussians, TrainingSetup]:
    """Return a scene with a block on cloth, the cloth with the hole under it, and views."""
    whole = cloth(has_dots)
    rest = whole[whole.means[:, [0, 2]].abs().amax(dim=1) > 0.3]
    line = torch.linspace(-0.33, 0.33, 18)
    a, b = (side.flatten() for side in torch.meshgrid(line, line, indexing="ij"))
    layers = [torch.stack([a, torch.full_like(a, height), b], dim=1) for height in (-0.02, -0.15, -0.3)]
    means = torch.cat(layers)
    block = splats(means, 0.04, torch.tensor([[0.8, 0.2, 0.1]]).repeat(len(means), 1))
    scene = concatenate([rest, block])
    region = from_mask("block", torch.arange(len(scene)) >= len(rest))
    return scene, rest, make_training_setup(TrainingViewOptions(views=10, image_size=96), scene, region)


@cache
def textured_fill() -> Fill:
    scene, rest, setup = case(True)
    return fill_holes(find_holes(scene, rest, setup.train), is_textured=True)


def views_around() -> list[Camera]:
    center = torch.tensor([0.0, 0.0, 0.0])
    places = [(0.1, -2.4, 0.1), (2.0, -1.4, 0.3), (-1.5, -1.0, 1.5), (0.0, -1.2, -2.2), (2.2, -0.5, 1.0)]
    up = torch.tensor([0.0, -1.0, 0.0])
    return [Camera(look_at(torch.tensor(p), center, up), intrinsics(0.6, 96, 96), 96, 96) for p in places]


def hole_error(rows: Gaussians | None) -> list[float]:
    """Return the error in the hole against the whole cloth, from above and from several sides, dB."""
    assert rows is not None
    rest = case(True)[1]
    errors = []
    for camera in views_around():
        truth = render_view(cloth(True), camera, WHITE).clamp(0, 1)
        shown = render_view(concatenate([rest, rows]), camera, WHITE).clamp(0, 1)
        hole = (render_view(rest, camera, WHITE).clamp(0, 1) - truth).abs().amax(dim=2) > 0.05
        errors.append(decibels(float((shown - truth)[hole].square().mean())))
    return errors


@needs_extra
def test_dotted_cloth_continues_under_a_removed_block_from_all_sides() -> None:
    scene, rest, setup = case(True)
    fill = textured_fill()
    assert fill.after < 0.05 * fill.before
    assert any("continued over" in note for note in fill.notes)
    smooth = hole_error(fill_holes(find_holes(scene, rest, setup.train)).rows)
    textured = hole_error(fill.rows)
    assert min(new - old for new, old in zip(textured, smooth, strict=True)) > 1.5, (textured, smooth)


def test_flat_cloth_is_filled_smoothly() -> None:
    scene, rest, setup = case(False)
    fill = fill_holes(find_holes(scene, rest, setup.train), is_textured=True)
    smooth = fill_holes(find_holes(scene, rest, setup.train))
    assert fill.rows is not None
    assert smooth.rows is not None
    assert torch.equal(fill.rows.means, smooth.rows.means)
    assert any("filled smoothly" in note for note in fill.notes)


def test_missing_extra_is_named_and_the_fill_is_smooth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(holes, "can_continue_texture", lambda: False)
    scene, rest, setup = case(True)
    fill = fill_holes(find_holes(scene, rest, setup.train), is_textured=True)
    smooth = fill_holes(find_holes(scene, rest, setup.train))
    assert fill.rows is not None
    assert smooth.rows is not None
    assert torch.equal(fill.rows.sh0, smooth.rows.sh0)
    assert any("progdf-studio[fill]" in note for note in fill.notes)


def test_ground_is_seen_straight_on() -> None:
    scene, rest, setup = case(True)
    seen = [(v.camera, holes.visible_depth(scene, v.camera), v.mask > 0.5) for v in setup.train]
    found = max((holes.find_hole(rest, view, seen) for view in setup.train), key=lambda hole: hole.pixels)
    ground = view_ground(
        rest, found.camera, found.mask, found.inverse_depth, lambda points: torch.ones(len(points)).bool()
    )
    assert ground is not None
    assert ground.name == "a plane"
    assert float(ground.camera.viewmat[2, 1]) > 0.99, "it looks down; y points down"
    x, y = ndimage.center_of_mass(ground.hole)[::-1]
    height, width = ground.hole.shape
    assert abs(x / width - 0.5) < 0.05
    assert abs(y / height - 0.5) < 0.05
    sides = [np.ptp(np.nonzero(ground.hole)[axis]) for axis in (0, 1)]
    assert max(sides) < 1.2 * min(sides)
