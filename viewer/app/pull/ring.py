"""Ring on the surface where the influence of a pull ends."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import binary_closing

from progdf.painting.projection import ViewSurface
from viewer.camera.decal_warp import Floats, project, vec3
from viewer.camera.view_camera import Vec3

_DIRECTIONS = 96  # directions of the picture in which the end of the influence is sought
_SAMPLES = 160  # pixels looked at in each direction
_REACH = 1.6  # length of a direction, in radii as they appear at the center
_HOLE = 9  # samples of a direction; a hole in the surface that is smaller is no end
_MAX_STEP = 0.2  # largest step between neighboring samples on one surface, in radii


def surface_ring(center: Vec3, radius: float, surface: ViewSurface, outermost: bool) -> list[Vec3]:
    """Return the points of the visible surface at a distance from a point, in the order of their directions.

    Where the surface ends before this distance, the point is on its visible edge.

    Args:
        center: point near the surface, world units
        radius: distance, world units
        surface: the visible surface
        outermost: the last point at this distance counts, not the first, as the surface near the center has
            moved

    Returns:
        Points; none if the center is behind the camera.
    """
    camera = surface.camera
    pixels, depths = project(np.array([center]), camera)
    depth = float(depths[0])
    if depth <= 0.0:
        return []
    K = camera.K.double().numpy()
    reach = _REACH * radius / depth * max(K[0, 0], K[1, 1])
    angles = np.linspace(0.0, 2.0 * math.pi, _DIRECTIONS, endpoint=False)
    steps = np.linspace(0.0, reach, _SAMPLES)
    x = pixels[0, 0] + np.cos(angles)[:, None] * steps
    y = pixels[0, 1] + np.sin(angles)[:, None] * steps
    points = _points(surface, x, y)
    with np.errstate(invalid="ignore"):
        distance = np.linalg.norm(points - np.array(center), axis=2)
    inside = np.isfinite(distance) & (distance <= radius)
    inside = binary_closing(inside, np.ones((1, _HOLE), bool)) | inside
    if outermost:
        last = _SAMPLES - 1 - np.argmax(inside[:, ::-1], axis=1)
    else:
        inside[:, 0] = True
        ends = np.concatenate([~inside[:, 1:], np.ones((_DIRECTIONS, 1), bool)], axis=1)
        last = np.argmax(ends, axis=1)
    rows = np.arange(_DIRECTIONS)
    after = np.minimum(last + 1, _SAMPLES - 1)
    near = points[rows, last]
    gap = distance[rows, after] - distance[rows, last]
    with np.errstate(invalid="ignore", divide="ignore"):
        share = (radius - distance[rows, last]) / gap
        joined = np.isfinite(gap) & (gap > 0.0) & (gap < _MAX_STEP * radius)
        ring = np.where(joined[:, None], near + share[:, None] * (points[rows, after] - near), near)
    found = inside[rows, last] & np.isfinite(ring).all(axis=1)
    return [vec3(point) for point in ring[found]]


def _points(surface: ViewSurface, x: Floats, y: Floats) -> Floats:
    """Return the points of the surface at pixels, infinite where there is none. [D,S] each -> [D,S,3]"""
    camera = surface.camera
    height, width = surface.depth.shape
    column = np.floor(x).astype(np.int64)
    row = np.floor(y).astype(np.int64)
    is_shown = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    depth = surface.depth[row.clip(0, height - 1), column.clip(0, width - 1)].astype(np.float64)
    depth = np.where(is_shown, depth, np.inf)
    K = camera.K.double().numpy()
    viewmat = camera.viewmat.double().numpy()
    with np.errstate(invalid="ignore"):
        local = np.stack([(x - K[0, 2]) / K[0, 0] * depth, (y - K[1, 2]) / K[1, 1] * depth, depth], axis=2)
        points: Floats = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
    return points
