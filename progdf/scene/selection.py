"""Selection tools of the window: shapes drawn over a picture, a ball, a color, and set operations.

A selection is a boolean mask over the scene. Shapes are tested against the projected centers of Gaussians
(`project_centers`). `front_surface` separates the Gaussians on the visible surface from those behind it.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw

from progdf.camera import Camera
from progdf.color.oklab import srgb_to_oklab
from progdf.gaussians import Gaussians
from progdf.rasterize import alpha_weights, render
from progdf.rasterize.engines import Rendering
from progdf.sh import sh0_to_rgb
from progdf.threads import StoppedError, stopped_by

Mask = NDArray[np.bool_]
Floats = NDArray[np.float32]

MODES = ("new", "add", "subtract", "intersect")
"""Ways to combine a new selection with the current one."""

_DEPTH_DOWNSCALE = 4  # factor by which the depth render of the front surface is smaller than the picture
# A Gaussian belongs to the surface up to a distance behind it: this share of the depth, plus this multiple of
# its longest standard deviation. Gaussians beneath a surface make its gloss: a lasso around a jacket covers
# 0.85 of the visible part with a multiple of 1, and 0.94 with 3.
_DEPTH_TOLERANCE = 0.01
_EXTENT_TOLERANCE = 3.0
_MIN_COVERAGE = 0.05  # cells with less total opacity are background
_SHOWN_PX = 640  # longer side of the picture in which the colors of Gaussians are measured, pixels
_MIN_SEED_SHARE = 0.1  # a seed contributes at least this fraction of a pixel's color
_MAX_CELLS = 1024  # cells per side of the grid in which a polygon is filled


class Centers(NamedTuple):
    """Projected centers of Gaussians."""

    # pixels from the upper left corner; NaN for centers that are not in front of the camera. [N,2]
    points: Floats
    depths: Floats  # camera z, world units. [N]


def combine(mask: Mask, selection: Mask, mode: str) -> Mask:
    """Combine the current mask with a new selection by one of `MODES`. [N]"""
    match mode:
        case "new":
            return selection
        case "add":
            return mask | selection
        case "subtract":
            return mask & ~selection
        case "intersect":
            return mask & selection
    raise ValueError(f"mode is '{mode}', expected one of {', '.join(MODES)}")


def project_centers(scene: Gaussians, camera: Camera) -> Centers:
    """Project the centers of a scene into the picture of a camera."""
    viewmat = camera.viewmat.float().numpy()
    K = camera.K.float().numpy()
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # by columns, which is many times faster than by rows
        across, down, depths = viewmat[:3, :3] @ scene.means.numpy().T + viewmat[:3, 3:]
        inverse = np.where(depths > 0.0, 1.0 / depths, np.nan).astype(np.float32)
        points = np.stack([across * inverse * K[0, 0] + K[0, 2], down * inverse * K[1, 1] + K[1, 2]], axis=1)
    return Centers(points, depths)


def inside_rectangle(points: Floats, corner: ArrayLike, opposite: ArrayLike) -> Mask:
    """Select the points [N,2] between two opposite corners [2], edges included. [N]"""
    low = np.minimum(corner, opposite)
    high = np.maximum(corner, opposite)
    x = points[:, 0]
    y = points[:, 1]
    return np.asarray((x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1]))


def inside_polygon(points: Floats, corners: ArrayLike) -> Mask:
    """Select the points inside a polygon by the even-odd rule. [N]

    The polygon is filled into a grid. Only points in cells near its edge are tested against its sides.

    Args:
        points: points; those that are not finite are outside. [N,2]
        corners: corners in order, closed automatically; fewer than three select nothing. [K,2]
    """
    outline = np.asarray(corners, np.float64).reshape(-1, 2)
    mask = np.zeros(len(points), bool)
    if len(outline) < 3:
        return mask
    low = outline.min(0)
    high = outline.max(0)
    candidates = np.flatnonzero(inside_rectangle(points, low, high))
    cell = max(float((high - low).max()) / _MAX_CELLS, 1e-12)
    cell_kinds = _fill((outline - low) / cell + 2.0)
    column, row = (
        (points[candidates, axis] * np.float32(1.0 / cell) + np.float32(2.0 - low[axis] / cell)).astype(
            np.int32
        )
        for axis in (0, 1)
    )
    cells = cell_kinds.ravel().take(row * cell_kinds.shape[1] + column, mode="clip")
    mask[candidates] = cells == _INSIDE
    uncertain = candidates[cells == _EDGE]
    mask[uncertain] = _crossings(points[uncertain].astype(np.float64), outline) % 2 == 1
    return mask


def inside_stroke(points: Floats, path: ArrayLike, radius: float) -> Mask:
    """Select the points that a round brush touches. [N]

    Args:
        points: points; those that are not finite are outside. [N,2]
        path: corners of the brush's path, or a single point. [K,2]
        radius: radius of the brush, in the unit of the points
    """
    corners = np.asarray(path, np.float32).reshape(-1, 2)
    mask = np.zeros(len(points), bool)
    for start, end in pairwise(corners if len(corners) > 1 else [*corners, *corners]):
        box = inside_rectangle(points, np.minimum(start, end) - radius, np.maximum(start, end) + radius)
        rows = np.flatnonzero(box)
        x = points[rows, 0] - start[0]
        y = points[rows, 1] - start[1]
        dx, dy = end - start
        along = np.clip((x * dx + y * dy) / max(dx * dx + dy * dy, 1e-12), 0.0, 1.0)
        mask[rows] |= (x - along * dx) ** 2 + (y - along * dy) ** 2 <= radius * radius
    return mask


def inside_ball(scene: Gaussians, center: ArrayLike, radius: float) -> Mask:
    """Select the Gaussians whose center is at most `radius` world units from `center` [3]. [N]"""
    offsets = scene.means.numpy() - np.asarray(center, np.float32)
    return np.asarray(np.einsum("ij,ij->i", offsets, offsets) <= radius * radius)


def base_colors(scene: Gaussians) -> Floats:
    """Return the view-independent colors of Gaussians (SH band 0), OKLab. [N,3]"""
    with torch.no_grad():
        colors: Floats = srgb_to_oklab(sh0_to_rgb(scene.sh0).clamp(0.0, 1.0)).numpy()
    return colors


def shown_colors(scene: Gaussians, camera: Camera, front: Mask) -> Floats:
    """Return the color on screen of each Gaussian: the mean color of its pixels by its weight, OKLab. [N,3]

    Many Gaussians blend in a pixel, so their own colors may differ much from the color on screen. Gaussians
    behind the front surface or outside the picture keep their own color, see `base_colors`.

    Args:
        scene: the scene on screen
        camera: the viewing camera
        front: Gaussians on its front surface, see `front_surface`. [N]
    """
    colors = base_colors(scene)
    scale = min(1.0, _SHOWN_PX / max(camera.width, camera.height))
    small = camera.resize(*(max(1, round(side * scale)) for side in (camera.width, camera.height)))
    with torch.no_grad():
        picture = srgb_to_oklab(_opaque_colors(render(scene, small, (0.0, 0.0, 0.0)))).float()
        for channel in range(3):
            # the mask is 0 to 1; a and b are -0.5 to 0.5
            offset = 0.5 if channel else 0.0
            weights = alpha_weights(scene, small, (picture[..., channel] + offset).clamp(0.0, 1.0))
            total = weights[:, 2]
            shown = (weights[:, 0] / total.clamp_min(1e-9) - offset).float().numpy()
            colors[:, channel] = np.where(front & (total > 0).numpy(), shown, colors[:, channel])
    return colors


def pixel_color(scene: Gaussians, camera: Camera, x: float, y: float) -> Floats:
    """Return the rendered color at a position inside the picture, OKLab. [3]"""
    column = int(x)
    row = int(y)
    with torch.no_grad():
        pixel = render(scene, camera, (0.0, 0.0, 0.0), crop=(column, row, column + 1, row + 1))
        color: Floats = srgb_to_oklab(_opaque_colors(pixel))[0, 0].float().numpy()
    return color


def rows_at_pixel(scene: Gaussians, camera: Camera, x: float, y: float) -> tuple[NDArray[np.int64], Floats]:
    """Return the Gaussians visible in a pixel of the picture, and their shares of its color. [M], [M]"""
    mask = torch.zeros(camera.height, camera.width)
    mask[int(y), int(x)] = 1.0
    shares = alpha_weights(scene, camera, mask)[:, 0].float().numpy()
    rows = np.flatnonzero(shares)
    return rows, shares[rows]


def main_rows(rows: NDArray[np.int64], shares: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the Gaussians that contribute most to the color of a pixel. [M], [M], M ≥ 1 -> [K]"""
    return rows[shares >= min(_MIN_SEED_SHARE, float(shares.max()))]


