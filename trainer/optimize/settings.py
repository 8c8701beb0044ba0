"""What the options mean for the optimizer, given what the edit moves; 0 and "auto" are decided here.

What each of them gives, alone, is in docs/experiments.md, Terms and options of a descent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from progdf.gaussians import BASE_CHANNELS
from trainer.editors import GIVEN
from trainer.editors.base import EditKind
from trainer.options import MOST_STAGES, QUICK_STAGES, STAGE_STEPS, Slider, TrainOptions
from trainer.presets import CONSTANTS, PRESETS

from .groups import GROWTH
from .objective import LossWeights, Sharpness
from .pgs import PgsSettings, learning_rates

PERCEPTUAL_WEIGHT: dict[EditKind, float] = {"color": 0.1, "style": 0.3, "geometry": 0.3}
SHARPNESS: dict[EditKind, Sharpness] = {"color": "off", "style": "hinge", "geometry": "off"}
SHARPNESS_WEIGHT: dict[Sharpness, float] = {"hinge": 0.1, "paper": 1.0, "off": 0.0}
PROGRESSIVE_WEIGHT = 5.0  # λ2 of the paper
GROUP_STEPS = 120
STAGES: dict[EditKind, int] = {"color": MOST_STAGES, "style": 1, "geometry": MOST_STAGES}


def stage_count(options: TrainOptions, kind: EditKind) -> int:
    """How many strengths an editor is asked for that pictures any."""
    most = STAGES[kind]
    hurried = options.quick or options.steps < STAGE_STEPS * most
    return options.stages or min(most, QUICK_STAGES if hurried else most)


def resolve_slider(slider: Slider, editor: str, strengths: Sequence[float]) -> Slider:
    """What "auto" means: even, but pinned where somebody gave pictures of several strengths.

    Args:
        slider: the option
        editor: `KIND:WHAT`
        strengths: of the stages
    """
    if slider != "auto":
        return slider
    return "stages" if len(strengths) > 1 and editor.partition(":")[0] in GIVEN else "even"


def group_steps(options: TrainOptions, kind: EditKind) -> int:
    """Steps of the group stage per strength; 0 where there is none."""
    wanted = GROUP_STEPS if options.group_steps is None else options.group_steps
    return wanted if kind == "geometry" else 0


def solves_colors(options: TrainOptions, kind: EditKind) -> bool:
    """Whether the edit is solved for (`color_solver`): colors alone change, and nothing is asked for that
    only a descent view by view has."""
    return (
        kind == "color"
        and CONSTANTS[options.preset].rates == "kind"
        and options.progressive == "off"
        and options.sharpness in ("auto", "off")
        and not options.perceptual_weight
        and not CONSTANTS[options.preset].raw
        and options.fit == "after"
        and not options.reedit_every
    )


def idle_options(options: TrainOptions, kind: EditKind) -> list[str]:
    """The options that were asked for and change nothing in a run of this kind, as one types them."""
    unasked = PRESETS[options.preset].get("group_steps", TrainOptions.group_steps)
    return ["--group-steps"] if kind != "geometry" and options.group_steps != unasked else []


def objective_line(options: TrainOptions, kind: EditKind, perceptual: str) -> str:
    """What a run minimizes, for log and report. `perceptual`: the name of the distance that is used."""
    if solves_colors(options, kind):
        return "squared error, all views at once"
    return loss_weights(options, kind).description(perceptual)


def loss_weights(options: TrainOptions, kind: EditKind) -> LossWeights:
    """Which loss terms a run pays for."""
    sharpness = SHARPNESS[kind] if options.sharpness == "auto" else options.sharpness
    return LossWeights(
        PERCEPTUAL_WEIGHT[kind] if options.perceptual_weight is None else options.perceptual_weight,
        CONSTANTS[options.preset].perceptual_every,
        options.progressive,
        PROGRESSIVE_WEIGHT,
        sharpness,
        SHARPNESS_WEIGHT[sharpness],
    )


def pgs_settings(
    options: TrainOptions, kind: EditKind, channels: int, extent: float, stages: int
) -> PgsSettings:
    """How a run descends.

    Args:
        options: see `TrainOptions`
        kind: what the edit moves
        channels: columns of a packed row
        extent: size of what moves, world units
        stages: how many strengths there are to optimize towards
    """
    constants = CONSTANTS[options.preset]
    rates = learning_rates(kind, channels, extent, constants.rates)
    if options.sh == "off":
        rates[BASE_CHANNELS:] = 0.0
    warmup = options.progressive == "warmup"
    smoothing, every = (0.0, max(1, options.steps // 32)) if constants.raw else (0.9, 0)
    if constants.rates == "3dgs":  # a plain descent: the target at once, the same steps throughout
        return PgsSettings(
            rates,
            warmup,
            damped=False,
            ramp=0.0,
            fall=0.0,
            reach=0.0,
            smoothing=smoothing,
            every=every,
            seed=options.seed,
        )
    return PgsSettings(
        rates,
        warmup,
        # one target alone is approached slowly: quick steps towards it shine in all colors half way
        ramp=0.0 if kind == "geometry" else 0.9 if stages == 1 else 0.6,
        reach=0.0 if kind == "geometry" else 0.16,
        fall=1.0 if stages == 1 else 0.35,
        smoothing=smoothing,
        every=every,
        growth=GROWTH if group_steps(options, kind) else math.inf,
        seed=options.seed,
    )
