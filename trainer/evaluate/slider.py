"""What a slider does between its ends: how far apart neighboring values look, how straight the way is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

from progdf.metrics.slider import Pictures, slider_statistics
from trainer.fit.evaluate import Evaluator
from trainer.fit.slider_uniformity import STEPS
from trainer.optimize.losses import Perceptual


@dataclass(frozen=True)
class SliderPath:
    """A slider in 20 equal steps.

    Args:
        evenness: smallest over largest visible change of a step, as report.json's `uniformity`, 0..1
        monotone: share of the steps that lead away from the original, by visible change, 0..1
        steps: LPIPS between neighboring slider values. [20]
        from_original: LPIPS from slider value 0, at the 21 values
    """

    evenness: float
    monotone: float
    steps: tuple[float, ...]
    from_original: tuple[float, ...]

    @property
    def ends(self) -> float:
        """LPIPS between both ends."""
        return self.from_original[-1]

    @property
    def mean(self) -> float:
        """Mean LPIPS of neighbors."""
        return sum(self.steps) / len(self.steps)

    @property
    def largest(self) -> float:
        """Largest LPIPS of neighbors."""
        return max(self.steps)

    @property
    def sum_over_ends(self) -> float:
        """Σ LPIPS of neighbors over LPIPS of the ends; 1/20 for a straight way in equal steps, as LPIPS is a
        squared distance."""
        return sum(self.steps) / self.ends if self.ends > 0 else math.nan

    @property
    def triangle_excess(self) -> float:
        """The same of the roots, which are distances: at least 1, and 1 for a straight way."""
        return sum(math.sqrt(d) for d in self.steps) / math.sqrt(self.ends) if self.ends > 0 else math.nan


def slider_path(evaluator: Evaluator, pictures: Pictures, perceptual: Perceptual) -> SliderPath:
    """Walk a slider. `pictures`: slider value -> the held-out views' boxes"""
    shown = {i / STEPS: pictures(i / STEPS) for i in range(STEPS + 1)}
    statistics = slider_statistics(
        lambda s: shown[s] if s in shown else pictures(s), STEPS, masks=evaluator.pixels
    )
    steps = [evaluator.perceptual(b, a, perceptual) for a, b in pairwise(shown.values())]
    from_original = [evaluator.perceptual(now, shown[0.0], perceptual, "original") for now in shown.values()]
    perceptual.forget()
    rises = [b > a for a, b in pairwise(statistics.distances)]
    return SliderPath(statistics.uniformity, sum(rises) / len(rises), tuple(steps), tuple(from_original))
