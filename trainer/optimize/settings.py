"""What the options mean for the optimiser, given what the edit moves; 0 and "auto" are decided here.

What each of them gives, alone, is in docs/experiments.md, Terms and options of a descent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from progdf.gaussians import BASE_CHANNELS
from trainer.editors import GIVEN
from trainer.editors.base import EditKind
from trainer.options import MOST_STAGES, QUICK_STAGES, STAGE_STEPS, Slider, TrainOptions
from trainer.presets import PRESETS

from .groups import GROWTH
from .objective import LossWeights, Sharpness
from .pgs import PgsSettings, learning_rates

PERCEPTUAL_WEIGHT: dict[EditKind, float] = {"colour": 0.1, "style": 0.3, "geometry": 0.3}
SHARPNESS: dict[EditKind, Sharpness] = {"colour": "off", "style": "hinge", "geometry": "off"}
SHARPNESS_WEIGHT: dict[Sharpness, float] = {"hinge": 0.1, "paper": 1.0, "off": 0.0}
GROUP_STEPS = 120
STAGES: dict[EditKind, int] = {"colour": MOST_STAGES, "style": 1, "geometry": MOST_STAGES}


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
        kind == "colour"
        and options.rates == "kind"
        and options.progressive == "off"
        and options.sharpness in ("auto", "off")
        and not options.perceptual_weight
        and options.recording == "smooth"
        and options.fit == "after"
        and not options.reedit_every
    )


def idle_options(options: TrainOptions, kind: EditKind) -> list[str]:
    """The options that were asked for and change nothing in a run of this kind, as one types them."""
    solved, weights = solves_colors(options, kind), loss_weights(options, kind)
    without_lpips = solved or weights.perceptual == 0
    idle = {
        "perceptual": without_lpips,
        "perceptual_every": without_lpips,
        "progressive_weight": weights.progressive not in ("decay", "growth"),
        "sharpness_weight": weights.sharpness == "off",
        "group_steps": kind != "geometry",
        "follow": kind != "colour",
    }
    unasked = {name: PRESETS[options.preset].get(name, getattr(TrainOptions, name)) for name in idle}
    asked = [name for name in idle if idle[name] and getattr(options, name) != unasked[name]]
    return ["--no-follow" if name == "follow" else "--" + name.replace("_", "-") for name in asked]


def objective_line(options: TrainOptions, kind: EditKind, perceptual: str) -> str:
    """What a run minimises, for log and report. `perceptual`: the name of the distance that is used."""
    if solves_colors(options, kind):
        return "squared error, all views at once"
    return loss_weights(options, kind).description(perceptual)


def loss_weights(options: TrainOptions, kind: EditKind) -> LossWeights:
    """Which loss terms a run pays for."""
    sharpness = SHARPNESS[kind] if options.sharpness == "auto" else options.sharpness
    return LossWeights(
        PERCEPTUAL_WEIGHT[kind] if options.perceptual_weight is None else options.perceptual_weight,
        options.perceptual_every,
        options.progressive,
        options.progressive_weight,
        sharpness,
        SHARPNESS_WEIGHT[sharpness] if options.sharpness_weight is None else options.sharpness_weight,
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
        stages: how many strengths there are to optimise towards
    """
    rates = learning_rates(kind, channels, extent, options.rates)
    if options.sh == "off":
        rates[BASE_CHANNELS:] = 0.0
    warmup = options.progressive == "warmup"
    smoothing, every = (0.9, 0) if options.recording == "smooth" else (0.0, max(1, options.steps // 32))
    if options.rates == "3dgs":  # a plain descent: the target at once, the same steps throughout
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
        # one target alone is approached slowly: quick steps towards it shine in all colours half way
        ramp=0.0 if kind == "geometry" else 0.9 if stages == 1 else 0.6,
        reach=0.0 if kind == "geometry" else 0.16,
        fall=1.0 if stages == 1 else 0.35,
        smoothing=smoothing,
        every=every,
        growth=GROWTH if group_steps(options, kind) else math.inf,
        seed=options.seed,
    )
