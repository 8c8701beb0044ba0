"""Pulls in very large and very small units, over far clusters, and of equal Gaussians."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from progdf.gaussians import concatenate
from progdf.pull.course import Handle, pull
from progdf.pull.live import HandlePose, LivePull
from progdf.region import inside_box, whole_scene
from tests.progdf.pull.test_pull import SPACING, at, bar, grip


@pytest.mark.parametrize("unit", [1e6, 1e-6])
def test_result_does_not_depend_on_the_unit(unit: float) -> None:
    scene = bar(12, degree=0)
    handle = grip(scene, (1.1, 0.1, 0.1), (-0.2, 0.6, 0.0))
    held = inside_box("held", scene, torch.tensor([-1.0, -1, -1]), torch.tensor([0.25, 1, 1]))
    expected = at(scene, pull(scene, [handle], held), 1.0)
    scaled = replace(scene, means=unit * scene.means, log_scales=scene.log_scales + math.log(unit))
    x, y, z = (unit * value for value in handle.point)
    dx, dy, dz = (unit * value for value in handle.pull)
    far = Handle(whole_scene(scaled), (x, y, z), (dx, dy, dz))
    end = at(scaled, pull(scaled, [far], held), 1.0)
    assert torch.allclose(end.means / unit, expected.means, atol=0.02 * SPACING)
    assert torch.allclose(end.log_scales - math.log(unit), expected.log_scales, atol=0.02)


def test_each_of_two_far_clusters_moves_by_its_own_handle() -> None:
    scene = concatenate([bar(6), bar(6, shift=(1000.0, 0.0, 0.0))])
    count = len(scene) // 2
    handles = [
        grip(scene, (0.5, 0.1, 0.1), (0.0, 0.3, 0.0)),
        grip(scene, (1000.5, 0.1, 0.1), (0.0, 0.0, -0.2)),
    ]
    moved = at(scene, pull(scene, handles), 1.0).means - scene.means
    assert torch.allclose(moved[:count], torch.tensor([0.0, 0.3, 0.0]).expand(count, 3), atol=5e-3)
    assert torch.allclose(moved[count:], torch.tensor([0.0, 0.0, -0.2]).expand(count, 3), atol=5e-3)


def test_equal_gaussians_move_as_one() -> None:
    one = bar(1, 1)
    scene = concatenate([one] * 300)
    handle = grip(scene, (0.0, 0.0, 0.0), (0.1, 0.2, 0.3))
    moved = at(scene, pull(scene, [handle]), 1.0).means - scene.means
    assert torch.allclose(moved, torch.tensor([0.1, 0.2, 0.3]).expand(300, 3), atol=1e-4)
    pose = HandlePose.of_shifts(np.array([handle.pull]))
    offsets = LivePull(scene, [handle]).step(pose, 30).offsets
    assert torch.allclose(offsets[:, :3], moved, atol=1e-3)
