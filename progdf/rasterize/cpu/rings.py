"""Kernel: Gaussians with their outlines, for inspection. shaders/rings.frag has the same formulas.

A Gaussian ends at its outline, two standard deviations from its center or where alpha is 1/255, whichever is
nearer. The outline is `RING_PX` wide, measured inwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.camera import Camera
from progdf.rasterize.engines import ALPHA_MAX, TRANSMITTANCE_MIN, ActivatedGaussians, Crop, RasterView

from .blend import RenderBuffers, TileScratch, tile_bounds, tile_corner
from .engine import draw_tiles
from .forward import EXTENT_Y, INV_L11, L11, L22, MX, MY, R2, SLOPE, UNIT, Pinhole, Splats, TileLists
from .jit import kernel

Array = NDArray[Any]

CONTOUR_SIGMAS = 2.0
"""Distance of the outline from the center, standard deviations."""
RING_ALPHA = 0.6
"""Alpha of the outline."""
RING_PX = 1.5
"""Width of the outline, pixels."""

LINE_CONTRAST = 0.4
"""Share of black, or of white on dark Gaussians, in the color of the outline."""

_CONTOUR2 = (CONTOUR_SIGMAS * UNIT) ** 2
_CHECK = 32  # number of splats between two checks for a finished tile


def render_rings(
    gaussians: ActivatedGaussians, camera: Camera, background: Sequence[float], crop: Crop | None = None
) -> tuple[Tensor, Tensor]:
    """Draw Gaussians with their outlines, without gradients.

    Args:
        gaussians: the scene
        camera: the view
        background: rgb behind everything
        crop: draw only this window

    Returns:
        The image and its transmittance. [H,W,3], [H,W]
    """
    view = RasterView.of(camera, gaussians, crop)
    out = draw_tiles(_blend_rings, gaussians, view, np.asarray(background, np.float32))
    return torch.from_numpy(out.image), torch.from_numpy(out.transmittance)


@kernel(cache=True)
def _blend_rings(
    begin: int, end: int, scratch: TileScratch, splats: Splats, lists: TileLists, camera: Pinhole,
    background: Array, out: RenderBuffers,
) -> None:  # fmt: skip
    """Blend tiles begin … end − 1 front to back. background: [3] float32"""
    bounds = scratch.bounds
    for tile in range(begin, end):
        x, y = tile_corner(camera, tile)
        tile_bounds(camera, x, y, bounds)
        x0 = x - camera.window[0]
        y0 = y - camera.window[1]
        for row in range(y0 + bounds[1], y0 + bounds[3]):
            for column in range(x0 + bounds[0], x0 + bounds[2]):
                out.transmittance[row, column] = 1.0
                for k in range(3):
                    out.image[row, column, k] = 0.0
        for index in range(lists.starts[tile], lists.starts[tile + 1]):
            if (index - lists.starts[tile]) % _CHECK == 0 and _is_done(out.transmittance, x0, y0, bounds):
                break
            s = lists.members[index]
            _blend_ring(splats.shapes[s], splats.colors[s], x, y, bounds, x0, y0, out)
        for row in range(y0 + bounds[1], y0 + bounds[3]):
            for column in range(x0 + bounds[0], x0 + bounds[2]):
                for k in range(3):
                    out.image[row, column, k] += out.transmittance[row, column] * background[k]


@kernel(inline=True)
def _is_done(transmittance: Array, x0: int, y0: int, bounds: Array) -> bool:
    for row in range(y0 + bounds[1], y0 + bounds[3]):
        for column in range(x0 + bounds[0], x0 + bounds[2]):
            if transmittance[row, column] > TRANSMITTANCE_MIN:
                return False
    return True


@kernel(inline=True)
def _blend_ring(
    shape: Array, color: Array, x: int, y: int, bounds: Array, x0: int, y0: int, out: RenderBuffers
) -> None:
    """Blend one splat into a tile. x, y: the tile's first pixel; x0, y0: the same in the window"""
    contour = min(shape[R2], _CONTOUR2)
    far_end = 1.0 if color[0] + color[1] + color[2] < 1.5 else 0.0
    mx = shape[MX] - x - 0.5
    my = shape[MY] - y - 0.5
    first = max(math.ceil(max(my - shape[EXTENT_Y], -1.0)), bounds[1])
    last = min(math.floor(min(my + shape[EXTENT_Y], 1e6)) + 1, bounds[3])
    for row in range(first, last):
        v = shape[L22] * (row - my)
        remaining = contour - v * v
        if remaining < 0.0:
            continue
        center = mx - shape[SLOPE] * (row - my)
        half = math.sqrt(remaining) * shape[INV_L11]
        start = int(max(math.ceil(center - half), float(bounds[0])))
        stop = int(min(math.floor(center + half) + 1.0, float(bounds[2])))
        for column in range(start, stop):
            through = out.transmittance[y0 + row, x0 + column]
            if through <= TRANSMITTANCE_MIN:
                continue
            u = shape[L11] * (column - center)
            q = u * u + v * v
            across = 2.0 * u * shape[L11]
            down = 2.0 * (u * shape[L11] * shape[SLOPE] + v * shape[L22])
            inside = (contour - q) / max(math.sqrt(across * across + down * down), 1e-6)
            ring = RING_ALPHA * min(max(RING_PX - inside, 0.0), 1.0)
            fill = min(ALPHA_MAX, color[3] * 2.0**-q)
            alpha = fill + ring * (1.0 - fill)
            for k in range(3):
                line = color[k] + LINE_CONTRAST * (far_end - color[k])
                out.image[y0 + row, x0 + column, k] += through * (line * ring + color[k] * (alpha - ring))
            out.transmittance[y0 + row, x0 + column] = through * (1.0 - alpha)
