"""Tests of the fit of an LOD pyramid: visibility, gain, cameras and broken scenes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from progdf.rasterize import ActivatedGaussians, render
from progdf.rasterize.cpu.pyramid import Pyramid
from progdf.rasterize.cpu.pyramid_fit import GAINS, cameras_around, fit_pyramid, measure_visibility
from tests.helpers.scenes import orbit_camera

PIXELS = 2
COARSE = orbit_camera(80, 60)
FULL = COARSE.resize(160, 120)


def shell(count: int = 6000) -> ActivatedGaussians:
    """Return a bright opaque sphere of overlapping Gaussians that is dark inside."""
    random = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=1)
    is_inside = torch.arange(count) % 2 == 1
    radii = torch.where(is_inside, 0.93, 1.0)
    brightness = torch.where(is_inside, -1.2, 1.2)
    return ActivatedGaussians(
        means=directions * radii[:, None],
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        scales=torch.full((count, 3), 0.035),
        opacities=torch.full((count,), 0.9),
        colors=brightness[:, None, None].repeat(1, 1, 3),
    )


def mean_color(gaussians: ActivatedGaussians, pixels: int = PIXELS) -> float:
    camera = COARSE if pixels == PIXELS else FULL
    return float(render(gaussians, camera, (0.0, 0.0, 0.0)).image.mean())


def test_hidden_gaussians_are_less_visible() -> None:
    scene = shell()
    visibility = torch.from_numpy(measure_visibility(scene, cameras_around(scene, COARSE, 12)))
    assert float(visibility[1::2].mean()) < 0.4 * float(visibility[::2].mean())
    assert bool((visibility > 0.0).all())


def test_fit_brings_brightness_close_to_the_full_picture() -> None:
    scene = shell()
    plain = Pyramid(scene)
    before = [array.copy() for array in plain.nodes[:2]]
    limit = 12.0
    fitted = fit_pyramid(plain, COARSE, limit, 6000, PIXELS)
    assert all(map(np.array_equal, before, plain.nodes[:2])), "the pyramid itself is unchanged"
    assert GAINS[0] <= fitted.gain <= GAINS[-1]
    full = mean_color(scene, 1)
    errors = []
    for pyramid in (plain, fitted):
        pyramid.limit = pyramid.finest = limit
        errors.append(abs(mean_color(pyramid.simplify(COARSE, 6000, PIXELS)) / full - 1.0))
    assert errors[1] < 0.35 * errors[0]


def centers(cameras: Tensor) -> Tensor:
    return -torch.einsum("nji,nj->ni", cameras[:, :3, :3], cameras[:, :3, 3])


def test_cameras_outside_orbit_the_center_at_their_distance() -> None:
    scene = shell(500)
    scene.means[:] += torch.tensor([0.3, -0.2, 0.1])
    eyes = centers(torch.stack([camera.viewmat for camera in cameras_around(scene, COARSE, 12)]))
    center = scene.means.median(0).values
    distance = float((centers(COARSE.viewmat[None])[0] - center).norm())
    torch.testing.assert_close((eyes - center).norm(dim=1), torch.full((12,), distance), rtol=1e-4, atol=1e-4)
    assert float(torch.cdist(eyes, eyes).fill_diagonal_(9.0).min()) > 0.3 * distance


def test_camera_inside_also_looks_around() -> None:
    scene = shell(500)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 0.2
    inside = COARSE.__class__(viewmat, COARSE.K, COARSE.width, COARSE.height)
    eyes = centers(torch.stack([camera.viewmat for camera in cameras_around(scene, inside, 8)]))
    torch.testing.assert_close(eyes[1::2], torch.tensor([[0.0, 0.0, -0.2]]).repeat(4, 1))
    assert float((eyes[::2] - eyes[1]).norm(dim=1).max()) > 0.1


@pytest.mark.parametrize("count", [0, 1, 5])
def test_small_scenes_can_be_fitted(count: int) -> None:
    fitted = fit_pyramid(Pyramid(shell(500).select(torch.arange(count))), COARSE, 4.0, 100, PIXELS)
    assert len(fitted.simplify(COARSE, 100, PIXELS).means) <= count


def test_values_that_are_not_finite_do_not_reach_the_fit() -> None:
    scene = shell(500)
    scene.means[7] = float("nan")
    scene.opacities[8] = float("inf")
    scene.scales[9] = float("nan")
    scene.colors[10] = float("nan")
    fitted = fit_pyramid(Pyramid(scene), COARSE, 4.0, 500, PIXELS)
    assert np.isfinite(fitted.nodes.visibility).all()
    assert GAINS[0] <= fitted.gain <= GAINS[-1]