def _opaque_colors(drawn: Rendering) -> torch.Tensor:
    """Return the color of a rendering on black without the background, 0 to 1. [H,W,3]"""
    alpha = (1.0 - drawn.transmittance[..., None]).clamp_min(1e-6)
    return (drawn.image / alpha).clamp(0.0, 1.0)


def alike_in_color(colors: Floats, color: ArrayLike, tolerance: float) -> Mask:
    """Select the colors [N,3] within `tolerance` of a color [3], in OKLab. [N]

    A distance of 0.02 is hardly visible.
    """
    offsets = colors - np.asarray(color, np.float32)
    return np.asarray(np.einsum("ij,ij->i", offsets, offsets) <= tolerance * tolerance)


def front_surface(
    scene: Gaussians, camera: Camera, centers: Centers, rows: NDArray[np.int64] | None = None
) -> Mask:
    """Select the Gaussians on the visible surface, not those behind it. [M]

    A Gaussian belongs to the surface if its center is not much farther behind the rendered depth than its own
    extent.

    Args:
        scene: the scene on screen
        camera: the viewing camera
        centers: centers of all its Gaussians, from `project_centers`
        rows: rows to test, all if None. The cost grows with the part of the picture that they cover. [M]

    Returns:
        Mask, False also for Gaussians that are not in front of the camera. [M]
    """
    part = slice(None) if rows is None else rows
    points = centers.points[part]
    depths = centers.depths[part]
    width = max(camera.width // _DEPTH_DOWNSCALE, 1)
    height = max(camera.height // _DEPTH_DOWNSCALE, 1)
    uv = points / np.array([camera.width / width, camera.height / height], np.float32)
    visible = np.asarray(np.isfinite(uv).all(axis=1))
    if not visible.any():
        return visible
    cells = np.where(visible[:, None], uv, uv[visible][0]).clip(0, (width - 1, height - 1)).astype(np.intp)
    x0, y0 = cells.min(axis=0).tolist()
    x1, y1 = cells.max(axis=0).tolist()
    with torch.no_grad():
        z = torch.from_numpy(centers.depths)[:, None].nan_to_num().expand(-1, 3).contiguous()
        crop = (x0, y0, x1 + 1, y1 + 1)
        image, transmittance, _ = render(
            scene, camera.resize(width, height), (0.0, 0.0, 0.0), colors=z, crop=crop
        )
    covered = 1.0 - transmittance.numpy().reshape(y1 + 1 - y0, x1 + 1 - x0)
    depth = np.where(covered > _MIN_COVERAGE, image[..., 0].numpy() / np.maximum(covered, 1e-6), np.inf)
    surface = depth[cells[:, 1] - y0, cells[:, 0] - x0]
    size = np.exp(scene.log_scales.numpy()[part].max(axis=1))
    return np.asarray(visible & (depths <= surface * (1.0 + _DEPTH_TOLERANCE) + _EXTENT_TOLERANCE * size))


class Surface:
    """Cache of projected centers, front surface and colors for one scene and camera.

    Each is computed on first use, from any thread. The scene must not change.

    Args:
        scene: the scene on screen
        camera: the viewing camera
    """

    def __init__(self, scene: Gaussians, camera: Camera) -> None:
        self.scene = scene
        self.camera = camera
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._centers: Centers | None = None
        self._front: Mask | None = None
        self._colors: Floats | None = None

    @property
    def centers(self) -> Centers:
        """Projected centers, see `project_centers`."""
        with self._lock:
            self._centers = self._centers or project_centers(self.scene, self.camera)
            return self._centers

    @property
    def colors(self) -> Floats:
        """Colors in the picture, OKLab, see `shown_colors`. [N,3]"""
        with self._lock:
            if self._colors is None:
                self._front = self._whole_front()
                self._colors = shown_colors(self.scene, self.camera, self._front)
            return self._colors

    def front(self, rows: NDArray[np.int64]) -> Mask:
        """Select the rows on the front surface, see `front_surface`. [M]"""
        with self._lock:
            if self._front is not None:
                return self._front[rows]
            return front_surface(self.scene, self.camera, self.centers, rows)

    def _whole_front(self) -> Mask:
        """Return the mask of all Gaussians on the front surface. [N]"""
        if self._front is not None:
            return self._front
        return front_surface(self.scene, self.camera, self.centers)

    def in_front(self, mask: Mask) -> Mask:
        """Return the part of a mask that lies on the front surface. [N]"""
        rows = np.flatnonzero(mask)
        seen = np.zeros_like(mask)
        seen[rows] = self.front(rows)
        return seen

    def prepare(self, colors: bool = False) -> None:
        """Compute the whole front surface, and optionally the colors, in advance. `drop` cancels it."""
        with self._lock, stopped_by(self._stop), suppress(StoppedError):
            self._front = self._whole_front()
            if colors and not self._stop.is_set():
                _ = self.colors

    def drop(self) -> None:
        """Cancel a running `prepare`; the cache is no longer needed."""
        self._stop.set()


_OUTSIDE = 0
_INSIDE = 1
_EDGE = 2


def _fill(outline: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Classify the cells of a grid as outside, inside or near the edge of a polygon in cell units. [H,W]"""
    width, height = (int(side) + 4 for side in outline.max(0))
    image = Image.new("L", (width, height), _OUTSIDE)
    draw = ImageDraw.Draw(image)
    corners = [(float(x), float(y)) for x, y in outline]
    draw.polygon(corners, fill=_INSIDE)
    draw.line([*corners, corners[0]], fill=_EDGE, width=3)
    for x, y in corners:  # wide lines have notches where they meet
        draw.rectangle((x - 2, y - 2, x + 2, y + 2), fill=_EDGE)
    return np.asarray(image)


def _crossings(points: NDArray[np.float64], outline: NDArray[np.float64]) -> NDArray[np.intp]:
    """Count the sides of a closed outline that the ray from each point to the right crosses. [N]"""
    count = np.zeros(len(points), np.intp)
    order = np.argsort(points[:, 1])
    x, y = points[order].T
    for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if y0 != y1:
            level = slice(*np.searchsorted(y, sorted((y0, y1))))
            count[order[level]] += x[level] < x0 + (y[level] - y0) / (y1 - y0) * (x1 - x0)
    return count
