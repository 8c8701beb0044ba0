"""Tests of the solver of ties."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_matrix, diags
from scipy.sparse.linalg import spsolve
from scipy.spatial import KDTree

from progdf.threads import set_threads
from trainer.optimize.tie_solver import gather_levels, solve_ties

_COLUMNS = 3


def _ties(points: NDArray[np.float64], neighbors: int, seed: int) -> csr_matrix:
    """Return symmetric ties of random strength between neighbors. [N,D] -> [N,N]"""
    near = KDTree(points).query(points, neighbors + 1)[1]
    rows = np.repeat(np.arange(len(points)), neighbors)
    strengths = np.random.default_rng(seed).uniform(0.01, 1.0, len(rows))
    links = coo_array((strengths, (rows, near[:, 1:].ravel())), shape=(len(points), len(points))).tocsr()
    return csr_matrix(0.5 * (links + links.T))


def _chain(count: int) -> csr_matrix:
    """Return ties between each member and the next one."""
    ones = np.full(count - 1, 0.5)
    return csr_matrix(diags([ones, ones], [-1, 1]))


def _solve_plainly(
    links: csr_matrix, weights: NDArray[np.float64], ridge: float, values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the result of `solve_ties` by a direct method."""
    system = diags(np.asarray(links.sum(axis=1)).ravel() + weights + ridge) - links
    return np.asarray(spsolve(system.tocsc(), weights[:, None] * values)).reshape(values.shape)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("ridge", [1e-5, 1e-2, 1.0])
def test_solution_equals_that_of_a_direct_method(seed: int, ridge: float) -> None:
    random = np.random.default_rng(seed)
    links = _ties(random.normal(size=(3000, 3)), 6, seed)
    weights = np.where(random.random(3000) < 0.1, random.uniform(0.0, 3.0, 3000), 0.0)
    values = random.normal(size=(3000, _COLUMNS))
    solution = solve_ties(gather_levels(links), weights, ridge, values)
    np.testing.assert_allclose(solution, _solve_plainly(links, weights, ridge, values), atol=2e-3)


@pytest.mark.parametrize("count", [1, 2, 150, 20_000])
def test_change_reaches_the_other_end_of_a_chain(count: int) -> None:
    weights = np.zeros(count)
    weights[0] = 1.0
    values = np.ones((count, 1))
    links = _chain(count) if count > 1 else csr_matrix((1, 1))
    solution = solve_ties(gather_levels(links), weights, 1e-12, values)
    np.testing.assert_allclose(solution, 1.0, atol=0.01)


def test_members_without_a_tie_to_a_value_stay_at_0() -> None:
    random = np.random.default_rng(0)
    points = random.normal(size=(2000, 3))
    points[1000:] += 100.0
    weights = np.zeros(2000)
    weights[:1000] = random.random(1000)
    levels = gather_levels(_ties(points, 5, 0))
    solution = solve_ties(levels, weights, 1e-8, random.normal(size=(2000, _COLUMNS)))
    assert not solution[1000:].any()
    assert solution[:1000].all()


def test_nothing_to_spread_is_0() -> None:
    levels = gather_levels(_chain(500))
    assert not solve_ties(levels, np.ones(500), 1.0, np.zeros((500, _COLUMNS))).any()
    assert not solve_ties(levels, np.zeros(500), 1.0, np.ones((500, _COLUMNS))).any()


def test_bits_do_not_depend_on_the_threads() -> None:
    random = np.random.default_rng(1)
    links = _ties(random.normal(size=(40_000, 3)), 6, 1)
    weights, values = random.random(40_000), random.normal(size=(40_000, _COLUMNS))
    solutions = []
    for count in (1, 3):
        set_threads(count)
        try:
            solutions.append(solve_ties(gather_levels(links), weights, 1e-5, values))
        finally:
            set_threads(None)
    np.testing.assert_array_equal(*solutions)
