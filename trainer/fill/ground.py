"""Ground around a hole as a texture: the fitted surface of the remaining scene, rendered straight on.

1. Fit a plane through the hole's boundary. A camera looks along its normal, with the hole in the middle and
   the hole's long side along a side of the picture.
2. Fit the surface: the simplest model of `progdf.surface` that predicts left-out samples around the hole.
3. Render the ground without the Gaussians in front of this surface, so that they hide none of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize.engines import Depth, render_depth
from progdf.surface.find import SAME_SURFACE_DEVIATIONS, PaintSurface, fit_surface, light_moments
from progdf.surface.models import (
    MIN_SAMPLES,
    Array,
    Mask,
    Samples,
    SurfaceModel,
    fit_planes,
)
from progdf.system.equality import equal_fields
from trainer.views.view import render_view

REACH_PX = 4.0
"""Largest distance, in pixels of a view, of a point from a surface that still belongs to it."""

MAX_SIDE_PX = 336
"""Largest longer side of the texture, pixels; it limits the inpainting to some seconds."""

RING_SHARE = 0.25
"""Width of the ring around a hole that decides its plane, as a share of the root of the hole's area."""

_MIN_RING_PX = 4  # smallest width of this ring, pixels
_MIN_SIDE_PX = 96  # smallest longer side of the texture, pixels
_DISTANCE_SIDES = 2.0  # camera distance, as a multiple of the longer side; far, for a weak perspective
_OPAQUE_SHARE = 0.5  # alpha of a pixel of the ground, as a share of the typical alpha around the hole
_ANGLE_STEP_DEG = 3  # step of the tried rotations of the picture, degrees
_PIXEL_DEVIATIONS = 0.6  # side of a pixel, in standard deviations of a typical Gaussian
_MIN_HOLE_PX = 16  # pixels; smaller holes of the texture stay as they are
_MAX_SAMPLES = 2000  # largest number of samples of the surface


@dataclass(frozen=True)
class Ground:
    """Texture of the ground around a hole."""

    __eq__ = equal_fields

    rows: Gaussians  # Gaussians at or behind the surface
    surface: PaintSurface  # fitted surface in the straight camera; opaque inside the hole too
    image: Tensor  # color of the ground without the background, 0 to 1. [H,W,3]
    known: Mask  # pixels that show the ground. [H,W]
    hole: Mask  # pixels to fill. [H,W]
    name: str  # name of the fitted model

    @property
    def camera(self) -> Camera:
        """Camera that looks straight at the hole."""
        return self.surface.camera


def view_ground(
    rest: Gaussians, camera: Camera, hole: Tensor, inverse_depth: Tensor, unseen: Callable[[Tensor], Tensor]
) -> Ground | None:
    """Return the ground around a hole; None if too little of it is visible.

    Args:
        rest: the remaining scene
        camera: view with the hole
        hole: pixels of the hole. [H,W] bool
        inverse_depth: 1 / camera z of the ground, continued into the hole. [H,W]
        unseen: function that returns the points that no view saw through or past. [P,3] float64 -> [P] bool
    """
    straight = straight_camera(rest, camera, hole, inverse_depth)
    if straight is None:
        return None
    eye, inside = straight
    low = rest[_low_rows(rest, eye, inside)]
    seen = render_depth(low, eye)
    splatted = _splat(inside, eye)
    around = _around(seen, splatted)
    samples = _samples(seen, eye, around)
    if len(samples) < MIN_SAMPLES:
        return None
    thickness_px = _thickness_px(low, eye, around)
    fitted = fit_surface(samples, thickness_px)
    if fitted is None:
        return None
    model, residual_px = fitted
    limit_px = SAME_SURFACE_DEVIATIONS * max(residual_px, thickness_px)
    ground = low[_rows_at(low, eye, model, limit_px)]
    if not len(ground):
        return None
    shown = render_depth(ground, eye)
    image = render_view(ground, eye, torch.zeros(3))
    image = (image / shown.alpha.clamp_min(1e-3)[..., None]).clamp(0.0, 1.0)
    surface = _model_surface(model, eye, thickness_px)
    known, missing = _known_and_missing(shown.alpha.numpy(), splatted)
    reach_px = _reach_px(camera, inverse_depth[hole], surface)
    missing = _keep_unseen(missing, surface, unseen, reach_px)
    if missing.sum() < _MIN_HOLE_PX or not known.any():
        return None
    return Ground(ground, surface, image, known & ~missing, missing, model.name)


