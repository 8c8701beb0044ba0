"""Double click finds the surface point under the cursor by accumulated opacity."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from progdf.gaussians import Gaussians
from progdf.rasterize import render
from tests.helpers.scenes import front_camera, orbit_camera, random_gaussians
from tests.helpers.ui_rig import bear
from viewer.camera.view_camera import first_camera, to_camera
from viewer.render.picking import surface_point


def wall(depth: float, opacity: float, width: float = 2.0) -> Gaussians:
    """Return one flat Gaussian across the view at a depth."""
    return Gaussians(
        means=torch.tensor([[0.0, 0.0, depth]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        log_scales=torch.tensor([[width, width, 1e-3]]).log(),
        logit_opacities=torch.logit(torch.tensor([opacity])),
        sh0=torch.zeros(1, 3),
        shN=torch.zeros(1, 0, 3),
    )


def joined(*parts: Gaussians) -> Gaussians:
    names = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
    return Gaussians(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})


def test_point_lies_on_the_ray_at_the_depth_of_the_wall() -> None:
    x, y, z = surface_point(wall(4.0, 0.95), front_camera(40, 24, focal=30.0), 29.0, 6.0) or (0, 0, 0)
    assert z == pytest.approx(4.0)
    assert (x, y) == pytest.approx((4.0 * (29 - 20) / 30, 4.0 * (6 - 12) / 30))


def test_veil_in_front_is_ignored() -> None:
    scene = joined(wall(2.0, 0.2), wall(5.0, 0.9))
    point = surface_point(scene, front_camera(), 20.0, 12.0)
    assert point is not None
    assert point[2] == pytest.approx(5.0)


def test_two_veils_that_are_half_opaque_together_are_a_surface() -> None:
    scene = joined(wall(5.0, 0.9), wall(2.0, 0.35), wall(3.0, 0.35))
    point = surface_point(scene, front_camera(), 20.0, 12.0)
    assert point is not None
    assert point[2] == pytest.approx(3.0)


def test_strongest_veil_is_picked_if_none_gets_half_opaque() -> None:
    point = surface_point(joined(wall(2.0, 0.1), wall(5.0, 0.3)), front_camera(), 20.0, 12.0)
    assert point is not None
    assert point[2] == pytest.approx(5.0)


def test_background_and_points_behind_the_camera_are_no_surface() -> None:
    assert surface_point(wall(4.0, 0.9, width=0.01), front_camera(), 1.0, 1.0) is None
    assert surface_point(wall(-4.0, 0.9), front_camera(), 20.0, 12.0) is None
    assert surface_point(wall(4.0, 0.02), front_camera(), 20.0, 12.0) is None
    empty = wall(4.0, 0.9)[torch.zeros(0, dtype=torch.int64)]
    assert surface_point(empty, front_camera(), 20.0, 12.0) is None


def test_rows_with_invalid_numbers_are_skipped() -> None:
    broken = wall(1.0, 0.9)
    broken = replace(broken, means=torch.full((1, 3), torch.nan))
    huge = replace(wall(1.0, 0.9), log_scales=torch.full((1, 3), torch.inf))
    point = surface_point(joined(broken, huge, wall(4.0, 0.9)), front_camera(), 20.0, 12.0)
    assert point is not None
    assert point[2] == pytest.approx(4.0)


@given(st.integers(0, 20), st.floats(0, 40, exclude_max=True), st.floats(0, 24, exclude_max=True))
@example(1, 31.0, 10.0)  # a Gaussian beside the picture and close to the camera: its projection is clamped
@settings(max_examples=40, deadline=None)
def test_pick_succeeds_exactly_on_covered_pixels(seed: int, x: float, y: float) -> None:
    camera = orbit_camera()
    scene = random_gaussians(60, seed)
    x = int(x) + 0.5
    y = int(y) + 0.5
    picked = surface_point(scene, camera, x, y)
    transmittance = render(scene, camera, engine="reference").transmittance
    covered = 1.0 - float(transmittance[int(y), int(x)])
    if abs(covered - 0.05) > 0.01:
        assert (picked is not None) == (covered > 0.05)


def test_nose_of_the_bear_is_picked_on_its_surface() -> None:
    demo = bear().demo
    camera = to_camera(first_camera(demo.gaussians, demo.cameras), 400, 400)
    head = demo.gaussians.means[demo.members("head")]
    seen = camera.viewmat @ torch.cat([head.mean(0), torch.ones(1)])
    x, y = (camera.K[:2, :2] @ (seen[:2] / seen[2]) + camera.K[:2, 2]).tolist()
    point = surface_point(demo.gaussians, camera, x, y)
    assert point is not None
    distance = (head - torch.tensor(point)).norm(dim=1).min()
    assert distance < 0.2
    assert (torch.tensor(point) - camera.position).norm() < (head.mean(0) - camera.position).norm()
