"""A small bear and its edits, for the tests of the trainer."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.ply import save_ply
from progdf.region import Region, from_mask
from progdf.scenes import bear
from trainer.options import TrainOptions
from trainer.view_choice import choose_views
from trainer.views import View, region_rig

WHITE = torch.ones(3)


@dataclass(frozen=True)
class Small:
    """A scene, a region of it, and views that look at the region."""

    scene: Gaussians
    region: Region
    views: tuple[View, ...]


@cache
def small(part: str = "scarf", size: int = 1500, count: int = 6, image_size: int = 72) -> Small:
    """A bear with `part` as its region, seen in `count` views of `image_size` pixels."""
    demo = bear(size)
    mask = torch.zeros(size, dtype=torch.bool)
    mask[demo.members(part)] = True
    region = from_mask(part, mask)
    cameras = region_rig(demo.gaussians, region, count + count // 2, image_size)
    return Small(demo.gaussians, region, choose_views(demo.gaussians, region, cameras, count, WHITE).views)


def write_bear(folder: Path, size: int = 1500) -> tuple[Path, Path]:
    """scene.ply and labels.npy of a small bear."""
    demo = bear(size)
    save_ply(folder / "scene.ply", demo.gaussians)
    np.save(folder / "labels.npy", demo.labels.numpy())
    return folder / "scene.ply", folder / "labels.npy"


def quick_options(folder: Path, out: str = "run", part: str = "body", **more: object) -> TrainOptions:
    """Options of a run that takes a few seconds on the bear of `write_bear` in `folder`."""
    number = bear(400).label_names.index(part)
    settings: dict[str, object] = {
        "scene": folder / "scene.ply",
        "out": folder / out,
        "region": f"labels:{folder / 'labels.npy'}:{number}",
        "editor": "recolor:#3060d0",
        "views": 10,
        "image_size": 72,
        "steps": 200,
        "stages": 4,
        "threads": 1,
        **more,
    }
    return TrainOptions(**settings)  # type: ignore[arg-type]


def masked_psnr(image: Tensor, target: Tensor, mask: Tensor) -> float:
    """PSNR over the pixels of a mask, dB. [H,W,3], [H,W,3], [H,W] bool"""
    return float(-10 * torch.log10((image[mask] - target[mask]).square().mean()))
