"""What an edit of colors does, as one function of the color that was there and an amount for each member.

A member's new color is its own plus the amount times an affine function of it. That is what a brush, a fill
or a grading does, and it tells of each member more than its few pixels do: how its color changes with the
view after the edit, and, where the amount is 1 all over, what becomes of the members that no picture shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

_TYPICAL = 0.5
"""Of the root mean square of all changes: members that change less do not say what it is."""

_LEAST_AMOUNT = 0.3  # below this a member's change does not tell where all of it would lead
_ROUNDS = 3

_WHOLE = 0.15
"""Share of the change's energy that one function of color may leave: stripes leave half, a fill a tenth."""

_COVERED, _TOUCHED = 0.8, 0.3
"""A change covers all where so much of what shows has changed, by so much of what is typical."""


@dataclass(frozen=True)
class Paint:
    """An edit of colors as one function.

    Args:
        full: change of each member where the amount is 1. [M,3]
        amounts: 0 untouched .. 1 all of it. [M]
        slope: derivative of the new color by the old one, less the old one's own, rows in, columns out. [3,3]
        trust: share of the change's energy that this explains, 0..1
        whole: the amount is 1 everywhere
        general: what a function of color without amounts makes of each member, where nearly all that shows
            has changed; else None. [M,3]
    """

    full: Tensor
    amounts: Tensor
    slope: Tensor
    trust: float
    whole: bool
    general: Tensor | None


def fit_paint(colors: Tensor, change: Tensor, weights: Tensor) -> Paint:
    """The paint that explains the members' change.

    Args:
        colors: as they were. [M,3]
        change: of each member. [M,3]
        weights: how much each shows, ≥ 0. [M]
    """
    ones = torch.ones_like(weights)
    energy = (weights[:, None] * change.square()).sum().clamp_min(1e-30)

    def unexplained(full: Tensor, amounts: Tensor) -> float:
        left = change - amounts[:, None] * full
        return float((weights[:, None] * left.square()).sum() / energy)

    full, slope = _fit_affine(colors, change, weights)
    left = unexplained(full, ones)
    if left <= _WHOLE:
        return Paint(full, ones, slope, max(0.0, 1.0 - left), True, full)
    typical = (energy / weights.sum().clamp_min(1e-30)).sqrt()
    touched = (weights * (change.norm(dim=1) > _TOUCHED * typical)).sum()
    general = full if bool(touched >= _COVERED * weights.sum()) else None
    least = _TYPICAL * typical
    telling, amounts = weights * (change.norm(dim=1) > least), ones
    for _ in range(_ROUNDS):
        divisor = amounts.clamp_min(_LEAST_AMOUNT)
        full, slope = _fit_affine(colors, change / divisor[:, None], telling * divisor.square())
        along = (change * full).sum(dim=1) / full.square().sum(dim=1).clamp_min(1e-9)
        amounts = along.clamp(0.0, 1.0)
    return Paint(full, amounts, slope, max(0.0, 1.0 - unexplained(full, amounts)), False, general)


def _fit_affine(colors: Tensor, change: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted least squares: the change of every member [M,3], and its derivative [3,3]."""
    x = torch.cat([colors - 0.5, torch.ones(len(colors), 1, dtype=colors.dtype)], dim=1)
    square = x.T @ (weights[:, None] * x)
    square += (1e-4 * square.diagonal().mean() + 1e-12) * torch.eye(4, dtype=colors.dtype)
    found = torch.linalg.solve(square, x.T @ (weights[:, None] * change))
    return x @ found, found[:3]
