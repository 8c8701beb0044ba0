"""Picking at the cursor: visible Gaussians with their shares, surface point, layer."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.rasterize import reference
from progdf.rasterize.engines import ALPHA_MAX, ALPHA_MIN, Crop, RasterView, activate
from progdf.scene.selection import Floats, Mask, Surface
from progdf.system.equality import equal_fields
from viewer.camera.view_camera import Vec3
from viewer.state.layers import is_visible
from viewer.state.view_state import ViewState

from .background import run_in_background

SURFACE_OPACITY = 0.5  # accumulated opacity that defines the surface
BACKGROUND_OPACITY = 0.05  # accumulated opacity below which a pixel is background
OUTLINE_POINTS = 32  # number of points of an outline
MIN_SHARE = 0.25  # share of a pixel's color that a layer needs to be picked


@dataclass(frozen=True)
class PixelGaussians:
    """Visible Gaussians at a pixel, nearest first."""

    __eq__ = equal_fields

    rows: NDArray[np.int64]  # indices of the Gaussians. [M] int64
    # share of each in the pixel's color; with the background's share they sum to 1. [M]
    shares: NDArray[np.float64]
    depths: NDArray[np.float64]  # depths in front of the camera, world units. [M]


def surface_point(scene: Gaussians, camera: Camera, x: float, y: float, near: float = 1e-4) -> Vec3 | None:
    """Return the surface point under a pixel position.

    The point is on the pixel's ray, at the depth of the Gaussian at which the accumulated opacity reaches
    `SURFACE_OPACITY`, or else of the Gaussian with the largest share.

    Args:
        scene: the edited scene on screen
        camera: the picture's camera
        x, y: pixels from the upper left corner, pixel centers at +0.5
        near: smallest depth, world units

    Returns:
        World position, or None on the background.
    """
    seen = seen_at(scene, camera, x, y, near)
    if seen is None:
        return None
    opaque = np.flatnonzero(np.cumsum(seen.shares) >= SURFACE_OPACITY)
    at = int(opaque[0]) if len(opaque) else int(seen.shares.argmax())
    z = float(seen.depths[at])
    fx, fy, cx, cy = _lens(camera)
    rotation = camera.viewmat[:3, :3].numpy()
    translation = camera.viewmat[:3, 3].numpy()
    wx, wy, wz = (
        float(v) for v in rotation.T @ (np.array([(x - cx) / fx * z, (y - cy) / fy * z, z]) - translation)
    )
    return (wx, wy, wz) if all(math.isfinite(v) for v in (wx, wy, wz)) else None


def layer_at(view: ViewState, gdfs: Sequence[Gdf], seen: PixelGaussians) -> int | None:
    """Return the layer with the largest share of a pixel.

    Visible layers take precedence over hidden ones, and later layers over earlier ones with an equal share.

    Args:
        view: the state on screen
        gdfs: the edits, indexed by `LayerState.gdf`
        seen: the visible Gaussians at the pixel

    Returns:
        Index into `view.layers`, or None if no layer has `MIN_SHARE` of the pixel.
    """
    best = (False, 0.0)
    chosen = None
    for i, layer in enumerate(view.layers):
        members = gdfs[layer.gdf].region.members.numpy()  # sorted
        if not len(members):
            continue
        inside = members[np.searchsorted(members, seen.rows).clip(max=len(members) - 1)] == seen.rows
        share = float(seen.shares[inside].sum())
        rank = is_visible(view, layer), share
        if share >= MIN_SHARE and rank >= best:
            best = rank
            chosen = i
    return chosen


def seen_at(
    scene: Gaussians, camera: Camera, x: float, y: float, near: float = 1e-4
) -> PixelGaussians | None:
    """Return the visible Gaussians at a pixel position, or None on the background. See `surface_point`."""
    rotation = camera.viewmat[:3, :3].numpy()
    translation = camera.viewmat[:3, 3].numpy()
    fx, fy, cx, cy = _lens(camera)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        # column by column, as row by row takes many times as long
        across, down, depth = rotation @ scene.means.numpy().T + translation[:, None]
        dx = across / depth
        dy = down / depth
        dx += np.float32((cx - x) / fx)
        dy += np.float32((cy - y) / fy)
        off = dx * dx + dy * dy
        widest = np.exp(functools.reduce(np.maximum, scene.log_scales.numpy().T))
        # √(1 + off) ≤ 1 + off / 2; `_alphas` drops the surplus candidates
        reach = widest / depth * (max(fx, fy) / min(fx, fy) * (1.0 + 0.5 * off)) + np.float32(1 / min(fx, fy))
        sized = np.isfinite(widest) & np.isfinite(scene.logit_opacities.numpy())
        near_ray = np.flatnonzero(sized & (depth > near) & (off < 3.5**2 * reach * reach))
    if not len(near_ray):
        return None
    rows, alphas = _alphas(scene, near_ray, camera, x, y, near)
    through = np.cumprod(1.0 - alphas)
    if not len(rows) or 1.0 - through[-1] < BACKGROUND_OPACITY:
        return None
    shares = alphas * np.concatenate([[1.0], through[:-1]])
    return PixelGaussians(rows, shares, depth[rows].astype(np.float64))


def outlines(
    scene: Gaussians, rows: NDArray[np.int64], camera: Camera, near: float, sigmas: float = 2.0
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the outlines of Gaussians in the picture.

    Args:
        scene: the scene
        rows: Gaussians to outline. [M]
        camera: the picture's camera
        near: smallest depth, world units
        sigmas: distance from the center, standard deviations

    Returns:
        The drawn ones of `rows` [K], and their outlines in pixels [K,`OUTLINE_POINTS`,2].
    """
    splats = _project(scene, rows, camera, near, None)
    l11, l21, l22 = (column[:, None] for column in splats.whitening.unbind(1))
    angles = torch.linspace(0.0, 2.0 * math.pi, OUTLINE_POINTS + 1, dtype=torch.float64)[:-1]
    down = sigmas * angles.sin() / l22
    across = (sigmas * angles.cos() - l21 * down) / l11
    points = splats.means2d[:, None] + torch.stack([across, down], dim=2)
    return rows[splats.rows.numpy()], points.numpy()


