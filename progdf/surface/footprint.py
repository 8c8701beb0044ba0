"""Surface under a small part of one picture, fast enough to follow the pointer.

`find_surface` is the plain version. It renders views around the paint, and chooses among more models by their
prediction of left-out parts. This version needs one depth picture per camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from progdf.camera import Camera
from progdf.gaussians import Gaussians

from .find import SAME_SURFACE_DEVIATIONS, light_moments, surface_pixels
from .models import (
    MIN_SAMPLES,
    Array,
    Mask,
    Parts,
    Planes,
    Samples,
    SurfaceModel,
    box_of,
    deviation,
    divisions,
    fit_planes,
    fit_quadric,
    fit_spline,
    linear_terms,
    mean_distance,
)

_SAMPLES_PER_SIDE = 18  # samples along each side of the footprint's box
_CENTER_PX = 4  # half the window around the pointer that must show a surface
_EDGE_STEPS = 6  # reweightings of an edge
_SPLINE_CELLS = 4  # cells along the longer side of the most complex model


@dataclass(frozen=True, eq=False)
class DepthPicture:
    """Depth of all pixels of a picture."""

    camera: Camera
    depth: Array  # camera z, world units; 0 without light. [H,W]
    thickness: Array  # standard deviation of the depths of the light within a pixel, world units. [H,W]
    opaque: Mask  # pixels with a surface. [H,W]


@dataclass(frozen=True, eq=False)
class Footprint:
    """Surface under a disc of a picture, in the coordinates of its camera."""

    model: SurfaceModel
    center: Array  # surface point under the middle of the disc, world units. [3]
    normal: Array  # unit normal of the mean plane, towards the camera; world axes. [3]
    depth: float  # camera z of the center, world units
    limit_px: float  # depths within this distance belong to the surface, in pixels at their depth


def depth_picture(scene: Gaussians, camera: Camera) -> DepthPicture:
    """Return the depth picture of a scene."""
    mean, spread, alpha = light_moments(scene, camera)
    drawn = alpha > 0
    return DepthPicture(camera, np.where(drawn, mean, 0.0), spread, surface_pixels(alpha))


def fit_footprint(picture: DepthPicture, column: float, row: float, radius_px: float) -> Footprint | None:
    """Return the surface under a disc: a plane; a quadric or an edge; or a B-spline. The first that fits.

    A model fits if the mean distance of the samples is at most the thickness of the surface.

    Args:
        picture: depth picture
        column, row: center of the disc, pixels; pixel centers at +0.5
        radius_px: radius of the disc, pixels

    Returns:
        The surface; None if the center shows no surface or too few pixels of the disc do.
    """
    near = _nearest_depth(picture, column, row)
    if near is None:
        return None
    K = picture.camera.K.double().numpy()
    focal = float(K[0, 0])
    rows, columns = _disc_pixels(picture, column, row, radius_px)
    depths = picture.depth[rows, columns]
    same = picture.opaque[rows, columns] & (np.abs(depths - near) <= radius_px * near / focal)
    if same.sum() < MIN_SAMPLES:
        return None
    rows = rows[same]
    columns = columns[same]
    depths = depths[same]
    samples = Samples(
        (columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1], 1.0 / depths, focal
    )
    thickness_px = float(np.median(picture.thickness[rows, columns])) * focal / near
    plane = fit_planes(samples)
    model, error_px = simplest_model(samples, plane, max(thickness_px, 1.0))
    x = np.array([(column - K[0, 2]) / K[0, 0]])
    y = np.array([(row - K[1, 2]) / K[1, 1]])
    inverse = float(model.inverse_depth(x, y)[0])
    if not inverse > 0:
        return None
    a, b, c = plane.coefficients[0] if model is plane else _mean_plane(samples)
    towards = -np.array([b, c, a]) / max(float(np.linalg.norm([a, b, c])), 1e-12)
    viewmat = picture.camera.viewmat.double().numpy()
    point = np.array([x[0], y[0], 1.0]) / inverse
    center = (point - viewmat[:3, 3]) @ viewmat[:3, :3]
    limit_px = SAME_SURFACE_DEVIATIONS * max(error_px, thickness_px, 1.0)
    return Footprint(model, center, towards @ viewmat[:3, :3], 1.0 / inverse, limit_px)


def near_surface(picture: DepthPicture, column: float, row: float, size_px: float) -> Mask:
    """Return the pixels of a picture that a decal may cover: at most its size away from its tangent plane.

    What is farther behind or in front is another thing.

    Args:
        picture: depth picture
        column, row: center of the decal, pixels
        size_px: its longer side, pixels

    Returns:
        The opaque ones of these pixels; all opaque pixels if the center shows no surface. [H,W]
    """
    found = fit_footprint(picture, column, row, 0.5 * size_px)
    if found is None:
        return picture.opaque
    K = picture.camera.K.double().numpy()
    viewmat = picture.camera.viewmat.double().numpy()
    height, width = picture.depth.shape
    x = (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0]
    y = (np.arange(height)[:, None] + 0.5 - K[1, 2]) / K[1, 1]
    normal = viewmat[:3, :3] @ found.normal
    center = viewmat[:3, :3] @ found.center + viewmat[:3, 3]
    apart = picture.depth * (normal[0] * x + normal[1] * y + normal[2]) - normal @ center
    size = size_px * found.depth / K[0, 0]
    return np.asarray(picture.opaque & (np.abs(apart) <= size))


def _mean_plane(samples: Samples) -> Array:
    """Return the least-squares plane a + b x + c y, to which all sides of an edge contribute. [3]"""
    terms = np.stack([np.ones(len(samples)), samples.x, samples.y], axis=1)
    return np.asarray(np.linalg.lstsq(terms, samples.inverse, rcond=None)[0], np.float64)


def simplest_model(samples: Samples, plane: Planes, thickness_px: float) -> tuple[SurfaceModel, float]:
    """Return the first model that fits, and the robust deviation of the samples from it in pixels.

    Args:
        samples: points of the surface, at least `MIN_SAMPLES`
        plane: their plane, see `fit_planes`
        thickness_px: standard deviation of the depths of the light within a pixel, pixels
    """
    models: list[SurfaceModel] = [plane]
    if mean_distance(samples, plane) > thickness_px:
        models = [fit_quadric(samples), fit_edge(samples)]
    model = min(models, key=lambda tried: mean_distance(samples, tried))
    if mean_distance(samples, model) > thickness_px:
        model = fit_spline(samples, _SPLINE_CELLS, box_of(samples))
    return model, deviation(samples.residuals(model))


def fit_edge(samples: Samples) -> Planes:
    """Fit two planes that meet in a sharp convex edge.

    `fit_planes` is the plain version. Here division, planes and weights change together in each step.
    """
    best = fit_planes(samples)
    lowest = math.inf
    unit = samples.focal / samples.inverse
    terms = linear_terms(samples.x, samples.y) * unit[:, None]
    wanted = samples.inverse * unit
    for division in divisions(samples, 2):
        planes = _descend_to_edge(samples, terms, wanted, division)
        if planes is not None and mean_distance(samples, planes) < lowest:
            best = planes
            lowest = mean_distance(samples, planes)
    return best


def _descend_to_edge(samples: Samples, terms: Array, wanted: Array, division: Parts) -> Planes | None:
    """Return the edge that a division of the samples leads to; None if one side loses its samples."""
    planes = None
    weights = np.ones(len(samples))
    for _ in range(_EDGE_STEPS):
        sides = [division == side for side in (0, 1)]
        if min(int(side.sum()) for side in sides) < MIN_SAMPLES:
            return None
        planes = Planes(np.array([_weighted_plane(terms[s], wanted[s], weights[s]) for s in sides]))
        residuals = samples.residuals(planes)
        spread = max(deviation(residuals), 1e-3)
        weights = 1.0 / (1.0 + (residuals / (2.0 * spread)) ** 2)
        division = planes.visible_plane(samples.x, samples.y)
    return planes


def _weighted_plane(terms: Array, wanted: Array, weights: Array) -> Array:
    """Return the coefficients of weighted least squares. [S,3], [S], [S] -> [3]"""
    left = terms.T * weights
    normal = left @ terms
    normal[np.diag_indices(3)] += 1e-10 * np.trace(normal)
    return np.asarray(np.linalg.solve(normal, left @ wanted), np.float64)


def _nearest_depth(picture: DepthPicture, column: float, row: float) -> float | None:
    """Return the median depth around a pixel; None if most of the window shows no surface."""
    height, width = picture.depth.shape
    if not (0 <= column < width and 0 <= row < height):
        return None
    left = max(0, int(column) - _CENTER_PX)
    top = max(0, int(row) - _CENTER_PX)
    window = np.s_[top : int(row) + _CENTER_PX + 1, left : int(column) + _CENTER_PX + 1]
    opaque = picture.opaque[window]
    if opaque.mean() < 0.5:
        return None
    return float(np.median(picture.depth[window][opaque]))


def _disc_pixels(picture: DepthPicture, column: float, row: float, radius_px: float) -> tuple[Parts, Parts]:
    """Return rows and columns of a regular grid of pixels in a disc. [S] int64 each"""
    height, width = picture.depth.shape
    steps = np.linspace(-radius_px, radius_px, _SAMPLES_PER_SIDE)
    down, across = np.meshgrid(steps, steps, indexing="ij")
    rows = np.floor(row + down).astype(np.int64)
    columns = np.floor(column + across).astype(np.int64)
    valid = (np.hypot(down, across) <= radius_px) & (rows >= 0) & (rows < height)
    valid &= (columns >= 0) & (columns < width)
    return rows[valid], columns[valid]
