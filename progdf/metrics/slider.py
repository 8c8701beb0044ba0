"""Statistics of a slider's visible steps: monotone, uniform, without jumps (docs/method.md 7)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from torch import Tensor

Pictures = Callable[[float], Sequence[Tensor]]
"""Function from a slider value, 0 to 1, to renders of fixed views. [H,W,3] each"""


@dataclass(frozen=True)
class SliderStatistics:
    """Figures of the entry `slider` in report.json."""

    monotone: bool  # the distance from the original never falls by more than 1 % of the whole change
    uniformity: float  # smallest over largest visible change of equal steps, 0 to 1; 0 if nothing changes
    largest_jump: (
        float  # largest visible change of a step of at most 1/1000, as a fraction of the whole change
    )
    # t50, t90: slider value at which 50 % and 90 % of the distance to the full edit are first reached, 0 to 1
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
        masks: pixels to compare in each view; None compares all. [H,W] bool each
    """
    original = before = pictures(0.0)
    distances = [0.0]
    steps = []
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
        t50=_first_reached(distances, 0.5),
        t90=_first_reached(distances, 0.9),
        distances=tuple(distances),
        steps=tuple(steps),
    )


def visible_change(a: Sequence[Tensor], b: Sequence[Tensor], masks: Sequence[Tensor] | None = None) -> float:
    """Return the mean absolute difference of two sets of images inside the masks, 0 to 1."""
    total = 0.0
    pixels = 0
    for i, (x, y) in enumerate(zip(a, b, strict=True)):
        difference = (x.detach() - y.detach()).abs().mean(dim=-1)
        if masks is not None:
            difference = difference[masks[i]]
        total += float(difference.double().sum())
        pixels += difference.numel()
    return total / pixels if pixels else 0.0


def _largest_jump(pictures: Pictures, steps: Sequence[float], masks: Sequence[Tensor] | None) -> float:
    """Return the largest visible change of a short step: bisect the largest step down to 1/1000."""
    largest = max(range(len(steps)), key=lambda i: steps[i])
    low = largest / len(steps)
    high = (largest + 1) / len(steps)
    change = steps[largest]
    at_low = pictures(low)
    at_high = pictures(high)
    while high - low > 1e-3:
        middle = (low + high) / 2
        at_middle = pictures(middle)
        lower_change = visible_change(at_low, at_middle, masks)
        upper_change = visible_change(at_middle, at_high, masks)
        if lower_change >= upper_change:
            high = middle
            at_high = at_middle
            change = lower_change
        else:
            low = middle
            at_low = at_middle
            change = upper_change
    return change


def _first_reached(distances: Sequence[float], share: float) -> float:
    """Return the slider value at which the distances first reach a fraction of the last one, 0 to 1."""
    goal = share * distances[-1]
    if goal <= 0:
        return 0.0
    for i, (a, b) in enumerate(pairwise(distances)):
        if b >= goal:
            return (i + (goal - a) / (b - a)) / (len(distances) - 1)
    return 1.0
