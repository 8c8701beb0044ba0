"""Projection of paint along the visible surface of a scene, from the view where it was painted to others.

Each painted pixel is a point on the surface, at the depth that the view shows there. Points are drawn as
small squares, the nearest last. This is fast enough for a turning camera and needs no new Gaussians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize import render
from progdf.surface.find import SAME_SURFACE_DEVIATIONS, find_surface
from progdf.surface.footprint import simplest_model
from progdf.surface.models import MIN_SAMPLES, Samples, fit_planes

from .strokes import Floats, Pixels, painted_box

OPAQUE = 0.5
"""Opacity from which a pixel has a surface."""

_SAME_SURFACE_DEVIATIONS = 2.0  # paint this far behind the blended depth lies on the visible surface
_QUICK_SAMPLES = 400  # pixels to which a quick model is fitted
_EXPLAINED_SHARE = 0.9  # smallest share of these pixels that a model must explain
_NEAR_PX = 5  # window of the largest deviation near a pixel, pixels
_MEDIAN_PX = 9  # window of the median of depths, pixels
_SMOOTH_SIGMA_PX = 5.0  # sigma of the Gaussian filter over depths, pixels
# size of a square relative to the distance of neighboring points, so that rounding leaves no holes
_SQUARE_OVERLAP = 1.4
_MAX_SQUARE_PX = 12  # largest side of a square, pixels
_HIDDEN_COSINE = -0.1  # points that face away by more than this are hidden; normals are noisy


@dataclass(frozen=True, eq=False)
class ViewSurface:
    """Visible surface of a scene in one view."""

    camera: Camera
    depth: Floats  # blended camera z, world units; infinite where there is no surface. [H,W]
    # standard deviation of the depths of the light within a pixel, the largest near it, world units. [H,W]
    deviation: Floats
    opacity: Floats  # 0 where there is no surface. [H,W]
    is_model: bool = False  # the depth is that of a smooth model


@dataclass(frozen=True, eq=False)
class PaintPoints:
    """Painted pixels as points on the surface."""

    positions: Floats  # world units. [P,3]
    normals: Floats  # towards the camera that sees them, unit length. [P,3]
    spacings: Floats  # distance of neighboring points, world units. [P]
    colors: Pixels  # straight RGBA. [P,4]
    places: NDArray[np.intp]  # row and column of each point in its own view. [2,P]


def view_surface(scene: Gaussians, camera: Camera) -> ViewSurface:
    """Return the visible surface of a scene.

    Args:
        scene: the scene on screen
        camera: the view
    """
    axis = camera.viewmat[2].float()
    depths = scene.means @ axis[:3] + axis[3]
    in_front = depths[depths.isfinite() & (depths > camera.near)]
    middle = float(in_front.median()) if len(in_front) else 0.0  # squares of differences keep their digits
    z = torch.nan_to_num(depths - middle, 0.0, 0.0, 0.0)
    colors = torch.stack([z, z.square(), torch.ones_like(z)], dim=1)
    with torch.no_grad():
        light = render(scene, camera, (0.0, 0.0, 0.0), colors=colors).image.numpy()
    opacity = light[..., 2]
    is_surface = opacity >= OPAQUE
    total = np.maximum(opacity, OPAQUE)
    mean = light[..., 0] / total
    variance = np.maximum(light[..., 1] / total - mean * mean, 0.0)
    depth = np.where(is_surface, mean + np.float32(middle), np.float32(np.inf))
    deviation = ndimage.maximum_filter(np.sqrt(variance), _NEAR_PX)
    return ViewSurface(camera, depth, deviation, np.where(is_surface, opacity, 0.0).astype(np.float32))


def fitted_surface(scene: Gaussians, seen: ViewSurface, painted: NDArray[np.bool_]) -> ViewSurface:
    """Return the surface of a view with the depth of the model that discs of this paint will lie on.

    Args:
        scene: the scene on screen
        seen: surface that the view shows
        painted: painted pixels. [H,W]
    """
    model = find_surface(scene, seen.camera, painted)
    depth = np.where(np.isfinite(seen.depth), model.depth, np.inf).astype(np.float32)
    return replace(seen, depth=depth, is_model=True)


def quick_surface(seen: ViewSurface, painted: NDArray[np.bool_]) -> ViewSurface:
    """Return the surface of a view with the depth of simple models under its paint, in milliseconds.

    `fitted_surface` is the plain version. It also uses the depths of views around the paint, and chooses the
    models by their prediction of left-out parts. Here each connected part of the paint has one model, which
    is fitted to the view's own depths. If that model does not explain a part, its smoothed depth is used.

    Args:
        seen: surface that the view shows
        painted: painted pixels. [H,W]
    """
    is_painted = painted & np.isfinite(seen.depth)
    parts, count = ndimage.label(ndimage.binary_dilation(is_painted, iterations=_MEDIAN_PX))
    depth = seen.depth.copy()
    for label, (rows, columns) in enumerate(ndimage.find_objects(parts, count), start=1):
        part = np.s_[
            max(rows.start - _MEDIAN_PX, 0) : rows.stop + _MEDIAN_PX,
            max(columns.start - _MEDIAN_PX, 0) : columns.stop + _MEDIAN_PX,
        ]
        inside = (parts[part] == label) & np.isfinite(seen.depth[part])
        depth[part][inside] = _quick_depth(seen, part, inside & is_painted[part])[inside]
    return replace(seen, depth=depth, is_model=True)


def _quick_depth(seen: ViewSurface, part: tuple[slice, slice], painted: NDArray[np.bool_]) -> Floats:
    """Return the depth of a part of a view, by one model of its painted pixels or smoothed. [h,w]

    Args:
        seen: see `quick_surface`
        part: rows and columns of the part
        painted: its painted pixels, at least one. [h,w]
    """
    smooth = _smooth_depth(seen.depth[part], seen.deviation[part])
    K = seen.camera.K.double().numpy()
    focal = float(K[0, 0])
    height, width = smooth.shape
    x = (np.arange(part[1].start, part[1].start + width) + 0.5 - K[0, 2]) / focal
    y = (np.arange(part[0].start, part[0].start + height) + 0.5 - K[1, 2]) / K[1, 1]
    x, y = np.meshgrid(x, y)
    chosen = np.flatnonzero(painted)
    chosen = chosen[:: 1 + len(chosen) // _QUICK_SAMPLES]
    if len(chosen) < MIN_SAMPLES:
        return smooth
    depths = smooth.reshape(-1)[chosen].astype(np.float64)
    samples = Samples(x.reshape(-1)[chosen], y.reshape(-1)[chosen], 1.0 / depths, focal)
    thickness_px = float(np.median(seen.deviation[part].reshape(-1)[chosen] / depths)) * focal
    thickness_px = max(thickness_px, 1.0)
    model, error_px = simplest_model(samples, fit_planes(samples), thickness_px)
    limit_px = SAME_SURFACE_DEVIATIONS * max(error_px, thickness_px)
    inverse = model.inverse_depth(x, y)
    is_explained = np.abs(samples.residuals(model)) <= limit_px
    if is_explained.mean() < _EXPLAINED_SHARE or not (inverse[painted] > 0.0).all():
        return smooth
    near = np.abs(smooth * inverse - 1.0) * focal <= limit_px
    with np.errstate(divide="ignore"):
        return np.where(near | painted, 1.0 / inverse, smooth).astype(np.float32)


def _smooth_depth(depth: Floats, deviation: Floats) -> Floats:
    """Return depths without noise; steps beyond the depth range of the light are edges and remain. [h,w]

    Args:
        depth: infinite where there is no surface; the nearest depth is used there. [h,w]
        deviation: see `ViewSurface`. [h,w]
    """
    smooth = _fill_depth(depth)
    for window in ((1, _MEDIAN_PX), (_MEDIAN_PX, 1)):
        smooth = ndimage.median_filter(smooth, window, mode="nearest")
    rounded = ndimage.gaussian_filter(smooth, _SMOOTH_SIGMA_PX, mode="nearest")
    smoothed: Floats = np.where(np.abs(rounded - smooth) <= deviation, rounded, smooth)
    return smoothed


def _fill_depth(depth: Floats) -> Floats:
    """Return depths in which pixels without a surface have the depth of the nearest pixel with one. [h,w]"""
    nearest = ndimage.distance_transform_edt(~np.isfinite(depth), return_distances=False, return_indices=True)
    filled: Floats = depth[tuple(nearest)]
    return filled


def paint_points(pixels: Pixels, surface: ViewSurface) -> PaintPoints:
    """Return the painted pixels of a view as points on its surface. Paint on the background is left out.

    Args:
        pixels: straight RGBA. [H,W,4]
        surface: surface of the view in which it was painted, of the same size
    """
    left, top, right, bottom = painted_box(pixels)
    margin = _MEDIAN_PX
    left = max(left - margin, 0)
    top = max(top - margin, 0)
    part = np.s_[top : bottom + margin, left : right + margin]
    depth = surface.depth[part]
    is_surface = np.isfinite(depth)
    is_painted = is_surface & (pixels[part][..., 3] > 0)
    rows, columns = np.nonzero(is_painted)
    if not len(rows):
        none = np.zeros((0, 3), np.float32)
        return PaintPoints(none, none, none[:, 0], np.zeros((0, 4), np.uint8), np.zeros((2, 0), np.intp))
    smooth = _fill_depth(depth) if surface.is_model else _smooth_depth(depth, surface.deviation[part])
    rounded = ndimage.gaussian_filter(smooth, _SMOOTH_SIGMA_PX, mode="nearest")
    places = _unproject(rounded, surface.camera, left, top)
    along_rows, along_columns = np.gradient(places, axis=(0, 1)) if min(rounded.shape) > 1 else (places,) * 2
    normals = np.cross(along_rows, along_columns)[rows, columns]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    positions = _unproject(smooth, surface.camera, left, top)[rows, columns]
    eye = np.linalg.inv(surface.camera.viewmat.double().numpy())[:3, 3].astype(np.float32)
    towards = np.einsum("ij,ij->i", normals, eye - positions)
    normals[towards < 0.0] *= -1.0
    spacings = smooth[rows, columns] / np.float32(_focal_px(surface.camera))
    where = np.stack([rows + top, columns + left])
    return PaintPoints(positions, normals, spacings, pixels[where[0], where[1]], where)


def thin_points(points: PaintPoints) -> PaintPoints:
    """Return a quarter of the points, of every second row and column, as larger squares."""
    kept = ~(points.places & 1).any(axis=0)
    return PaintPoints(
        points.positions[kept],
        points.normals[kept],
        2.0 * points.spacings[kept],
        points.colors[kept],
        points.places[:, kept],
    )


def draw_points(points: PaintPoints, camera: Camera, surface: ViewSurface | None) -> Pixels:
    """Draw points in a view. The nearest point covers the others.

    Args:
        points: see `paint_points`
        camera: the view
        surface: its surface, which hides paint behind it; None while it is unknown

    Returns:
        straight RGBA. [H,W,4]
    """
    image = np.zeros((camera.height, camera.width, 4), np.uint8)
    across, down, depths = _project(points.positions, camera)
    eye = np.linalg.inv(camera.viewmat.double().numpy())[:3, 3].astype(np.float32)
    to_eye = eye - points.positions
    facing = np.einsum("ij,ij->i", points.normals, to_eye)
    shown = (depths > camera.near) & (facing > _HIDDEN_COSINE * np.linalg.norm(to_eye, axis=1))
    shown &= (across >= 0.0) & (across < camera.width) & (down >= 0.0) & (down < camera.height)
    if surface is not None:
        shown &= _is_visible(across, down, depths, shown, surface)
    rows = np.flatnonzero(shown)
    rows = rows[np.argsort(-depths[rows], kind="stable")]
    if not len(rows):
        return image
    sides = np.ceil(_SQUARE_OVERLAP * points.spacings[rows] * _focal_px(camera) / depths[rows])
    sides = np.minimum(sides, _MAX_SQUARE_PX)
    lefts = np.floor(across[rows] - 0.5 * (sides - 1.0)).astype(np.intp)
    tops = np.floor(down[rows] - 0.5 * (sides - 1.0)).astype(np.intp)
    colors = points.colors[rows]
    flat = image.reshape(-1, 4).view(np.uint32)[:, 0]
    packed = np.ascontiguousarray(colors).view(np.uint32)[:, 0]
    largest = int(sides.max())
    for y in range(largest):
        for x in range(largest):
            columns = lefts + x
            lines = tops + y
            inside = (max(x, y) < sides) & (columns >= 0) & (columns < camera.width)
            inside &= (lines >= 0) & (lines < camera.height)
            flat[lines[inside] * camera.width + columns[inside]] = packed[inside]
    return image


def project_coverage(coverage: Floats, surface: ViewSurface, points: PaintPoints) -> Floats:
    """Return the influence that a stroke in one view has on paint of another view.

    Args:
        coverage: influence of the stroke on each pixel of its view, 0 to 1. [H,W]
        surface: surface of the stroke's view
        points: the paint of the other view. [P]

    Returns:
        influence on each point, 0 where the stroke's view does not show it. [P]
    """
    camera = surface.camera
    across, down, depths = _project(points.positions, camera)
    shown = depths > camera.near
    shown &= (across >= 0.0) & (across < camera.width) & (down >= 0.0) & (down < camera.height)
    shown &= _is_visible(across, down, depths, shown, surface)
    influence = np.zeros(len(points.positions), np.float32)
    influence[shown] = coverage[down[shown].astype(np.intp), across[shown].astype(np.intp)]
    return influence


def is_apart(one: ViewSurface, other: ViewSurface, column: int, row: int) -> bool:
    """Return True if two surfaces of one view differ at a pixel by more than the thickness of their light."""
    depths = one.depth[row, column], other.depth[row, column]
    if not np.isfinite(depths).all():
        return bool(np.isfinite(depths).any())
    pixel = depths[0] / _focal_px(one.camera)
    thickness = max(one.deviation[row, column], other.deviation[row, column], pixel)
    return bool(abs(depths[0] - depths[1]) > _SAME_SURFACE_DEVIATIONS * thickness)


def _is_visible(
    across: Floats, down: Floats, depths: Floats, inside: NDArray[np.bool_], surface: ViewSurface
) -> NDArray[np.bool_]:
    """Return the points that lie on the visible surface, not behind it or beside it. [P]"""
    columns = np.where(inside, across, 0.0).astype(np.intp)
    rows = np.where(inside, down, 0.0).astype(np.intp)
    pixel = depths / np.float32(_focal_px(surface.camera))
    tolerance = _SAME_SURFACE_DEVIATIONS * np.maximum(surface.deviation[rows, columns], pixel)
    depth = surface.depth[rows, columns]
    return np.asarray(np.isfinite(depth) & (depths <= depth + tolerance))


def _project(positions: Floats, camera: Camera) -> tuple[Floats, Floats, Floats]:
    """Return columns and rows in pixels, and depths, of points [P,3]. [P] each"""
    viewmat = camera.viewmat.float().numpy()
    K = camera.K.float().numpy()
    x, y, z = viewmat[:3, :3] @ positions.T + viewmat[:3, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(z > 0.0, np.float32(1.0) / z, np.float32(0.0))
    return x * inverse * K[0, 0] + K[0, 2], y * inverse * K[1, 1] + K[1, 2], z


def _unproject(depth: Floats, camera: Camera, left: int, top: int) -> Floats:
    """Return the world positions of the pixels of a part of a view. [h,w] -> [h,w,3]"""
    K = camera.K.double().numpy()
    height, width = depth.shape
    x = (np.arange(width) + (left + 0.5 - K[0, 2])) / K[0, 0]
    y = ((np.arange(height) + (top + 0.5 - K[1, 2])) / K[1, 1])[:, None]
    rays = np.stack(np.broadcast_arrays(x, y, np.ones((1, 1))), axis=-1)
    to_world = np.linalg.inv(camera.viewmat.double().numpy())
    points = (rays * depth[..., None]) @ to_world[:3, :3].T + to_world[:3, 3]
    positions: Floats = points.astype(np.float32)
    return positions


def _focal_px(camera: Camera) -> float:
    """Return the mean focal length, pixels."""
    return math.sqrt(float(camera.K[0, 0]) * float(camera.K[1, 1]))
