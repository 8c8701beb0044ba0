"""A small bear and its edits, for tests of the trainer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import trainer.run.run
from progdf.camera import Camera
from progdf.demo_scenes.bear import LABELS
from progdf.formats.ply import save_ply
from progdf.gaussians import Gaussians, pack
from progdf.region import Region, from_mask
from tests.helpers.demo_scenes import bear
from trainer.editors import make_editor
from trainer.optimize.color_solver import choose_model, make_solver, split_solver
from trainer.optimize.color_views import add_bands, color_views
from trainer.optimize.losses import GradientL1, Objective
from trainer.optimize.pgs import PgsSettings, TargetStage, learning_rates
from trainer.optimize.ties import Ties, surface_ties
from trainer.options import EditorOptions, OptimizeOptions, RegionOptions, TrainOptions, with_values
from trainer.run.finish import RunResult
from trainer.views.choose import choose_views
from trainer.views.crops import CropScene, crop_scene
from trainer.views.view import View, crop, region_rig, render_colors

WHITE = torch.ones(3)


@dataclass(frozen=True)
class Small:
    """A scene, a region of it, and views of the region."""

    scene: Gaussians
    region: Region
    views: tuple[View, ...]


@cache
def small(part: str = "scarf", size: int = 1500, count: int = 6, image_size: int = 72) -> Small:
    """Return a bear with `part` as its region, seen in `count` views of `image_size` pixels."""
    demo = bear(size)
    mask = torch.zeros(size, dtype=torch.bool)
    mask[demo.members(part)] = True
    region = from_mask(part, mask)
    cameras = region_rig(demo.gaussians, region, count + count // 2, image_size)
    return Small(demo.gaussians, region, choose_views(demo.gaussians, region, cameras, count, WHITE).views)


Optimization = tuple[Tensor, list[CropScene], list[CropScene], list[TargetStage], Objective, PgsSettings]


def course(case: Small, steps: int = 40, **more: object) -> Optimization:
    """Return the arguments of `optimize` to recolor a small bear's part in two stages."""
    editor = make_editor(EditorOptions("recolor:#3060d0"), case.scene, case.region, case.views)
    original = pack(case.scene[case.region.members], with_shN=True)
    crops = [crop_scene(case.scene, case.region.members, v.camera, v.box, WHITE) for v in case.views]
    stages = [TargetStage(s, [crop(editor.edit(v, s), v.box) for v in case.views], steps) for s in (0.5, 1.0)]
    settings = replace(PgsSettings(learning_rates("color", original.shape[1], 1.0)), **more)  # type: ignore[arg-type]
    return (
        original,
        crops,
        crops[:2],
        stages,
        Objective(GradientL1(), OptimizeOptions(perceptual_weight=0.1)),
        settings,
    )


def edit_few(
    scene: Gaussians,
    members: Tensor,
    crops: list[CropScene],
    targets: list[Tensor],
    ties: Ties | None = None,
) -> Tensor:
    """Return the change of the members' lowest bands from a small number of pictures. [M,B,3]"""
    original = pack(scene[members], with_shN=scene.sh_degree > 0)
    ties = ties or surface_ties(scene, members, [some.camera for some in crops])
    solver = make_solver(color_views(crops, original), original, ties)
    solver, model = choose_model(solver, split_solver(solver, targets), targets, 100, 1)
    return add_bands(solver.fit_map(model.degree, targets)[1], model.residual)


def label_mask(scene: Gaussians, member: Tensor, camera: Camera) -> Tensor:
    """Return the pixels of which the members [N] bool contribute more than half. [H,W] bool"""
    white = member.float()[:, None].expand(-1, 3).contiguous()
    return render_colors(scene, white, camera, torch.zeros(3))[..., 0] > 0.5


def write_bear(folder: Path, size: int = 1500) -> tuple[Path, Path]:
    """Write scene.ply and labels.npy of a small bear. Return their paths."""
    demo = bear(size)
    save_ply(folder / "scene.ply", demo.gaussians)
    np.save(folder / "labels.npy", demo.labels.numpy())
    return folder / "scene.ply", folder / "labels.npy"


def quick_options(folder: Path, out: str = "run", part: str = "body", **more: object) -> TrainOptions:
    """Return the options of a run of a few seconds on the bear of `write_bear` in `folder`."""
    number = LABELS.index(part)
    settings: dict[str, object] = {
        "views": 6,
        "image_size": 56,
        "steps": 200,
        "stages": 4,
        "threads": 1,
        **more,
    }
    region = RegionOptions(f"labels:{folder / 'labels.npy'}:{number}")
    options = TrainOptions(folder / "scene.ply", folder / out, region, EditorOptions("recolor:#3060d0"))
    return with_values(options, **settings)


def train(options: TrainOptions, quiet: bool = True) -> RunResult:
    """Run `progdf train` with these options."""
    return trainer.run.run.train(options, quiet)


def masked_psnr(image: Tensor, target: Tensor, mask: Tensor) -> float:
    """Return the PSNR over the pixels of a mask in dB. [H,W,3], [H,W,3], [H,W] bool"""
    return float(-10 * torch.log10((image[mask] - target[mask]).square().mean()))
