"""Surface under paint: the simplest model of its depth that predicts left-out parts of the paint.

The depth that a camera sees is noisy, as the centers of the Gaussians scatter around the real surface. Discs
at that depth tear apart as soon as the scene is rotated. Nearby views give further samples of the surface.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.quaternions import rotate_vectors
from progdf.rasterize import render
from progdf.rasterize.engines import Crop, Depth, render_depth
from progdf.system.equality import equal_fields

from .models import (
    MIN_SAMPLES,
    Array,
    Mask,
    ModelMaker,
    Parts,
    Samples,
    SurfaceModel,
    deviation,
    join_samples,
    model_makers,
)

OPAQUE = 0.97
"""Minimum opacity of a pixel whose depth is that of a surface."""
_HALF = 0.5  # opacity; below it, a pixel shows more of the background than of the scene

MEDIAN_PX = 9
"""Window of the median filter of depths, pixels."""
_SMOOTHING_PX = 3.0  # standard deviation of the Gaussian filter of depths, pixels
# median slopes; a smoothed depth that differs more from the median crosses an edge
_SAME_SURFACE_SLOPES = 4.0
MIN_COSINE = 0.3
"""Cosine between normal and ray; steeper discs face the camera, and steeper depth steps separate surfaces."""

_NEARBY_DEG = (-15.0, -7.5, 7.5, 15.0)  # rotations of the nearby views, around both image axes
_SAMPLES_PER_VIEW = 300  # largest number of samples of one view
_BLOCKS = 4  # left-out blocks along each side of the paint
SAME_SURFACE_DEVIATIONS = 4.0
"""Deviations, or thicknesses if that is more, within which a pixel belongs to a fitted surface."""
_AROUND_PX = 16  # pixels; width of the border around the paint in which the model replaces the depth
_MIN_PIECE_SHARE = 0.02  # share of the paint; smaller pieces are noise


@dataclass(frozen=True)
class SurfaceFit:
    """Chosen model of one piece of the surface."""

    model: SurfaceModel
    pixels: int  # painted pixels of the piece
    residual_px: float  # robust standard deviation of the samples from it, in pixels at their depth
    thickness_px: float  # see `light_thickness`, in pixels

    def describe(self) -> str:
        """Return the model, its residual and the thickness of the surface as text."""
        return (
            f"{self.model.name}; the scene's depth deviates from it by {self.residual_px:.1f} px, and the "
            f"light of one pixel spreads over {self.thickness_px:.1f} px of depth"
        )


@dataclass(frozen=True)
class PaintSurface:
    """Surface that a camera sees under its paint."""

    __eq__ = equal_fields

    camera: Camera
    depth: Array  # camera z, world units. [H,W]
    slopes: Array  # derivatives of the depth by column and by row, world units per pixel. [2,H,W]
    is_continuous: Mask  # the depth changes less from pixel to pixel than on the steepest disc. [H,W]
    pieces: Parts  # index of the continuous piece. [H,W]
    opaque: Mask  # pixels with a surface. [H,W]
    thickness: float  # see `light_thickness`; 0 without paint
    fits: tuple[SurfaceFit, ...] = ()  # models of the painted pieces, the largest first

    def pivot(self, painted: Mask) -> torch.Tensor:
        """Return the surface point under the painted pixel nearest to the center of the paint. [3]"""
        return _middle_point(self.camera, painted, self.depth)

    def describe(self) -> str:
        """Return the models of the painted pieces as one line."""
        if not self.fits:
            return "the smoothed depth of its view, as the paint is too small for a model"
        return "; and ".join(fit.describe() for fit in self.fits)

    def summary(self) -> str:
        """Return the models of the painted pieces and the deviation of the scene's depth as short text."""
        if not self.fits:
            return "the smoothed depth"
        names = " and ".join(fit.model.name for fit in self.fits)
        scatter = max(fit.residual_px for fit in self.fits)
        return f"{names}; the scene's depth deviates by {scatter:.0f} px"


