"""Anchors of added rows: the rows of the scene on which each added row lies.

An added row follows its anchors when other layers change them, see `progdf.compose.follow`. The candidates
are the nearest Gaussians, as they are under the full edit. The weight of a candidate is

    opacity · exp(−½ dᵀ (Σ + h² I)⁻¹ d)

with its covariance Σ, the vector d from its center to the row, and the local spacing h of the candidates. A
wide, flat Gaussian below the row therefore outweighs a nearer one of another surface. One that the edit
removes is no candidate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.quaternions import normalize_quats, rotate_vectors
from progdf.system.equality import equal_fields

MAX_ANCHORS = 4
"""Largest number of anchors of a row."""
WEIGHT_SUM_TOLERANCE = 1e-4
"""Largest deviation of the sum of a row's weights from 1."""
NOTHING: frozenset[str] = frozenset()
"""No kind of change."""
PUSHED_SHAPE = frozenset({"geometry", "opacity"})
"""Kinds of change by which paint over a recolor makes way for its added rows."""
_MIN_LYING_WEIGHT = 0.5  # share of its anchors' weight on rows on which a row lies
_CANDIDATES = 16  # nearest Gaussians of which the anchors are chosen
_SPACING_NEIGHBOR = 4  # its distance is the local spacing
_CHUNK = 1 << 14  # rows that are anchored at once


@dataclass(frozen=True)
class Anchors:
    """Anchors of the B rows that an edit adds.

    Raises:
        ValueError: a shape or type is wrong, an index is negative, or the weights of a row are not finite,
            are negative, or sum up to neither 1 nor 0.
    """

    __eq__ = equal_fields

    rows: Tensor  # rows of the scene; those with weight 0 have no meaning. [B,4] int64
    weights: Tensor  # 0 to 1, sum 1 per row; all 0 if the row follows nothing, as in a copy. [B,4] float32
    # Kinds of change (see `progdf.compose.layers.KINDS`) that the edit makes to its own members only to make
    # way for the added rows, as paint does. Rows of other edits do not follow them.
    pushes: frozenset[str] = NOTHING
    # share of each added row's color that repeats the surface beside the paint, 0 to 1; None if all are 0.
    # [B] float32
    rim: Tensor | None = None
    # True if rows of other edits stay in place although this edit changes the surface below them, as when the
    # user moves an object without its paint
    leaves_paint: bool = False

    def __post_init__(self) -> None:
        shape = (len(self.rows), MAX_ANCHORS)
        for name, values, dtype in (
            ("rows", self.rows, torch.int64),
            ("weights", self.weights, torch.float32),
        ):
            if tuple(values.shape) != shape or values.dtype != dtype:
                raise ValueError(
                    f"anchors.{name} is {values.dtype} {list(values.shape)}, expected {dtype} {list(shape)}"
                )
        if len(self.rows) and int(self.rows.min()) < 0:
            raise ValueError("an anchor is a negative row")
        if not bool((self.weights >= 0.0).all()):  # also refuses NaN
            raise ValueError("a weight of an anchor is negative or not a number")
        if self.rim is not None and self.rim.shape != self.rows.shape[:1]:
            raise ValueError(f"anchors.rim is {list(self.rim.shape)}, expected {[len(self.rows)]}")
        if self.rim is not None and not bool(((self.rim >= 0.0) & (self.rim <= 1.0)).all()):
            raise ValueError("a share of a rim is not between 0 and 1")
        sums = self.weights.double().sum(dim=1)
        if not bool((((sums - 1.0).abs() <= WEIGHT_SUM_TOLERANCE) | (sums == 0.0)).all()):
            raise ValueError("the weights of a row's anchors do not sum up to 1")

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def carries_others(self) -> bool:
        """True if rows of other edits follow the edit's change of its own members."""
        return not self.pushes and not self.leaves_paint

    @property
    def free(self) -> int:
        """Number of rows that follow nothing."""
        return int((self.weights.sum(dim=1) == 0.0).sum())

    def lie_on(self, mask: Tensor) -> Tensor:
        """Return the rows that lie on some rows of the scene, by at least half of their weight. [N] -> [B]"""
        return (self.weights * mask[self.rows]).sum(dim=1) >= _MIN_LYING_WEIGHT


def free_anchors(count: int) -> Anchors:
    """Return the anchors of rows that follow nothing."""
    rows = torch.zeros(count, MAX_ANCHORS, dtype=torch.int64)
    return Anchors(rows, torch.zeros(count, MAX_ANCHORS))


