"""What the options mean for the optimiser, given what the edit moves; 0 and "auto" are decided here.

Measured on held-out views: PSNR and LPIPS of the finished edit, PSNR to the editor's own pictures at
strengths .25, .5 and .75, sharpness over that of the editor's picture, evenness of the slider (its smallest
step over its largest).

The robot of playbot_31k recoloured, 13 views of 160 pixels, 240 steps in 4 stages, 10 to 13 ms a step
    default                       29.5 dB  .004   29.7 24.5 26.5   sharp  .96   even .20
    no LPIPS; LPIPS 1             29.6     .004 ; 24.5 .016
    LPIPS through VGG16           29.1     .005 , 2.3 times as long
    LPIPS at every step           29.4     .004
    progressive warmup            22.5     .018   27.4 15.4 16.0   sharp  .95   even .40
    progressive decay, growth      9.5     .284 (before the edit: 9.7 dB, .263)
    progressive decay, 1e-4       26.1     .007   29.4 20.2 21.3   sharp  .95   even .43
    sharpness hinge               29.1     .005   29.7 23.5 26.0   sharp 1.07   even .19
    sharpness paper               29.5     .004 , the same pictures
    rates of 3DGS                 13.7     .127   21.8 13.0 12.2   sharp 1.19   even .31
    recording raw                 29.5     .004   29.7 25.5 26.8   sharp  .96   even .04
    one target                    29.4     .004   19.8 15.2 17.3   sharp  .96   even .60

Painted in a style, every strength a cross-fade (* as it was before)
    one target, no hinge          18.8 dB  .157   29.5 24.5 21.2   sharp  .60   even .68
    one target, hinge .3          18.5     .151   29.4 24.0 20.6   sharp 1.00   even .22
    one target, hinge .5          18.6     .154   29.0 23.9 20.7   sharp 1.02   even .18
    2 stages, hinge .5            18.2     .143   24.3 22.5 20.4   sharp 1.04   even .00
    4 stages, hinge .5            18.3     .154   27.8 23.0 20.1   sharp 1.00   even .03
    robot, one target, no hinge * 16.6     .166   26.4 21.7 18.6   sharp  .75   even .61
    robot, one target, hinge .3   16.6     .167   26.4 21.6 18.7   sharp  .93   even .68
    robot, 8 stages, no hinge *   16.3     .172   25.0 20.5 18.1   sharp  .78   even .00

Painted in style 14 in the region's box (editors/style.py), one target, 24 views of 256 pixels, 480 steps
    bear's body, no hinge         27.9 dB  .107   clean and soft
    bear's body, hinge .1         27.6     .103   clean
    bear's body, hinge .3         26.8     .118   coloured needles all over the fur
    robot, no hinge; .1; .3       23.6 .081 ; 23.2 .085 ; 23.2 .089   sharp  .78; .82; .86

A painting differs from view to view, and what one stage makes of that the next has to undo: staged, a style
gets dirty half way. Its strengths are cross-fades, which one straight way meets by itself.
"""

from __future__ import annotations

import math

from progdf.gaussians import BASE_CHANNELS
from trainer.editors.base import EditKind
from trainer.groups import GROWTH
from trainer.objective import LossWeights, Sharpness
from trainer.options import MOST_STAGES, QUICK_STAGES, TrainOptions
from trainer.pgs import PgsSettings, learning_rates

PERCEPTUAL_WEIGHT: dict[EditKind, float] = {"colour": 0.1, "style": 0.3, "geometry": 0.3}
SHARPNESS: dict[EditKind, Sharpness] = {"colour": "off", "style": "hinge", "geometry": "off"}
SHARPNESS_WEIGHT: dict[Sharpness, float] = {"hinge": 0.1, "paper": 1.0, "off": 0.0}
STAGES: dict[EditKind, int] = {"colour": MOST_STAGES, "style": 1, "geometry": MOST_STAGES}


def stages_to_ask(options: TrainOptions, kind: EditKind) -> int:
    """How many strengths an editor is asked for that pictures any."""
    return options.stages or min(STAGES[kind], QUICK_STAGES if options.quick else STAGES[kind])


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
        growth=GROWTH if kind == "geometry" and options.group_steps else math.inf,
        seed=options.seed,
    )
