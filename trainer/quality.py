"""Limits of a quality: gain and price of each step to a larger model, and the error of its packing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from trainer.options import Quality


@dataclass(frozen=True)
class QualityLimits:
    """Limits of the steps from a small model of a color edit to larger ones."""

    min_gain: float  # share of the squared error that a step must remove, 0 to 1
    # bytes per dB that a step may cost, as a multiple of those of the whole way from the map alone to the
    # smaller model; a file's bytes grow with the functions of its members
    max_price_ratio: float
    added_error: float  # share of the edit's own squared error that its packing may add, 0 to 1

    @property
    def max_error_share(self) -> float:
        """Largest error after a step, as a share of the error before."""
        return 1.0 - self.min_gain

    @property
    def rule(self) -> str:
        """Rule of the choice in words, for the log."""
        smallest = f"smallest model within {100 * self.min_gain:.0f} % of the best error"
        if math.isinf(self.max_price_ratio):
            return smallest
        return f"{smallest}, no step above {self.max_price_ratio:g} times the bytes per dB of the one before"

    def is_too_dear(
        self, base: tuple[float, float], smaller: tuple[float, float], larger: tuple[float, float]
    ) -> bool:
        """Return True if the step from a smaller to a larger model costs too much beside the step before it.

        Args:
            base, smaller, larger: number of functions per member and PSNR, dB, of three models by size. The
                step before leads from `base`, the map alone, to `smaller`. All files hold the map and a
                header. The functions are therefore proportional to the bytes that a step adds to a file
        """
        gain = larger[1] - smaller[1]
        gain_before = smaller[1] - base[1]
        functions = larger[0] - smaller[0]
        functions_before = smaller[0] - base[0]
        if functions <= 0.0 or functions_before <= 0.0 or not 0.0 < gain_before < math.inf:
            return False
        if gain <= 0.0:
            return True
        return functions * gain_before > self.max_price_ratio * functions_before * gain


QUALITIES: Mapping[Quality, QualityLimits] = {
    "small": QualityLimits(min_gain=0.2, max_price_ratio=3.0, added_error=0.25),
    "balanced": QualityLimits(min_gain=0.05, max_price_ratio=10.0, added_error=0.1),
    "best": QualityLimits(min_gain=0.01, max_price_ratio=math.inf, added_error=0.03),
}
"""Limits by the value of --quality (docs/benchmarks.md, Bytes and quality)."""

BALANCED = QUALITIES["balanced"]
"""Default limits."""
