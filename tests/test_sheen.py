"""Whether the higher SH bands are trained follows from how much the region's colours change with the view."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from progdf.sh import shade
from tests.scenes import orbit_camera, random_gaussians
from trainer.sheen import view_dependence

CAMERAS = [orbit_camera(azimuth=0.7 * i, elevation=0.1 * i) for i in range(8)]


def test_it_is_the_change_of_the_colours_that_are_drawn() -> None:
    members = random_gaussians(1, sh_degree=3)
    members = replace(members, sh0=members.sh0 + 9.0)  # so that nothing is cut at 0
    directions = [torch.nn.functional.normalize(members.means - c.position, dim=1) for c in CAMERAS]
    colours = torch.stack([shade(3, d, members.sh) for d in directions])
    expected = float((colours - colours.mean(dim=0)).square().mean().sqrt())
    assert view_dependence(replace(members, sh0=members.sh0 + 9.0), CAMERAS) == pytest.approx(
        expected, rel=0.2
    )
    assert expected > 0.02


def test_a_matt_region_and_a_single_view_have_none() -> None:
    members = random_gaussians(20, sh_degree=2)
    assert view_dependence(replace(members, shN=torch.zeros_like(members.shN)), CAMERAS) == 0.0
    assert view_dependence(replace(members, shN=members.shN[:, :0]), CAMERAS) == 0.0
    assert view_dependence(members, CAMERAS[:1]) == 0.0
    assert view_dependence(members[:0], CAMERAS) == 0.0


def test_what_cannot_be_seen_does_not_count() -> None:
    members = random_gaussians(40, sh_degree=1)
    shN = members.shN.clone()
    shN[:20] = 0.0
    hidden = members.logit_opacities.clone()
    hidden[20:] = -30.0
    assert view_dependence(replace(members, shN=shN, logit_opacities=hidden), CAMERAS) < 1e-3
