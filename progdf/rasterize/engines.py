"""The engines: one signature, a line each."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import isqrt
from typing import NamedTuple, Protocol, cast

from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians

from .conventions import RasterInfo

Crop = tuple[int, int, int, int]
"""A window x0, y0, x1, y1 in pixels of the full image; x1 and y1 are one past the last."""

ENGINES = {"reference": "progdf.rasterize.reference", "cpu": "progdf.rasterize.cpu.engine"}
"""Engine name -> module that is a `RasterEngine`, imported when first used."""


class ActivatedGaussians(NamedTuple):
    """N Gaussians in activated units, as they are drawn.

    Args:
        means: centers, world units. [N,3]
        quats: rotations wxyz, any nonzero length. [N,4]
        scales: standard deviations, world units, ≥ 0. [N,3]
        opacities: 0..1. [N]
        colors: rgb [N,3], or spherical-harmonic coefficients [N,K,3], K = (degree+1)²
        antialiased: scale opacities by sqrt(det/dilated det) of the 2D covariance (Mip-Splatting)
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    antialiased: bool = False

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """All but the flag."""
        return self[:5]

    @property
    def sh_degree(self) -> int | None:
        """Degree of the harmonics that are shown, 0..3; None where the colors are rgb."""
        return None if self.colors.ndim == 2 else min(isqrt(self.colors.shape[1]) - 1, 3)

    def each(self, function: Callable[[Tensor], Tensor]) -> ActivatedGaussians:
        """The same with every tensor passed through a function."""
        means, quats, scales, opacities, colors = map(function, self.tensors)
        return ActivatedGaussians(means, quats, scales, opacities, colors, self.antialiased)

    def select(self, rows: Tensor) -> ActivatedGaussians:
        """Some of them. [M] int64"""
        return self.each(lambda tensor: tensor[rows])


def activate(gaussians: Gaussians, colors: Tensor | None = None) -> ActivatedGaussians:
    """Raw Gaussians in activated units, with their own spherical harmonics or, if given, other `colors`."""
    colors = gaussians.sh if colors is None else colors
    return ActivatedGaussians(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colors, gaussians.antialiased
    )


@dataclass(frozen=True)
class RasterView:
    """A camera and what is drawn of its image; see `progdf.rasterize.render`."""

    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    crop: Crop
    near: float = 0.01
    sh_degree: int | None = None
    antialiased: bool = False

    @classmethod
    def of(cls, camera: Camera, gaussians: ActivatedGaussians, crop: Crop | None = None) -> RasterView:
        """What `camera` sees of `gaussians`; of its whole image where there is no crop."""
        width, height = camera.width, camera.height
        return cls(
            camera.viewmat, camera.K, width, height, crop or (0, 0, width, height), camera.near,
            gaussians.sh_degree, gaussians.antialiased,
        )  # fmt: skip


class RasterEngine(Protocol):
    """What draws; shapes have been checked."""

    def rasterize(
        self, gaussians: ActivatedGaussians, view: RasterView, background: Tensor, grad_rows: Tensor | None
    ) -> tuple[Tensor, Tensor, RasterInfo]:
        """See `progdf.rasterize.render`."""
        ...

    def alpha_weights(self, gaussians: ActivatedGaussians, view: RasterView, mask: Tensor) -> Tensor:
        """See `progdf.rasterize.alpha_weights`; colors are not read."""
        ...


@cache
def get_engine(name: str) -> RasterEngine:
    """The engine of that name."""
    if name not in ENGINES:
        raise ValueError(f"unknown rasterizer '{name}'; use one of {', '.join(ENGINES)}")
    return cast(RasterEngine, importlib.import_module(ENGINES[name]))
