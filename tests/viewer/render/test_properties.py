"""Properties of Gaussians: their values, histograms and ranges."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.helpers.scenes import front_camera, logit_of, one_gaussian, random_gaussians
from viewer.render.picking import OUTLINE_POINTS, outlines
from viewer.render.properties import BINS, PROPERTIES, distribution, rows_between
from viewer.render.view_modes import visible_count


@pytest.mark.parametrize("name", PROPERTIES)
def test_full_range_holds_every_gaussian_with_a_value(name: str) -> None:
    found = distribution(random_gaussians(500), name)
    known = np.isfinite(found.values)
    assert found.counts.sum() == known.sum()
    assert np.array_equal(rows_between(found, found.low, found.high), known)


@pytest.mark.parametrize("name", PROPERTIES)
def test_adjacent_ranges_share_no_gaussian(name: str) -> None:
    found = distribution(random_gaussians(500), name)
    middle = 0.5 * (found.low + found.high)
    low = rows_between(found, found.low, middle)
    high = rows_between(found, np.nextafter(np.float32(middle), np.float32(np.inf)), found.high)
    assert not (low & high).any()
    assert len(found.counts) == BINS


def test_range_of_surface_distances_selects_the_gaussians_off_a_plane() -> None:
    scene = random_gaussians(1000)
    random = np.random.default_rng(0)
    means = np.zeros((1000, 3))
    means[:, :2] = random.random((1000, 2))
    means[::100, 2] = 0.05
    scene = replace(scene, means=torch.tensor(means, dtype=torch.float32))
    found = distribution(scene, "surface")
    chosen = rows_between(found, math.log10(0.025), found.high)
    assert np.flatnonzero(chosen).tolist() == [*range(0, 1000, 100)]


def test_scene_with_broken_rows_has_a_histogram() -> None:
    scene = random_gaussians(20)
    scene.log_scales[3] = math.nan
    found = distribution(scene, "size")
    assert not rows_between(found, found.low, found.high)[3]
    assert found.counts.sum() == 19


def test_empty_scene_has_an_empty_histogram() -> None:
    assert distribution(random_gaussians(0), "hue").counts.sum() == 0


def test_outline_of_a_ball_is_a_circle_of_two_deviations() -> None:
    scene = one_gaussian(scales=(0.2, 0.2, 0.2))
    camera = front_camera()
    rows, lines = outlines(scene, np.zeros(1, np.int64), camera, 0.01)
    assert rows.tolist() == [0]
    assert lines.shape == (1, OUTLINE_POINTS, 2)
    radii = np.linalg.norm(lines[0] - [20.0, 12.0], axis=1)
    expected = 2.0 * math.sqrt((30.0 * 0.2 / 2.0) ** 2 + 0.3)  # with the rasterizer's blur
    np.testing.assert_allclose(radii, expected, rtol=1e-6)


def test_visible_count_leaves_out_what_is_behind_or_transparent() -> None:
    scene = random_gaussians(4)
    means = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0], [9.0, 0.0, 2.0], [0.0, 0.0, 3.0]])
    opacities = logit_of(torch.tensor([0.9, 0.9, 0.9, 0.001]))
    scene = replace(scene, means=means, logit_opacities=opacities)
    assert visible_count(scene, front_camera(), 0.01) == 1
