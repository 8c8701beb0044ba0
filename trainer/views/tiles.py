"""Which tiles of a view an edit that moves nothing can change, and which Gaussians these tiles show.

While the members of a region keep their places, shapes and opacities, a pixel to which none of them
contributes keeps its color. So only the tiles with a pixel to which one does are drawn again, with the
Gaussians that reach into them; the others are the original picture. In the drawn tiles the same Gaussians
are blended in the same order, so picture and gradients are the same bits (tests/trainer/views/test_tiles.py).

The box around the region brings most of it; tiles help where a region is small or scattered, and cost a
twentieth elsewhere (docs/experiments.md, Views).
"""

from __future__ import annotations

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.rasterize import Crop
from progdf.rasterize.cpu.forward import TILE_H, TILE_W

_SUPPORT = 2 * 5.55
"""Most squared Mahalanobis distance at which alpha ≥ 1/255: 2 ln 255, rounded up."""

_DILATION = 0.3
"""Pixels² that the rasterizer adds to a projected covariance."""


def live_tiles(contributes: Tensor, box: Crop) -> Tensor:
    """The tiles in which some pixel of a box is set, on the tile grid of the full image.

    Args:
        contributes: pixels of the box. [h,w] bool
        box: x0, y0, x1, y1 in the full image

    Returns:
        [rows, columns] bool; tiles from the image's left top to the box's right bottom
    """
    x0, y0, x1, y1 = box
    rows, columns = -(-y1 // TILE_H), -(-x1 // TILE_W)
    whole = torch.zeros(rows * TILE_H, columns * TILE_W, dtype=torch.bool)
    whole[y0:y1, x0:x1] = contributes
    return whole.view(rows, TILE_H, columns, TILE_W).any(dim=3).any(dim=1)


def live_pixels(live: Tensor, box: Crop) -> Tensor:
    """The pixels of a box that lie in live tiles. [rows, columns] bool -> [h,w] bool"""
    x0, y0, x1, y1 = box
    return live.repeat_interleave(TILE_H, dim=0).repeat_interleave(TILE_W, dim=1)[y0:y1, x0:x1]


def may_reach(means: Tensor, scales: Tensor, camera: Camera, live: Tensor) -> Tensor:
    """Which Gaussians may reach into a live tile; too many rather than too few.

    The bound: the largest axis, through the Jacobian of the projection at the place where the rasterizer
    takes it (Kerbl 2023 clamps it to 1.3 times the field of view), is the largest a projected axis can be.

    Args:
        means, scales: activated. [n,3], [n,3]
        camera: the whole view
        live: as from `live_tiles`

    Returns:
        [n] bool
    """
    seen = means.double() @ camera.viewmat[:3, :3].T.double() + camera.viewmat[:3, 3].double()
    z = seen[:, 2].clamp_min(camera.near)
    K = camera.K.double()
    focal = torch.stack([K[0, 0], K[1, 1]])
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    slope = seen[:, :2] / z[:, None]
    center = slope * focal + K[:2, 2]
    # at least as far out as the rasterizer's clamp, which leaves 0.15 of the picture beyond each edge
    most = torch.maximum(K[:2, 2], size - K[:2, 2]) / focal + 0.2 * size / focal
    widened = 1 + slope.abs().minimum(most).square().sum(dim=1)
    spread = (scales.double().amax(dim=1) * focal.max() / z).square() * widened + _DILATION
    radius = (_SUPPORT * spread).sqrt() + 1.0
    rows, columns = live.shape
    step = torch.tensor([TILE_W, TILE_H], dtype=torch.float64)
    last = torch.tensor([columns, rows])
    low = ((center - radius[:, None]) / step).floor().clamp(min=0).minimum(last).nan_to_num(0.0).long()
    high = ((center + radius[:, None]) / step).floor().clamp(min=-1).minimum(last - 1).nan_to_num(
        0.0
    ).long() + 1
    sums = torch.zeros(rows + 1, columns + 1, dtype=torch.int64)
    sums[1:, 1:] = live.long().cumsum(0).cumsum(1)
    (left, top), (right, bottom) = low.unbind(1), high.unbind(1)
    found = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    return found > 0
