"""Tests of the up direction, the front, and of scenes viewed from inside."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.quaternions import rotation_matrices
from progdf.scene.bounds import front_direction, is_surrounding, normals_of
from progdf.scene.orbit_rig import orbit_rig
from progdf.scene.up_axis import guess_up
from tests.helpers.demo_scenes import bear
from tests.helpers.scenes import ball, random_gaussians, turned, upright_turn

Y_UP = torch.tensor([0.0, 1.0, 0.0])


AXES = [torch.eye(3)[i] * sign for i in range(3) for sign in (1.0, -1.0)]


@pytest.fixture(scope="module")
def small_bear() -> Gaussians:
    return bear(3000).gaussians


@pytest.mark.parametrize("up", AXES, ids=["+x", "-x", "+y", "-y", "+z", "-z"])
def test_up_is_found_for_any_orientation_of_the_bear(up: Tensor, small_bear: Gaussians) -> None:
    assert torch.equal(guess_up(turned(small_bear, upright_turn(up))), up)


def test_normals_are_the_shortest_axes() -> None:
    scene = random_gaussians(50, seed=4)
    rotations = rotation_matrices(scene.unit_quats)
    expected = rotations[torch.arange(50), :, scene.scales.argmin(dim=1)]
    torch.testing.assert_close(normals_of(scene), expected)


def test_agreeing_cameras_determine_up(small_bear: Gaussians) -> None:
    up = torch.nn.functional.normalize(torch.tensor([0.1, -1.0, 0.2]), dim=0)
    cameras = orbit_rig(ball(), 12, 64, 64, up=up)
    found = guess_up(small_bear, cameras)
    torch.testing.assert_close(found, up, atol=0.05, rtol=0)


def test_front_is_level_and_of_unit_length() -> None:
    for up in [*AXES, torch.nn.functional.normalize(torch.tensor([0.3, -0.9, 0.4]), dim=0)]:
        assert abs(float(front_direction(up) @ up)) < 1e-6
        assert abs(float(front_direction(up).norm()) - 1) < 1e-6
    assert front_direction(torch.tensor([0.0, -1.0, 0.0])).tolist() == [0, 0, -1]
    assert front_direction(torch.tensor([0.0, 0.0, 1.0])).tolist() == [0, -1, 0]


def walls(ceiling: bool) -> Gaussians:
    """Return a room of 4 x 3 x 4 units with furniture, y up, with or without its ceiling."""
    spots = torch.rand(6000, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    side = torch.arange(6000) % (6 if ceiling else 5)
    for face, (axis, place) in enumerate([(0, -0.5), (0, 0.5), (1, -0.5), (2, -0.5), (2, 0.5), (1, 0.5)]):
        spots[side == face, axis] = place
    scene = random_gaussians(6000, scale=0.02)
    return replace(scene, means=spots * torch.tensor([4.0, 3.0, 4.0]))


def test_surrounding_scene_is_recognized(small_bear: Gaussians, caplog: pytest.LogCaptureFixture) -> None:
    assert is_surrounding(walls(ceiling=True), Y_UP)
    assert not is_surrounding(walls(ceiling=False), Y_UP)
    assert not is_surrounding(small_bear, Y_UP)
    assert not is_surrounding(ball(), Y_UP)
    landscape = random_gaussians(3000)
    far = replace(landscape, means=landscape.means * torch.linspace(0, 3, 3000)[:, None].exp() ** 2)
    assert is_surrounding(far, Y_UP)
    orbit_rig(walls(ceiling=True), 2, 64, 64, up=Y_UP)
    assert "give its own cameras" in caplog.text
