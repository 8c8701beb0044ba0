"""Presets: values of options that belong together. What the command line says itself goes before them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from progdf.field.neural import Bins, Inputs

from .options import Preset, Rates, TrainOptions


@dataclass(frozen=True)
class Constants:
    """What only a preset changes.

    Args:
        rates: learning rates as the kind of edit needs, with short steps on the last stretch; or 3DGS's own,
            flat, for all attributes, which hardly move in 600 steps
        perceptual_every: LPIPS is paid for every so many steps
        sharpness: of the renders: for a style not less than the target's, or the printed term, which pulls at
            no pixel but the rim's
        raw: record the bare iterates at even steps, between which the slider's steps differ far more; not a
            running mean of the parameters whenever the pictures have moved
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
    inputs: Inputs = "own"
    bins: Bins = "smooth"
    code: int = 8
    joint: bool = False


CONSTANTS: Mapping[Preset, Constants] = {
    "default": Constants(),
    "paper": Constants("3dgs", 1, "paper", True, "position", "hard", 0, True),
}

PRESETS: Mapping[Preset, Mapping[str, Any]] = {
    "default": {},
    # the trainer of ProGDF (AAAI 2025) as it is printed. PGS: λ = 1, 5, 1, one target, the rates of 3DGS, all
    # attributes free, raw iterates along the optimizer's time; `--progressive growth` is its other schedule.
    # GDF: 6 million parameters that see positions alone, hard bins, trained jointly with PGS on L1 + LPIPS;
    # it takes a quarter of an hour, so `--field auto` omits it. Not the paper's: gradients through clamped
    # colors, and the bake.
    "paper": {
        "steps": 1500,
        "stages": 1,
        "views": 96,
        "group_steps": 0,
        "perceptual_weight": 1.0,
        "progressive": "decay",
        "slider": "time",
        "field": "neural",
        "size": "paper",
        "picture_loss": 1.0,
    },
}


def apply_preset(options: TrainOptions, preset: Preset) -> TrainOptions:
    """The options with a preset's values in the fields that it names; `replace` what should differ."""
    return replace(options, preset=preset, **PRESETS[preset])
