"""Image errors PSNR and SSIM; see also `progdf.metrics.lpips` and `progdf.metrics.slider`."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import conv2d

WINDOW = 11
"""Side of SSIM's Gaussian window, pixels (Wang et al. 2004)."""
SIGMA = 1.5
"""Standard deviation of SSIM's Gaussian window, pixels (Wang et al. 2004)."""

NO_DIFFERENCE = 99.0
"""PSNR in dB reported for equal images, instead of infinity."""

ROUNDING = 1 / 255**2 / 12
"""Mean squared rounding error of an 8-bit image, range 0 to 1."""

LEVEL = 1 / 255**2
"""Mean squared error of two images that differ by one 8-bit level everywhere.

Rounding alone can cause it, so smaller errors are not certain to be visible on a screen.
"""


def round_to_8_bits(values: Tensor) -> Tensor:
    """Return values rounded to those that 8 bits hold. Values outside 0 to 1 are clamped. Any shape"""
    return (values.clamp(0.0, 1.0) * 255.0).round() / 255.0


def decibels(mse: float) -> float:
    """Return the PSNR in dB of a mean squared error (images of range 0 to 1), at most `NO_DIFFERENCE`."""
    return NO_DIFFERENCE if mse <= 0 else min(NO_DIFFERENCE, -10 * math.log10(mse))


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB; infinite for equal images.

    Args:
        image, target: range 0 to 1, the same shape. [H,W,3] or [...]
        mask: pixel weights, bool or 0 to 1, broadcast over the colors. [H,W]

    Raises:
        ValueError: the shapes differ, or all weights are 0.
    """
    _check_pair(image, target)
    squares = (image.detach().double() - target.detach().double()).square()
    if mask is None:
        error = float(squares.mean()) if squares.numel() else 0.0
    else:
        weights = _mask(mask, image)
        error = float((squares.mean(dim=-1) * weights).sum() / weights.sum())
    return math.inf if error == 0 else -10 * math.log10(error)


def edge_weights(image: Tensor) -> Tensor:
    """Return the length of the color gradient at each pixel, by differences to the pixels left and above.

    As weights of an error they emphasize outlines and letters, of which a mean over pixels shows little.
    [H,W,3] -> [H,W]
    """
    squares = torch.zeros_like(image[..., 0])
    squares[:, 1:] += image.diff(dim=1).square().sum(dim=2)
    squares[1:] += image.diff(dim=0).square().sum(dim=2)
    return squares.sqrt()


def ssim(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the structural similarity (Wang et al. 2004) with an 11 px Gaussian window; differentiable.

    Args:
        image, target: range 0 to 1. [H,W,C]
        mask: weights of the average over pixels, bool or 0 to 1. None averages the pixels whose window lies
            inside the image, or all pixels of an image smaller than the window. [H,W]

    Returns:
        Mean similarity over colors and pixels, at most 1. []

    Raises:
        ValueError: the shapes differ, or all weights are 0.
    """
    _check_pair(image, target)
    x, y = (v.movedim(-1, 0) for v in (image, target))
    # at the border the window is cut off and its weights are normalized to a sum of 1
    weight_sums = _blur(torch.ones_like(x[:1]))
    planes = torch.cat([x, y, x * x, y * y, x * y])
    mean_x, mean_y, square_x, square_y, product = (_blur(planes) / weight_sums).chunk(5)
    var_x = (square_x - mean_x * mean_x).clamp(min=0)
    var_y = (square_y - mean_y * mean_y).clamp(min=0)
    covariance = product - mean_x * mean_y
    c1 = 0.01**2
    c2 = 0.03**2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    similarity = similarity / ((mean_x * mean_x + mean_y * mean_y + c1) * (var_x + var_y + c2))
    per_pixel = similarity.mean(dim=0)
    if mask is not None:
        weights = _mask(mask, image).to(per_pixel.dtype)
        return (per_pixel * weights).sum() / weights.sum()
    edge = WINDOW // 2
    if min(per_pixel.shape) >= WINDOW:
        per_pixel = per_pixel[edge:-edge, edge:-edge]
    return per_pixel.mean()


def _blur(planes: Tensor) -> Tensor:
    """Return weighted sums over the window, with zeros beyond the border. [C,H,W]"""
    offsets = torch.arange(WINDOW, dtype=planes.dtype, device=planes.device) - WINDOW // 2
    kernel = torch.exp(-offsets.square() / (2 * SIGMA**2))
    kernel = kernel / kernel.sum()
    count = len(planes)
    across = kernel.expand(count, 1, 1, -1).contiguous()
    # planes as groups: a batch of images would take ten times as long
    rows = conv2d(planes[None], across, padding=(0, WINDOW // 2), groups=count)
    return conv2d(rows, across.transpose(2, 3), padding=(WINDOW // 2, 0), groups=count)[0]


def _check_pair(image: Tensor, target: Tensor) -> None:
    if image.shape != target.shape:
        raise ValueError(f"the images have shapes {list(image.shape)} and {list(target.shape)}")


def _mask(mask: Tensor, image: Tensor) -> Tensor:
    if mask.shape != image.shape[:-1]:
        raise ValueError(f"mask has shape {list(mask.shape)}, expected {list(image.shape[:-1])}")
    weights = mask.double()
    if not float(weights.sum()) > 0:
        raise ValueError("the mask is empty")
    return weights
