"""Parity of the deformation graph's kernels with their plain versions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from progdf.gaussians import pack
from progdf.pull import graph_kernel
from progdf.pull.follow import bind, widen
from progdf.pull.graph import build_graph
from progdf.quaternions import rotation_matrices
from progdf.scene.neighbors import nearest_rows
from tests.helpers import plain_graph
from tests.helpers.scenes import random_gaussians
from tests.progdf.pull.test_pull import bar


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_measures_of_pairs_agree_with_the_plain_version(unit: float) -> None:
    scene = random_gaussians(300, seed=3, sh_degree=0)
    scene.means.mul_(unit)
    scene.log_scales.add_(float(np.log(unit)))
    scene.means[7] = scene.means[8]  # a pair without a direction
    points = scene.means.double()
    found = nearest_rows(points, torch.arange(300), 5)
    near = found[0].contiguous().numpy()
    distance = found[1].contiguous().numpy()
    colors = np.random.default_rng(0).random((300, 3))
    gaps = np.empty(near.shape)
    color_distance = np.empty(near.shape)
    bent = np.empty(near.shape, bool)
    shapes = (points.numpy(), scene.unit_quats.double().numpy(), scene.scales.double().numpy(), colors)
    for part in ((0, 100), (100, 300)):
        graph_kernel.measure_pairs(shapes, near, distance, (0.5, *part), gaps, color_distance, bent)
    expected = plain_graph.measure_pairs(scene, colors, near, distance)
    assert np.allclose(gaps, expected[0], rtol=1e-9)
    assert np.allclose(color_distance, expected[1], rtol=1e-9)
    assert np.array_equal(bent, expected[2] < 0.5)


def test_cells_are_counted_up_to_a_limit() -> None:
    points = np.random.default_rng(1).random((500, 3))
    low = points.min(axis=0)
    for size in (2.0, 0.3, 0.05, 1e-6):
        count = plain_graph.count_cells(points, low, size)
        assert graph_kernel.exceeds_cells(points, low, size, count - 1)
        assert not graph_kernel.exceeds_cells(points, low, size, count)


def test_groups_of_links_agree_with_the_plain_version() -> None:
    generator = np.random.default_rng(2)
    start = generator.integers(0, 400, 500)
    end = generator.integers(0, 400, 500)
    cell = generator.integers(0, 3, 400)
    assert np.array_equal(graph_kernel.join_links(start, end, cell), plain_graph.join_links(start, end, cell))


@pytest.mark.parametrize("width", [2, 7])
def test_bindings_agree_with_the_plain_version(width: int) -> None:
    scene = bar(width)  # a single node, or many
    graph = build_graph(scene)
    points = scene.means.double().numpy()
    found = bind(graph, points, graph.node_of).toarray()
    assert np.allclose(found, plain_graph.bind(graph, points, graph.node_of, 7), atol=1e-12)
    assert np.allclose(found.sum(axis=1), 1.0)


def test_averaged_weights_agree_with_the_plain_version() -> None:
    scene = bar(7)
    scene.log_scales.add_(1.0)
    graph = build_graph(scene)
    points = scene.means.double().numpy()
    binding = widen(graph, bind(graph, points, graph.node_of), pack(scene), graph.node_of)
    axes = rotation_matrices(scene.unit_quats.double()).numpy()
    halves = axes * scene.scales.double().numpy()[:, None, :]
    weights, slopes = plain_graph.average(graph, points, halves, graph.node_of, 7)
    assert np.allclose(binding.weights.toarray(), weights, atol=1e-6)
    assert np.allclose(plain_graph.dense_slopes(binding, len(graph)), slopes, atol=1e-6)
    assert np.allclose(slopes.sum(axis=1), 0.0, atol=1e-9)


def test_small_gaussians_have_the_weights_of_their_centers() -> None:
    scene = bar(7)
    scene.log_scales[::2].sub_(3.0)
    scene.log_scales[1::2].add_(1.0)
    graph = build_graph(scene)
    centers = bind(graph, scene.means.double().numpy(), graph.node_of)
    binding = widen(graph, centers, pack(scene), graph.node_of)
    counts = np.diff(binding.firsts)
    assert not counts[::2].any()
    assert (counts[1::2] > 0).all()
    assert np.allclose(binding.weights.toarray()[::2], centers.toarray()[::2], atol=1e-6)
