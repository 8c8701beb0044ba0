"""Tests of the rig of cameras around a scene: framing, positions and held-out cameras."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.scene.bounds import front_direction, scene_sphere
from progdf.scene.orbit_rig import orbit_rig
from tests.helpers.scenes import ball

Y_UP = torch.tensor([0.0, 1.0, 0.0])


def seen(scene: Gaussians, camera: Camera) -> Tensor:
    """Return the mask of centers inside the picture. [N] bool"""
    places = scene.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = (places @ camera.K.T)[:, :2] / places[:, 2:]
    inside = (pixels >= 0) & (pixels <= torch.tensor([camera.width, camera.height]))
    return inside.all(dim=1) & (places[:, 2] > 0)


@pytest.mark.parametrize(("width", "height"), [(64, 64), (128, 64), (64, 128)])
@pytest.mark.parametrize("fov", [20.0, 60.0, 100.0])
def test_rig_frames_the_scene_for_any_lens(width: int, height: int, fov: float) -> None:
    scene = ball()
    for camera in orbit_rig(scene, 5, width, height, fov_y=math.radians(fov), up=Y_UP):
        assert float(seen(scene, camera).float().mean()) > 0.99
        assert (camera.width, camera.height) == (width, height)
        places = scene.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixels = (places @ camera.K.T)[:, :2] / places[:, 2:]
        spread = pixels.amax(dim=0) - pixels.amin(dim=0)
        assert float(spread.max()) > 0.6 * min(width, height)


def test_rig_surrounds_the_scene_evenly() -> None:
    cameras = orbit_rig(ball(), 40, 64, 64, up=Y_UP)
    places = torch.stack([camera.position for camera in cameras])
    azimuths = torch.atan2(places[:, 0], places[:, 2]).sort().values
    gaps = azimuths.diff()
    torch.testing.assert_close(gaps, torch.full((39,), 2 * math.pi / 40), atol=0.02, rtol=0)
    heights = (places[:, 1] / places.norm(dim=1)).sort().values
    low = math.sin(math.radians(5))
    high = math.sin(math.radians(60))
    even = low + (high - low) * (torch.arange(40) + 0.5) / 40
    assert float((heights - even).abs().max()) < 0.05
    every_fifth = places[::5, 1] / places[::5].norm(dim=1)
    assert float(every_fifth.max() - every_fifth.min()) > 0.6 * (high - low)


def test_rig_looks_at_the_center_upright_and_starts_at_the_front() -> None:
    scene = ball()
    scene = replace(scene, means=scene.means + torch.tensor([5.0, -3.0, 2.0]))
    center, _ = scene_sphere(scene)
    up = torch.tensor([0.0, -1.0, 0.0])
    cameras = orbit_rig(scene, 7, 64, 48, up=up)
    for camera in cameras:
        ahead = camera.viewmat[:3, :3] @ (center - camera.position)
        torch.testing.assert_close(ahead[:2], torch.zeros(2), atol=1e-4, rtol=0)
        assert float((camera.viewmat[:3, :3] @ up)[1]) < 0
        assert float((camera.position - center) @ up) > 0, "a camera under the ground"
    away = cameras[0].position - center
    assert float(away @ front_direction(up)) > 0.8 * float(away.norm()) * math.cos(math.radians(60))
    assert [camera.name for camera in cameras[:2]] == ["orbit_000", "orbit_001"]


def test_rig_may_look_from_below() -> None:
    cameras = orbit_rig(ball(), 20, 64, 64, up=Y_UP, elevations=(-40.0, 40.0))
    heights = torch.stack([camera.position[1] for camera in cameras])
    assert 8 <= int((heights < 0).sum()) <= 12


def test_far_strays_do_not_move_the_rig() -> None:
    scene = ball()
    means = scene.means.clone()
    means[:40] = torch.tensor([2000.0, 0.0, 0.0])
    center, radius = scene_sphere(replace(scene, means=means))
    assert float(center.norm()) < 0.1
    assert 0.8 < radius < 1.1


def test_single_gaussian_is_framed_by_its_own_size() -> None:
    scene = ball(1)
    camera = orbit_rig(scene, 1, 64, 64)[0]
    distance = float((camera.position - scene.means[0]).norm())
    assert 2 < distance / float(scene.scales.max()) < 20


@pytest.mark.parametrize(("count", "elevations"), [(0, (5.0, 60.0)), (4, (60.0, 5.0)), (4, (0.0, 90.0))])
def test_impossible_rig_is_reported_in_one_line(count: int, elevations: tuple[float, float]) -> None:
    with pytest.raises(ProgdfError, match="the rig"):
        orbit_rig(ball(), count, 64, 64, elevations=elevations)
