"""Extent of an edit beyond the pictures that it is made from.

A changed picture gives the color of the Gaussians that it shows. The edit ends where the picture ends: a
member that no picture shows takes a share of the change. The share falls from 1 at the nearest visible
members to 0 within a fade width. The distance is geodesic: the shortest path over neighbors on one surface.
So the edit reaches no other surface and leaves no islands.

The fade width is the half width of the paint's own soft border, measured in the pictures. An outline cuts
through such a border, and about its outer half remains. A hard border fades over the spacing of the members,
so that it does not look torn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from progdf.camera import Camera
from progdf.color.oklab import smoothstep
from progdf.gaussians import Gaussians
from progdf.rasterize.engines import render_depth
from progdf.scene.neighbors import nearest_rows

_PAINT_COLOR = 2 / 255  # color difference above which a pixel is painted
_SURFACE_ALPHA = 0.5  # opacity above which a pixel shows a surface
_MAX_SLOPE = 3.0  # depth step per pixel, in pixel footprints; a steeper step separates two surfaces
_FULL_QUANTILE = 0.75  # quantile over the painted pixels of the mean change that counts as full
_SPACING_NEIGHBOR = 8  # the median distance to this neighbor is the spacing of the members
_MIN_WIDTH = 1e-12  # world units; against a division by zero where centers coincide
_SMOOTHING_ROUNDS = 4  # averages over neighbors, against steps between paths over single Gaussians
_MIN_SUPPORT = 0.4  # share of a visible member's ties that must lead to visible members
_LEVELS = 255.0  # shares are stored as bytes


@dataclass(frozen=True)
class Fade:
    """Width over which an edit fades beyond the pictures' border."""

    width: float  # along the surface, world units
    border_px: float  # width of the paint's border in the pictures, pixels; 0: no border inside a surface


def border_half_width(change: Tensor, depth: Tensor, alpha: Tensor, pixel: float) -> tuple[float, float]:
    """Return the half width of the paint's border where it lies inside a surface, in pixels and world units.

    It is the distance from the unpainted pixels of the same surface at which the mean change reaches half of
    its full value. A border at the object's outline does not count.

    Args:
        change: largest color difference to the original. [H,W] 0..1
        depth: depth of the visible surface, world units. [H,W]
        alpha: opacity of the scene. [H,W] 0..1
        pixel: width of a pixel at depth 1

    Returns:
        half width in pixels; half width in world units. Both are 0 without such a border.
    """
    painted = (change > _PAINT_COLOR).numpy()
    z = depth.numpy()
    surface = (alpha > _SURFACE_ALPHA).numpy()
    beside = np.zeros_like(painted)  # unpainted pixels next to paint on the same surface
    for axis in (0, 1):
        for step in (1, -1):
            is_level = np.abs(np.roll(z, step, axis) - z) <= _MAX_SLOPE * pixel * z
            beside |= is_level & np.roll(painted & surface, step, axis)
    beside &= ~painted & surface
    if not beside.any():
        return 0.0, 0.0
    inside = ndimage.distance_transform_edt(~beside)
    nearest = painted & (inside <= ndimage.distance_transform_edt(painted) + 0.5)
    bins = np.round(inside[nearest]).astype(int)
    counts = np.bincount(bins)
    means = np.bincount(bins, change.numpy()[nearest]) / np.maximum(counts, 1)
    full = np.quantile(np.repeat(means, counts), _FULL_QUANTILE)
    half_width = float(np.argmax(means >= 0.5 * full))
    return half_width, half_width * pixel * float(np.median(z[nearest & (inside <= half_width + 1.0)]))


def find_fade(
    scene: Gaussians, members: Tensor, cameras: Sequence[Camera], changes: Sequence[Tensor]
) -> Fade:
    """Return the fade of an edit: the half width of its pictures' widest border, at least one spacing.

    Args:
        scene: the original
        members: rows of the region, at least one. [M] int64
        cameras: cameras of the pictures
        changes: difference of each picture to the original. [H,W,3] each
    """
    means = scene.means[members]
    distances = nearest_rows(means, torch.arange(len(members)), _SPACING_NEIGHBOR)[1]
    spacing = float(distances[:, -1].median()) if distances.shape[1] else 0.0
    width = max(spacing, _MIN_WIDTH)
    border_px = 0.0
    for camera, change in zip(cameras, changes, strict=True):
        with torch.no_grad():
            drawn = render_depth(scene, camera)
        half_px, half_width = border_half_width(
            change.abs().amax(dim=2), drawn.depth, drawn.alpha, 1.0 / float(camera.K[0, 0])
        )
        border_px = max(border_px, 2.0 * half_px)
        width = max(width, half_width)
    return Fade(width, border_px)


def drop_unsupported(links: csr_matrix, visible: Tensor) -> Tensor:
    """Return the visible members without those that are alone among hidden ones, such as a hair's tip.

    Args:
        links: see `surface_reach`. [M,M]
        visible: members that a picture shows. [M] bool

    Returns:
        [M] bool
    """
    totals = np.asarray(links.sum(axis=1)).ravel()
    support = links @ visible.double().numpy()
    return visible & torch.from_numpy(support >= _MIN_SUPPORT * totals)


def surface_reach(links: csr_matrix, means: Tensor, visible: Tensor, width: float) -> Tensor:
    """Return each member's share of the change: 1 if a picture shows it, else a smooth fall to 0.

    Args:
        links: positive between neighbors on one surface, symmetric. [M,M]
        means: centers of the members. [M,3]
        visible: members that a picture shows. [M] bool
        width: geodesic distance at which the share is 0, world units, > 0

    Returns:
        [M] 0..1, in steps of 1/255
    """
    sources = visible.nonzero()[:, 0].numpy()
    if not len(sources):
        return torch.zeros(len(means))
    pairs = links.tocoo()
    first = torch.from_numpy(pairs.row.astype(np.int64))
    second = torch.from_numpy(pairs.col.astype(np.int64))
    # a length of 0 would be no link
    lengths = (means[first] - means[second]).double().norm(dim=1).clamp_min(_MIN_WIDTH)
    graph = csr_matrix((lengths.numpy(), (pairs.row, pairs.col)), links.shape)
    distances = dijkstra(graph, directed=False, indices=sources, min_only=True, limit=width)
    reach = smoothstep(1.0 - torch.from_numpy(np.minimum(distances / width, 1.0)).float())
    faded = (reach > 0.0) & ~visible
    totals = torch.from_numpy(np.asarray(links.sum(axis=1)).ravel()).float().clamp_min(_MIN_WIDTH)
    for _ in range(_SMOOTHING_ROUNDS):
        mean = torch.from_numpy(links @ reach.numpy()).float() / totals
        reach = torch.where(faded, 0.5 * (reach + mean), reach)
    return (reach * _LEVELS).round() / _LEVELS
