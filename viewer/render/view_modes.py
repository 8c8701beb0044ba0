"""View modes: other colors and shapes for all Gaussians, so that the picture shows their properties.

centers  a dot of constant size per Gaussian, in its own color
rings    the Gaussians with their outlines at `progdf.rasterize.cpu.rings.CONTOUR_SIGMAS`
depth    yellow is near, blue is far; the range is that of the centers in the picture
normals  shortest axis, towards the camera: red right, green up, blue towards the camera
opacity  blue is transparent, yellow is opaque

Depth, normals and opacity are colors per Gaussian, blended like its own color. Pictures in motion draw merged
Gaussians, see `can_merge`.
shaders/include/view_modes.glsl has the same formulas.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize import ActivatedGaussians
from progdf.rasterize.engines import ALPHA_MIN

from .highlight import RAMP, rgba

SPLATS = "splats"
CONTRIBUTION = "contribution"
"""Mode with the picture of the splats; the window adds a readout at the pointer."""
CENTERS = "centers"
RINGS = "rings"
RECOLORED = ("depth", "normals", "opacity")
"""Modes that change colors alone, in the order of their numbers in the shader, from 1."""

LOGIT_MIN = math.log(ALPHA_MIN / (1.0 - ALPHA_MIN))  # opacity logit below which nothing is drawn
DOT_PX = 0.7  # standard deviation of a dot before the rasterizer's blur, pixels
DEPTH_PERCENTILES = (2.0, 98.0)  # ends of the depth range, so that single floaters do not stretch it
MAX_SAMPLE = 50_000  # number of centers from which the depth range is measured

RAMP_COLORS = tuple(rgba(color)[:3] for _, color in RAMP)
"""Colors of the ramp at 0, 1/4, 1/2, 3/4 and 1."""


def can_merge(mode: str, has_highlights: bool) -> bool:
    """Return whether a picture in motion may draw merged Gaussians in a mode.

    They have no opacity that compares with those of the scene, and no highlight beside their color.
    """
    return mode != "opacity" and not (has_highlights and mode in RECOLORED)


def depth_range(means: Tensor, camera: Camera) -> tuple[float, float]:
    """Return the depths at the near and far end of the colors, world units.

    Args:
        means: centers, world units. [N,3]
        camera: view whose picture the centers must be in
    """
    step = max(1, len(means) // MAX_SAMPLE)
    points = means[::step].double().numpy() @ camera.viewmat[:3, :3].double().numpy().T
    points += camera.viewmat[:3, 3].double().numpy()
    depths = points[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = (points @ camera.K.double().numpy().T / depths[:, None])[:, :2]
        visible = ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(axis=1)
        inside = visible & (depths > camera.near)
    if not inside.any():
        return 0.0, 1.0
    near, far = np.percentile(depths[inside], DEPTH_PERCENTILES)
    return float(near), float(max(far, near * (1.0 + 1e-6)))


def visible_count(scene: Gaussians, camera: Camera, near: float) -> int:
    """Return the number of Gaussians whose center is in the picture and that are not transparent."""
    rotation = camera.viewmat[:3, :3].numpy()
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y, depth = rotation @ scene.means.numpy().T + camera.viewmat[:3, 3:].numpy()
        column = x / depth * float(camera.K[0, 0]) + float(camera.K[0, 2])
        row = y / depth * float(camera.K[1, 1]) + float(camera.K[1, 2])
        inside = (column >= 0.0) & (column <= camera.width) & (row >= 0.0) & (row <= camera.height)
        drawn = scene.logit_opacities.numpy() >= LOGIT_MIN
    return int(np.count_nonzero(inside & (depth > near) & drawn))


def apply(
    gaussians: ActivatedGaussians,
    highlights: Tensor | None,
    camera: Camera,
    mode: str,
    depths: tuple[float, float] | None = None,
) -> ActivatedGaussians:
    """Return the Gaussians as a mode shows them from a camera. Rings are drawn by another kernel.

    Args:
        gaussians: the scene, or merged Gaussians in its place, with highlights in the colors
        highlights: rgb and share of the highlights, 0 to 1, or None. [N,4]
        camera: the view
        mode: one of `view_state.VIEW_MODES`
        depths: near and far end of the depth colors, world units; None for those of `gaussians`
    """
    if mode == CENTERS:
        return _dots(gaussians, camera)
    if mode not in RECOLORED:
        return gaussians
    if mode == "depth":
        colors = _depth_colors(gaussians, camera, depths or depth_range(gaussians.means, camera))
    elif mode == "normals":
        colors = _normal_colors(gaussians, camera)
    else:
        colors = ramp(gaussians.opacities)
    if highlights is not None:
        colors = colors + highlights[:, 3:] * (highlights[:, :3] - colors)
    return gaussians._replace(colors=colors)


def _dots(gaussians: ActivatedGaussians, camera: Camera) -> ActivatedGaussians:
    focal = float(max(camera.K[0, 0], camera.K[1, 1]))
    sizes = (_depths(gaussians, camera).clamp_min(0.0) * (DOT_PX / focal))[:, None].expand(-1, 3)
    usable = gaussians.scales.isfinite().all(dim=1) & (gaussians.opacities >= ALPHA_MIN)
    return gaussians._replace(scales=sizes.contiguous(), opacities=usable.float(), antialiased=False)


def _depths(gaussians: ActivatedGaussians, camera: Camera) -> Tensor:
    depths = gaussians.means.double() @ camera.viewmat[2, :3].double() + camera.viewmat[2, 3].double()
    return depths.float()


def _depth_colors(gaussians: ActivatedGaussians, camera: Camera, ends: tuple[float, float]) -> Tensor:
    near, far = ends
    return ramp((far - _depths(gaussians, camera)) / (far - near))


def _normal_colors(gaussians: ActivatedGaussians, camera: Camera) -> Tensor:
    rotation = camera.viewmat[:3, :3]
    normals = shortest_axes(gaussians.quats, gaussians.scales) @ rotation.T
    points = gaussians.means @ rotation.T + camera.viewmat[:3, 3]
    away = (normals * points).sum(dim=1, keepdim=True) > 0.0
    normals = torch.where(away, -normals, normals)
    return 0.5 + 0.5 * normals * normals.new_tensor([1.0, -1.0, -1.0])


def shortest_axes(quats: Tensor, scales: Tensor) -> Tensor:
    """Return the unit axis with the smallest scale of each Gaussian, world axes. [N,4], [N,3] -> [N,3]"""
    length = quats.norm(dim=1, keepdim=True)
    usable = length.isfinite() & (length > 0.0)
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    w, x, y, z = torch.where(usable, quats / length, identity).unbind(dim=1)
    columns = torch.stack(
        [
            torch.stack([1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)], dim=1),
            torch.stack([2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)], dim=1),
            torch.stack([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)], dim=1),
        ],
        dim=1,
    )
    return columns[torch.arange(len(quats)), scales.argmin(dim=1)]


def ramp(shares: Tensor) -> Tensor:
    """Return the ramp's colors for shares from 0 to 1, clamped. [N] -> [N,3]"""
    stops = shares.new_tensor(RAMP_COLORS)
    at = shares.nan_to_num().clamp(0.0, 1.0) * (len(stops) - 1)
    low = at.long().clamp_max(len(stops) - 2)
    return torch.lerp(stops[low], stops[low + 1], (at - low)[:, None])