def surface_pixels(alpha: NDArray[np.floating[Any]]) -> Mask:
    """Return the pixels of a surface: the opaque ones, and the thin spots among them.

    Scans are thinner in places. A group of connected pixels below `OPAQUE` is a thin spot if all of them are
    opaque by half or more. Along outlines and around gaps the opacity falls to 0.

    Args:
        alpha: opacity, 0..1. [H,W]

    Returns:
        [H,W]
    """
    opaque = alpha > OPAQUE
    groups, count = ndimage.label(~opaque)
    lowest = np.ones(count + 1)
    np.minimum.at(lowest, groups.ravel(), alpha.ravel())
    return np.asarray(opaque | (lowest[groups] >= _HALF))


def smooth_depth(depth: NDArray[np.float32], opaque: Mask) -> Array:
    """Return denoised depths with edges preserved.

    Pixels without a surface take the nearest depth. [H,W] each
    """
    if not opaque.any():
        return depth.astype(np.float64)
    nearest = ndimage.distance_transform_edt(~opaque, return_distances=False, return_indices=True)
    filled = depth.astype(np.float64)[tuple(nearest)]
    median = ndimage.median_filter(filled, MEDIAN_PX)
    smooth = ndimage.gaussian_filter(median, _SMOOTHING_PX)
    slope = np.hypot(*np.gradient(median))
    is_flat = np.abs(smooth - median) <= _SAME_SURFACE_SLOPES * np.median(slope[opaque]) + 1e-9
    return np.asarray(np.where(is_flat, smooth, median), np.float64)


def orbit(camera: Camera, pivot: torch.Tensor, degrees: float, axis: int = 1) -> Camera:
    """Return the camera rotated around one of its image axes (0: horizontal, 1: vertical) through a pivot."""
    c2w = camera.c2w.double()
    direction = c2w[:3, axis]
    half = 0.5 * math.radians(degrees)
    rotation = torch.cat([torch.tensor([math.cos(half)]).double(), math.sin(half) * direction])
    rotated_c2w = torch.eye(4, dtype=torch.float64)
    rotated_c2w[:3, :3] = rotate_vectors(c2w[:3, :3].T, rotation[None]).T
    rotated_c2w[:3, 3] = pivot.double() + rotate_vectors(c2w[:3, 3] - pivot.double(), rotation)
    return replace(camera, viewmat=torch.linalg.inv(rotated_c2w).float(), name=f"decal{degrees:+.0f}")


def fit_surface(samples: Samples, thickness_px: float) -> tuple[SurfaceModel, float] | None:
    """Return the simplest model that explains samples within the thickness of the surface, and its deviation.

    Each model predicts blocks that are left out of its fit. Of models with as many coefficients, the best is
    tried. The first whose mean deviation is at most the thickness is taken. If there is none, a model
    replaces a simpler one if it predicts better by more than the standard error of their difference.

    Args:
        samples: surface points under one piece of the paint
        thickness_px: standard deviation of the depths of the light within a pixel, in pixels

    Returns:
        the model and the robust standard deviation of the samples from it in pixels; None without samples
    """
    if len(samples) < MIN_SAMPLES:
        return None
    blocks = _block_of(samples)
    best: ModelMaker | None = None
    lowest = np.full(_BLOCKS**2, np.inf)
    for group in model_makers(samples):
        errors, make = min(
            ((_left_out_errors(make, samples, blocks), make) for make in group),
            key=lambda tried: _mean_error(tried[0]),
        )
        if _mean_error(errors) <= thickness_px:
            best = make
            break
        gain = (lowest - errors)[np.isfinite(errors)]
        if best is None or (len(gain) and gain.mean() > gain.std() / math.sqrt(len(gain))):
            best = make
            lowest = errors
    if best is None:
        return None
    model = best(samples)
    return model, deviation(samples.residuals(model))


def find_surface(scene: Gaussians, camera: Camera, painted: Mask, seen: Depth | None = None) -> PaintSurface:
    """Return the surface under paint, from the depth of its own view and of views near it.

    Args:
        scene: the scene under the paint
        camera: camera of the painted picture
        painted: painted pixels. [H,W]
        seen: the depth of the camera's own view, if it is known
    """
    seen = render_depth(scene, camera) if seen is None else seen
    opaque = surface_pixels(seen.alpha.numpy())
    local = local_surface(seen, camera)
    on_surface = painted & opaque
    if not on_surface.any():
        return _paint_surface(camera, local, opaque, 0.0, ())
    thickness = light_thickness(scene, camera, on_surface)
    samples = join_samples(_sample_views(scene, camera, on_surface, seen))
    fitted, fits = _fit_pieces(samples, camera, on_surface, local, thickness)
    return _paint_surface(camera, fitted, opaque, thickness, fits)


