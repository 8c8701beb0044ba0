"""How the members are optimized: all that is known once the kind of the edit is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from progdf.gaussians import BASE_CHANNELS
from trainer.editors.base import EditKind
from trainer.options import Bands, Rates, Slider
from trainer.presets import Refinements

from .groups import GROWTH
from .objective import LossWeights
from .pgs import PgsSettings, learning_rates

GROUP_STEPS = 120
"""Steps of the group stage per strength, where parts are moved as wholes."""


@dataclass(frozen=True)
class Optimization:
    """How the members are optimized.

    Args:
        kind: what the edit moves
        steps: over all stages
        stages: strengths that an editor is asked for that pictures any
        group_steps: of the group stage per strength; 0 leaves it out
        sh: whether the SH bands beyond DC are trained; auto: where the region's colors change with the view
        weights: of the loss terms
        rates, raw, refinements: see `trainer.presets.Constants`
        solves_colors: the edit is solved for, all views at once (`color_solver`)
        seed: order of the views
        few: colors are solved for with neighbors tied, see `picture_solver`
    """

    kind: EditKind
    steps: int
    stages: int
    group_steps: int
    sh: Bands
    weights: LossWeights
    rates: Rates
    raw: bool
    refinements: Refinements
    solves_colors: bool
    seed: int
    few: bool = False

    def objective(self, perceptual: str) -> str:
        """What is minimized, for log and report. `perceptual`: the name of the distance that is used."""
        if self.few:
            return "squared error, all pictures at once, neighbors tied"
        if self.solves_colors:
            return "squared error, all views at once"
        return self.weights.description(perceptual)


def resolve_slider(slider: Slider, strengths: Sequence[float]) -> Slider:
    """What slider values mean, given the strengths of the stages; see `Plan.slider`."""
    if slider != "auto":
        return slider
    return "stages" if len(strengths) > 1 else "even"


def pgs_settings(
    optimization: Optimization, bands: bool, channels: int, extent: float, stages: int
) -> PgsSettings:
    """How a run descends.

    Args:
        optimization: see `Optimization`
        bands: whether the SH bands beyond DC are trained
        channels: columns of a packed row
        extent: size of what moves, world units
        stages: how many strengths there are to optimize towards
    """
    kind, does = optimization.kind, optimization.refinements
    rates = learning_rates(kind, channels, extent, optimization.rates)
    if not bands:
        rates[BASE_CHANNELS:] = 0.0
    return PgsSettings(
        rates,
        optimization.weights.progressive == "warmup",
        damped=does.damps,
        # one target alone is approached slowly: quick steps towards it shine in all colors half way
        ramp=0.0 if kind == "geometry" or not does.ramps else 0.9 if stages == 1 else 0.6,
        reach=0.16 if kind != "geometry" and does.sizes else 0.0,
        fall=0.0 if not does.slows else 1.0 if stages == 1 else 0.35,
        smoothing=0.9 if does.averages else 0.0,
        # a run too short for the paper's snapshots still has four
        every=min(100, max(1, optimization.steps // 4)) if optimization.raw else 0,
        growth=GROWTH if optimization.group_steps else math.inf,
        seed=optimization.seed,
    )
