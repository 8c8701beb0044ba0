"""The engines: one signature, a line each."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple, Protocol, cast

from torch import Tensor

from .conventions import RasterInfo

Crop = tuple[int, int, int, int]
"""A window x0, y0, x1, y1 in pixels of the full image; x1 and y1 are one past the last."""

ENGINES = {"reference": "progdf.rasterize.reference", "cpu": "progdf.rasterize.cpu.engine"}
"""Engine name -> module that is a `RasterEngine`, imported when first used."""


class ActivatedGaussians(NamedTuple):
    """N Gaussians in activated units; what each is: see `progdf.rasterize.rasterize`."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor


@dataclass(frozen=True)
class RasterView:
    """A camera and what is drawn of its image; see `progdf.rasterize.rasterize`."""

    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    crop: Crop
    near: float = 0.01
    sh_degree: int | None = None
    antialiased: bool = False


class RasterEngine(Protocol):
    """What draws; shapes have been checked."""

    def rasterize(
        self, gaussians: ActivatedGaussians, view: RasterView, background: Tensor, grad_rows: Tensor | None
    ) -> tuple[Tensor, Tensor, RasterInfo]:
        """See `progdf.rasterize.rasterize`."""
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
