"""Whether the higher SH bands are trained follows from how much the region's colors change with the view."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from progdf.gaussians import Gaussians
from progdf.sh import shade
from tests.helpers.scenes import logit_of, orbit_camera, random_gaussians
from trainer.optimize.unseen import view_dependence
from trainer.views.choose import visible_area

CAMERAS = [orbit_camera(azimuth=0.7 * i, elevation=0.1 * i) for i in range(8)]


def test_it_is_the_change_of_the_colors_that_are_drawn() -> None:
    members = random_gaussians(1, sh_degree=3)
    members = replace(members, sh0=members.sh0 + 9.0)  # so that nothing is cut at 0
    directions = [torch.nn.functional.normalize(members.means - c.position, dim=1) for c in CAMERAS]
    colors = torch.stack([shade(3, d, members.sh) for d in directions])
    expected = float((colors - colors.mean(dim=0)).square().mean().sqrt())
    assert view_dependence(members, CAMERAS) == pytest.approx(expected, rel=1e-5)
    assert expected > 0.02


def sheeny(scales: list[tuple[float, float, float]], opacities: list[float]) -> Gaussians:
    """Members whose colors change alike with the view, so that only how much each counts differs."""
    one = random_gaussians(1, sh_degree=1)
    many = one[torch.zeros(len(scales), dtype=torch.int64)]
    return replace(
        many, log_scales=torch.tensor(scales).log(), logit_opacities=logit_of(torch.tensor(opacities))
    )


def test_a_member_counts_as_the_area_that_it_can_cover() -> None:
    members = sheeny([(0.01, 0.2, 0.3), (0.1, 0.1, 0.1)], [0.5, 0.9])
    whole = view_dependence(members, CAMERAS)
    members.shN[1] = 0.0
    first, second = 0.5 * 0.2 * 0.3, 0.9 * 0.1 * 0.1
    expected = whole * (first / (first + second)) ** 0.5
    assert view_dependence(members, CAMERAS) == pytest.approx(expected, rel=1e-4)


def test_no_giant_speaks_for_all() -> None:
    members = sheeny([(1e4, 1e4, 1e4), *[(0.1, 0.1, 0.1)] * 99], [0.9] * 100)
    assert float(visible_area(members)[0]) == pytest.approx(20 / 100 * 0.9e8, rel=1e-3)


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