def straight_camera(
    rest: Gaussians, camera: Camera, hole: Tensor, inverse_depth: Tensor
) -> tuple[Camera, Tensor] | None:
    """Return a camera that looks straight at the hole, and the hole's points on the plane of its boundary.

    Its picture shows the hole with a margin of the hole's mean size. The size of its pixels follows that of a
    typical Gaussian around the hole.

    Args:
        rest: the remaining scene
        camera: view with the hole
        hole: pixels of the hole. [H,W] bool
        inverse_depth: 1 / camera z of the ground, continued into the hole. [H,W]

    Returns:
        The camera, and the points in world coordinates [P,3] float64; None without enough samples.
    """
    mask = hole.numpy()
    width_px = max(_MIN_RING_PX, round(RING_SHARE * float(mask.sum()) ** 0.5))
    ring = ndimage.binary_dilation(mask, iterations=width_px)
    samples = _image_samples(camera, inverse_depth.double().numpy(), ring)
    if len(samples) < MIN_SAMPLES:
        return None
    plane = fit_planes(samples)
    a, b, c = plane.coefficients[0]
    own = _image_samples(camera, plane.inverse_depth(*_coordinates(camera)), mask)
    depth = 1.0 / np.maximum(own.inverse, 1e-12)
    c2w = camera.c2w.double().numpy()
    points = np.stack([own.x, own.y, np.ones_like(own.x)], axis=1) * depth[:, None]
    points = points @ c2w[:3, :3].T + c2w[:3, 3]
    forward = c2w[:3, :3] @ np.array([b, c, a])
    forward /= np.linalg.norm(forward)
    frame = _tight_frame(points, forward)
    local = points @ frame.T
    low = local.min(axis=0)
    high = local.max(axis=0)
    half = np.maximum(0.5 * (high - low)[:2], 1e-9)
    half += 2.0 * np.sqrt(half[0] * half[1])
    center = 0.5 * (low + high)
    distance = 2.0 * _DISTANCE_SIDES * half.max()
    eye = np.array([center[0], center[1], center[2] - distance])
    viewmat = np.eye(4)
    viewmat[:3, :3] = frame
    viewmat[:3, 3] = -eye
    pixel = _PIXEL_DEVIATIONS * _typical_deviation(rest, viewmat, half, distance)
    longer = 2.0 * half.max()
    pixel = min(max(pixel, longer / MAX_SIDE_PX), longer / _MIN_SIDE_PX)
    size = np.maximum(np.ceil(2.0 * half / pixel), 16).astype(int)
    width = int(size[0])
    height = int(size[1])
    focal = float(distance / pixel)
    K = torch.tensor([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
    straight = Camera(torch.from_numpy(viewmat).float(), K, width, height)
    return replace(straight, near=0.01 * distance, name="ground"), torch.from_numpy(points)


def _tight_frame(points: Array, forward: Array) -> Array:
    """Return the axes right, down and forward in whose picture the points have the smallest box. [3,3]"""
    first = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    first /= np.linalg.norm(first)
    second = np.cross(forward, first)
    places = points @ np.stack([first, second], axis=1)
    angles = np.radians(np.arange(0, 90, _ANGLE_STEP_DEG))
    right = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    down = np.stack([-np.sin(angles), np.cos(angles)], axis=1)
    areas = np.ptp(places @ right.T, axis=0) * np.ptp(places @ down.T, axis=0)
    best = int(areas.argmin())
    axes = [side[best, 0] * first + side[best, 1] * second for side in (right, down)]
    return np.stack([*axes, forward])


def _typical_deviation(rest: Gaussians, viewmat: Array, half: Array, distance: float) -> float:
    """Return the median standard deviation of the Gaussians around the hole along their middle axis, or 0."""
    places = rest.means.double().numpy() @ viewmat[:3, :3].T + viewmat[:3, 3]
    inside = (np.abs(places[:, :2]) <= half).all(axis=1) & (np.abs(places[:, 2] - distance) <= half.min())
    inside &= rest.opacities.numpy() > 0.1
    if not inside.any():
        return 0.0
    scales = np.sort(rest.scales.double().numpy()[inside], axis=1)
    return float(np.median(scales[:, 1]))


def _low_rows(rest: Gaussians, eye: Camera, points: Tensor) -> Tensor:
    """Return the rows that stand at most a quarter of the picture's side in front of the hole. [N] bool"""
    axis = eye.viewmat[2]
    depth = rest.means @ axis[:3] + axis[3]
    distance = float((points @ axis[:3].double() + axis[3].double()).median())
    side = min(eye.width, eye.height) * distance / float(eye.K[0, 0])
    return depth > distance - 0.25 * side


def _coordinates(camera: Camera) -> tuple[Array, Array]:
    """Return the normalized image coordinates of all pixels. [H,W] each"""
    K = camera.K.double().numpy()
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]


def _image_samples(camera: Camera, inverse_depth: Array, mask: Mask) -> Samples:
    """Return the pixels of a mask with a positive inverse depth as samples. [H,W], [H,W]"""
    x, y = _coordinates(camera)
    mask = mask & (inverse_depth > 0)
    return Samples(x[mask], y[mask], inverse_depth[mask], float(camera.K[0, 0]))


def _splat(points: Tensor, eye: Camera) -> Mask:
    """Return the pixels that points project to, without gaps between them. [H,W]"""
    places = (points @ eye.viewmat[:3, :3].double().T + eye.viewmat[:3, 3].double()).numpy()
    K = eye.K.double().numpy()
    columns = np.floor(places[:, 0] / places[:, 2] * K[0, 0] + K[0, 2]).astype(int)
    rows = np.floor(places[:, 1] / places[:, 2] * K[1, 1] + K[1, 2]).astype(int)
    valid = (columns >= 0) & (columns < eye.width) & (rows >= 0) & (rows < eye.height)
    mask = np.zeros((eye.height, eye.width), bool)
    mask[rows[valid], columns[valid]] = True
    spacing = (eye.width * eye.height / max(1, len(points))) ** 0.5
    reach = max(1, round(spacing))
    closed = np.asarray(ndimage.binary_closing(np.pad(mask, reach), iterations=reach))
    return closed[reach:-reach, reach:-reach]


def _around(seen: Depth, hole: Mask) -> Mask:
    """Return the opaque pixels outside the hole. [H,W]"""
    alpha = seen.alpha.numpy()
    known = ~ndimage.binary_dilation(hole, iterations=2)
    typical = float(np.median(alpha[known])) if known.any() else 0.0
    return np.asarray(known & (alpha > max(0.05, _OPAQUE_SHARE * typical)))


def _samples(seen: Depth, eye: Camera, around: Mask) -> Samples:
    """Return up to `_MAX_SAMPLES` samples of the surface around the hole, chosen at random."""
    depth = np.where(around, seen.depth.double().numpy(), 1.0)
    samples = _image_samples(eye, np.where(around, 1.0 / depth, 0.0), around)
    chosen = np.zeros(len(samples), bool)
    chosen[np.random.default_rng(0).permutation(len(samples))[:_MAX_SAMPLES]] = True
    return samples.select(chosen)


def _thickness_px(scene: Gaussians, eye: Camera, around: Mask) -> float:
    """Return the typical spread of depths within a pixel, as pixels at this depth, at least 1."""
    mean, spread, _ = light_moments(scene, eye)
    return max(1.0, float(np.median(spread[around] / mean[around])) * float(eye.K[0, 0]))


def _rows_at(scene: Gaussians, eye: Camera, model: SurfaceModel, limit_px: float) -> Tensor:
    """Return the rows that are behind the surface, or at most `limit_px` pixels in front of it. [N] bool"""
    places = (scene.means @ eye.viewmat[:3, :3].T + eye.viewmat[:3, 3]).double().numpy()
    z = np.maximum(places[:, 2], 1e-9)
    inverse = model.inverse_depth(places[:, 0] / z, places[:, 1] / z)
    before_px = (1.0 / np.maximum(inverse, 1e-12) - z) / z * float(eye.K[0, 0])
    return torch.from_numpy(np.asarray((before_px <= limit_px) & (places[:, 2] > eye.near)))


def _model_surface(model: SurfaceModel, eye: Camera, thickness_px: float) -> PaintSurface:
    """Return the model as a surface that covers the whole picture."""
    x, y = _coordinates(eye)
    inverse = np.maximum(model.inverse_depth(x, y), 1e-12)
    depth = 1.0 / inverse
    slopes = np.stack(
        [-change / (inverse**2 * float(eye.K[i, i])) for i, change in enumerate(model.gradient(x, y))]
    )
    whole = np.ones(depth.shape, bool)
    thickness = thickness_px * float(np.median(depth)) / float(eye.K[0, 0])
    return PaintSurface(eye, depth, slopes, whole, model.part(x, y), whole, thickness)


def _known_and_missing(alpha: NDArray[np.float32], hole: Mask) -> tuple[Mask, Mask]:
    """Return the pixels that show the ground, and the pixels of its hole. [H,W] each

    The hole consists of the connected pieces of missing pixels that overlap the projected hole.
    """
    outside = ~ndimage.binary_dilation(hole, iterations=2)
    shown = alpha[outside & (alpha > 0.05)]
    typical = float(np.median(shown)) if len(shown) else 1.0
    known = alpha >= _OPAQUE_SHARE * typical
    pieces, count = ndimage.label(~known)
    overlap = np.bincount(pieces[hole], minlength=count + 1)
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    chosen = (overlap > 0) & (sizes >= _MIN_HOLE_PX)
    chosen[0] = False
    missing = chosen[pieces] & ndimage.binary_dilation(hole, iterations=8)
    return known, np.asarray(missing)


def _reach_px(camera: Camera, inverse_depth: Tensor, surface: PaintSurface) -> int:
    """Return `REACH_PX` of a view as a distance in pixels of the texture, at least 1."""
    eye = surface.camera
    world = REACH_PX / (float(inverse_depth.median()) * float(camera.K[0, 0]))
    return max(1, round(world * float(eye.K[0, 0]) / float(np.median(surface.depth))))


def _keep_unseen(
    missing: Mask, surface: PaintSurface, unseen: Callable[[Tensor], Tensor], reach_px: int
) -> Mask:
    """Return the missing pixels at points that no view saw through, or near such points. [H,W]"""
    eye = surface.camera
    rows, columns = np.nonzero(missing)
    if not len(rows):
        return missing
    x, y = _coordinates(eye)
    depth = surface.depth[rows, columns]
    places = np.stack([x[rows, columns] * depth, y[rows, columns] * depth, depth], axis=1)
    c2w = eye.c2w.double().numpy()
    points = torch.from_numpy(places @ c2w[:3, :3].T + c2w[:3, 3])
    kept = np.zeros_like(missing)
    kept[rows, columns] = unseen(points).numpy()
    return np.asarray(ndimage.binary_dilation(kept, iterations=reach_px) & missing)