def _paint_surface(
    camera: Camera, local: LocalSurface, opaque: Mask, thickness: float, fits: tuple[SurfaceFit, ...]
) -> PaintSurface:
    return PaintSurface(
        camera, local.depth, local.slopes, local.is_continuous, local.pieces, opaque, thickness, fits
    )


def light_thickness(scene: Gaussians, camera: Camera, mask: Mask, window: Crop | None = None) -> float:
    """Return the typical standard deviation of the depths of the light within a pixel, at least one pixel.

    Args:
        scene: the scene
        camera: the view
        mask: pixels whose median is returned, of the window's size. [H,W]
        window: window of the view; None for all of it

    Returns:
        the deviation, world units
    """
    mean, spread, _ = light_moments(scene, camera, window)
    pixel = float(np.median(mean[mask])) / float(camera.K[0, 0])
    return max(pixel, float(np.median(spread[mask])))


def light_moments(scene: Gaussians, camera: Camera, window: Crop | None = None) -> tuple[Array, Array, Array]:
    """Return mean and standard deviation of the depths of the light within each pixel, and the opacity.

    Depths are camera z, world units. [H,W] each
    """
    axis = camera.viewmat[2].double()
    depths = scene.means.double() @ axis[:3] + axis[3]
    middle = depths.median() if len(depths) else torch.zeros(())
    z = (depths - middle).float()
    colors = torch.stack([z, z.square(), torch.ones_like(z)], dim=1)
    light = render(scene, camera, (0.0, 0.0, 0.0), colors=colors, crop=window).image.double()
    first, second, total = light.unbind(2)
    visible = total.clamp_min(1e-6)
    variance = (second / visible - (first / visible).square()).clamp_min(0.0)
    return (first / visible + middle).numpy(), variance.sqrt().numpy(), total.numpy()


@dataclass(frozen=True)
class LocalSurface:
    """Depths for paint, and their continuous pieces."""

    __eq__ = equal_fields

    depth: Array  # camera z, world units. [H,W]
    slopes: Array  # derivatives of the depth by column and by row, world units per pixel. [2,H,W]
    is_continuous: Mask  # the depth changes less from pixel to pixel than on the steepest disc. [H,W]
    pieces: Parts  # index of the continuous piece. [H,W]


def local_surface(seen: Depth, camera: Camera) -> LocalSurface:
    """Return smoothed depths. Depths blended across an edge are replaced by those of one side."""
    opaque = (seen.alpha > OPAQUE).numpy()
    surface = smooth_depth(seen.depth.numpy(), opaque)
    is_continuous = _is_continuous(surface, camera)
    distance, nearest = ndimage.distance_transform_edt(~is_continuous, return_indices=True)
    surface = np.where(distance <= MEDIAN_PX, surface[tuple(nearest)], surface)
    pieces = ndimage.label(is_continuous)[0][tuple(nearest)]
    slopes = np.stack([ndimage.gaussian_filter1d(surface, 1.0, axis=axis, order=1) for axis in (1, 0)])
    return LocalSurface(surface, slopes, is_continuous, pieces.astype(np.int64))


def _is_continuous(surface: Array, camera: Camera) -> Mask:
    """Return True where the depth changes less from pixel to pixel than that of the steepest disc. [H,W]"""
    steepest = surface / float(camera.K[0, 0]) * (1 - MIN_COSINE**2) ** 0.5 / MIN_COSINE
    steps = [np.abs(np.diff(surface, axis=axis, append=surface.take([-1], axis))) for axis in (0, 1)]
    return np.asarray(np.maximum(*steps) < steepest)


