"""Checkpoints as gsplat and nerfstudio save them."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from progdf.gaussians import Gaussians


def gsplat_tensors(scene: Gaussians) -> dict[str, Tensor]:
    """Return the table `splats` of gsplat's simple_trainer."""
    return {
        "means": scene.means.clone(),
        "quats": scene.quats.clone(),
        "scales": scene.log_scales.clone(),
        "opacities": scene.logit_opacities.clone(),
        "sh0": scene.sh0[:, None].clone(),
        "shN": scene.shN.clone(),
    }


def nerfstudio_tensors(scene: Gaussians) -> dict[str, Tensor]:
    """Return the parameters of splatfacto, without the prefix of its model."""
    return {
        "means": scene.means.clone(),
        "quats": scene.quats.clone(),
        "scales": scene.log_scales.clone(),
        "opacities": scene.logit_opacities[:, None].clone(),
        "features_dc": scene.sh0.clone(),
        "features_rest": scene.shN.clone(),
    }


def save_gsplat(path: Path, scene: Gaussians, step: int = 29_999) -> Path:
    """Write a checkpoint of simple_trainer on one GPU."""
    torch.save({"step": step, "splats": gsplat_tensors(scene)}, path)
    return path
