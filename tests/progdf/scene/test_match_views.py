"""Tests of the search for the view that an edited picture shows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.demo_scenes import DemoScene
from progdf.rasterize import render
from progdf.scene.match_views import ViewMatch, match_views, matched_camera, view_thumbnail
from progdf.scene.orbit_rig import orbit_rig
from tests.helpers.changed_pictures import paint_over, save_elsewhere
from tests.helpers.demo_scenes import bear, room

SIZE = (320, 240)
VIEWS = 12
TRIALS = 20
MIN_FOUND = 16  # a miss is asked about in the window; the goal is 19
MAX_CORNER_ERROR = 0.003  # share of the view's width


@dataclass(frozen=True)
class Views:
    """Views of a scene: those that were taken, and others."""

    cameras: list[Camera]
    taken: list[NDArray[np.uint8]]
    others: list[NDArray[np.uint8]]

    @property
    def thumbnails(self) -> list[NDArray[np.uint8]]:
        return [view_thumbnail(image) for image in self.taken]


def _views(demo: DemoScene) -> Views:
    cameras = orbit_rig(demo.gaussians, 2 * VIEWS, *SIZE, distance=1.6)
    images = []
    for camera in cameras:
        with torch.no_grad():
            image = render(demo.gaussians, camera, (1.0, 1.0, 1.0)).image
        images.append((image.clamp(0.0, 1.0) * 255).round().byte().numpy())
    return Views(cameras[::2], images[::2], images[1::2])


@cache
def bear_views() -> Views:
    return _views(bear(4000))


@cache
def room_views() -> Views:
    return _views(room(4000))


def corner_error(match: ViewMatch, area: tuple[float, float, float, float]) -> float:
    """Return the largest error of the found area's corners, as a share of the view."""
    found = np.array([match.area, area])
    corners = np.concatenate([found[:, :2], found[:, :2] + found[:, 2:]], axis=1)
    return float(np.abs(corners[0] - corners[1]).max())


@pytest.fixture(scope="module")
def views() -> Views:
    return bear_views()


def test_half_painted_cropped_jpeg_is_found(views: Views) -> None:
    rng = np.random.default_rng(1)
    changed = save_elsewhere(paint_over(views.taken[4], 0.5, rng), rng)
    match = match_views(changed.pixels, views.thumbnails[3:6])
    assert match is not None
    assert (match.index, match.certain) == (1, True)
    assert corner_error(match, changed.area) < MAX_CORNER_ERROR


def test_view_beside_the_taken_ones_is_only_the_nearest(views: Views) -> None:
    match = match_views(views.others[4], views.thumbnails[4:6])
    assert match is not None
    assert not match.certain


def test_no_views_give_no_match() -> None:
    assert match_views(np.zeros((60, 80, 3), np.uint8), []) is None


@pytest.mark.parametrize("size", [(8, 8), (1, 400), (400, 1)])
def test_odd_and_empty_pictures_match_nothing(size: tuple[int, int]) -> None:
    match = match_views(np.zeros((*size, 3), np.uint8), bear_views().thumbnails[:3])
    assert match is None or not match.certain


def test_camera_of_a_crop_projects_to_the_crop() -> None:
    camera = bear_views().cameras[0]
    match = ViewMatch(0, (0.1, 0.2, 0.5, 0.6), 1.0, 0.0, True)
    cropped = matched_camera(match, camera, (320, 288))
    point = camera.K @ torch.tensor([0.1, -0.05, 1.0])
    moved = cropped.K @ torch.tensor([0.1, -0.05, 1.0])
    assert float(moved[0]) == pytest.approx(float(point[0] / SIZE[0] - 0.1) / 0.5 * 320, abs=1e-3)
    assert float(moved[1]) == pytest.approx(float(point[1] / SIZE[1] - 0.2) / 0.6 * 288, abs=1e-3)
    assert (cropped.width, cropped.height) == (320, 288)


@pytest.mark.slow
def test_changed_pictures_are_found_and_others_never_accepted() -> None:
    own = bear_views()
    rng = np.random.default_rng(7)
    thumbnails = own.thumbnails
    found = 0
    for trial in range(TRIALS):
        index = trial % VIEWS
        share = rng.uniform(0.05, 0.6)
        changed = save_elsewhere(paint_over(own.taken[index], share, rng), rng)
        match = match_views(changed.pixels, thumbnails)
        assert match is not None
        assert not match.certain or match.index == index
        found += match.certain and corner_error(match, changed.area) < MAX_CORNER_ERROR
    assert found >= MIN_FOUND
    foreign = room_views()
    for trial in range(TRIALS):
        source = own.others if trial % 2 else foreign.taken
        image = source[trial % VIEWS]
        changed = save_elsewhere(paint_over(image, rng.uniform(0.05, 0.6), rng), rng)
        match = match_views(changed.pixels, thumbnails)
        assert match is not None
        assert not match.certain