def _fit_pieces(
    samples: Samples, camera: Camera, painted: Mask, local: LocalSurface, thickness: float
) -> tuple[LocalSurface, tuple[SurfaceFit, ...]]:
    """Replace the depth of the painted pieces by fitted models.

    All painted pixels that the model of the largest piece explains share it. The rest is fitted in turn.
    """
    x, y = _image_coordinates(camera)
    focal = float(camera.K[0, 0])
    depth = local.depth.copy()
    slopes = local.slopes.copy()
    is_continuous = local.is_continuous.copy()
    pieces = local.pieces.copy()
    fits = list[SurfaceFit]()
    remaining = painted.copy()
    min_pixels = max(MIN_SAMPLES, _MIN_PIECE_SHARE * float(painted.sum()))
    while remaining.sum() >= min_pixels:
        largest = int(np.bincount(local.pieces[remaining]).argmax())
        start = remaining & (local.pieces == largest)
        if fits and start.sum() < min_pixels:
            break
        thickness_px = thickness * focal / float(np.median(local.depth[start]))
        chosen = fit_surface(_inside(samples, camera, start), thickness_px)
        if chosen is None:
            break
        limit = SAME_SURFACE_DEVIATIONS * max(chosen[1], thickness_px)
        same = start | remaining & (_distance_px(chosen[0], x, y, local.depth, focal) <= limit)
        if same.sum() > start.sum():
            chosen = fit_surface(_inside(samples, camera, same), thickness_px) or chosen
        model, residual = chosen
        around = ndimage.binary_dilation(same, iterations=_AROUND_PX) & ~(remaining & ~same)
        around &= same | (_distance_px(model, x, y, local.depth, focal) <= limit)
        inverse = model.inverse_depth(x, y)[around]
        depth[around] = 1.0 / inverse
        for axis, change in enumerate(model.gradient(x, y)):
            slopes[axis][around] = -change[around] / (inverse**2 * float(camera.K[axis, axis]))
        pieces[around] = (int(pieces.max()) + 1 + model.part(x, y))[around]
        is_continuous[around] = True
        fits.append(SurfaceFit(model, int(same.sum()), residual, thickness_px))
        remaining &= ~same
    edges = [np.diff(pieces, axis=axis, append=pieces.take([-1], axis)) != 0 for axis in (0, 1)]
    is_continuous &= ~(painted & (edges[0] | edges[1]))
    fits.sort(key=lambda fit: -fit.pixels)
    return LocalSurface(depth, slopes, is_continuous, pieces), tuple(fits)


def _distance_px(model: SurfaceModel, x: Array, y: Array, depth: Array, focal: float) -> Array:
    """Return the distance between model and depths in pixels, its median over a window. [H,W]"""
    apart = np.abs(depth * model.inverse_depth(x, y) - 1.0) * focal
    return np.asarray(ndimage.median_filter(apart, MEDIAN_PX), np.float64)


def _image_coordinates(camera: Camera) -> tuple[Array, Array]:
    """Return the normalized image coordinates of all pixels. [H,W] each"""
    K = camera.K.double().numpy()
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]


def _sample_views(scene: Gaussians, camera: Camera, painted: Mask, seen: Depth) -> list[Samples]:
    """Return surface points under the paint, of its own view and of views rotated around it."""
    pivot = _middle_point(camera, painted, seen.depth.double().numpy())
    own = _samples_of(camera, camera, seen, painted)
    found = [own]
    corners = _box_points(camera, painted, seen)
    for axis in (1, 0):
        for degrees in _NEARBY_DEG:
            other = orbit(camera, pivot, degrees, axis)
            crop = _crop_around(other, corners)
            if crop is None:
                continue
            depth = render_depth(scene, other, crop=crop)
            found.append(_samples_of(other, camera, depth, painted, (crop[0], crop[1])))
    return found


