"""Fit of a level-of-detail pyramid to full pictures of its scene.

Merging by opacity times area alone makes a picture too dark or too light, for two reasons:

- Hidden Gaussians have other colors than visible ones. The visibility of each Gaussian is its share of the
  pictures of cameras around it, relative to its opacity times area.
- Gaussians below a node overlap. The gain of the nodes' opacity is fitted to the mean color of full pictures
  on white and on black.

The cameras are rotations of one camera about the scene's center, and about itself if it stands in the scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.rasterize.engines import ActivatedGaussians, RasterView, render

from .engine import alpha_weights
from .pyramid import Pyramid

Floats = NDArray[np.float32]

VISIBILITY_EXPONENT = 0.6
"""Exponent of the measured visibility.

Few cameras measure it, so it is uncertain (docs/lab/experiments.md, The brightness of moving pictures).
"""

MIN_VISIBILITY = 1e-4
"""Visibility of a Gaussian that no camera sees, relative to the mean."""

MAX_VISIBILITY = 100.0
"""Limit of the visibility, relative to the mean."""

GAINS = (0.6, 0.8, 1.0)
"""Gains of the nodes' opacity that are drawn; the best is interpolated between them."""

VIEWS = (8, 24)
"""Smallest and largest number of cameras that measure the visibility."""

GAIN_VIEWS = 4
"""Number of cameras that measure the gain."""

_GAUSSIANS_OF_ALL_VIEWS = 5_000_000  # Gaussians drawn in all views together, which bounds the time
_VISIBILITY_PIXELS = 2  # pixels of the coarse picture per pixel of a visibility picture, per axis
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_CORE_SHARE = 0.9  # share of the Gaussians whose distance from the center is the scene's radius
_SAMPLE_STEP_ROWS = 100_000  # larger scenes are sampled evenly for their center


