"""What lies under the cursor: which Gaussians with which shares, which point of the surface, which layer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.checkpoint import Gdf
from progdf.gaussians import Gaussians
from progdf.rasterize.conventions import ALPHA_MAX, ALPHA_MIN, DILATION

from .stack import shown
from .state import Vec3, ViewState

HALF = 0.5
FAINT = 0.05  # less than this in all counts as background
LEAST_SHARE = 0.25  # of what one sees at a pixel must be a layer's own before a click there means it


@dataclass(frozen=True)
class Seen:
    """What one sees at a pixel, nearest first.

    Args:
        rows: indices of the Gaussians. [M] int64
        shares: the part of the pixel's colour that each gives; with the background's share they make 1. [M]
        depths: in front of the camera, world units. [M]
    """

    rows: NDArray[np.int64]
    shares: NDArray[np.float64]
    depths: NDArray[np.float64]


def surface_point(scene: Gaussians, camera: Camera, x: float, y: float, near: float = 1e-4) -> Vec3 | None:
    """The point under a pixel position, on its ray at the depth of the Gaussian that makes it half opaque.

    Args:
        scene: what is on screen, so with its edits
        camera: the picture's camera
        x, y: pixels from the upper left corner, pixel centres at +0.5
        near: least depth, world units

    Returns:
        World position; the strongest Gaussian's depth where the pixel never gets half opaque; None on the
        background.
    """
    seen = seen_at(scene, camera, x, y, near)
    if seen is None:
        return None
    opaque = np.flatnonzero(np.cumsum(seen.shares) >= HALF)
    at = int(opaque[0]) if len(opaque) else int(seen.shares.argmax())
    z = float(seen.depths[at])
    fx, fy, cx, cy = _lens(camera)
    rotation, translation = camera.viewmat[:3, :3].numpy(), camera.viewmat[:3, 3].numpy()
    wx, wy, wz = (
        float(v) for v in rotation.T @ (np.array([(x - cx) / fx * z, (y - cy) / fy * z, z]) - translation)
    )
    return (wx, wy, wz) if all(math.isfinite(v) for v in (wx, wy, wz)) else None


def layer_at(view: ViewState, gdfs: Sequence[Gdf], seen: Seen) -> int | None:
    """The layer that most of what one sees belongs to, an index into `view.layers`.

    Args:
        view: what is on screen
        gdfs: the edits that `LayerState.gdf` counts
        seen: at the pixel

    Returns:
        A shown layer goes before a hidden one, of equal ones the later; None where no layer has
        `LEAST_SHARE` of the pixel.
    """
    visible, best, chosen = shown(view), (False, 0.0), None
    for i, layer in enumerate(view.layers):
        own = np.isin(seen.rows, gdfs[layer.gdf].region.members.numpy(), assume_unique=True)
        share = float(seen.shares[own].sum())
        if share >= LEAST_SHARE and (layer in visible, share) >= best:
            best, chosen = (layer in visible, share), i
    return chosen


def seen_at(scene: Gaussians, camera: Camera, x: float, y: float, near: float = 1e-4) -> Seen | None:
    """The Gaussians that one sees at a pixel position, None on the background; as `surface_point`."""
    rotation, translation = camera.viewmat[:3, :3].numpy(), camera.viewmat[:3, 3].numpy()
    fx, fy, cx, cy = _lens(camera)
    means = scene.means.numpy()
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        local = means @ rotation.T + translation
        depth = local[:, 2]
        dx, dy = local[:, 0] / depth * fx + cx - x, local[:, 1] / depth * fy + cy - y
        widest = scene.log_scales.amax(1).exp().numpy()
        reach = 3.5 * (widest * max(fx, fy) / depth * np.hypot(1.0, np.hypot(dx / fx, dy / fy)) + 1.0)
        sized = np.isfinite(widest) & np.isfinite(scene.logit_opacities.numpy())
        near_ray = np.flatnonzero(sized & (depth > near) & (dx * dx + dy * dy < reach * reach))
    if not len(near_ray):
        return None
    alphas = _alphas(
        scene[torch.from_numpy(near_ray)], local[near_ray], rotation, fx, fy, dx[near_ray], dy[near_ray]
    )
    order = np.argsort(depth[near_ray], kind="stable")
    through = np.cumprod(1.0 - alphas[order])
    if 1.0 - through[-1] < FAINT:
        return None
    shares = alphas[order] * np.concatenate([[1.0], through[:-1]])
    rows = near_ray[order]
    return Seen(rows, shares, depth[rows].astype(np.float64))


def _lens(camera: Camera) -> tuple[float, float, float, float]:
    """Focal lengths and principal point, pixels."""
    fx, fy, cx, cy = (float(v) for v in (camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]))
    return fx, fy, cx, cy


def _alphas(
    seen: Gaussians,
    local: np.ndarray,
    rotation: np.ndarray,
    fx: float,
    fy: float,
    dx: np.ndarray,
    dy: np.ndarray,
) -> np.ndarray:
    """Alpha of each Gaussian at the pixel (EWA projection, as the renderer's). [M]"""
    axes = _rotations(seen.unit_quats.double().numpy()) * seen.scales.double().numpy()[:, None, :]
    axes = rotation.astype(np.float64) @ axes  # principal axes in the camera, columns
    x, y, z = local.astype(np.float64).T
    jacobian = np.zeros((len(local), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 0, 2] = fx / z, -fx * x / (z * z)
    jacobian[:, 1, 1], jacobian[:, 1, 2] = fy / z, -fy * y / (z * z)
    flat = jacobian @ axes
    cov = flat @ flat.transpose(0, 2, 1)
    a, b, c = cov[:, 0, 0] + DILATION, cov[:, 0, 1], cov[:, 1, 1] + DILATION
    power = 0.5 * (c * dx * dx - 2.0 * b * dx * dy + a * dy * dy) / np.maximum(a * c - b * b, 1e-12)
    alphas = seen.opacities.double().numpy() * np.exp(-np.clip(power, 0.0, 80.0))
    alphas[alphas < ALPHA_MIN] = 0.0
    clamped: np.ndarray = np.minimum(alphas, ALPHA_MAX)
    return clamped


def _rotations(quats: np.ndarray) -> np.ndarray:
    """Rotation matrices of unit quaternions wxyz. [M,4] -> [M,3,3]"""
    w, x, y, z = quats.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)
