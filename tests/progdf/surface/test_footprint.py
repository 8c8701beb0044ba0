"""Fast surface under a disc of a picture, against the surface that training finds."""

from __future__ import annotations

import numpy as np
import pytest

from progdf.surface.find import find_surface
from progdf.surface.footprint import DepthPicture, depth_picture, fit_edge, fit_footprint, near_surface
from progdf.surface.models import fit_planes, mean_distance
from tests.progdf.surface.test_surface import edge, samples
from tests.trainer.painted_wall import CAMERA, SIDE, wall

COLUMNS, ROWS = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5)
X = (COLUMNS - float(CAMERA.K[0, 2])) / float(CAMERA.K[0, 0])
Y = (ROWS - float(CAMERA.K[1, 2])) / float(CAMERA.K[1, 1])


def picture_of(inverse: np.ndarray, thickness: float = 0.001) -> DepthPicture:
    """Return a depth picture of an inverse depth per pixel."""
    depth = 1.0 / inverse
    return DepthPicture(CAMERA, depth, np.full_like(depth, thickness), np.ones(depth.shape, bool))


def test_tilted_plane_has_its_normal() -> None:
    found = fit_footprint(picture_of(0.4 + 0.1 * X - 0.2 * Y), 60.0, 70.0, 20.0)
    assert found is not None
    assert found.model.name == "a plane"
    towards = -np.array([0.1, -0.2, 0.4]) / np.linalg.norm([0.1, -0.2, 0.4])
    assert np.allclose(found.normal @ CAMERA.viewmat[:3, :3].double().numpy().T, towards, atol=1e-6)
    inside = CAMERA.viewmat[:3, :3].double().numpy() @ found.center + CAMERA.viewmat[:3, 3].double().numpy()
    assert inside[2] == pytest.approx(found.depth)
    assert inside[0] / inside[2] == pytest.approx((60.0 - SIDE / 2) / float(CAMERA.K[0, 0]))


def test_curved_surface_needs_a_curved_model() -> None:
    found = fit_footprint(picture_of(0.4 - 0.6 * X**2 - 0.4 * Y**2), 64.0, 64.0, 30.0)
    assert found is not None
    assert found.model.name == "a curved surface of degree 2"


def test_direction_of_an_edge_lies_between_its_sides() -> None:
    found = fit_footprint(picture_of(np.minimum(0.4 + 0.4 * X, 0.4 - 0.4 * X)), 64.0, 64.0, 30.0)
    assert found is not None
    assert abs(float(found.normal @ CAMERA.viewmat[0, :3].double().numpy())) < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_fast_edge_fits_like_the_plain_one(seed: int) -> None:
    noisy = samples(edge, seed)
    fast = mean_distance(noisy, fit_edge(noisy))
    plain = mean_distance(noisy, fit_planes(noisy, 2))
    assert fast == pytest.approx(plain, rel=0.02)
    assert fast < 0.6 * mean_distance(noisy, fit_planes(noisy)), "one plane does not fit"


def test_decal_covers_only_what_is_near_its_plane() -> None:
    inverse = np.where(COLUMNS < 80, 0.4 + 0.1 * Y, 0.2)
    near = near_surface(picture_of(inverse), 60.0, 64.0, 30.0)
    assert near[:, :80].all()
    assert not near[:, 80:].any(), "another thing twice as far away"
    assert near_surface(picture_of(inverse), -5.0, 64.0, 30.0).all(), "the center shows no surface"


def test_grazing_plane_is_covered_as_a_whole() -> None:
    steep = 0.4 - 0.7 * Y
    assert near_surface(picture_of(steep), 64.0, 64.0, 60.0)[20:, :].all()


def test_place_without_a_surface_has_no_footprint() -> None:
    plane = picture_of(np.full((SIDE, SIDE), 0.4))
    holed = DepthPicture(plane.camera, plane.depth, plane.thickness, COLUMNS > 64)
    assert fit_footprint(holed, 30.0, 64.0, 15.0) is None
    assert fit_footprint(holed, -5.0, 64.0, 15.0) is None
    assert fit_footprint(holed, 90.0, 64.0, 15.0) is not None


def test_footprint_agrees_with_the_surface_of_the_training() -> None:
    scene = wall(rough=0.03)
    found = fit_footprint(depth_picture(scene, CAMERA), 64.0, 64.0, 20.0)
    assert found is not None
    painted = np.hypot(COLUMNS - 64, ROWS - 64) <= 20
    trained = find_surface(scene, CAMERA, painted)
    difference = found.model.inverse_depth(X, Y) * trained.depth - 1.0
    assert np.abs(difference[painted]).max() * float(CAMERA.K[0, 0]) < 2.0, "pixels at the surface's depth"
