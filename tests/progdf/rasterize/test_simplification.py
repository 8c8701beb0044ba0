"""Fewer Gaussians for a picture in motion: the plain version, the budget, and the brightness."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from progdf.camera import Camera
from progdf.rasterize import ActivatedGaussians, activate, render
from progdf.rasterize.simplification import simplify
from tests.helpers.plain_simplification import plain_simplify
from tests.helpers.scenes import front_camera, orbit_camera, random_gaussians

WIDTH, HEIGHT, PIXELS = 120, 80, 2


def coarse(camera: Camera) -> Camera:
    return camera.resize(camera.width // PIXELS, camera.height // PIXELS)


def cloud(count: int, size: float = 0.25, antialiased: bool = False) -> ActivatedGaussians:
    """Small ones, as in a scene of a million."""
    scene = random_gaussians(count, seed=3, sh_degree=2)
    scene = replace(scene, log_scales=scene.log_scales + torch.tensor(size).log(), antialiased=antialiased)
    return activate(scene)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("budget", [300, 100_000])
def test_the_fast_one_keeps_the_plain_ones_gaussians(budget: int, antialiased: bool) -> None:
    scene, camera = cloud(4000, antialiased=antialiased), coarse(orbit_camera(WIDTH, HEIGHT))
    found = simplify(scene, camera, budget, PIXELS)
    expected, rows = plain_simplify(scene, camera, budget, PIXELS)
    row_of = {tuple(mean): row for row, mean in enumerate(scene.means.tolist())}
    ours = torch.tensor([row_of[tuple(mean)] for mean in found.means.tolist()])
    both = torch.isin(ours, rows), torch.isin(rows, ours)
    # the fast threshold lies between two edges of bins that are a ninth apart: few lots lie between the two
    assert int(both[0].sum()) >= 0.98 * max(len(ours), len(rows)), "the same lots, and the same threshold"
    for fast, plain in zip(found.tensors, expected.tensors, strict=True):
        # 2e-3: a fiftieth of a pixel, which is .1 wide there; a size is a root, steep near 0
        torch.testing.assert_close(fast[both[0]], plain[both[1]], rtol=2e-2, atol=2e-3)
    assert (len(rows) == pytest.approx(budget, rel=0.1)) == (budget < 4000)


@pytest.mark.parametrize("background", [0.0, 1.0])
def test_a_quarter_of_the_gaussians_on_a_quarter_of_the_pixels_is_as_bright(background: float) -> None:
    scene, camera = cloud(20_000, 0.4), orbit_camera(8 * WIDTH, 8 * HEIGHT)
    fewer = simplify(scene, coarse(camera), 5_000, PIXELS)
    fine = render(scene, camera, (background,) * 3).image
    moving = render(fewer, coarse(camera), (background,) * 3).image
    # real scenes are within 1 % on white (docs/benchmarks.md); a ball of fog is the harder case
    assert float(moving.mean()) == pytest.approx(float(fine.mean()), rel=0.02)
    plain = render(scene.select(torch.arange(0, 20_000, 4)), coarse(camera), (background,) * 3).image
    assert abs(float(plain.mean()) / float(fine.mean()) - 1.0) > 0.02, "every fourth alone is not"


def test_nothing_flickers_while_the_camera_turns() -> None:
    scene = cloud(20_000)
    steps = [orbit_camera(WIDTH, HEIGHT, azimuth=0.4 + 0.01 * step) for step in range(2)]
    one, two = ({tuple(row) for row in simplify(scene, step, 3_000).means.tolist()} for step in steps)
    assert len(one & two) > 0.95 * max(len(one), len(two))


def test_what_others_hide_goes_first() -> None:
    scene = activate(random_gaussians(8000, seed=1, scale=0.1))
    flat = scene.means * torch.tensor([1.0, 1.0, 0.02]) + torch.tensor([0.0, 0.0, 4.0])
    flat[4000:, 2] += 4.0
    scene = scene._replace(means=flat, opacities=torch.full((8000,), 0.95))
    found = simplify(scene, front_camera(WIDTH, HEIGHT, focal=100.0), 1000)
    assert int((found.means[:, 2] < 6.0).sum()) > 3 * int((found.means[:, 2] > 6.0).sum())


def test_what_is_not_finite_is_left_out() -> None:
    scene = cloud(500)
    scene.means[7] = float("nan")
    scene.opacities[8] = float("inf")
    scene.quats[9] = float("nan")
    found = simplify(scene, orbit_camera(WIDTH, HEIGHT), 100)
    assert all(bool(tensor[..., 0].isfinite().all()) for tensor in (found.means, found.opacities))
    assert bool(render(found, orbit_camera(WIDTH, HEIGHT)).image.isfinite().all())
