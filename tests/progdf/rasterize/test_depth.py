"""Tests of rendered depth: its definition, its weights, and agreement of all engines."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from progdf.gaussians import Gaussians
from progdf.rasterize import render
from progdf.rasterize.engines import render_depth
from tests.helpers.drawn import CASES, EVERY, FAST
from tests.helpers.scenes import concatenate, front_camera, one_gaussian, orbit_camera, random_gaussians

pytestmark = pytest.mark.usefixtures("two_threads")


def _wall(z: float, opacity: float) -> Gaussians:
    """Return a Gaussian so wide that it covers the whole picture evenly."""
    return one_gaussian(
        mean=(0.0, 0.0, z), scales=(1e3, 1e3, 1e-3), quat=(1.0, 0.0, 0.0, 0.0), opacity=opacity
    )


@pytest.mark.parametrize("engine", EVERY)
def test_depth_is_the_mean_weighted_by_contribution(engine: str) -> None:
    camera = front_camera()
    found = render_depth(concatenate(_wall(5.0, 0.8), _wall(2.0, 0.5)), camera, engine)
    near = 0.5
    far = 0.5 * 0.8
    expected = (near * 2.0 + far * 5.0) / (near + far)
    torch.testing.assert_close(found.depth, torch.full_like(found.depth, expected), rtol=1e-5, atol=0)
    torch.testing.assert_close(found.alpha, torch.full_like(found.alpha, near + far), rtol=1e-5, atol=0)


@pytest.mark.parametrize("engine", FAST)
@pytest.mark.parametrize("name", CASES)
def test_fast_engine_matches_the_reference_depth_in_each_hard_case(name: str, engine: str) -> None:
    case = CASES[name]
    found, expected = (render_depth(case.gaussians, case.camera, some) for some in (engine, "reference"))
    assert bool(found.depth.isfinite().all())
    torch.testing.assert_close(found.depth, expected.depth, rtol=2e-5, atol=1e-6)
    torch.testing.assert_close(found.alpha, expected.alpha, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", CASES)
def test_depth_alpha_matches_the_picture(name: str) -> None:
    case = CASES[name]
    alpha = 1.0 - render(case.gaussians, case.camera).transmittance
    torch.testing.assert_close(render_depth(case.gaussians, case.camera).alpha, alpha, rtol=0, atol=1e-5)


def test_depth_of_a_crop_matches_the_whole_picture() -> None:
    scene = random_gaussians(300, seed=4, sh_degree=1)
    camera = orbit_camera(90, 60)
    whole = render_depth(scene, camera)
    part = render_depth(scene, camera, crop=(20, 10, 71, 43))
    assert torch.equal(part.depth, whole.depth[10:43, 20:71])
    assert torch.equal(part.alpha, whole.alpha[10:43, 20:71])


def test_depth_and_its_gradient_follow_the_scene() -> None:
    camera = front_camera()
    scene = one_gaussian()
    means = scene.means.clone().requires_grad_()
    found = render_depth(replace(scene, means=means), camera)
    inside = found.alpha > 0
    assert bool(inside.any())
    assert not bool(inside.all())
    torch.testing.assert_close(found.depth[inside], torch.full_like(found.depth[inside], 2.0))
    assert not bool(found.depth[~inside].any())
    (by_means,) = torch.autograd.grad(found.depth[inside].mean(), means)
    assert float(by_means[0, 2]) == pytest.approx(1.0, rel=1e-4)
