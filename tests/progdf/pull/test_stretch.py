"""Pulled parts stay closed: Gaussians stretch with the surface, so that no gap opens between them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_closing, binary_erosion

from progdf.camera import Camera, intrinsics, look_at
from progdf.gaussians import Gaussians
from progdf.pull.course import Handle, pull
from progdf.rasterize import render
from progdf.region import from_mask, whole_scene
from tests.progdf.pull.test_pull import at

MAX_HOLE_SHARE = 1e-3  # of the part's pixels
SIZE = 160  # pixels
GAP_PX = 4  # half the width of the widest gap that counts as a hole
BORDER_PX = 2  # width of the part's ragged border, which is left out
Point = tuple[float, float, float]


def sheet(count: int = 60) -> Gaussians:
    """Return thin discs in the xy plane, from 0 to 1."""
    generator = torch.Generator().manual_seed(0)
    side = (torch.arange(count) + 0.5) / count
    x, y = (values.flatten() for values in torch.meshgrid(side, side, indexing="ij"))
    means = torch.stack([x, y, 0.0 * x], dim=1)
    means[:, :2] += 0.5 * (torch.rand(len(x), 2, generator=generator) - 0.5) / count
    scales = torch.tensor([0.8, 0.8, 0.02]) / count
    return discs(means, torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(len(x), 4), scales)


def tube(count: int = 3000) -> Gaussians:
    """Return thin discs around the x axis, from 0 to 1."""
    index = torch.arange(count)
    half = 0.5 * index * math.pi * (3.0 - math.sqrt(5.0))
    means = torch.stack([(index + 0.5) / count, 0.15 * (2 * half).cos(), 0.15 * (2 * half).sin()], dim=1)
    spacing = math.sqrt(2.0 * math.pi * 0.15 / count)
    scales = spacing * torch.tensor([0.8, 0.05, 0.8])
    return discs(means, torch.stack([half.cos(), half.sin(), 0.0 * half, 0.0 * half], dim=1), scales)


def discs(means: torch.Tensor, quats: torch.Tensor, scales: torch.Tensor) -> Gaussians:
    count = len(means)
    logits = torch.full((count,), 3.0)
    white = torch.full((count, 3), 0.5)
    return Gaussians(means, quats, scales.log().expand(count, 3), logits, white, torch.zeros(count, 0, 3))


def hole_share(scene: Gaussians, direction: Point) -> float:
    """Return the share of a part's pixels that show the background through a gap."""
    means = scene.means.double()
    center = 0.5 * (means.amin(dim=0) + means.amax(dim=0))
    radius = float((means - center).norm(dim=1).max())
    eye = center + 3.0 * radius * torch.nn.functional.normalize(
        torch.tensor(direction, dtype=torch.float64), dim=0
    )
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    view = Camera(look_at(eye, center, up), intrinsics(0.7, SIZE, SIZE), SIZE, SIZE)
    covered = render(scene, view).transmittance.numpy() < 0.5
    part = binary_closing(np.pad(covered, 2 * GAP_PX), iterations=GAP_PX)
    part = binary_erosion(part, iterations=BORDER_PX)
    inner = part[2 * GAP_PX : -2 * GAP_PX, 2 * GAP_PX : -2 * GAP_PX]
    return float((inner & ~covered).sum() / inner.sum())


@pytest.mark.parametrize("times", [2.0, 3.0])
@pytest.mark.parametrize("make", [sheet, tube])
def test_no_gap_opens_in_a_stretched_part(make: object, times: float) -> None:
    assert callable(make)
    scene = make()
    far = scene.means[:, 0] > 0.95
    tips = scene.means[far][:: max(1, int(far.sum()) // 6)]
    handles = [Handle(whole_scene(scene), (x, y, z), (times - 1.0, 0.0, 0.0)) for x, y, z in tips.tolist()]
    course = pull(scene, handles, from_mask("held", scene.means[:, 0] < 0.05))
    for strength in (0.5, 1.0):
        stretched = at(scene, course, strength)
        extent = float(stretched.means[:, 0].max() - stretched.means[:, 0].min())
        assert extent > 0.9 * (1.0 + strength * (times - 1.0))
        for direction in ((0.0, 0.0, 1.0), (0.2, 0.5, 1.0)):
            assert hole_share(stretched, direction) <= MAX_HOLE_SHARE
