"""What the options mean for the optimiser, given what the edit moves; 0 and "auto" are decided here.

Measured on held-out views: PSNR and LPIPS of the finished edit, PSNR to the editor's own pictures at
strengths .25, .5 and .75, sharpness over that of the editor's picture, evenness of the slider (its smallest
step over its largest).

A colour edit is solved for (`color_solver`) and has none of these terms, unless one is asked for. What a
descent view by view gives instead: the robot of playbot_31k recoloured (before: 9.4 dB, .305), 13 views of
160 pixels, 240 steps in 4 stages
    LPIPS of weight .1            30.8 dB  .007   30.9 25.3 27.5   sharp  .91   even .14
    no LPIPS                      30.8     .008   31.0 25.4 27.5   sharp  .90   even .16
    LPIPS of weight 1             25.7     .024   27.8 19.8 22.9   sharp  .94   even .14
    LPIPS at every step           30.7     .008   30.8 25.1 27.6   sharp  .92   even .10
    LPIPS through VGG16           30.5     .008   30.8 25.0 27.3   sharp  .91   even .17   2.1 times as long
    plainly clamped colours       19.9     .062   31.6 21.4 21.0   sharp  .96   even .32
    progressive warmup            24.2     .027   28.0 15.4 16.8   sharp  .91   even .37
    progressive decay              9.2     .311   and growth alike: frozen
    sharpness paper               30.8     .007   the same pictures
    sharpness hinge .3            30.1     .008   30.6 24.9 27.2   sharp 1.06   even .10
    recording raw                 30.8     .008   31.0 25.4 27.3   sharp  .91   even .01
    one target                    30.9     .007   19.0 14.9 17.6   sharp  .91   even .67
    rates of 3DGS                 13.6     .163   21.5 12.6 12.1   sharp 1.14   even .27
    preset paper, 1500 steps       9.4     .301   frozen, in six times the time
    the same, progressive off     22.5     .034   14.7 14.4 16.9   sharp  .89   even .01

Painted in style 14 in the region's box (editors/style.py), one target, 24 views of 256 pixels, 480 steps
    bear's body, no hinge         27.9 dB  .107   clean and soft
    bear's body, hinge .1         27.6     .103   clean
    bear's body, hinge .3         26.8     .118   coloured needles all over the fur
    robot, no hinge; .1; .3       23.6 .081 ; 23.2 .085 ; 23.2 .089   sharp  .78; .82; .86

A painting differs from view to view, and what one stage makes of that the next has to undo: staged, a style
gets dirty half way. Its strengths are cross-fades, which one straight way meets by itself (a robot
whose views disagreed, 800 steps: 8 stages 25.0 20.5 18.1, even .00; one target 26.4 21.7 18.6, even .61).
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


def stages_to_ask(options: TrainOptions, kind: EditKind) -> int:
    """How many strengths an editor is asked for that pictures any."""
    most = STAGES[kind]
    hurried = options.quick or options.steps < STAGE_STEPS * most
    return options.stages or min(most, QUICK_STAGES if hurried else most)


def slider_meant(slider: Slider, editor: str, strengths: Sequence[float]) -> Slider:
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
    return loss_weights(options, kind).described(perceptual)


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
