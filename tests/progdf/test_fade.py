"""Tests of fading: even in pictures, exact at both ends."""

from __future__ import annotations

import math
from functools import cache

import pytest
import torch
from torch import Tensor

from progdf.compose.reference import edited_scene
from progdf.fade import cameras_around, fading_course, front_transmittance, linear_remap
from progdf.gaussians import Gaussians, concatenate
from progdf.gdf.file import ADDED_LOGIT
from progdf.metrics.slider import visible_change
from progdf.quaternions import matrix_quats
from progdf.rasterize import render
from progdf.region import Region, from_mask
from progdf.sh import rgb_to_sh0
from progdf.tidy import Step, similarity, tidy
from tests.helpers.scenes import orbit_camera

SHELL_COUNT = 1200
BACKGROUNDS = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def shell(radius: float, rgb: tuple[float, float, float]) -> Gaussians:
    """Return a closed sphere of opaque discs."""
    at = torch.arange(SHELL_COUNT)
    height = (2 * at + 1) / SHELL_COUNT - 1
    level = (1 - height.square()).sqrt()
    angle = at * math.pi * (3 - math.sqrt(5))
    normals = torch.stack([level * angle.cos(), height, level * angle.sin()], dim=1)
    helper = torch.eye(3)[normals.abs().argmin(dim=1)]
    axis = torch.nn.functional.normalize(torch.linalg.cross(normals, helper), dim=1)
    frames = torch.stack([axis, torch.linalg.cross(normals, axis), normals], dim=2)
    size = 0.1 * radius
    scales = torch.log(torch.tensor([size, size, size / 10])).repeat(SHELL_COUNT, 1)
    colors = rgb_to_sh0(torch.tensor([rgb]).repeat(SHELL_COUNT, 1))
    return Gaussians(
        radius * normals,
        matrix_quats(frames),
        scales,
        torch.full((SHELL_COUNT,), 3.0),
        colors,
        torch.zeros(SHELL_COUNT, 0, 3),
    )


@cache
def nested() -> tuple[Gaussians, Region]:
    """Return a red sphere around a hidden green one, and the region of both."""
    scene = concatenate([shell(1.0, (0.8, 0.2, 0.1)), shell(0.6, (0.1, 0.9, 0.2))])
    return scene, from_mask("ball", torch.ones(len(scene), dtype=torch.bool))


def pictures(scene: Gaussians) -> list[Tensor]:
    cameras = [orbit_camera(72, 72, azimuth=azimuth) for azimuth in (0.3, 2.1)]
    return [render(scene, camera, background).image for camera in cameras for background in BACKGROUNDS]


def test_remap_inverts_a_known_course() -> None:
    ramp = torch.linspace(0.2, 1.0, 50)
    remap = linear_remap(lambda place: place**2 * ramp)
    places = torch.linspace(0.0, 1.0, 9)
    assert torch.allclose(remap(places), places.double().square(), atol=0.02)
    assert remap.at(0.0) == 0.0
    assert remap.at(1.0) == 1.0
    assert linear_remap(lambda place: ramp).is_identity


@pytest.mark.parametrize("does", ["remove", "duplicate"])
def test_visible_change_is_linear_in_unseen_views(does: str) -> None:
    scene, region = nested()
    step = Step("remove", region) if does == "remove" else Step("duplicate", region, similarity((3.0, 0, 0)))
    gdf = tidy(scene, [step], "gone", cameras=())
    linear = tidy(scene, [step], "gone")
    first = pictures(scene)
    whole = visible_change(first, pictures(edited_scene(scene, gdf, 1.0)))
    for strength in (0.25, 0.5, 0.75):
        share = visible_change(first, pictures(edited_scene(scene, gdf, strength))) / whole
        assert share == pytest.approx(strength, abs=0.05)
    assert torch.equal(gdf.field.offsets(1.0), linear.field.offsets(1.0))
    assert torch.equal(edited_scene(scene, gdf, 0.0).logit_opacities[: len(scene)], scene.logit_opacities)


def test_plain_opacities_fade_unevenly() -> None:
    scene, region = nested()
    gdf = tidy(scene, [Step("remove", region)], "gone")
    first = pictures(scene)
    whole = visible_change(first, pictures(edited_scene(scene, gdf, 1.0)))
    assert visible_change(first, pictures(edited_scene(scene, gdf, 0.5))) < 0.3 * whole


def test_hidden_gaussians_vanish_first() -> None:
    scene, _ = nested()
    front = front_transmittance(scene, cameras_around(scene))
    outer = front[:SHELL_COUNT]
    inner = front[SHELL_COUNT:]
    assert float(outer.median()) > 0.15  # neighbors on the shell overlap
    assert float(inner.median()) < 0.01
    rows = torch.arange(len(scene))
    knots, offsets = fading_course(scene, rows, torch.full((len(scene),), ADDED_LOGIT))
    middle = int((knots - 0.5).abs().argmin())
    opacities = (scene.logit_opacities + offsets[middle]).sigmoid()
    assert float(opacities[SHELL_COUNT:].max()) < 0.5 * float(opacities[:SHELL_COUNT].median())


def test_rows_that_appear_behind_are_opaque_from_the_start() -> None:
    outer = shell(1.0, (0.8, 0.2, 0.1))
    inner = shell(0.6, (0.1, 0.9, 0.2))
    appearing = Gaussians(
        inner.means,
        inner.quats,
        inner.log_scales,
        torch.full((SHELL_COUNT,), ADDED_LOGIT),
        inner.sh0,
        inner.shN,
    )
    scene = concatenate([outer, appearing])
    end = torch.cat([torch.full((SHELL_COUNT,), ADDED_LOGIT), inner.logit_opacities])
    knots, offsets = fading_course(scene, torch.arange(len(scene)), end)
    early = int((knots - 0.2).abs().argmin())
    opacities = (scene.logit_opacities + offsets[early]).sigmoid()
    assert float(opacities[SHELL_COUNT:].min()) > 0.8
