"""How many views an edit needs and of how many pixels: what the members' density asks for, within reason."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize import alpha_weights
from progdf.region import Region
from trainer.options import MOST_VIEWS, VIEWS, ViewOptions
from trainer.views.view import fit_size

SIZES = (256, 320, 384)
"""Longer sides that are tried, in pixels."""

PICTURE_SIZE = 512
"""The longest side at which a changed picture is trained on."""

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
    options: ViewOptions,
    scene: Gaussians,
    region: Region,
    cameras_of: Callable[[int, int], Sequence[Camera]],
) -> tuple[Sequence[Camera], int, str]:
    """Cameras, how many of them to choose, and a line where the members are not resolved by these.

    What was typed is kept to. Else there are more and larger views where members are dense, and only larger
    ones where the cameras are given and few. Why 40 of 320 and not 30 of 384: docs/experiments.md, Views.

    Args:
        options: see `ViewOptions`
        scene, region: what they look at
        cameras_of: longer side in pixels, number of views -> cameras
    """
    tried = list(zip(SIZES, (VIEWS, MOST_VIEWS, MOST_VIEWS), strict=True)) if options.dense else []
    if options.dense and options.cameras is None and not options.views:
        tried.pop()
    tried = [
        (options.image_size or size, options.views or views) for size, views in tried or [(SIZES[0], VIEWS)]
    ]
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
