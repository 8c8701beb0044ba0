"""How many views an edit needs and of how many pixels: what the members' density asks for, within reason."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize import alpha_weights
from progdf.region import Region
from trainer.editors import VIEW_BY_VIEW
from trainer.options import MOST_VIEWS, VIEWS, TrainOptions
from trainer.views.view import fit_size

SIZES = (256, 320, 384)
"""Longer sides that are tried, in pixels."""

_WELCOME, _BEARABLE = 0.3, 0.5
"""Share of unresolved members up to which a size will do, and above which it is said."""

_LOOK, _LOOKS = 96, 4  # pixels of the views in which members are measured, and how many


def unresolved_share(
    scene: Gaussians, region: Region, cameras: Sequence[Camera], image_size: int, views: int
) -> float:
    """Share of the visible members that get less than a pixel, in so many views of that size together. 0..1

    Args:
        scene, region: what is looked at
        cameras: views of it, of which a few are looked through
        image_size: longer side in pixels
        views: how many there will be
    """
    shown = torch.zeros(len(region))
    looks = cameras[:: max(1, len(cameras) // _LOOKS)][:_LOOKS]
    for camera in looks:
        small = fit_size(camera, _LOOK)
        area = (image_size / max(small.width, small.height)) ** 2
        weights = alpha_weights(scene, small, torch.ones(small.height, small.width))
        shown += area * weights[region.members, 2]
    shown *= views / max(1, len(looks))
    visible = shown > 0
    return float((shown[visible] < 1.0).float().mean()) if bool(visible.any()) else 0.0


def choose_resolution(
    options: TrainOptions,
    scene: Gaussians,
    region: Region,
    cameras_of: Callable[[int, int], Sequence[Camera]],
) -> tuple[Sequence[Camera], int, str]:
    """Cameras, how many of them to choose, and a line where the members are not resolved by these.

    `--views` and `--image-size` are kept to. Else there are more and larger views where members are dense,
    and only larger ones where the cameras are given and few. What is painted or given picture by picture
    stays as small as can be, as does a draft. Why 40 of 320 and not 30 of 384:
    docs/experiments.md, Views.

    Args:
        options: see `TrainOptions`
        scene, region: what they look at
        cameras_of: longer side in pixels, number of views -> cameras
    """
    fixed = options.quick or options.editor.partition(":")[0] in VIEW_BY_VIEW
    tried = [(SIZES[0], VIEWS)] if fixed else list(zip(SIZES, (VIEWS, MOST_VIEWS, MOST_VIEWS), strict=True))
    if not fixed and options.cameras is None and not options.views:
        tried.pop()
    tried = [(options.image_size or size, options.views or views) for size, views in tried]
    for size, views in tried:
        cameras = cameras_of(size, views)
        count = min(views, len(cameras)) * 4 // 5  # every fifth is held out
        share = unresolved_share(scene, region, cameras, size, count)
        if share <= _WELCOME:
            break
    line = (
        f"{share:.0%} of the region's visible Gaussians have less than a pixel in all {count} views "
        f"of {size} pixels: what differs among neighbors is not resolved; give --image-size or --views more"
    )
    return cameras, views, line if share > _BEARABLE else ""
