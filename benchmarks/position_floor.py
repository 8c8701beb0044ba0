"""How much of an edit a Gaussian's place tells: the floor of fields that see nothing but positions.

Two Gaussians at one place cannot move differently in such a field, however large its network is. What the
nearest neighbors do is the best guess that the place allows; a network that is given the time gets there,
and beyond it only by learning its members by heart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.field.evaluate import FieldEvaluator
from progdf.field.separable import channel_weights, check_trajectory, moving_attributes
from progdf.interpolation import interpolate_at
from progdf.scene.neighbors import nearest_rows

from .courses import KnownEdit
from .table import Table

NEIGHBORS = (1, 2, 4, 8, 16)


@dataclass(frozen=True)
class PositionFloor:
    """What the neighbors of a Gaussian tell of its movement.

    Args:
        unpredictable: share of the movement, about its mean, that they do not tell, by attribute; 0..1, 1
            where they are no help at all
        neighbors: how many of them tell most
        psnr_mean, psnr_worst: of the movement that they predict against the recorded one, over the slider,
            dB; NaN where no judge was given
    """

    unpredictable: Mapping[str, float]
    neighbors: int
    psnr_mean: float
    psnr_worst: float


class _Predicted:
    """Every member moves as its neighbors do on average; an `evaluate.Field`."""

    def __init__(self, strengths: Tensor, offsets: Tensor, nearest: Tensor, attributes: list[str]) -> None:
        self.attributes = attributes
        self._strengths, self._offsets, self._nearest = strengths, offsets, nearest

    def offsets(self, s: float) -> Tensor:
        """[M,C]"""
        return _mean_of(interpolate_at(self._strengths, self._offsets, s), self._nearest)


def position_floor(
    strengths: Tensor,
    offsets: Tensor,
    places: Tensor,
    visibility: Tensor | None = None,
    judge: FieldEvaluator | None = None,
) -> PositionFloor:
    """What a field of the position alone can know of a trajectory, measured without training one.

    Args:
        strengths: of the snapshots, ascending from 0 to 1. [T]
        offsets: [T,M,C] float32
        places: the members' centers before the edit. [M,3]
        visibility: how much each member shows. [M]; None is evenly
        judge: compares pictures; None leaves the decibels out

    Raises:
        ValueError: no trajectory, or not one place for each member.
    """
    check_trajectory(strengths, offsets)
    if tuple(places.shape) != (offsets.shape[1], 3):
        raise ValueError(f"places is {list(places.shape)}, expected [{offsets.shape[1]}, 3]")
    attributes = moving_attributes(offsets)
    nothing = PositionFloor(dict.fromkeys(attributes, 1.0), 0, float("nan"), float("nan"))
    if len(places) < 2 or not attributes:
        return nothing
    shown = channel_weights(visibility, len(places), 1)
    nearest, _ = nearest_rows(places, torch.arange(len(places)), max(NEIGHBORS))
    found = {}
    for count in [n for n in NEIGHBORS if n <= nearest.shape[1]]:
        share = {
            name: _unexplained_share(offsets[:, :, c], shown, nearest[:, :count])
            for name, c in attributes.items()
        }
        found[count] = share
    best = min(found, key=lambda n: sum(found[n].values()))
    mean = worst = float("nan")
    if judge is not None:
        curve = judge.curve(_Predicted(strengths, offsets, nearest[:, :best], list(attributes)))
        mean, worst = sum(curve) / len(curve), min(curve)
    return PositionFloor({name: min(1.0, s) for name, s in found[best].items()}, best, mean, worst)


def _mean_of(offsets: Tensor, nearest: Tensor) -> Tensor:
    """Mean of each member's neighbors. [M,C], [M,k] -> [M,C]"""
    total = offsets[nearest[:, 0]]
    for k in range(1, nearest.shape[1]):
        total = total + offsets[nearest[:, k]]
    return total / nearest.shape[1]


def _unexplained_share(offsets: Tensor, shown: Tensor, nearest: Tensor) -> float:
    """Share of the movement about its mean that neighbors do not tell. [T,M,c], [M,1]"""
    wrong = whole = 0.0
    for moved in offsets[1:]:
        mean = (moved * shown).sum(dim=0) / shown.sum()
        wrong += float((shown * (moved - _mean_of(moved, nearest)).square()).sum())
        whole += float((shown * (moved - mean).square()).sum())
    return wrong / whole if whole > 0 else 0.0


def floor_table(courses: Sequence[KnownEdit]) -> Table:
    """What places tell of every edit, beside which a network that sees positions alone may be held."""
    rows = []
    for course in courses:
        places = course.scene.means[course.members]
        found = position_floor(course.strengths, course.offsets, places, course.weights, course.judge)
        shares = ", ".join(f"{name} {share:.2f}" for name, share in found.unpredictable.items())
        rows.append(
            (course.name, str(found.neighbors), shares, f"{found.psnr_mean:.1f} / {found.psnr_worst:.1f}")
        )
    return Table(
        name="position floor",
        title="Position floor: every member moves as its nearest neighbors do on average",
        columns=("edit", "neighbors", "share not predicted", "PSNR between snapshots, mean / worst, dB"),
        rows=tuple(rows),
        note="What a field can know that sees nothing but positions, without training one.",
    )
