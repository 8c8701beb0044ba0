"""What every engine agrees on: the numbers that make a picture match scenes trained elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

DILATION = 0.3
"""Added to the diagonal of the 2D covariance, px² (Kerbl 2023, gsplat)."""

ALPHA_MAX = 0.99
"""Alpha is clamped here; where it is, its gradient is zero (Kerbl 2023)."""

ALPHA_MIN = 1.0 / 255.0
"""A Gaussian contributes to a pixel exactly where its alpha is at least this."""

TRANSMITTANCE_MIN = 1e-4
"""A Gaussian that would bring the transmittance to this or below is left out, and the pixel is done."""

FRUSTUM_MARGIN = 0.3
"""x/z and y/z in the Jacobian are clamped to the frustum plus this share of tan(fov/2) on each side."""

ANTIALIAS_FLOOR = 0.005
"""Least det(before dilation) / det(after) that the antialias option takes the root of."""


@dataclass(frozen=True)
class Simplification:
    """How `simplify` weighs: found on seven real scenes of a million (docs/experiments.md, The viewer).

    Args:
        cell: side of a cell of the grid in which optical depth is added up, pixels
        slices: of its depth from the near plane on, sixteen to a factor of two
        least_light: share of a hidden one's importance that is left, as cells know nothing of gaps
        most_times: as much of its area one takes that stands for others, at most
        dense: optical depth of a slice beyond which there is no need of more area
    """

    cell: int = 8
    slices: int = 224
    least_light: float = 0.05
    most_times: float = 5.0
    dense: float = 8.0


SIMPLIFY = Simplification()

GOLDEN = 0.6180339887498949
"""Multiples of it, less the whole ones, are spread evenly however many are taken: the lots of `simplify`."""


@dataclass(frozen=True)
class RasterInfo:
    """What the projection found, not differentiable.

    Args:
        means2d: centers in pixels; 0 for a Gaussian that is not in front of the near plane or not finite.
            [N,2]
        depths: camera z, world units; 0 likewise. [N] float32
        visible: the box around its {alpha ≥ 1/255} touches the window that was rendered. [N] bool
    """

    means2d: Tensor
    depths: Tensor
    visible: Tensor