def join_free(anchors: Anchors, free: int) -> Anchors:
    """Return the anchors followed by rows that follow nothing.

    Args:
        anchors: anchors of B rows
        free: number of further rows F

    Returns:
        Anchors of B + F rows.
    """
    others = free_anchors(free)
    rows = torch.cat([anchors.rows, others.rows])
    rim = None if anchors.rim is None else torch.cat([anchors.rim, anchors.rim.new_zeros(free)])
    return replace(anchors, rows=rows, weights=torch.cat([anchors.weights, others.weights]), rim=rim)


def choose_anchors(
    end: Gaussians, means: Tensor, unseen_logit: float, pushes: frozenset[str] = NOTHING
) -> Anchors:
    """Choose the anchors of added rows; see the module docstring.

    Args:
        end: the scene's own rows under the full edit. N Gaussians
        means: centers of the added rows at strength 1, relative to the origin of `end`. [B,3]
        unseen_logit: Gaussians below this opacity logit are no candidates
        pushes: see `Anchors.pushes`

    Returns:
        Anchors of B rows, heaviest first. Without a candidate, the rows follow nothing.
    """
    drawn = (end.logit_opacities >= unseen_logit) & end.means.isfinite().all(dim=1)
    candidates = _nearby(end.means, drawn, means).nonzero()[:, 0].numpy()
    positions = end.means.numpy()[candidates].astype(np.float64)
    # of equal positions one is enough; a k-d tree cannot split them
    first = np.unique(positions, axis=0, return_index=True)[1]
    candidates = candidates[first]
    rows = torch.zeros(len(means), MAX_ANCHORS, dtype=torch.int64)
    weights = torch.zeros(len(means), MAX_ANCHORS)
    if not len(candidates) or not len(means):
        return Anchors(rows, weights, pushes)
    tree = cKDTree(positions[first], balanced_tree=False, compact_nodes=False)
    count = min(_CANDIDATES, len(candidates))
    for begin in range(0, len(means), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        places = means[part].double()
        distances, found = tree.query(places.numpy(), list(range(1, count + 1)))
        near = torch.from_numpy(candidates[found])
        scores = _scores(end, places, near, torch.from_numpy(distances))
        best = scores.topk(min(MAX_ANCHORS, count), dim=1)
        total = best.values.sum(dim=1, keepdim=True)
        rows[part, : best.indices.shape[1]] = near.gather(1, best.indices)
        weights[part, : best.indices.shape[1]] = (best.values / total).float()
    return Anchors(rows, weights, pushes)


def _nearby(means: Tensor, drawn: Tensor, places: Tensor) -> Tensor:
    """Return the drawn Gaussians in the box of the added rows, extended by its diagonal; all if few are.

    Args:
        means: [N,3]
        drawn: [N] bool
        places: centers of the added rows. [B,3]

    Returns:
        [N] bool
    """
    if not len(places):
        return drawn
    low = places.amin(dim=0)
    high = places.amax(dim=0)
    margin = (high - low).norm()
    nearby = drawn & ((means >= low - margin) & (means <= high + margin)).all(dim=1)
    return nearby if int(nearby.sum()) >= _CANDIDATES * MAX_ANCHORS else drawn


def _scores(end: Gaussians, places: Tensor, near: Tensor, distances: Tensor) -> Tensor:
    """Return the weight of each candidate of each row, relative to the row's best. [B,k] float64

    Args:
        end: the scene under the full edit
        places: centers of the rows. [B,3] float64
        near: candidates, nearest first. [B,k]
        distances: their distances. [B,k] float64
    """
    spacing = distances[:, min(_SPACING_NEIGHBOR, distances.shape[1]) - 1]
    spacing = spacing.clamp_min(1e-30)[:, None, None]
    flat = near.flatten()
    unit = normalize_quats(end.quats[flat].double())
    conjugate = unit * unit.new_tensor([1.0, -1.0, -1.0, -1.0])
    apart = (places[:, None] - end.means[near].double()).flatten(0, 1)
    local = rotate_vectors(apart, conjugate).reshape(*near.shape, 3)
    scales = end.log_scales[near].double().exp()
    exponent = -0.5 * (local.square() / (scales.square() + spacing.square())).sum(dim=2)
    logs = exponent + torch.nn.functional.logsigmoid(end.logit_opacities[near].double())
    return (logs - logs.amax(dim=1, keepdim=True)).exp()
