"""Remains of a removed region: missed Gaussians are found, neighbors and the ground stay."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.rasterize import render
from progdf.region import Region, from_mask
from tests.helpers.demo_scenes import room
from trainer.regions.remains import _forest, find_remains, grown_mask, remaining_share
from trainer.views.view import View, make_view

MISSED_STRIDE = 12
ROOM_SIZE = 12_000
WHITE = torch.ones(3)


@cache
def scene_and_labels() -> tuple[Gaussians, Tensor, tuple[str, ...], list]:
    demo = room(ROOM_SIZE)
    cameras = [camera.resize(160, 120) for camera in demo.cameras[::3]]
    return demo.gaussians, demo.labels.long(), tuple(demo.label_names), cameras


def case(name: str) -> tuple[Gaussians, Tensor, Region, list[View]]:
    """Return the room, the mask of an object, a region that misses every twelfth of its Gaussians, and
    views."""
    scene, labels, names, cameras = scene_and_labels()
    whole = labels == names.index(name)
    named = whole.clone()
    named[whole.nonzero()[::MISSED_STRIDE, 0]] = False
    region = from_mask(name, named)
    return scene, whole, region, [make_view(scene, region, camera, WHITE) for camera in cameras]


@pytest.mark.parametrize("name", ["ball", "stool", "vase"])
def test_missed_gaussians_are_found_and_others_stay(name: str) -> None:
    scene, whole, region, views = case(name)
    found = find_remains(scene, region, views)
    taken = torch.zeros(len(scene), dtype=torch.bool)
    taken[found.seen] = True
    taken[found.hidden] = True
    missed = whole & ~region.mask
    assert int((taken & missed).sum()) >= 0.9 * int(missed.sum())
    assert int((taken & ~whole).sum()) <= 0.05 * int(whole.sum())


@pytest.mark.parametrize("name", ["ball", "stool", "vase"])
def test_surroundings_keep_their_pixels(name: str) -> None:
    scene, _, region, views = case(name)
    found = find_remains(scene, region, views)
    kept = ~region.mask
    whole_removal = kept.clone()
    whole_removal[found.seen] = False
    whole_removal[found.hidden] = False
    for view in views:
        alone, clean = (
            render(scene[mask], view.camera, (1.0, 1.0, 1.0)).image for mask in (kept, whole_removal)
        )
        changed = (alone - clean).abs().amax(dim=2)[~grown_mask(view)]
        assert float(changed.mean()) < 1e-4
        assert float(changed.max()) < 0.1


def test_remaining_share_counts_only_the_surface_of_the_object() -> None:
    scene, whole, region, views = case("ball")
    exact = from_mask("ball", whole)
    masked = [make_view(scene, exact, view.camera, WHITE) for view in views]
    assert remaining_share(scene, scene, masked) > 0.95
    assert remaining_share(scene, scene[~whole], masked) < 0.02
    assert remaining_share(scene, scene[~region.mask], masked) > remaining_share(scene, scene[~whole], masked)


def test_forest_joins_each_node_by_its_smallest_largest_step() -> None:
    # cheapest first: 2-3, 1-3, 0-2; node 4 is alone
    roots = _forest(np.array([2, 1, 0]), np.array([3, 3, 2]), 5)
    assert roots.tolist() == [0, 1, 1, 1, -1]


def test_scene_without_other_gaussians_has_no_remains() -> None:
    scene, _, region, views = case("ball")
    rest = scene[region.members]
    everything = from_mask("all", torch.ones(len(rest), dtype=torch.bool))
    found = find_remains(rest, everything, [make_view(rest, everything, v.camera, WHITE) for v in views[:2]])
    assert len(found.seen) == 0
    assert len(found.hidden) == 0