def fit_pyramid(pyramid: Pyramid, camera: Camera, limit: float, budget: int, pixels: int) -> Pyramid:
    """Return a copy of a pyramid, fitted to full pictures of its scene.

    Args:
        pyramid: the pyramid; unchanged
        camera: camera of a coarse picture
        limit: threshold for a node's error, pixels²
        budget: largest number of Gaussians in a coarse picture
        pixels: size of a coarse pixel in pixels of the full resolution, per axis
    """
    gaussians = pyramid.gaussians
    count = len(gaussians.means)
    if count == 0:
        return pyramid
    views = min(max(_GAUSSIANS_OF_ALL_VIEWS // count, VIEWS[0]), VIEWS[1])
    fitted = pyramid.weigh_colors(measure_visibility(gaussians, cameras_around(gaussians, camera, views)))
    fitted.gain = fit_gain(fitted, cameras_around(gaussians, camera, GAIN_VIEWS), limit, budget, pixels)
    return fitted


def cameras_around(gaussians: ActivatedGaussians, camera: Camera, count: int) -> list[Camera]:
    """Return rotations of a camera about the scene's center, or about itself if it stands inside."""
    means = gaussians.means[:: 1 + len(gaussians.means) // _SAMPLE_STEP_ROWS].double()
    means = means[means.isfinite().all(1)]
    if not len(means):
        return [camera] * count
    center = means.median(0).values
    distances = (means - center).norm(dim=1)
    radius = float(distances.quantile(_CORE_SHARE))
    viewmat = camera.viewmat.double()
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    is_inside = float((eye - center).norm()) < radius
    cameras = []
    for index in range(count):
        # directions spread evenly over the sphere
        lean = math.asin(1.0 - (2.0 * index + 1.0) / count)
        turn = index * _GOLDEN_ANGLE
        pivot = eye if is_inside and index % 2 else center
        cameras.append(replace(camera, viewmat=_rotate_camera(viewmat, pivot, turn, lean).to(camera.viewmat)))
    return cameras


def _rotate_camera(viewmat: torch.Tensor, pivot: torch.Tensor, turn: float, lean: float) -> torch.Tensor:
    """Return a camera rotated about a point: by `turn` about its y axis, then by `lean` about its x axis."""
    cos_turn = math.cos(turn)
    sin_turn = math.sin(turn)
    cos_lean = math.cos(lean)
    sin_lean = math.sin(lean)
    about_y = torch.tensor([[cos_turn, 0, sin_turn], [0, 1, 0], [-sin_turn, 0, cos_turn]]).double()
    about_x = torch.tensor([[1, 0, 0], [0, cos_lean, -sin_lean], [0, sin_lean, cos_lean]]).double()
    local = viewmat[:3, :3] @ pivot + viewmat[:3, 3]
    turned = viewmat.clone()
    turned[:3, :3] = about_x @ about_y @ viewmat[:3, :3]
    turned[:3, 3] = local - turned[:3, :3] @ pivot
    return turned


def measure_visibility(gaussians: ActivatedGaussians, cameras: Sequence[Camera]) -> Floats:
    """Return the relative visibility of each Gaussian, > 0. [N] float32"""
    totals = np.zeros(len(gaussians.means))
    for camera in cameras:
        small = camera.resize(-(-camera.width // _VISIBILITY_PIXELS), -(-camera.height // _VISIBILITY_PIXELS))
        everywhere = torch.ones(small.height, small.width)
        view = RasterView.of(small, gaussians)
        totals += alpha_weights(gaussians, view, everywhere)[:, 2].numpy()
    sizes = gaussians.scales.abs().sort(dim=1).values
    areas = (gaussians.opacities * sizes[:, 1] * sizes[:, 2]).double().nan_to_num(0.0, 0.0, 0.0).numpy()
    ratios = totals / np.maximum(areas, 1e-30)
    mean = totals.sum() / max(float(areas.sum()), 1e-30)
    if not 0.0 < mean < math.inf:
        return np.ones(len(totals), np.float32)
    relative = np.minimum(ratios / mean, MAX_VISIBILITY) + MIN_VISIBILITY
    return np.asarray(relative**VISIBILITY_EXPONENT, np.float32)


def fit_gain(pyramid: Pyramid, cameras: Sequence[Camera], limit: float, budget: int, pixels: int) -> float:
    """Return the gain whose pictures have the mean colors of full pictures, on white and on black.

    Args:
        pyramid: the pyramid; its gain and thresholds are overwritten
        cameras: cameras of coarse pictures
        limit: threshold for a node's error, pixels²
        budget: largest number of Gaussians in a coarse picture
        pixels: size of a coarse pixel in pixels of the full resolution, per axis
    """
    errors = np.zeros((len(GAINS), len(cameras), 6))
    for index, camera in enumerate(cameras):
        full = _mean_colors(pyramid.gaussians, camera.resize(camera.width * pixels, camera.height * pixels))
        for row, gain in enumerate(GAINS):
            pyramid.gain = gain
            pyramid.finest = limit
            pyramid.limit = limit
            moving = _mean_colors(pyramid.simplify(camera, budget, pixels), camera)
            errors[row, index] = (moving - full) / np.maximum(full.mean(), 1e-3)
    # a parabola through the errors of each view and channel
    curves = np.polyfit(GAINS, errors.reshape(len(GAINS), -1), 2)
    gains = np.linspace(GAINS[0], GAINS[-1], 41)
    squares = [float(np.square(curves[0] * gain**2 + curves[1] * gain + curves[2]).sum()) for gain in gains]
    return float(gains[int(np.argmin(squares))])


def _mean_colors(gaussians: ActivatedGaussians, camera: Camera) -> NDArray[np.float64]:
    """Return the mean color on white, then on black, as on a screen. [6]"""
    with torch.no_grad():
        rendered = render(gaussians, camera, (0.0, 0.0, 0.0))
    black = rendered.image.numpy()
    white = black + rendered.transmittance.numpy()[..., None]
    means = [np.clip(image, 0.0, 1.0).mean((0, 1), dtype=np.float64) for image in (white, black)]
    return np.concatenate(means)
