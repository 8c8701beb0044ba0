"""Solver of a color change that spreads along ties: conjugate gradients with a multigrid preconditioner.

A change spreads by one member per step of plain conjugate gradients. A body of half a million members is
hundreds of members wide, so the steps end long before the change has arrived. Here the members are also
gathered into groups, and the groups into larger groups. Each step first spreads the change among the largest
groups, so that it crosses the body at once (Briggs, Henson and McCormick, A Multigrid Tutorial, 2000).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import splu

from progdf.rasterize.cpu.engine import Array
from progdf.rasterize.cpu.jit import kernel
from progdf.system.equality import equal_fields
from progdf.threads import run_chunks

_CHUNK = 16384  # rows that a thread processes at once
_MIN_ROWS = 200  # groups are not gathered further below this number
_MAX_SHARE = 0.8  # groups per row above which a level is the last: most of its rows have no ties
_DAMPING = np.float32(0.7)  # step of the Jacobi smoother, as usual for such graphs
_TOLERANCE = 1e-5  # remaining imbalance, as a share of the right-hand side; colors differ by less than 1/255
_MAX_STEPS = 300


@dataclass(frozen=True)
class TieLevel:
    """Symmetric ties between the rows of one level, and the group of each row on the next level."""

    __eq__ = equal_fields

    starts: NDArray[np.int32]  # first tie of each row, and the number of ties. [R+1]
    columns: NDArray[np.int32]  # other row of each tie. [T]
    strengths: NDArray[np.float32]  # [T], > 0
    sums: NDArray[np.float64]  # sum of the strengths of each row's ties. [R]
    groups: NDArray[np.int32] | None  # group of each row; None on the last level. [R]


def gather_levels(links: csr_matrix) -> list[TieLevel]:
    """Gather members into groups of close neighbors, level by level.

    Args:
        links: symmetric ties between different members, ≥ 0. [M,M]
    """
    levels = []
    while True:
        links.eliminate_zeros()
        starts, columns = links.indptr.astype(np.int32), links.indices.astype(np.int32)
        strengths = links.data.astype(np.float32)
        rows = len(starts) - 1
        row_of_tie = np.repeat(np.arange(rows), np.diff(starts))
        sums = np.bincount(row_of_tie, strengths, rows)
        groups = np.full(rows, -1, np.int32)
        count = _gather_groups(starts, columns, strengths, groups) if rows > _MIN_ROWS else rows
        if count >= _MAX_SHARE * rows:
            return [*levels, TieLevel(starts, columns, strengths, sums, None)]
        levels.append(TieLevel(starts, columns, strengths, sums, groups))
        ends = groups[row_of_tie], groups[columns]
        between = ends[0] != ends[1]
        links = csr_matrix(
            (strengths[between].astype(np.float64), (ends[0][between], ends[1][between])), (count, count)
        )


def solve_ties(
    levels: Sequence[TieLevel], weights: NDArray[np.float64], ridge: float, values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the x that minimizes Σ weight · |x − value|² + Σ tie · |x − x of the neighbor|² + ridge · |x|².

    Steps end when the equations hold within 1e-5 of the weighed values, or after 300.

    Args:
        levels: ties of the members, see `gather_levels`
        weights: weights of the members' values, ≥ 0. [M]
        ridge: > 0
        values: [M,K]

    Returns:
        [M,K]
    """
    cycle = _Cycle(levels, weights + ridge)
    x = np.zeros_like(values)
    rest = weights[:, None] * values
    limit = _TOLERANCE**2 * _inner_product(rest, rest)
    product = np.empty_like(rest)
    direction = np.zeros_like(rest)
    power = 1.0
    for _ in range(_MAX_STEPS):
        if _inner_product(rest, rest) <= limit:
            break
        pulled = cycle.precondition(rest.astype(np.float32))
        before, power = power, _inner_product(rest, pulled)
        direction *= power / before
        direction += pulled
        cycle.multiply(direction, product)
        step = power / _inner_product(direction, product)
        product *= step
        rest -= product
        np.multiply(direction, step, out=product)
        x += product
    return x