def _samples_of(
    camera: Camera, own: Camera, seen: Depth, painted: Mask, at: tuple[int, int] = (0, 0)
) -> Samples:
    """Return points of a depth picture that lie under the paint of the view `own`.

    Args:
        camera: camera of the depth
        own: camera of the painted view
        seen: depth and opacity, from the pixel `at` on
        painted: painted pixels of the painted view. [H,W]
        at: column and row of the first pixel
    """
    rows, columns = np.nonzero((seen.alpha > OPAQUE).numpy())
    if camera is own:
        inside = painted[rows, columns]
        rows = rows[inside]
        columns = columns[inside]
    z = seen.depth.double().numpy()[rows, columns]
    K = camera.K.double().numpy()
    rays = np.stack(
        [
            (columns + at[0] + 0.5 - K[0, 2]) / K[0, 0],
            (rows + at[1] + 0.5 - K[1, 2]) / K[1, 1],
            np.ones(len(z)),
        ],
        1,
    )
    to_own = (own.viewmat.double() @ torch.linalg.inv(camera.viewmat.double())).numpy()
    points = (rays * z[:, None]) @ to_own[:3, :3].T + to_own[:3, 3]
    points = points[points[:, 2] > own.near]
    samples = Samples(
        points[:, 0] / points[:, 2], points[:, 1] / points[:, 2], 1.0 / points[:, 2], float(own.K[0, 0])
    )
    samples = _inside(samples, own, painted)
    step = max(1, len(samples) // _SAMPLES_PER_VIEW)
    chosen = np.zeros(len(samples), bool)
    chosen[np.random.default_rng(0).permutation(len(samples))[: len(samples) // step]] = True
    return samples.select(chosen)


def _inside(samples: Samples, camera: Camera, mask: Mask) -> Samples:
    """Return the samples in pixels of a mask. [H,W]"""
    K = camera.K.double().numpy()
    columns = np.floor(samples.x * K[0, 0] + K[0, 2]).astype(np.int64)
    rows = np.floor(samples.y * K[1, 1] + K[1, 2]).astype(np.int64)
    valid = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    valid[valid] = mask[rows[valid], columns[valid]]
    return samples.select(valid)


def _middle_point(camera: Camera, painted: Mask, depth: Array) -> torch.Tensor:
    """Return the surface point under the painted pixel nearest to the center of the paint. [3]"""
    rows, columns = np.nonzero(painted)
    nearest = int(np.hypot(rows - rows.mean(), columns - columns.mean()).argmin())
    row = int(rows[nearest])
    column = int(columns[nearest])
    K = camera.K.double()
    c2w = camera.c2w.double()
    ray = torch.stack([(column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1], torch.ones(())])
    return c2w[:3, :3] @ (float(depth[row, column]) * ray.double()) + c2w[:3, 3]


def _box_points(camera: Camera, painted: Mask, seen: Depth) -> torch.Tensor:
    """Return world points around the paint, at its nearest and farthest depth. [8,3]"""
    rows, columns = np.nonzero(painted)
    depths = seen.depth.double().numpy()[rows, columns]
    K = camera.K.double().numpy()
    c2w = camera.c2w.double().numpy()
    points = []
    for column, row, z in itertools.product(
        (columns.min(), columns.max() + 1), (rows.min(), rows.max() + 1), np.quantile(depths, (0.02, 0.98))
    ):
        ray = np.array([(column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1], 1.0])
        points.append(c2w[:3, :3] @ (z * ray) + c2w[:3, 3])
    return torch.from_numpy(np.array(points))


def _crop_around(camera: Camera, points: torch.Tensor) -> tuple[int, int, int, int] | None:
    """Return the box of projected points; None if a point is behind the camera or the box is outside."""
    viewmat = camera.viewmat.double()
    inside = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    if float(inside[:, 2].min()) <= camera.near:
        return None
    pixels = (inside / inside[:, 2:]) @ camera.K.double().T
    left = max(0, int(pixels[:, 0].min()))
    top = max(0, int(pixels[:, 1].min()))
    right = min(camera.width, int(pixels[:, 0].max()) + 1)
    bottom = min(camera.height, int(pixels[:, 1].max()) + 1)
    return (left, top, right, bottom) if left < right and top < bottom else None


def _block_of(samples: Samples) -> Parts:
    """Return the index of each sample's block of the paint's bounding box. [S]"""
    cells = []
    for values in (samples.x, samples.y):
        ranks = values.argsort().argsort()
        cells.append(ranks * _BLOCKS // max(1, len(values)))
    block: Parts = cells[0] * _BLOCKS + cells[1]
    return block


def _mean_error(errors: Array) -> float:
    """Return the mean over the blocks with samples; infinite without any. [blocks]"""
    known = errors[np.isfinite(errors)]
    return float(known.mean()) if len(known) else math.inf


def _left_out_errors(make: ModelMaker, samples: Samples, blocks: Parts) -> Array:
    """Return the deviation of a model from each left-out block, px. [blocks]; NaN for an empty block"""
    errors = np.full(_BLOCKS**2, np.nan)
    for block in np.unique(blocks):
        left_out = blocks == block
        if left_out.sum() >= MIN_SAMPLES <= (~left_out).sum():
            model = make(samples.select(~left_out))
            errors[block] = deviation(samples.select(left_out).residuals(model))
    return errors