def _lens(camera: Camera) -> tuple[float, float, float, float]:
    """Return the focal lengths and the principal point, px."""
    fx, fy, cx, cy = (float(v) for v in (camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]))
    return fx, fy, cx, cy


def _alphas(
    scene: Gaussians, rows: NDArray[np.int64], camera: Camera, x: float, y: float, near: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the given Gaussians that the rasterizer draws at a position, nearest first, and their alphas."""
    pixel = (math.floor(x), math.floor(y), math.floor(x) + 1, math.floor(y) + 1)
    splats = _project(scene, rows, camera, near, pixel)
    l11, l21, l22 = splats.whitening.unbind(1)
    dx, dy = (torch.tensor([x, y], dtype=torch.float64) - splats.means2d).unbind(1)
    alphas = splats.opacities * torch.exp(-0.5 * ((l11 * dx + l21 * dy).square() + (l22 * dy).square()))
    alphas = torch.where(alphas >= ALPHA_MIN, alphas.clamp_max(ALPHA_MAX), 0.0)
    return rows[splats.rows.numpy()], alphas.numpy()


def _project(
    scene: Gaussians, rows: NDArray[np.int64], camera: Camera, near: float, crop: Crop | None
) -> reference.ReferenceSplats:
    """Project the given Gaussians in float64."""
    some = scene[torch.from_numpy(rows)]
    activated = activate(replace(some, means=some.means.double()), torch.zeros(len(rows), 3))
    return reference.project(activated, RasterView.of(replace(camera, near=near), activated, crop))[0]


PREPARE_MIN_GAUSSIANS = 100_000
"""Number of Gaussians below which no surface is prepared ahead, as it takes only about 0.1 s on demand."""


class Surfaces:
    """Cache of the surface of the still picture."""

    def __init__(self) -> None:
        self._key: object = None
        self._surface: Surface | None = None
        self._colors = False
        self._dots_key: object = None
        self._dots = (np.zeros((0, 2), np.float32), np.zeros(0, bool))

    def dots(self, key: object, find: Callable[[], tuple[Floats, Mask]]) -> tuple[Floats, Mask]:
        """Return the positions of a picture's dots [M,2] and a mask of the visible ones [M], found once.

        Args:
            key: identifies the picture and the dots
            find: function that returns both
        """
        if key != self._dots_key:
            self._dots = find()
            self._dots_key = key
        return self._dots

    def at(self, key: object) -> Surface | None:
        """Return the surface of a picture if it is prepared or in preparation, else None."""
        return self._surface if key == self._key else None

    def look(self, key: object, make: Callable[[], Surface], colors: bool) -> bool:
        """Prepare the surface of a picture in another thread, unless it is already prepared.

        Args:
            key: identifies the picture
            make: creates the surface, which must not change afterwards
            colors: whether colors will also be requested

        Returns:
            Whether it is a new surface.
        """
        if (key, colors) == (self._key, self._colors):
            return False
        self.drop()
        self._surface = make()
        self._key = key
        self._colors = colors
        run_in_background(self._surface.prepare, colors)
        return True

    def drop(self) -> None:
        """Discard the surface."""
        if self._surface is not None:
            self._surface.drop()
        self._key = self._surface = None
