"""Losses of the product's descent with one term of the paper's, for `benchmarks.ablation.variants`."""

from __future__ import annotations

from torch import Tensor

from trainer.optimize.losses import Moment, Objective
from trainer.paper import losses
from trainer.paper.losses import Exponent, Over


class PrintedSharpness(Objective):
    """Loss with the paper's L_render."""

    def terms(self, moment: Moment) -> dict[str, Tensor]:
        """See `Objective.terms`."""
        printed = losses.SHARPNESS_WEIGHT * losses.sharpness(moment.image)
        return {**super().terms(moment), "sharpness": printed}


class ProgressiveDecay(Objective):
    """Loss with the progressive constraint, which loosens over the steps."""

    exponent: Exponent = "decay"
    over: Over = "mean"

    def terms(self, moment: Moment) -> dict[str, Tensor]:
        """See `Objective.terms`."""
        change = losses.progressive_change(
            moment.moved, moment.previous, moment.step, self.exponent, self.over
        )
        return {**super().terms(moment), "progressive": losses.PROGRESSIVE_WEIGHT * change}


class ProgressiveGrowth(ProgressiveDecay):
    """Loss with the progressive constraint, which tightens over the steps."""

    exponent: Exponent = "growth"


class ProgressiveSum(ProgressiveGrowth):
    """Loss with the tightening constraint over the sum of all members' steps."""

    over: Over = "sum"
