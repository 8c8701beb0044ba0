"""Size of the views, chosen by the smallest visible Gaussians and limited by time."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from progdf.gaussians import Gaussians
from progdf.region import Region
from tests.helpers.demo_scenes import bear
from trainer.options import LARGEST_VIEW_PX
from trainer.views.size import MAX_SIDE_PX, SizeLimits, ViewSize, choose_view_size
from trainer.views.view import region_rig

LEAST = 96  # pixels
LARGE = 10**9  # pixels, no limit


def shell(scale: float, count: int = 3000) -> Gaussians:
    """Return a sphere of radius 1 covered by round opaque Gaussians of one standard deviation."""
    directions = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return replace(
        bear(count).gaussians,
        means=torch.nn.functional.normalize(directions, dim=1),
        log_scales=torch.full((count, 3), math.log(scale)),
        logit_opacities=torch.full((count,), 4.0),
    )


def size_of(scene: Gaussians, limit: int = LARGE) -> ViewSize:
    region = Region("all", torch.arange(len(scene)), torch.ones(len(scene)))
    return choose_view_size(
        scene, region, region_rig(scene, region, 3, 64, fills=True), SizeLimits(LEAST, limit)
    )


def test_finer_gaussians_get_larger_views() -> None:
    sizes = [size_of(shell(scale)).needed for scale in (0.02, 0.01, 0.005)]
    assert sizes[1] == pytest.approx(2 * sizes[0], rel=0.15)
    assert sizes[2] == pytest.approx(2 * sizes[1], rel=0.15)


def test_size_does_not_depend_on_the_unit_of_length() -> None:
    scene = shell(0.01)
    larger = replace(scene, means=100 * scene.means, log_scales=scene.log_scales + math.log(100))
    assert size_of(scene) == size_of(larger)


def test_hidden_fine_gaussians_do_not_count() -> None:
    coarse = shell(0.05)
    scales = coarse.log_scales.clone()
    scales[:1000] = math.log(0.002)
    inside = coarse.means.clone()
    inside[:1000] *= 0.3
    hidden = replace(coarse, means=inside, log_scales=scales)
    assert size_of(hidden).needed == pytest.approx(size_of(coarse).needed, rel=0.2)


def test_time_limits_the_size_and_the_log_names_the_needed_one() -> None:
    free = size_of(shell(0.005))
    limited = size_of(shell(0.005), 20_000)
    assert LEAST <= limited.side < free.side
    assert limited.needed == free.needed
    assert f"--image-size {free.needed}" in limited.line()
    assert "limit" not in size_of(shell(0.02)).line()


def test_log_names_a_size_that_the_command_accepts() -> None:
    size = size_of(shell(0.0001))
    assert size.needed > LARGEST_VIEW_PX
    assert f"(--image-size {LARGEST_VIEW_PX})" in size.line()


def test_size_stays_in_its_range() -> None:
    assert size_of(shell(0.5)).side == LEAST
    assert size_of(shell(0.0001)).side <= MAX_SIDE_PX
