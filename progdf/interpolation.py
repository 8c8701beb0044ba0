"""Piecewise linear interpolation between knots: the one place that finds a segment and where in it one is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Segment(NamedTuple):
    """A place between two knots."""

    right: int  # index of the right one, 1..S−1; the left one is that before it
    share: float  # of the way from the left one, 1 exactly at the right one; beyond 0..1 outside all knots


def find_segment(knots: Tensor, x: float) -> Segment:
    """The segment that holds `x`, at a knot the one left of it; the outer ones go on for ever.

    Args:
        knots: ascending, at least 2. [S]
        x: in their unit; which segment it is is told in their precision
    """
    places = knots.numpy()  # for one place a tenth of the time that torch takes
    right = min(max(int(places.searchsorted(places.dtype.type(x))), 1), len(places) - 1)
    low, high = float(places[right - 1]), float(places[right])
    return Segment(right, (x - low) / (high - low))


def interpolate_at(knots: Tensor, values: Sequence[Tensor] | Tensor, x: float) -> Tensor:
    """Linear between the values at knots [S], the outermost ones beyond them. S × [...] -> [...]"""
    right, share = find_segment(knots, x)
    return torch.lerp(values[right - 1], values[right], min(max(share, 0.0), 1.0))


def interpolate(x: Tensor, knots: Tensor, values: Tensor) -> Tensor:
    """`interpolate_at` for many places and one number a knot. [n], [S], [S] -> [n]"""
    right = torch.searchsorted(knots, x).clamp(1, len(knots) - 1)
    share = (x - knots[right - 1]) / (knots[right] - knots[right - 1])
    return torch.lerp(values[right - 1], values[right], share.clamp(0, 1))
