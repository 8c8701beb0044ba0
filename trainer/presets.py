"""Presets: values of options that belong together. What the command line says itself goes before them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from progdf.field.neural import Bins, Inputs

from .options import Preset, Rates, TrainOptions


@dataclass(frozen=True)
class Refinements:
    """What this trainer does that the paper's does not, each of which can be left out alone.

    Args:
        solves: an edit of colors is solved for, all views at once, unless something is asked for that only a
            descent view by view has
        asks_evenly: where the slider is even, an editor with a strength control is asked for pictures that
            are equally far apart; not for equally distant strengths
        damps: members that hardly show are held still, see `PgsState.descend`
        ramps: a stage's target moves from the last stage's pictures to its own, see `PgsSettings.ramp`
        slows: the last steps of a stage are short, see `PgsSettings.fall`
        sizes: steps are as long as a stage's way asks for, see `PgsSettings.reach`
        averages: a running mean of the parameters is recorded, not the bare iterates
        leads_back: clamps of colors and pixels pass gradients that lead back into range (`views.crops`)
        prunes: attributes that do not pay are left out
        propagates: in an edit of colors, members that no view shows do what their neighbors do
    """

    solves: bool = True
    asks_evenly: bool = True
    damps: bool = True
    ramps: bool = True
    slows: bool = True
    sizes: bool = True
    averages: bool = True
    leads_back: bool = True
    prunes: bool = True
    propagates: bool = True


@dataclass(frozen=True)
class Constants:
    """What only a preset changes.

    Args:
        rates: learning rates as the kind of edit needs; or 3DGS's own, for all attributes, which hardly move
            in 600 steps
        perceptual_every: LPIPS is paid for every so many steps
        sharpness: of the renders: for a style not less than the target's, or the printed term, which pulls at
            no pixel but the rim's
        raw: record every 100 steps and keep the jitter, between which the slider's steps differ far more; not
            whenever the pictures have moved
        whole: losses are of whole pictures, not of the region's box in each
        refinements: see `Refinements`
        inputs: what a network sees, the position alone, or also what the Gaussian looks like and where it
            ends: 38 dB instead of 34 at no cost
        bins: a network's ten bins of the slider, interpolated, or hard, between which the edit jumps
        code: a byte each for so many learned numbers per Gaussian, which tell what its place does not
        joint: a network is trained step by step while the edit is recorded, not on the finished recording
    """

    rates: Rates = "kind"
    perceptual_every: int = 2
    sharpness: Literal["kind", "paper"] = "kind"
    raw: bool = False
    whole: bool = False
    refinements: Refinements = Refinements()
    inputs: Inputs = "own"
    bins: Bins = "smooth"
    code: int = 8
    joint: bool = False


AS_PRINTED = Refinements(False, False, False, False, False, False, False, True, False, False)
"""All but the clamps: with 3DGS's own, a sixth of the colors could never change, and the paper is silent."""

CONSTANTS: Mapping[Preset, Constants] = {
    "default": Constants(),
    "paper": Constants(
        "3dgs", 1, "paper", True, True, AS_PRINTED, inputs="position", bins="hard", code=0, joint=True
    ),
}

PRESETS: Mapping[Preset, Mapping[str, Any]] = {
    "default": {},
    # the trainer of ProGDF (AAAI 2025) as it is printed: docs/paper.md
    "paper": {
        "steps": 1500,
        "stages": 1,
        "views": 96,
        "group_steps": 0,
        "perceptual_weight": 1.0,
        "progressive": "growth",
        "progressive_norm": "squares",
        "sh": "off",
        "image_size": 256,
        "lift_rule": "paper",
        "slider": "time",
        "field": "neural",
        "size": "paper",
        "field_loss": "pictures",
    },
}


def apply_preset(options: TrainOptions, preset: Preset) -> TrainOptions:
    """The options with a preset's values in the fields that it names; `replace` what should differ."""
    return replace(options, preset=preset, **PRESETS[preset])
