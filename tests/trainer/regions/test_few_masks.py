"""Repairs of regions from few rough masks: strays seen by one view, loose pieces, holes."""

from __future__ import annotations

from dataclasses import replace

import torch

from progdf.gaussians import Gaussians
from tests.helpers.scenes import random_gaussians
from trainer.regions.few_masks import connected_pieces, drop_strays, find_holes


def grids(*places: tuple[float, int]) -> Gaussians:
    """Return square sheets of Gaussians 0.1 apart, each given as (depth, Gaussians per side)."""
    sheets = []
    for depth, side in places:
        x, y = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
        sheets.append(torch.stack([0.1 * x.flatten(), 0.1 * y.flatten(), torch.full((side**2,), depth)], 1))
    means = torch.cat(sheets).float()
    return replace(random_gaussians(len(means)), means=means)


def test_gaussian_inside_one_of_two_masks_is_no_member() -> None:
    scene = grids((0.0, 10))
    views = torch.full((100,), 3.0)
    inside = torch.full((100,), 2.0)
    inside[40:60] = 1.0
    messages: list[str] = []
    kept = drop_strays(scene, torch.ones(100, dtype=torch.bool), views, inside, messages.append)
    assert kept.nonzero()[:, 0].tolist() == [*range(40), *range(60, 100)]
    assert messages == [
        "the masks: 20 Gaussians inside only one mask although two views see them: their surroundings decide"
    ]


def test_larger_background_seen_by_one_view_is_dropped() -> None:
    scene = grids((0.0, 10), (5.0, 20))
    near = torch.arange(500) < 100
    views = torch.where(near, 3.0, 1.0)
    messages: list[str] = []
    kept = drop_strays(scene, torch.ones(500, dtype=torch.bool), views, views, messages.append)
    assert torch.equal(kept, near)
    assert messages == ["the masks: 400 Gaussians not on the 1 largest connected surface: removed"]


def test_two_separate_pieces_are_both_kept() -> None:
    scene = grids((0.0, 10), (5.0, 8))
    views = torch.full((164,), 2.0)
    assert bool(drop_strays(scene, torch.ones(164, dtype=torch.bool), views, views).all())


def test_hole_is_filled_unless_two_views_see_through_it() -> None:
    scene = grids((0.0, 12))
    member = torch.ones(144, dtype=torch.bool)
    member[65] = False
    member[78] = False
    outside = torch.zeros(144)
    assert find_holes(scene, member, outside).tolist() == [65, 78]
    outside[78] = 2.0
    messages: list[str] = []
    assert find_holes(scene, member, outside, messages.append).tolist() == [65]
    assert messages == ["the masks: 1 Gaussian in holes of the region: added"]


def test_empty_region_stays_empty() -> None:
    scene = grids((0.0, 4))
    no_members = torch.zeros(16, dtype=torch.bool)
    views = torch.zeros(16)
    assert not bool(drop_strays(scene, no_members, views, views).any())
    assert not len(find_holes(scene, no_members, views))


def test_touching_large_gaussians_are_one_piece_beside_small_ones() -> None:
    scene = grids((0.0, 10), (9.0, 30))
    small = torch.arange(1000) >= 100
    means = torch.where(small[:, None], scene.means * torch.tensor([0.01, 0.01, 1.0]), scene.means)
    widths = torch.where(small, 0.0005, 0.05).log()[:, None].expand(1000, 3)
    pieces = connected_pieces(replace(scene, means=means, log_scales=widths))
    assert len(set(pieces[:100].tolist())) == len(set(pieces[100:].tolist())) == 1
    assert pieces[0] != pieces[-1]
