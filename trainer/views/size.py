"""Size of the views of a region: enough pixels for its visible detail, as far as training time allows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize import alpha_weights
from progdf.region import Region
from progdf.threads import map_threads
from trainer.options import LARGEST_VIEW_PX

MAX_SIDE_PX = 768
"""Largest longer side of the views, if it is chosen."""

MIN_WIDTH_PX = 1.0
"""Width of the smallest visible Gaussians in views that show all detail: two standard deviations, pixels."""

PIXELS_PER_MEMBER = 1.5
"""Pixels of the region in the mean view, per visible Gaussian, that are always allowed.

The time of a run grows with the Gaussians too (docs/lab/experiments.md, Views).
"""

_SMALL_SHARE = 0.1  # share of the visible weight that counts as the smallest Gaussians
_COMPARED_SIDE_PX = 128  # size of the pictures in which the region is measured
_SIDE_STEP_PX = 16  # sizes are multiples of this
_MIN_WEIGHT_PX = 0.25  # smallest blended weight of a visible Gaussian in such a picture, pixels


@dataclass(frozen=True)
class ViewSize:
    """Size of the views, with the measurements that decided it."""

    side: int  # longer side, pixels
    needed: int  # longer side at which the smallest visible Gaussians are `MIN_WIDTH_PX` wide

    def line(self) -> str:
        """Return the log line on the size."""
        need = f"the region's detail needs {self.needed}"
        if self.side < self.needed:
            largest = min(self.needed, LARGEST_VIEW_PX)
            return f"views of {self.side} pixels to limit the time; {need} (--image-size {largest})"
        return f"views of {self.side} pixels; {need}"


@dataclass(frozen=True)
class SizeLimits:
    """Limits of the size of the views."""

    min_side: int  # smallest longer side, pixels
    # maximum pixels of the region in the mean view; more for many Gaussians, see `PIXELS_PER_MEMBER`
    region_pixels: int


def choose_view_size(
    scene: Gaussians, region: Region, cameras: Sequence[Camera], limits: SizeLimits
) -> ViewSize:
    """Return the size at which the smallest visible Gaussians of a region are a pixel wide.

    Args:
        scene: the original
        region: the region to show
        cameras: at least one, framed like the views; their size is ignored
        limits: limits of the size; `MAX_SIDE_PX` is another one

    Returns:
        The size; its sides are multiples of 16 pixels.
    """
    found = map_threads(lambda camera: _measure(scene, region, camera), cameras)
    sides = sorted(detail.side for detail in found if detail.cover > 0)
    needed = sides[len(sides) // 2] if sides else limits.min_side
    cover = max(sum(detail.cover for detail in found) / len(found), 1e-6)
    affordable = max(limits.region_pixels, PIXELS_PER_MEMBER * max(detail.visible for detail in found))
    side = min(needed, MAX_SIDE_PX, math.sqrt(affordable / cover))
    return ViewSize(max(limits.min_side, _round_side(side)), _round_side(needed))


@dataclass(frozen=True)
class _Detail:
    """Detail of a region from one camera."""

    side: float = math.inf  # longer side at which the smallest visible Gaussians have `MIN_WIDTH_PX`
    cover: float = 0.0  # the region's share of the picture
    visible: int = 0  # number of visible members


def _round_side(side: float) -> int:
    """Return the nearest multiple of the size step, at least one step, pixels."""
    return max(1, round(side / _SIDE_STEP_PX)) * _SIDE_STEP_PX


def _measure(scene: Gaussians, region: Region, camera: Camera) -> _Detail:
    """Measure the region's detail from a camera."""
    side = _COMPARED_SIDE_PX
    scale = side / max(camera.width, camera.height)
    small = camera.resize(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))
    pixels = torch.ones(small.height, small.width)
    weights = alpha_weights(scene, small, pixels)[region.members, 2].double()
    total = float(weights.sum())
    if total <= 0:
        return _Detail()
    widths = _widths(scene, region, small)
    order = widths.argsort()
    shares = weights[order].cumsum(dim=0) / total
    smallest = float(widths[order[int((shares < _SMALL_SHARE).sum())]])
    visible = int((weights > _MIN_WEIGHT_PX).sum())
    return _Detail(MIN_WIDTH_PX / max(smallest, 1e-6) * side, total / pixels.numel(), visible)


def _widths(scene: Gaussians, region: Region, camera: Camera) -> Tensor:
    """Return two standard deviations of each member along its middle axis, pixels. [M] float64"""
    members = region.members
    depth = (scene.means[members] @ camera.viewmat[2, :3] + camera.viewmat[2, 3]).double()
    middle = scene.scales[members].double().sort(dim=1).values[:, 1]
    return 2.0 * middle * float(camera.K[0, 0]) / depth.clamp_min(camera.near)
