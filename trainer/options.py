"""What a training run can be told. Each option changes something one can see or measure."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import tyro

from progdf.errors import ProgdfError
from progdf.field.choose import Kind
from trainer.objective import Progressive
from trainer.trajectory import Slider

QUICK_STEPS, QUICK_STAGES, QUICK_VIEWS = 240, 4, 12


@dataclass(frozen=True)
class TrainOptions:
    """Edit a region of a scene and write its .gdf file.

    Where a default differs from ProGDF (AAAI 2025), it measured better.
    """

    scene: tyro.conf.Positional[Path]
    """The scene, a 3DGS .ply file."""
    out: Path
    """Folder of the run; made if need be."""
    region: str
    """What may change: all, labels:FILE.npy:ID[,ID], box:x0,y0,z0,x1,y1,z1, sphere:x,y,z,r; join by + -."""
    editor: str
    """recolor:#rrggbb, tint:#rrggbb, stripes:#rrggbb, darken:AMOUNT, night, folder:DIR (edited views)."""
    name: str = ""
    """Name of the layer and of the .gdf file; the folder's name if empty."""
    cameras: Path | None = None
    """cameras.json or transforms.json; without it, a rig around the scene that looks at the region."""
    views: int = 30
    """How many views are edited, 3 to 96 (the paper's limit); every fifth is held out to measure with."""
    image_size: int = 256
    """Longer side of the views in pixels."""
    steps: int = 800
    """Optimiser steps over all stages (paper: 1500-2000 towards the finished edit alone)."""
    kind: Literal["auto", "colour", "style", "geometry"] = "auto"
    """What the edit moves; sets learning rates and loss weights. auto: as the editor says (folder: style)."""
    stages: int = 8
    """Strengths that a procedural editor is asked for; 1 is the paper's way, towards the end alone."""
    progressive: Progressive = "off"
    """The paper's progressive constraint (eq. 5): as a warm-up of the learning rate, or as the loss that it
    is, which lets go of the steps (decay) or tightens (growth)."""
    slider: Slider = "stages"
    """Slider values: even visible change between the stages' strengths, even overall, or optimiser time."""
    field: Kind = "auto"
    """Kind of field; auto keeps the smallest that meets --target-psnr."""
    target_psnr: float = 40.0
    """The field's worst PSNR against the recorded trajectory over the slider, on held-out views, dB."""
    quick: bool = False
    """A draft in a third of the time: 240 steps in 4 stages, 12 views."""
    seed: int = 0
    """Order of the views; the same seed gives the same files."""
    threads: int = 0
    """CPU threads; 0 takes all cores but one, at least one. More than there are idle cores is slower."""


@dataclass(frozen=True)
class FitOptions:
    """Refit the field of a run to its recorded trajectory; nothing is optimised again."""

    run: tyro.conf.Positional[Path]
    """Folder that progdf train wrote."""
    field: Kind = "auto"
    """Kind of field; auto keeps the smallest that meets --target-psnr."""
    target_psnr: float = 40.0
    """The field's worst PSNR against the recorded trajectory over the slider, on held-out views, dB."""
    scene: Path | None = None
    """Where the scene is now, if it has moved since the run."""
    threads: int = 0
    """CPU threads; 0 takes all cores but one, at least one."""


def settled(options: TrainOptions) -> TrainOptions:
    """The options with `quick` and the name worked in, and checked.

    Raises:
        ProgdfError: a number that makes no sense.
    """
    if options.quick:
        options = replace(
            options,
            steps=min(options.steps, QUICK_STEPS),
            stages=min(options.stages, QUICK_STAGES),
            views=min(options.views, QUICK_VIEWS),
        )
    name = options.name or options.out.resolve().name
    if not name or "/" in name or name.startswith("."):
        raise ProgdfError(f"'{name}' cannot be a layer's name; choose one with --name, as --name shirt")
    for what, value, low, high in (
        ("--views", options.views, 3, 96),
        ("--image-size", options.image_size, 32, 2048),
        ("--stages", options.stages, 1, 16),
        ("--threads", options.threads, 0, 1024),
    ):
        if not low <= value <= high:
            raise ProgdfError(f"{what} is {value}; {low} to {high} would be right")
    if options.steps < 4 * options.stages:
        raise ProgdfError(
            f"--steps is {options.steps}; at least {4 * options.stages} "
            f"would be right for {options.stages} stages"
        )
    if not math.isfinite(options.target_psnr):
        raise ProgdfError(
            f"--target-psnr is {options.target_psnr}; a number of decibels, as 40, would be right"
        )
    return replace(options, name=name)
