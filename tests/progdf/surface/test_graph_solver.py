"""Tests of the solver of values on a graph."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags
from scipy.sparse.linalg import spsolve
from scipy.spatial import KDTree

from progdf.surface.graph_solver import GraphSolver

_ACCURACY = 1e-4


def _links(points: NDArray[np.float64], neighbors: int, seed: int) -> csr_array:
    """Return symmetric links of random weight between neighbors. [N,D] -> [N,N]"""
    near = KDTree(points).query(points, neighbors + 1)[1]
    rows = np.repeat(np.arange(len(points)), neighbors)
    weights = np.random.default_rng(seed).uniform(0.01, 1.0, len(rows)).astype(np.float32)
    links = coo_array((weights, (rows, near[:, 1:].ravel())), shape=(len(points), len(points))).tocsr()
    return csr_array(links + links.T)


def _chain(count: int) -> csr_array:
    """Return links between each node and the next one."""
    ones = np.ones(count - 1, np.float32)
    return csr_array(diags([ones, ones], [-1, 1], shape=(count, count)), dtype=np.float32)


def _solve_directly(
    links: csr_array, anchors: NDArray[np.float64], target: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the result of `GraphSolver.solve` by a direct method."""
    system = diags(links.sum(axis=1) + anchors) - links
    return np.asarray(spsolve(system.tocsc().astype(np.float64), target))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("ridge", [1e-5, 1e-2, 1.0])
def test_solution_equals_that_of_a_direct_method(seed: int, ridge: float) -> None:
    random = np.random.default_rng(seed)
    links = _links(random.normal(size=(3000, 3)), 6, seed)
    weights = np.where(random.random(3000) < 0.1, random.uniform(0.0, 3.0, 3000), 0.0)
    target = weights * random.normal(size=3000)
    solution = GraphSolver(links).solve(weights + ridge, target, _ACCURACY)
    np.testing.assert_allclose(solution, _solve_directly(links, weights + ridge, target), atol=2e-3)


@pytest.mark.parametrize("count", [1, 2, 150, 3000])
def test_value_reaches_the_other_end_of_a_chain(count: int) -> None:
    """Conjugate gradients without groups of nodes would need as many steps as there are nodes."""
    target = np.zeros(count)
    target[0] = 10.0
    anchors = target + 1e-6
    solution = GraphSolver(_chain(count)).solve(anchors, target, 1e-5)
    np.testing.assert_allclose(solution, _solve_directly(_chain(count), anchors, target), atol=0.02)
    assert solution[-1] > 0.05


def test_nodes_without_a_link_to_a_value_stay_at_0() -> None:
    random = np.random.default_rng(0)
    points = random.normal(size=(2000, 3))
    points[1000:] += 100.0
    weights = np.zeros(2000)
    weights[:1000] = random.random(1000)
    target = weights * random.uniform(1.0, 2.0, 2000)
    solution = GraphSolver(_links(points, 5, 0)).solve(weights + 1e-5, target, _ACCURACY)
    assert not solution[1000:].any()
    assert solution[:1000].all()


def test_no_values_give_0() -> None:
    assert not GraphSolver(_chain(500)).solve(np.ones(500), np.zeros(500), _ACCURACY).any()
