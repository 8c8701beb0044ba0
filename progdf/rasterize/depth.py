"""Depth: how far away what a pixel shows is. Any engine draws it, as a color that is no color.

    depth = Σ w z / Σ w,  alpha = Σ w,  w = αT,  z: camera z of a Gaussian's center

The expected depth, as gsplat's "ED": of a surface half covered by another it lies between the two. There is
no kernel of its own: the scene is painted with (z, 1, 0) and drawn on black, so the depth has the picture's
weights, whichever engine draws.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.sh import rgb_to_sh0

from .engines import Crop, render

_SHOWN_SH = 16  # coefficients that a picture shows; one that is not finite hides its Gaussian


class Depth(NamedTuple):
    """What `render_depth` draws.

    Args:
        depth: camera z, world units; 0 where nothing is drawn. [H,W]
        alpha: 1 − transmittance, 0..1. [H,W]
    """

    depth: Tensor
    alpha: Tensor


def render_depth(
    gaussians: Gaussians, camera: Camera, engine: str = "cpu", crop: Crop | None = None
) -> Depth:
    """Draw the depth of a scene, differentiable as the picture is. Arguments as of `progdf.render`."""
    painted = paint_depth(gaussians, camera)
    return depth_of(render(painted, camera, (0.0, 0.0, 0.0), crop=crop, engine=engine).image)


def paint_depth(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """The scene in the colors (camera z, 1, 0), to be drawn on black from this camera by any engine."""
    viewmat = camera.viewmat.double()
    z = (gaussians.means.double() @ viewmat[2, :3] + viewmat[2, 3]).to(gaussians.means)
    colors = torch.stack([z, torch.ones_like(z), torch.zeros_like(z)], dim=1)
    shown = gaussians.sh[:, :_SHOWN_SH].isfinite().flatten(1).all(1)
    sh0 = torch.where(shown[:, None], rgb_to_sh0(colors), torch.nan)
    return replace(gaussians, sh0=sh0, shN=gaussians.shN[:, :0])


def depth_of(image: Tensor) -> Depth:
    """What a picture of a scene painted by `paint_depth` shows. [H,W,≥2]"""
    weighted, alpha = image[..., 0], image[..., 1]
    shown = alpha > 0
    return Depth(torch.where(shown, weighted / torch.where(shown, alpha, 1.0), 0.0), alpha)
