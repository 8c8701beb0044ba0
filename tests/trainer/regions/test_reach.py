"""Extent of an edit beyond its pictures: distance along the surface, soft borders, and lone members."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.sparse import csr_matrix, diags
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.sh import rgb_to_sh0
from tests.helpers.trained import WHITE, edit_few
from trainer.optimize.ties import surface_ties
from trainer.regions.reach import border_half_width, drop_unsupported, surface_reach
from trainer.views.crops import crop_scene
from trainer.views.view import render_view

SIDE = 96
TURN = 48  # members around a cylinder
RINGS = 16


def chain(count: int) -> csr_matrix:
    """Return links between successive members of a chain."""
    ones = np.ones(count - 1)
    return csr_matrix(diags([ones, ones], [1, -1]))


def cylinder() -> Gaussians:
    """Return an upright orange cylinder of radius 0.5 of flat, opaque Gaussians."""
    angle = (torch.arange(TURN) * 2 * math.pi / TURN).repeat(RINGS)
    height = torch.linspace(-0.6, 0.6, RINGS).repeat_interleave(TURN)
    means = torch.stack([0.5 * angle.sin(), height, -0.5 * angle.cos()], dim=1)
    half = 0.5 * angle
    zero = torch.zeros_like(half)
    quats = torch.stack([half.cos(), zero, -half.sin(), zero], dim=1)
    count = len(means)
    scales = torch.tensor([0.05, 0.06, 0.003]).log().expand(count, 3).clone()
    sh0 = rgb_to_sh0(torch.tensor([0.7, 0.45, 0.2]).expand(count, 3)).clone()
    return Gaussians(means, quats, scales, torch.full((count,), 5.0), sh0, torch.zeros(count, 0, 3))


def front() -> Camera:
    """Return a camera in front of the cylinder."""
    viewmat = look_at(torch.tensor([0.0, 0.0, -3.0]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
    return Camera(viewmat, intrinsics(0.7, SIDE, SIDE), SIDE, SIDE)


def tint(picture: Tensor, opacity: Tensor) -> Tensor:
    """Return the picture with teal paint on everything that is not white. [H,W,3], [H,W] -> [H,W,3]"""
    share = (opacity * (picture.amin(dim=2) < 0.6))[..., None]
    return picture * (1.0 - share) + share * torch.tensor([0.1, 0.6, 0.6])


def azimuth(scene: Gaussians) -> Tensor:
    """Return the angle of each member around the cylinder, degrees from the camera. [N] -180..180"""
    return torch.rad2deg(torch.atan2(scene.means[:, 0], -scene.means[:, 2]))


def change_of(scene: Gaussians, opacity: Tensor, carries_on: bool) -> Tensor:
    """Return the size of each member's color change by a tint of its front view. [N]"""
    members = torch.arange(len(scene))
    camera = front()
    original = render_view(scene, camera, WHITE).clamp(0, 1)
    painted = tint(original, opacity)
    crops = [crop_scene(scene, members, camera, (0, 0, SIDE, SIDE), WHITE, True)]
    ties = surface_ties(scene, members, [camera])
    if not carries_on:
        ties, _ = ties.end_at_pictures(scene, members, [camera], [painted - original])
    return edit_few(scene, members, crops, [painted], ties)[:, 0].norm(dim=1)


def test_share_falls_smoothly_along_a_chain() -> None:
    means = torch.stack([torch.arange(20.0), torch.zeros(20), torch.zeros(20)], dim=1)
    reach = surface_reach(chain(20), means, torch.arange(20) < 5, 8.0)
    assert bool((reach[:5] == 1.0).all())
    assert bool((reach[13:] == 0.0).all())
    assert bool((reach[5:].diff() <= 0.0).all())
    assert float(reach.diff().abs().max()) < 0.25
    assert torch.equal(reach, (reach * 255).round() / 255)


def test_members_without_a_path_are_not_reached() -> None:
    links = chain(6).tolil()
    links[2, 3] = links[3, 2] = 0.0
    means = torch.zeros(6, 3)  # in one place, yet on two surfaces
    reach = surface_reach(csr_matrix(links), means, torch.arange(6) == 0, 1.0)
    assert reach.tolist() == [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    assert surface_reach(chain(3), means[:3], torch.zeros(3, dtype=torch.bool), 1.0).tolist() == [0.0] * 3


def test_member_alone_among_hidden_ones_is_dropped() -> None:
    visible = torch.tensor([True, True, True, False, False, True, False, False])
    assert drop_unsupported(chain(8), visible).tolist() == [True, True, True] + [False] * 5


@pytest.mark.parametrize("half", [1, 6, 12])
def test_half_width_of_a_border_is_measured(half: int) -> None:
    columns = torch.arange(64)
    change = (0.4 * (columns - 15).clamp(0, 2 * half) / (2 * half)).expand(64, 64)
    change = change * (0.8 + 0.4 * torch.rand(64, 64, generator=torch.Generator().manual_seed(0)))
    level = torch.full((64, 64), 2.0)
    pixels, width = border_half_width(change, level, torch.ones(64, 64), 0.01)
    assert abs(pixels - half) <= 1.0
    assert width == pytest.approx(pixels * 0.02)


def test_border_at_an_outline_has_no_width() -> None:
    change = torch.zeros(32, 32)
    change[:, 16:] = 0.5
    level = torch.full((32, 32), 2.0)
    behind = torch.where(torch.arange(32) < 16, 3.0, 2.0).expand(32, 32)
    empty = (torch.arange(32) >= 16).float().expand(32, 32)
    assert border_half_width(change, level, empty, 0.01) == (0.0, 0.0)
    assert border_half_width(change, behind, torch.ones(32, 32), 0.01) == (0.0, 0.0)


def test_paint_on_the_front_ends_behind_the_outline() -> None:
    scene = cylinder()
    degrees = azimuth(scene).abs()
    ended = change_of(scene, torch.ones(SIDE, SIDE), carries_on=False)
    carried = change_of(scene, torch.ones(SIDE, SIDE), carries_on=True)
    painted = float(ended[degrees < 60].mean())
    assert painted == pytest.approx(float(carried[degrees < 60].mean()), rel=0.02)
    assert float(ended[degrees > 115].max()) < 0.01 * painted
    assert float(carried[degrees > 115].min()) > 0.9 * painted


def test_soft_paint_fades_on_and_leaves_no_other_hue() -> None:
    scene = cylinder()
    degrees = azimuth(scene)
    x = torch.arange(SIDE) / SIDE
    opacity = ((x - 0.4) / 0.4).clamp(0, 1).expand(SIDE, SIDE)
    change = change_of(scene, opacity, carries_on=False)
    largest = float(change.max())
    assert float(change[(degrees < -20) | (degrees > 140)].max()) < 0.05 * largest
    by_angle = torch.stack([change[(degrees >= a) & (degrees < a + 10)].mean() for a in range(60, 170, 10)])
    assert float(by_angle.diff()[2:].max()) < 0.02 * largest  # falls steadily behind the outline
    assert float(by_angle[0]) > 0.5 * largest


def test_other_thing_behind_keeps_its_color() -> None:
    near = cylinder()
    behind = replace(near, means=near.means * torch.tensor([0.8, 1.0, 0.8]))
    both = Gaussians(**{n: torch.cat([getattr(near, n), getattr(behind, n)]) for n in ATTRIBUTES})
    change = change_of(both, torch.ones(SIDE, SIDE), carries_on=False)
    inner_back = torch.cat([torch.zeros(len(near), dtype=torch.bool), azimuth(behind).abs() > 110])
    assert float(change[inner_back].max()) < 0.02 * float(change.max())
