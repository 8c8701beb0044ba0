"""The demo's bear: seated on a stone plinth in the grass, as Gaussians with exact labels."""

from __future__ import annotations

import math

import torch

from progdf.camera import Camera, intrinsics, look_at
from progdf.errors import ProgdfError

from .assemble import DemoScene, assemble
from .bear_paint import paint
from .bear_parts import LABELS, bear_parts

SMALLEST = 400
"""Fewer Gaussians than this are no bear."""

SKY = (0.510, 0.639, 0.761)
"""Darker than snow and lighter than fur, and cold, so that the bear stands out before it in any coat."""


def bear(size: int = 24_000, seed: int = 0) -> DemoScene:
    """A teddy bear of exactly `size` Gaussians; the same seed gives the same bear, bit for bit
    on the same kind of processor.

    Raises:
        ProgdfError: fewer than `SMALLEST` Gaussians.
    """
    if size < SMALLEST:
        raise ProgdfError(f"{size} Gaussians are too few for a bear; use at least {SMALLEST}")
    gaussians, labels = assemble(bear_parts(), LABELS, paint, size, seed)
    return DemoScene(gaussians, labels, LABELS, _rig(), torch.tensor([0.0, 1.0, 0.0]), SKY)


def _rig(count: int = 32, width: int = 512, height: int = 512) -> tuple[Camera, ...]:
    """Cameras around the bear, the first in front, 4 to 42 degrees above the horizon."""
    center = torch.tensor([0.0, 0.78, 0.12])
    K = intrinsics(math.radians(40), width, height)
    cameras = []
    for i in range(count):
        azimuth = 2 * math.pi * i / count
        elevation = math.radians(4 + 38 * ((0.22 + i * 0.618034) % 1.0))
        direction = torch.tensor(
            [
                math.sin(azimuth) * math.cos(elevation),
                math.sin(elevation),
                math.cos(azimuth) * math.cos(elevation),
            ]
        )
        viewmat = look_at(center + 4.6 * direction, center, torch.tensor([0.0, 1.0, 0.0]))
        cameras.append(Camera(viewmat, K, width, height, name=f"bear_{i:03d}"))
    return tuple(cameras)
