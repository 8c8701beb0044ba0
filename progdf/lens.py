"""Lens distortion: what bends a photograph, and how to straighten it.

Everything drawn here is drawn through a pinhole, so a distorted camera's *view* is exact without its lens. A
photograph taken through the lens is not: it shows each ray at another pixel. The lens is therefore kept
beside the camera, and a photograph is undistorted before it is compared with a render.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

_WIDEST, _RADII = 4.0, 4096
"""Up to which r (76°) and at how many places the lens is checked for folding back."""


@dataclass(frozen=True)
class Lens:
    """Radial and tangential distortion as in OpenCV and COLMAP (Brown 1966; Conrady 1919).

    A ray at (x, y) on the plane one unit before the camera, r² = x² + y², meets the sensor at
    x·(1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 xy + p2 (r² + 2x²), and y likewise with p1 and p2 exchanged.

    Raises:
        ValueError: a number is not finite.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(number) for number in astuple(self)):
            raise ValueError(f"the lens has a number that is not finite: {self}")

    def __bool__(self) -> bool:
        """Whether it bends anything."""
        return any(astuple(self))

    def distort(self, rays: Tensor) -> Tensor:
        """Where rays through (x, y) at z = 1 meet the sensor, in the same units. [...,2] -> [...,2]"""
        x, y = rays[..., 0], rays[..., 1]
        square = x * x + y * y
        radial = 1 + square * (self.k1 + square * (self.k2 + square * self.k3))
        return torch.stack(
            [
                x * radial + 2 * self.p1 * x * y + self.p2 * (square + 2 * x * x),
                y * radial + self.p1 * (square + 2 * y * y) + 2 * self.p2 * x * y,
            ],
            dim=-1,
        )

    def valid_radius(self) -> float:
        """The r up to which what is farther out stays farther out; beyond it the formula folds back."""
        r = torch.linspace(0.0, _WIDEST, _RADII, dtype=torch.float64)
        slope = 1 + r**2 * (3 * self.k1 + r**2 * (5 * self.k2 + r**2 * 7 * self.k3))
        folded = (slope <= 0).nonzero()
        return math.inf if not len(folded) else float(r[max(0, int(folded[0]) - 1)])


def undistort(photograph: Tensor, K: Tensor, lens: Lens) -> tuple[Tensor, Tensor]:
    """A photograph as a pinhole with the same intrinsics would have taken it, sampled bilinearly.

    Args:
        photograph: taken through `lens`. [H,W,3] 0..1
        K: intrinsics of both, pixels of the photograph; pixel centers at +0.5. [3,3]
        lens: what bent it

    Returns:
        the straight picture [H,W,3], and which of its pixels the photograph shows at all [H,W] bool (the
        others are 0)
    """
    height, width = photograph.shape[:2]
    focal = torch.stack([K[0, 0], K[1, 1]]).double()
    middle = K[:2, 2].double()
    rows, columns = torch.meshgrid(
        torch.arange(height, dtype=torch.float64) + 0.5,
        torch.arange(width, dtype=torch.float64) + 0.5,
        indexing="ij",
    )
    rays = (torch.stack([columns, rows], dim=-1) - middle) / focal
    pixels = lens.distort(rays) * focal + middle
    size = torch.tensor([width, height], dtype=torch.float64)
    shown = ((pixels >= 0) & (pixels <= size)).all(dim=-1) & (rays.norm(dim=-1) < lens.valid_radius())
    grid = (2 * pixels / size - 1).float()
    straight = grid_sample(
        photograph.permute(2, 0, 1)[None], grid[None], padding_mode="border", align_corners=False
    )[0].permute(1, 2, 0)
    return torch.where(shown[..., None], straight, 0.0), shown
