"""Distance of Gaussians to the local surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from progdf.gaussians import Gaussians
from progdf.quaternions import rotation_matrices
from progdf.scene.neighbors import surface_distances
from tests.helpers.scenes import logit_of, random_gaussians

_Floats = NDArray[np.float64]


def _scene_at(points: _Floats) -> Gaussians:
    means = torch.tensor(points, dtype=torch.float32)
    return replace(random_gaussians(len(means)), means=means, logit_opacities=torch.zeros(len(means)))


def _plane(count: int, offset: float, seed: int) -> tuple[Gaussians, NDArray[np.int64]]:
    """Return a unit square with 1 % offset Gaussians, and their rows. `offset`: spacings of the square"""
    random = np.random.default_rng(seed)
    points = np.zeros((count, 3))
    points[:, :2] = random.random((count, 2))
    rows = np.sort(random.choice(count, count // 100, replace=False))
    points[rows, 2] = offset / np.sqrt(count) * random.choice([-1.0, 1.0], len(rows))
    return _scene_at(points), rows


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("offset", [0.3, 1.0, 4.0, 20.0])
def test_offset_gaussians_of_a_plane_are_exactly_those_far_from_it(offset: float, seed: int) -> None:
    scene, rows = _plane(2000, offset, seed)
    far = surface_distances(scene) > 0.5 * offset / np.sqrt(2000)
    assert np.flatnonzero(far).tolist() == rows.tolist()


def test_distance_scales_and_turns_with_the_scene_in_any_order() -> None:
    scene, _ = _plane(2000, 2.0, 0)
    points = scene.means.double() + 0.001 * torch.randn(2000, 3, generator=torch.manual_seed(1))
    expected = surface_distances(replace(scene, means=points))
    quats = torch.tensor([[1.0, 2.0, -3.0, 1.0]], dtype=torch.float64) / 15.0**0.5
    turn = rotation_matrices(quats)[0]
    order = torch.randperm(2000, generator=torch.manual_seed(2))
    moved = 40.0 * points @ turn.T + torch.tensor([5.0, -3.0, 9.0])
    found = surface_distances(replace(scene, means=moved)[order])
    np.testing.assert_allclose(found, 40.0 * expected[order.numpy()], rtol=1e-6, atol=1e-9)


def test_floater_level_with_a_table_but_outside_it_is_far() -> None:
    grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), axis=-1).reshape(-1, 3)
    scene = _scene_at(np.concatenate([grid, [[60.0, 10.0, 0.0]]]))
    distances = surface_distances(scene)
    assert distances[:-1].max() < 1e-6
    assert 30.0 < distances[-1] <= 41.0


def test_transparent_gaussians_are_no_surface() -> None:
    scene, _ = _plane(1000, 0.0, 0)
    fog = scene.means + torch.tensor([0.0, 0.0, 0.2])
    logits = logit_of(torch.cat([torch.full((1000,), 0.9), torch.full((1000,), 0.05)]))
    both = replace(_scene_at(torch.cat([scene.means, fog]).numpy()), logit_opacities=logits)
    distances = surface_distances(both)
    assert distances[:1000].max() < 1e-6
    np.testing.assert_allclose(distances[1000:], 0.2, rtol=0.01)


def test_sphere_has_small_distances_everywhere() -> None:
    points = np.random.default_rng(0).normal(size=(4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    assert surface_distances(_scene_at(points)).max() < 0.02


@pytest.mark.parametrize("count", [0, 1, 3])
def test_few_gaussians_have_no_surface(count: int) -> None:
    assert np.isnan(surface_distances(random_gaussians(count))).all()


def test_copies_and_broken_centers_are_measured_or_unknown() -> None:
    points = np.zeros((100, 3))
    points[3] = np.nan
    distances = surface_distances(_scene_at(points))
    assert np.flatnonzero(np.isnan(distances)).tolist() == [3]
    assert np.nanmax(distances) == 0.0
