"""Tests of neighbor searches, which stay exact and bounded if many points share one position."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from progdf.gaussians import Gaussians
from progdf.scene.neighbors import Neighborhood, nearest_rows
from progdf.scene.point_tree import LEAF_SIZE, PointTree
from progdf.scene.scribbles import likely_steps
from tests.helpers.paths import ROOT
from tests.helpers.scenes import random_gaussians

CROWD = 4000
APART = 300


def crowded_points() -> np.ndarray:
    """Return a cloud, and many points at one position inside it."""
    cloud = np.random.default_rng(5).random((APART, 3))
    return np.concatenate([cloud, np.full((CROWD, 3), 0.5)])


def crowded_scene() -> Gaussians:
    scene = random_gaussians(APART + CROWD, seed=2)
    return replace(scene, means=torch.from_numpy(crowded_points()).float())


def test_crowded_position_makes_no_large_leaf() -> None:
    tree = PointTree(crowded_points(), 8)
    assert tree.largest_leaf == LEAF_SIZE
    assert PointTree(crowded_points(), 24).largest_leaf == 25
    assert sorted(tree.order.tolist()) == [*range(APART + CROWD)]


@pytest.mark.parametrize("within", [np.inf, 0.1])
def test_distances_match_a_full_search(within: float) -> None:
    points = crowded_points()
    places = np.random.default_rng(6).random((50, 3))
    tree = PointTree(points, 9)
    distances, rows = tree.query(places, 9, within)
    every = np.sort(np.linalg.norm(points - places[:, None], axis=2), axis=1)[:, :9]
    np.testing.assert_allclose(distances, np.where(every < within, every, np.inf))
    found = rows < len(points)
    assert np.array_equal(found, every < within)
    away = np.linalg.norm(points[np.where(found, rows, 0)] - places[:, None], axis=2)
    np.testing.assert_allclose(away[found], every[found])
    np.testing.assert_allclose(tree.kth_distances(places, 4), every[:, 3])


def test_missing_second_neighbor_is_infinitely_far() -> None:
    distances, rows = PointTree(np.zeros((1, 3)), 2).query(np.ones((1, 3)), 2)
    assert rows.tolist() == [[0, 1]]
    assert np.isinf(distances).tolist() == [[False, True]]


def test_neighbors_in_a_crowd_are_other_rows() -> None:
    points = torch.from_numpy(crowded_points())
    rows = torch.arange(len(points))
    near, distances = nearest_rows(points, rows, 5)
    assert not bool((near == rows[:, None]).any())
    assert float(distances[APART:].max()) == 0.0
    assert all(len(set(row)) == 5 for row in near.tolist())


def test_grow_reaches_a_whole_crowd() -> None:
    scene = crowded_scene()
    mask = np.zeros(len(scene), bool)
    mask[-1] = True
    assert Neighborhood(scene).grow(mask)[APART:].all()


def test_crowd_is_one_connected_part() -> None:
    scene = crowded_scene()
    neighborhood = Neighborhood(replace(scene, log_scales=torch.full((len(scene), 3), -12.0)))
    crowd = np.arange(len(scene)) >= APART
    every = np.ones(len(scene), bool)
    assert np.array_equal(neighborhood.largest_part(every), crowd)
    for seed in (APART, len(scene) - 1):
        assert np.array_equal(neighborhood.connected_part(every, np.array([seed])), crowd)


@pytest.mark.parametrize("step", ["shrink", "smooth", "refine"])
def test_other_steps_accept_a_crowd(step: str) -> None:
    scene = crowded_scene()
    mask = scene.means[:, 0].numpy() <= 0.5
    changed = getattr(Neighborhood(scene), step)(mask)
    assert changed[APART:].any()
    assert changed.shape == mask.shape


def test_steps_of_a_walk_in_a_crowd_are_bounded() -> None:
    steps = likely_steps(crowded_points(), np.zeros((APART + CROWD, 3), np.float32))
    assert steps.nnz <= 2 * 10 * (APART + CROWD)
    assert np.isfinite(steps.data).all()


def test_all_nearest_neighbor_searches_use_point_trees() -> None:
    users = {
        path.relative_to(ROOT).as_posix()
        for package in ("progdf", "trainer", "viewer")
        for path in (ROOT / package).rglob("*.py")
        if "scipy.spatial import" in path.read_text("utf-8")
    }
    # anchors.py drops equal positions; parts.py joins the centroids of cells, which never share a position.
    # paint_sheets.py and paint.py search among discs of paint, which lie apart; carry_on.py finds a hull of
    # colors
    expected = {
        "progdf/compose/paint_sheets.py",
        "progdf/gdf/anchors.py",
        "progdf/scene/point_tree.py",
        "trainer/motion/parts.py",
        "trainer/optimize/carry_on.py",
        "viewer/state/paint.py",
    }
    assert users == expected
