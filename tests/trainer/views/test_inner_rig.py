"""Tests of the cameras around a region of a scene that surrounds the viewer."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from progdf.demo_scenes import room
from progdf.demo_scenes.assemble import DemoScene
from progdf.errors import ProgdfError
from progdf.region import Region, from_mask, whole_scene
from progdf.scene.bounds import is_surrounding
from trainer.views.view import make_view, region_rig, region_sphere, with_near_plane


@cache
def small_room() -> DemoScene:
    return room(12_000)


def part(name: str) -> Region:
    demo = small_room()
    label = demo.label_names.index(name)
    return from_mask(name, demo.labels == label)


def outside(position: Tensor) -> bool:
    """Return whether a position lies outside the walls."""
    means = small_room().gaussians.means
    low = torch.stack([axis.quantile(0.01) for axis in means.unbind(1)])
    high = torch.stack([axis.quantile(0.99) for axis in means.unbind(1)])
    return bool(((position < low) | (position > high)).any())


@pytest.mark.parametrize("name", ["stool", "vase", "rug", "walls", "floor"])
def test_cameras_stand_inside_and_show_the_region(name: str) -> None:
    scene = small_room().gaussians
    region = part(name)
    cameras = with_near_plane(region_rig(scene, region, 10, 64), scene)
    assert len(cameras) == 10
    for camera in cameras:
        assert not outside(camera.position)
        view = make_view(scene, region, camera, torch.ones(3))
        assert float(view.mask.max()) > 0.5


def test_cameras_look_from_all_sides() -> None:
    scene = small_room().gaussians
    region = part("stool")
    center, radius = region_sphere(scene, region)
    toward = torch.stack([camera.position - center for camera in region_rig(scene, region, 16, 64)])
    assert float(toward.norm(dim=1).min()) >= 0.99 * radius
    plan = torch.atan2(toward[:, 0], toward[:, 2]).sort().values
    gaps = torch.diff(torch.cat([plan, plan[:1] + 2 * torch.pi]))
    assert float(gaps.max()) < torch.pi / 2


def test_whole_room_is_seen_from_its_inside() -> None:
    scene = small_room().gaussians
    cameras = region_rig(scene, whole_scene(scene), 8, 64)
    assert len(cameras) == 8
    assert not any(outside(camera.position) for camera in cameras)


def test_hidden_region_is_refused_in_one_line() -> None:
    scene = small_room().gaussians
    center = scene.means.median(dim=0).values
    region = Region(
        "hidden", torch.tensor([0]), torch.zeros(len(scene)).index_fill(0, torch.tensor([0]), 1.0)
    )
    means = scene.means.clone()
    means[0] = center
    opacities = scene.logit_opacities.clone()
    opacities[0] = -20.0
    hidden = replace(scene, means=means, logit_opacities=opacities)
    assert is_surrounding(hidden, torch.tensor([0.0, 1.0, 0.0]))
    with pytest.raises(ProgdfError, match="no free place shows the region 'hidden'"):
        region_rig(hidden, region, 4, 64)