class _Cycle:
    """The system of `solve_ties`, and its approximate inverse by one multigrid cycle.

    Args:
        levels: ties of the members
        weights: sum of the weight and the ridge of each member, > 0. [M]
    """

    def __init__(self, levels: Sequence[TieLevel], weights: NDArray[np.float64]) -> None:
        self._levels = levels
        self._diagonals = [levels[0].sums + weights]
        for level, below in pairwise(levels):
            weights = np.bincount(level.groups, weights, len(below.sums))
            self._diagonals.append(below.sums + weights)
        self._coarse_diagonals = [diagonal.astype(np.float32) for diagonal in self._diagonals]
        self._dampers = [_DAMPING / diagonal[:, None] for diagonal in self._coarse_diagonals]
        last = levels[-1]
        rows = len(last.sums)
        links = csr_matrix((last.strengths.astype(np.float64), last.columns, last.starts), (rows, rows))
        self._last = splu((diags(self._diagonals[-1]) - links).tocsc())

    def multiply(self, x: NDArray[np.float64], product: NDArray[np.float64]) -> None:
        """Write the product of the system and x. [M,K] each"""
        _multiply(self._levels[0], self._diagonals[0], x, product)

    def precondition(self, rest: NDArray[np.float32], depth: int = 0) -> NDArray[np.float32]:
        """Return the approximate solution for a right-hand side of one level. [R,K] -> [R,K]"""
        level = self._levels[depth]
        if level.groups is None:
            return self._last.solve(rest.astype(np.float64)).astype(np.float32)
        damper = self._dampers[depth]
        x = damper * rest
        product = np.empty_like(x)
        _multiply(level, self._coarse_diagonals[depth], x, product)
        group_rest = np.zeros((len(self._diagonals[depth + 1]), rest.shape[1]), np.float32)
        _add_to_groups(level.groups, rest, product, group_rest)
        x += self.precondition(group_rest, depth + 1)[level.groups]
        _multiply(level, self._coarse_diagonals[depth], x, product)
        np.subtract(rest, product, out=product)
        product *= damper
        x += product
        return x


def _multiply(level: TieLevel, diagonal: Array, x: Array, product: Array) -> None:
    """Write diagonal · x − Σ tie · x of the neighbor. [R], [R,K], [R,K]"""

    def work(chunk: int) -> None:
        begin = chunk * _CHUNK
        end = min(begin + _CHUNK, len(x))
        _multiply_rows(begin, end, level.starts, level.columns, level.strengths, diagonal, x, product)

    run_chunks(work, -(-len(x) // _CHUNK))


def _inner_product(a: Array, b: Array) -> float:
    """Return Σ a · b, added in float64 in an order that does not depend on the number of threads."""
    return float(np.einsum("ij,ij->", a, b, dtype=np.float64))


@kernel(cache=True)
def _multiply_rows(
    begin: int, end: int, starts: Array, columns: Array, strengths: Array, diagonal: Array, x: Array,
    product: Array,
) -> None:  # fmt: skip
    """Compute `_multiply` for rows begin … end − 1."""
    for row in range(begin, end):
        for k in range(x.shape[1]):
            product[row, k] = diagonal[row] * x[row, k]
        for tie in range(starts[row], starts[row + 1]):
            other = columns[tie]
            for k in range(x.shape[1]):
                product[row, k] -= strengths[tie] * x[other, k]


@kernel(cache=True)
def _add_to_groups(groups: Array, rest: Array, product: Array, group_rest: Array) -> None:
    """Add rest − product of the rows to their groups. [R], [R,K], [R,K], [G,K]"""
    for row in range(len(groups)):
        for k in range(rest.shape[1]):
            group_rest[groups[row], k] += rest[row, k] - product[row, k]


@kernel(cache=True)
def _gather_groups(starts: Array, columns: Array, strengths: Array, groups: Array) -> int:
    """Write the group of each row and return the number of groups.

    A row whose neighbors are all without a group founds one with them. The rows left join the group to which
    their strongest tie leads.
    """
    count = 0
    for row in range(len(groups)):
        is_free = groups[row] < 0
        for tie in range(starts[row], starts[row + 1]):
            is_free = is_free and groups[columns[tie]] < 0
        if is_free:
            groups[row] = count
            for tie in range(starts[row], starts[row + 1]):
                groups[columns[tie]] = count
            count += 1
    for row in range(len(groups)):
        strongest = np.float32(0.0)
        if groups[row] < 0:
            for tie in range(starts[row], starts[row + 1]):
                if strengths[tie] > strongest and groups[columns[tie]] >= 0:
                    strongest = strengths[tie]
                    groups[row] = groups[columns[tie]]
    return count
