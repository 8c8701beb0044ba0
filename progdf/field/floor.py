"""How much of an edit a Gaussian's place tells: the floor of fields that see nothing but positions.

Two Gaussians at one place cannot move differently in such a field, however large its network is. What the
nearest neighbours do is the best guess that the place allows; a network that is given the time gets there,
and beyond it only by learning its members by heart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from .evaluate import FieldJudge
from .separable import channel_weights, check_trajectory, moving_attributes

NEIGHBOURS = (1, 2, 4, 8, 16)

_MOST_DISTANCES = 1 << 24  # at a time, 64 MB


@dataclass(frozen=True)
class PositionFloor:
    """What the neighbours of a Gaussian tell of its movement.

    Args:
        unpredictable: share of the movement, about its mean, that they do not tell, by attribute; 0..1, 1
            where they are no help at all
        neighbours: how many of them tell most
        psnr_mean, psnr_worst: of the movement that they foretell against the recorded one, over the slider,
            dB; NaN where no judge was given
    """

    unpredictable: Mapping[str, float]
    neighbours: int
    psnr_mean: float
    psnr_worst: float


class _Foretold:
    """Every member moves as its neighbours do on average; a `judge.Field`."""

    def __init__(self, strengths: Tensor, offsets: Tensor, nearest: Tensor, attributes: list[str]) -> None:
        self.attributes = attributes
        self._strengths, self._offsets, self._nearest = strengths, offsets, nearest

    def offsets(self, s: float) -> Tensor:
        """[M,C]"""
        right = int(torch.searchsorted(self._strengths, torch.tensor(s)).clamp(1, len(self._strengths) - 1))
        low, high = float(self._strengths[right - 1]), float(self._strengths[right])
        share = (s - low) / (high - low)
        return _told(torch.lerp(self._offsets[right - 1], self._offsets[right], share), self._nearest)


def position_floor(
    strengths: Tensor,
    offsets: Tensor,
    places: Tensor,
    visibility: Tensor | None = None,
    judge: FieldJudge | None = None,
) -> PositionFloor:
    """What a field of the position alone can know of a trajectory, measured without training one.

    Args:
        strengths: of the snapshots, ascending from 0 to 1. [T]
        offsets: [T,M,C] float32
        places: the members' centres before the edit. [M,3]
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
    nearest = _nearest(places, max(NEIGHBOURS))
    found = {}
    for count in [n for n in NEIGHBOURS if n <= nearest.shape[1]]:
        share = {name: _left(offsets[:, :, c], shown, nearest[:, :count]) for name, c in attributes.items()}
        found[count] = share
    best = min(found, key=lambda n: sum(found[n].values()))
    mean = worst = float("nan")
    if judge is not None:
        curve = judge.curve(_Foretold(strengths, offsets, nearest[:, :best], list(attributes)))
        mean, worst = sum(curve) / len(curve), min(curve)
    return PositionFloor({name: min(1.0, s) for name, s in found[best].items()}, best, mean, worst)


def _told(offsets: Tensor, nearest: Tensor) -> Tensor:
    """Mean of each member's neighbours. [M,C], [M,k] -> [M,C]"""
    total = offsets[nearest[:, 0]]
    for k in range(1, nearest.shape[1]):
        total = total + offsets[nearest[:, k]]
    return total / nearest.shape[1]


def _left(offsets: Tensor, shown: Tensor, nearest: Tensor) -> float:
    """Share of the movement about its mean that neighbours do not tell. [T,M,c], [M,1]"""
    wrong = whole = 0.0
    for moved in offsets[1:]:
        mean = (moved * shown).sum(dim=0) / shown.sum()
        wrong += float((shown * (moved - _told(moved, nearest)).square()).sum())
        whole += float((shown * (moved - mean).square()).sum())
    return wrong / whole if whole > 0 else 0.0


def _nearest(places: Tensor, most: int) -> Tensor:
    """Every member's nearest others, nearest first. [M,3] -> [M,≤most] int64"""
    count = len(places)
    most = min(most, count - 1)
    rows = max(1, _MOST_DISTANCES // count)
    found = []
    for start in range(0, count, rows):
        own = torch.arange(start, min(count, start + rows))
        distances = torch.cdist(places[own], places)
        distances[torch.arange(len(own)), own] = float("inf")
        found.append(distances.topk(most, largest=False).indices)
    return torch.cat(found)
