"""Presets: values of options that belong together. What the command line says itself goes before them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from .options import Preset, TrainOptions

PRESETS: Mapping[Preset, Mapping[str, Any]] = {
    "default": {},
    # the trainer of ProGDF (AAAI 2025) as it is printed. PGS: λ = 1, 5, 1, one target, the rates of 3DGS, all
    # attributes free, raw iterates along the optimiser's time; `--progressive growth` is its other schedule.
    # GDF: 6 million parameters that see positions alone, hard bins, trained beside PGS on L1 + LPIPS, which
    # takes a quarter of an hour; `--field auto` leaves it out. Not the paper's: the gradients through clamped
    # colours, and the bake.
    "paper": {
        "steps": 1500,
        "stages": 1,
        "views": 96,
        "rates": "3dgs",
        "group_steps": 0,
        "perceptual_weight": 1.0,
        "perceptual_every": 1,
        "progressive": "decay",
        "progressive_weight": 5.0,
        "sharpness": "paper",
        "sharpness_weight": 1.0,
        "recording": "raw",
        "slider": "time",
        "field": "neural",
        "fit": "joint",
        "size": "paper",
        "inputs": "position",
        "bins": "hard",
        "code": 0,
        "picture_loss": 1.0,
    },
}


def under_preset(options: TrainOptions, preset: Preset) -> TrainOptions:
    """The options with a preset's values in the fields that it names; `replace` what should differ."""
    return replace(options, preset=preset, **PRESETS[preset])
