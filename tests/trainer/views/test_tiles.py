"""Tiles that an edit cannot change are not redrawn; picture and gradients stay bit-identical."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from progdf.gaussians import Gaussians, pack
from progdf.rasterize import ActivatedGaussians, render
from progdf.rasterize.cpu.forward import TILE_H, TILE_W
from tests.helpers.drawn import CASES
from tests.helpers.scenes import front_camera, orbit_camera, random_gaussians
from tests.helpers.trained import WHITE, small
from trainer.views.crops import CropScene, crop_scene, live_pixels, live_tiles, may_reach, render_all

COLORS = ("sh0", "shN")


def picture_and_gradient(view: CropScene, rows: Tensor) -> tuple[Tensor, Tensor]:
    packed = rows.clone().requires_grad_()
    image = view.render(packed, COLORS)
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(0))
    (image * weights).sum().backward()  # type: ignore[no-untyped-call]
    assert packed.grad is not None
    return image.detach(), packed.grad


def recolored(scene: Gaussians, members: Tensor) -> Tensor:
    rows = pack(scene[members], with_shN=scene.sh_degree > 0)
    rows[:, 11:] += 0.3 * torch.randn(rows[:, 11:].shape, generator=torch.Generator().manual_seed(3))
    return rows


@pytest.mark.parametrize("part", ["scarf", "ears", "head"])
def test_tiles_match_the_whole_box_in_picture_and_gradients(part: str) -> None:
    case = small(part, count=3, image_size=120)
    rows = recolored(case.scene, case.region.members)
    saved = 0
    for view in case.views:
        box = (0, 0, view.camera.width, view.camera.height)
        whole = crop_scene(case.scene, case.region.members, view.camera, box, WHITE)
        tiles = crop_scene(case.scene, case.region.members, view.camera, box, WHITE, still=True)
        (image, gradient), (expected, expected_gradient) = (
            picture_and_gradient(v, rows) for v in (tiles, whole)
        )
        assert torch.equal(image, expected)
        assert torch.equal(gradient, expected_gradient)
        assert float(expected_gradient[:, 11:].abs().max()) > 0
        saved += len(whole.gaussians.means) - len(tiles.gaussians.means)
    assert saved > 0, "nothing was left out"


def test_invisible_region_gives_the_original_picture() -> None:
    scene = random_gaussians(50, seed=4, sh_degree=1)
    scene.means[:3] = torch.tensor([0.0, 0.0, -50.0])
    members = torch.arange(3)
    camera = orbit_camera(64, 40)
    whole, tiles = (crop_scene(scene, members, camera, (0, 0, 64, 40), WHITE, s) for s in (False, True))
    rows = recolored(scene, members)
    assert torch.equal(*(render_all([v], rows, COLORS)[0] for v in (whole, tiles)))


def test_live_tiles_are_those_of_the_full_image() -> None:
    contributes = torch.zeros(20, 70, dtype=torch.bool)
    contributes[5, 40] = True
    box = (10, 13, 80, 33)
    live = live_tiles(contributes, box)
    assert live.nonzero().tolist() == [[(13 + 5) // TILE_H, (10 + 40) // TILE_W]]
    pixels = live_pixels(live, box)
    assert pixels.shape == (20, 70)
    rows, columns = pixels.nonzero().unbind(dim=1)
    top = 18 // TILE_H * TILE_H
    left = 50 // TILE_W * TILE_W
    assert (int(rows.min()) + 13, int(columns.min()) + 10) == (top, max(left, 10))
    assert (int(rows.max()) + 13, int(columns.max()) + 10) == (top + TILE_H - 1, min(left + TILE_W, 80) - 1)


def test_tiles_end_with_the_box() -> None:
    assert live_tiles(torch.ones(40, 64, dtype=torch.bool), (0, 0, 64, 40)).shape == (
        40 // TILE_H,
        64 // TILE_W,
    )
    last = live_tiles(torch.ones(1, 1, dtype=torch.bool), (64, 40, 65, 41))
    assert last.nonzero().tolist() == [[40 // TILE_H, 64 // TILE_W]]


def test_needles_beyond_the_edge_of_an_off_center_picture_are_kept() -> None:
    """Place needles beside the picture, where the clamped projection stretches them most."""
    rng = torch.Generator().manual_seed(6)
    camera = front_camera(160, 80, focal=60.0)
    K = torch.tensor([[60.0, 0.0, 30.0], [0.0, 90.0, 65.0], [0.0, 0.0, 1.0]])
    camera = replace(camera, K=K)
    slopes = 8 * torch.rand(400, 2, generator=rng) - 4
    depths = 1 + 2 * torch.rand(400, 1, generator=rng)
    means = torch.cat([slopes * depths, depths], dim=1)
    length = slopes.norm(dim=1, keepdim=True)
    axis = torch.nn.functional.normalize(torch.cat([slopes / length, -length], dim=1), dim=1)
    half = torch.nn.functional.normalize(axis + torch.tensor([1.0, 0.0, 0.0]), dim=1)
    quats = torch.cat([torch.zeros(400, 1), half], dim=1)  # a half turn that takes x to the axis
    scales = torch.tensor([[1.0, 1e-3, 1e-3]]) * (0.05 + torch.rand(400, 1, generator=rng))
    needles = ActivatedGaussians(means, quats, scales, torch.full((400,), 0.99), torch.zeros(400, 3))
    found = render(needles, camera).info
    every = torch.ones(80 // TILE_H, 160 // TILE_W, dtype=torch.bool)
    assert 20 < int(found.visible.sum()) < 380
    assert not bool((found.visible & ~may_reach(means, scales, camera, every)).any())


def _cases() -> dict[str, Callable[[], object]]:
    return {name: (lambda case=case: case) for name, case in CASES.items()}


@pytest.mark.parametrize("name", sorted(_cases()))
def test_no_gaussian_that_reaches_a_tile_is_left_out(name: str) -> None:
    case = CASES[name]
    scene = case.gaussians
    camera = case.camera
    for row in range(-(-camera.height // TILE_H)):
        for column in range(-(-camera.width // TILE_W)):
            window = (
                column * TILE_W,
                row * TILE_H,
                min(camera.width, (column + 1) * TILE_W),
                min(camera.height, (row + 1) * TILE_H),
            )
            found = render(scene, camera, colors=torch.zeros(len(scene), 3), crop=window).info
            live = torch.zeros(-(-camera.height // TILE_H), -(-camera.width // TILE_W), dtype=torch.bool)
            live[row, column] = True
            assert not bool((found.visible & ~may_reach(scene.means, scene.scales, camera, live)).any())
