"""How a slider feels: does every step show, do they show equally, does anything jump (docs/method.md 7)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from torch import Tensor

Pictures = Callable[[float], Sequence[Tensor]]
"""Slider value -> renders of some views. [H,W,3] each"""


@dataclass(frozen=True)
class SliderStatistics:
    """The figures of `report.json`'s `slider`."""

    monotone: bool  # the distance from the original never falls by more than 1 % of the whole change
    uniformity: float  # smallest over largest visible change of equal steps, 0..1; 0 where nothing changes
    largest_jump: float  # largest visible change of a step of at most 1/1000, as a share of the whole change
    # t50, t90: slider value at which half and nine tenths of the distance to the end are first reached, 0..1
    t50: float
    t90: float
    distances: tuple[float, ...]  # distance from the original at equal steps, the first 0
    steps: tuple[float, ...]  # visible change of each equal step


def slider_statistics(
    pictures: Pictures, count: int = 20, masks: Sequence[Tensor] | None = None
) -> SliderStatistics:
    """Measure a slider on renders.

    Args:
        pictures: renders at a slider value; called about count + 16 times
        count: number of equal steps, ≥ 1
        masks: per view, pixels that count; None is all. [H,W] bool each
    """
    original = before = pictures(0.0)
    distances, steps = [0.0], []
    for i in range(1, count + 1):
        now = pictures(i / count)
        distances.append(visible_change(original, now, masks))
        steps.append(visible_change(before, now, masks))
        before = now
    largest = max(distances)
    falls = [a - b for a, b in pairwise(distances)]
    return SliderStatistics(
        monotone=max(falls) <= 0.01 * largest,
        uniformity=min(steps) / max(steps) if max(steps) > 0 else 0.0,
        largest_jump=_largest_jump(pictures, steps, masks) / largest if largest > 0 else 0.0,
        t50=_place_of_share(distances, 0.5),
        t90=_place_of_share(distances, 0.9),
        distances=tuple(distances),
        steps=tuple(steps),
    )


def visible_change(a: Sequence[Tensor], b: Sequence[Tensor], masks: Sequence[Tensor] | None = None) -> float:
    """Mean absolute difference of two sets of pictures over the pixels that count, 0..1."""
    total, pixels = 0.0, 0
    for i, (x, y) in enumerate(zip(a, b, strict=True)):
        difference = (x.detach() - y.detach()).abs().mean(dim=-1)
        if masks is not None:
            difference = difference[masks[i]]
        total += float(difference.double().sum())
        pixels += difference.numel()
    return total / pixels if pixels else 0.0


def _largest_jump(pictures: Pictures, steps: Sequence[float], masks: Sequence[Tensor] | None) -> float:
    """Halve the step that changes most, again and again, until it is at most 1/1000 long."""
    widest = max(range(len(steps)), key=lambda i: steps[i])
    low, high, change = widest / len(steps), (widest + 1) / len(steps), steps[widest]
    at_low, at_high = pictures(low), pictures(high)
    while high - low > 1e-3:
        middle = (low + high) / 2
        at_middle = pictures(middle)
        before, after = visible_change(at_low, at_middle, masks), visible_change(at_middle, at_high, masks)
        if before >= after:
            high, at_high, change = middle, at_middle, before
        else:
            low, at_low, change = middle, at_middle, after
    return change


def _place_of_share(distances: Sequence[float], share: float) -> float:
    """Where the course of distances first reaches a share of its last value, linear in between. 0..1"""
    goal = share * distances[-1]
    if goal <= 0:
        return 0.0
    for i, (a, b) in enumerate(pairwise(distances)):
        if b >= goal:
            return (i + (goal - a) / (b - a)) / (len(distances) - 1)
    return 1.0
