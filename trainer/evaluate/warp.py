"""One view warped onto another by rendered depth: is what both see the same?

Consistency between views as stylization papers measure it (Huang et al. 2021, Nguyen-Phuoc et al. 2022), with
rendered depth in place of optical flow.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize.depth import Depth, render_depth

_OPAQUE = 0.9  # less shows the background through, which has no depth
_SAME_PLACE = 0.02  # of the depth: further off is another surface


@dataclass(frozen=True)
class SeenDepth:
    """A camera and the depth that it sees."""

    camera: Camera
    depth: Depth


def see_depth(scene: Gaussians, camera: Camera) -> SeenDepth:
    """The depth of a scene from a camera, without gradients."""
    with torch.no_grad():
        return SeenDepth(camera, render_depth(scene, camera))


def warp_view(image: Tensor, source: SeenDepth, target: SeenDepth) -> tuple[Tensor, Tensor]:
    """What the source's picture shows where the target's pixels are.

    Args:
        image: the source's picture. [H,W,3]
        source, target: cameras, with the depth of the same scene

    Returns:
        The picture as the target sees it, sampled bilinearly [h,w,3]; the pixels whose surface the source
        sees too: both opaque, and the same depth to 2 % [h,w] bool
    """
    here, there = target.camera, source.camera
    rows, columns = torch.meshgrid(
        torch.arange(here.height) + 0.5, torch.arange(here.width) + 0.5, indexing="ij"
    )
    pixels = torch.stack([columns, rows, torch.ones_like(rows)], dim=2)
    rays = pixels @ torch.linalg.inv(here.K).T
    points = rays * target.depth.depth[..., None]
    relative = there.viewmat @ here.c2w
    moved = points @ relative[:3, :3].T + relative[:3, 3]
    z = moved[..., 2]
    front = z > there.near
    projected = moved @ there.K.T / torch.where(front, z, 1.0)[..., None]
    u, v = projected[..., 0], projected[..., 1]
    inside = front & (u >= 0.5) & (v >= 0.5) & (u <= there.width - 0.5) & (v <= there.height - 0.5)
    # pixel centers lie at +0.5, as those of `grid_sample` without align_corners do
    grid = torch.stack([2 * u / there.width - 1, 2 * v / there.height - 1], dim=2).clamp(-2, 2)
    planes = torch.cat([image, source.depth.depth[..., None], source.depth.alpha[..., None]], dim=2)
    found = grid_sample(planes.permute(2, 0, 1)[None], grid[None], align_corners=False, padding_mode="border")
    warped, depth, alpha = found[0, :3].permute(1, 2, 0), found[0, 3], found[0, 4]
    both = inside & (target.depth.alpha > _OPAQUE) & (alpha > _OPAQUE)
    return warped, both & ((depth - z).abs() <= _SAME_PLACE * z)
