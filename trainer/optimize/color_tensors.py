"""Plain torch twin of the color solver's kernels, on any device, and the arithmetic of a step's numbers.

On a GPU the color solver uses these functions instead of `color_kernels`. Sums over members and pixels stay
there as tensors without dimensions. `read_number` alone copies one of them to the processor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor

from progdf.sh import C0, basis
from progdf.threads import map_threads

_A = TypeVar("_A")
_B = TypeVar("_B")

Scalar = float | Tensor
"""Number of the processor, or of another device: a tensor without dimensions."""

_MIN_DIVISOR = 1e-30


def shade_views(means: Tensor, positions: Tensor, sh: Tensor, bias: float, lowest: float) -> Tensor:
    """Return max(lowest, bias + Σ basis · sh) of all members from some cameras.

    Args:
        means: centers of the members. [M,3]
        positions: centers of the cameras. [V,3]
        sh: coefficients of the lowest b = 1, 4, 9 or 16 functions. [M,b,3]
        bias: constant, 0.5 for colors and 0 for changes
        lowest: lower limit, 0 for drawn colors

    Returns:
        colors. [V,M,3]
    """
    if sh.shape[1] == 1:
        constant = (sh[:, 0] * C0 + bias).clamp_min(lowest)
        return constant.expand(len(positions), -1, -1).clone()
    colors = [(_view_basis(means, one, sh)[..., None] * sh).sum(dim=1) for one in positions]
    return (torch.stack(colors) + bias).clamp_min(lowest)


def add_gradients(means: Tensor, positions: Tensor, by_color: Tensor, gradient: Tensor) -> None:
    """Add Σ basis · by_color over some views to the gradient by SH, the transpose of `shade_views`.

    Args:
        means, positions: see `shade_views`
        by_color: gradient by the members' colors in each view. [V,M,3]
        gradient: changed in place. [M,b,3]
    """
    if gradient.shape[1] == 1:
        gradient[:, 0] += C0 * by_color.sum(dim=0)
        return
    for position, one in zip(positions, by_color, strict=True):
        gradient += _view_basis(means, position, gradient)[..., None] * one[:, None]


def _view_basis(means: Tensor, position: Tensor, sh: Tensor) -> Tensor:
    """Return the SH functions of each member from a camera, as many as the coefficients. [M,b]"""
    degree = int(sh.shape[1] ** 0.5) - 1
    return basis(degree, torch.nn.functional.normalize(means - position, dim=1))


def add_curvature(basis_values: Tensor, weights: Tensor, curvature: Tensor) -> None:
    """Add weight · basis · basisᵀ of each member. [M,B], [M], curvature [M,b,b]"""
    lowest = basis_values[:, : curvature.shape[1]]
    curvature += (weights[:, None] * lowest)[:, :, None] * lowest[:, None]


def invert_blocks(curvature: Tensor, free: Tensor, diagonal: Tensor) -> Tensor:
    """Return the inverse of each member's block, with 0 where a function is not solved for.

    Args:
        curvature: positive semidefinite. [M,B,B]
        free: functions to solve for, the lowest b. [M,b] bool
        diagonal: positive numbers added to the diagonals. [M]

    Returns:
        [M,b,b] float32, computed in float64
    """
    count = free.shape[1]
    both = free[:, :, None] & free[:, None]
    blocks = (curvature[:, :count, :count] * both).double()
    blocks.diagonal(dim1=1, dim2=2).add_(diagonal.double()[:, None])
    inverse: Tensor = torch.linalg.inv_ex(blocks)[0]
    return inverse.float() * both


def compare(shown: Tensor, others: Tensor, target: Tensor, counts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the residuals of unclamped channels, these channels, and the squared error in float64.

    Args:
        shown: the members' share of the pixels. [P,3]
        others: the remaining share. [P,3]
        target: the picture. [P,3]
        counts: pixels that count. [P,1] bool

    Returns:
        residuals [P,3], channels that are not clamped [P,3] bool, squared error []
    """
    image = others + shown
    error = (target - image.clamp(0.0, 1.0)).double() * counts
    clamped = ((image <= 0.0) & (target <= 0.0)) | ((image >= 1.0) & (target >= 1.0))
    passed = counts & ~clamped
    return (target - image) * passed, passed, error.square().sum()


def drop_held(colors: Tensor, gradient: Tensor, drawn: Tensor) -> None:
    """Set the gradient of channels to 0 that stay black, and mark the others.

    colors: at least 0, [M,3]; gradient: negative, in place, [M,3]; drawn: out, [M,3] bool
    """
    drawn.copy_((colors > 0.0) | (gradient > 0.0))
    gradient.masked_fill_(~drawn, 0.0)


def inner_product(a: Tensor, b: Tensor) -> Tensor:
    """Return Σ a · b of two float32 tensors of one shape, summed in float64. []"""
    return (a * b).double().sum()


def add_scaled(x: Tensor, direction: Tensor, factor: Scalar) -> Tensor:
    """Return x + factor · direction."""
    if isinstance(factor, Tensor):
        return x + factor.to(x.dtype) * direction
    return torch.add(x, direction, alpha=factor)


def divide(a: Scalar, b: Scalar) -> Scalar:
    """Return a / b, for b ≥ 0."""
    if isinstance(b, Tensor):
        return a / b.clamp_min(_MIN_DIVISOR)
    return a / max(b, _MIN_DIVISOR)


def at_least_zero(x: Scalar) -> Scalar:
    """Return a number, or 0 in place of a negative one."""
    return x.clamp_min(0.0) if isinstance(x, Tensor) else max(0.0, x)


def read_number(x: Scalar) -> float:
    """Return a number on the processor. From a GPU this waits until all work before it is done."""
    return x.item() if isinstance(x, Tensor) else x


def map_views(work: Callable[[_A], _B], views: Sequence[_A], device: torch.device) -> list[_B]:
    """Return `work(view)` of every view: on the threads of the cpu engine, or one after another on a GPU."""
    if device.type == "cpu":
        return map_threads(work, views)
    return [work(view) for view in views]
