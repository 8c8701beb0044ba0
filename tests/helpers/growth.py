"""Objects added to the bear in 3D, which gives a known truth, and pictures of them as an edit."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from progdf.gaussians import Gaussians, concatenate
from progdf.io.images import write_image
from progdf.rasterize import render
from progdf.sh import rgb_to_sh0
from tests.helpers.trained import WHITE, quick_options, small, write_bear
from trainer.options import TrainOptions
from trainer.resolve import resolve
from trainer.views.setup import make_training_setup

RED = (0.85, 0.15, 0.15)
YELLOW = (0.95, 0.85, 0.3)
BLUE = (0.1, 0.3, 0.8)


def balls(scene: Gaussians, means: Tensor, colors: Tensor, size: float) -> Gaussians:
    """Return opaque round Gaussians. [n,3], [n,3]"""
    rows = scene[torch.zeros(len(means), dtype=torch.int64)]
    return replace(
        rows,
        means=means,
        log_scales=torch.full_like(means, math.log(size)),
        logit_opacities=torch.full((len(means),), 4.0),
        sh0=rgb_to_sh0(colors),
        shN=torch.zeros_like(rows.shN),
    )


def things(scene: Gaussians, head: Tensor) -> dict[str, Gaussians]:
    """Return a striped hat on the head, and a rod a few pixels thick that sticks out of it."""
    means = scene.means[head]
    x, _, z = means.median(dim=0).values.tolist()
    top = float(means[:, 1].quantile(0.98))
    radius = 0.75 * float((means[:, 0] - x).abs().quantile(0.9))
    out = ((torch.arange(900) + 0.5) / 900).sqrt()
    angle = math.pi * (3 - math.sqrt(5)) * torch.arange(900)
    cone = [x + radius * out * angle.cos(), top + radius * (1.1 - 1.2 * out), z + radius * out * angle.sin()]
    striped = torch.where(((1 - out) * 4).long()[:, None] % 2 == 0, torch.tensor(RED), torch.tensor(YELLOW))
    along = torch.linspace(0, 1, 200)
    rod = [x + 0.5 * radius * along, top + radius * (1.3 * along - 0.1), torch.full_like(along, z)]
    return {
        "hat": balls(scene, torch.stack(cone, 1), striped, 0.07 * radius),
        "rod": balls(scene, torch.stack(rod, 1), torch.tensor([BLUE]).repeat(200, 1), 0.03 * radius),
    }


def write_growth(folder: Path, what: str, size: int = 1500, **more: object) -> TrainOptions:
    """Write pictures of the bear with one of `things`, or without its ears ("no ears"), into the folder.

    Return the options of a quick run towards them.
    """
    write_bear(folder, size)
    part = "ears" if what == "no ears" else "head"
    case = small(part, size)
    edited = folder / what.replace(" ", "_")
    options = quick_options(folder, part=part, **{"editor": f"folder:{edited}", "steps": 120, **more})
    setup = make_training_setup(resolve(options).views, case.scene, case.region)
    others = torch.ones(size, dtype=torch.bool).index_fill(0, case.region.members, False)
    truth = case.scene[others]
    if what != "no ears":
        truth = concatenate([case.scene, things(case.scene, case.region.members)[what]])
    edited.mkdir()
    for view in setup.views:
        with torch.no_grad():
            write_image(
                edited / f"{view.camera.name}.png", render(truth, view.camera, WHITE).image.clamp(0, 1)
            )
    return options
