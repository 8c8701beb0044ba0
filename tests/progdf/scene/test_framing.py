"""Which way is up, where is the front, and is one to stand inside."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from progdf.gaussians import Gaussians, normalize_quats
from progdf.rasterize.reference import rotation_matrices
from progdf.scene.bounds import front_direction, is_surrounding, normals_of
from progdf.scene.orbit_rig import orbit_rig
from progdf.scene.up_axis import guess_up
from tests.helpers.demo_scenes import bear
from tests.helpers.scenes import ball, random_gaussians

Y_UP = torch.tensor([0.0, 1.0, 0.0])


def quat_of(rotation: Tensor) -> Tensor:
    """The quaternion wxyz of a rotation matrix of a quarter or half turn. [3,3] -> [4]"""
    w = 0.5 * math.sqrt(max(0.0, 1 + float(rotation.trace())))
    xyz = torch.stack(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    if w > 0.1:
        return torch.cat([torch.tensor([w]), xyz / (4 * w)])
    axis = (rotation + torch.eye(3))[:, int(rotation.diagonal().argmax())]
    return torch.cat([torch.zeros(1), axis / axis.norm()])


def turned(scene: Gaussians, rotation: Tensor) -> Gaussians:
    """The scene rotated about the origin, its Gaussians with it."""
    w, x, y, z = quat_of(rotation)
    left = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return replace(scene, means=scene.means @ rotation.T, quats=normalize_quats(scene.quats) @ left.T)


AXES = [torch.eye(3)[i] * sign for i in range(3) for sign in (1.0, -1.0)]


@pytest.fixture(scope="module")
def small_bear() -> Gaussians:
    return bear(3000).gaussians


@pytest.mark.parametrize("up", AXES, ids=["+x", "-x", "+y", "-y", "+z", "-z"])
def test_up_is_found_however_the_bear_lies(up: Tensor, small_bear: Gaussians) -> None:
    axis = int(up.abs().argmax())
    second = torch.eye(3)[(axis + 1) % 3]
    # y -> up, z -> second, x -> their cross product: a rotation by quarter turns
    rotation = torch.stack([torch.linalg.cross(up, second), up, second], dim=1)
    assert torch.equal(guess_up(turned(small_bear, rotation)), up)


def test_normals_are_the_shortest_axes() -> None:
    scene = random_gaussians(50, seed=4)
    rotations = rotation_matrices(scene.unit_quats)
    expected = rotations[torch.arange(50), :, scene.scales.argmin(dim=1)]
    torch.testing.assert_close(normals_of(scene), expected)


def test_cameras_that_agree_tell_the_up_direction(small_bear: Gaussians) -> None:
    up = torch.nn.functional.normalize(torch.tensor([0.1, -1.0, 0.2]), dim=0)
    cameras = orbit_rig(ball(), 12, 64, 64, up=up)
    found = guess_up(small_bear, cameras)
    torch.testing.assert_close(found, up, atol=0.05, rtol=0)


def test_the_front_is_level_and_of_unit_length() -> None:
    for up in [*AXES, torch.nn.functional.normalize(torch.tensor([0.3, -0.9, 0.4]), dim=0)]:
        assert abs(float(front_direction(up) @ up)) < 1e-6
        assert abs(float(front_direction(up).norm()) - 1) < 1e-6
    assert front_direction(torch.tensor([0.0, -1.0, 0.0])).tolist() == [0, 0, -1]
    assert front_direction(torch.tensor([0.0, 0.0, 1.0])).tolist() == [0, -1, 0]


def walls(ceiling: bool) -> Gaussians:
    """A room of 4 x 3 x 4 with furniture, y up, with or without its ceiling."""
    spots = torch.rand(6000, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    side = torch.arange(6000) % (6 if ceiling else 5)
    for face, (axis, place) in enumerate([(0, -0.5), (0, 0.5), (1, -0.5), (2, -0.5), (2, 0.5), (1, 0.5)]):
        spots[side == face, axis] = place
    scene = random_gaussians(6000, scale=0.02)
    return replace(scene, means=spots * torch.tensor([4.0, 3.0, 4.0]))


def test_a_scene_to_stand_inside_is_recognized(
    small_bear: Gaussians, caplog: pytest.LogCaptureFixture
) -> None:
    assert is_surrounding(walls(ceiling=True), Y_UP)
    assert not is_surrounding(walls(ceiling=False), Y_UP)
    assert not is_surrounding(small_bear, Y_UP)
    assert not is_surrounding(ball(), Y_UP)
    landscape = random_gaussians(3000)
    far = replace(landscape, means=landscape.means * torch.linspace(0, 3, 3000)[:, None].exp() ** 2)
    assert is_surrounding(far, Y_UP)
    orbit_rig(walls(ceiling=True), 2, 64, 64, up=Y_UP)
    assert "give its own cameras" in caplog.text
