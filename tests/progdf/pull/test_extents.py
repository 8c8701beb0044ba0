"""Wide Gaussians follow the bend of a pull as a whole, and not by the tangent at their center."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from progdf.gaussians import Gaussians, concatenate
from progdf.pull.course import Handle, pull
from progdf.quaternions import rotation_matrices
from progdf.region import whole_scene
from tests.progdf.pull.test_pull import at, covariances
from tests.progdf.pull.test_stretch import discs, tube

WIDE_FACTOR = 3.0
TIP_SIGMAS = math.sqrt(3.0)  # six points at this distance average cubics exactly


def half_axes(gaussians: Gaussians) -> Tensor:
    """Return principal axes times standard deviations, as columns. [N,3,3]"""
    return rotation_matrices(gaussians.unit_quats.double()) * gaussians.scales.double()[:, None, :]


def tip_probes(gaussians: Gaussians) -> Gaussians:
    """Return six tiny Gaussians on the principal axes of each Gaussian."""
    arms = TIP_SIGMAS * half_axes(gaussians).transpose(1, 2)
    centers = gaussians.means.double()[:, None]
    tips = torch.cat([centers + arms, centers - arms], dim=1).flatten(0, 1).float()
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(len(tips), 4)
    return discs(tips, upright, torch.full((3,), 1e-3))


def test_wide_gaussians_have_the_moments_of_their_mapped_tips() -> None:
    shell = tube(3000)
    top = shell.means[(shell.means - torch.tensor([0.5, 0.15, 0.0])).norm(dim=1).argmin()]
    near = (shell.means - top).norm(dim=1) < 0.3
    wide = shell[near.nonzero()[:, 0][::10]]
    wide = replace(wide, log_scales=wide.log_scales + torch.tensor([WIDE_FACTOR, 1.0, WIDE_FACTOR]).log())
    scene = concatenate([shell, wide, tip_probes(wide)])
    x, y, z = top.tolist()
    course = pull(scene, [Handle(whole_scene(scene), (x, y, z), (0.0, 0.4, 0.0), 0.45)])
    pulled = at(scene, course, 1.0)
    first = len(shell)
    last = first + len(wide)
    tips = pulled.means[last:].double().reshape(len(wide), 2, 3, 3)
    halves = (tips[:, 0] - tips[:, 1]).transpose(1, 2) / (2.0 * TIP_SIGMAS)
    spread = halves @ halves.transpose(1, 2)
    size = halves.flatten(1).norm(dim=1)
    missed = (pulled.means[first:last].double() - tips.mean(dim=(1, 2))).norm(dim=1) / size
    error = (covariances(pulled)[first:last] - spread).flatten(1).norm(dim=1) / spread.flatten(1).norm(dim=1)
    assert float(missed.mean()) < 0.04
    assert float(error.mean()) < 0.065
