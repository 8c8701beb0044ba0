"""Painted pixels as thin discs on the surface, and what lies before that surface moved behind them.

Splats are drawn in the order of their centers: a large Gaussian whose center is nearer than a disc covers it,
although its own surface lies behind. Such a Gaussian is moved back along its ray and grows with the distance,
which leaves its outline in the painted view as it is; see docs/method.md 3.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.gdf.file import ADDED_LOGIT
from progdf.quaternions import matrix_quats
from progdf.rasterize import render
from progdf.rasterize.cpu.engine import ListedWeights
from progdf.rasterize.engines import Crop, activate, color_map, render_depth
from progdf.sh import rgb_to_sh0

Array = NDArray[np.float64]

OPAQUE = 0.97
"""What a pixel must cover of the background to have a surface."""
DISC_LOGIT = 4.0
"""The opacity of a disc at strength 1."""

_GROWN = 2  # pixels around the paint that discs keep as they are: what is drawn behind them was moved
_SIDES = (16, 8, 4, 2, 1)  # of the rectangles of pixels that share a disc
_SPREAD, _MERGED_SPREAD = 0.28, 0.6  # standard deviation of a disc in its sides: of a pixel, of more
_BACK, _MERGED_BACK = 0.9, 0.4  # pixels by which discs lie deeper, as nearer neighbors cover them; of more
_THIN = 0.1  # pixels: the standard deviation across
_STEEP = 0.3  # cosine below which a disc is turned no further
_MEDIAN, _SMOOTH, _SAME = 9, 3.0, 4.0  # pixels, of depths; how far both may be apart on one surface
_LEAST_LIGHT = 0.005  # of a pixel, below which what a Gaussian takes before a disc does not matter
_REACH = 4.0  # standard deviations of the light's depths, within which a Gaussian is of the surface
_SETTLED = 1e-3  # of the reach: nearer, a row that was moved is behind but for rounding
_CLEARED = 12  # times, at most, that what lies before the discs is moved behind them
_GAP = 4.0  # pixels between a disc and what is moved behind it, which is wide and seen from the sides too


@dataclass(frozen=True)
class Paint:
    """What one view shall show."""

    camera: Camera
    picture: Tensor  # the view as it was painted, over the run's background. [H,W,3] 0..1
    painted: Tensor  # the pixels that were changed. [H,W] bool


@dataclass(frozen=True)
class Discs:
    """Gaussians to add, and rows that make way."""

    added: Gaussians  # as they are at strength 1
    cells: Array  # column and row of each one's center, pixels, and its sides. [B,4]
    moved: Tensor  # rows of the scene that lie before them, ascending. [M] int64
    scene: Gaussians  # with these rows moved


def place_discs(scene: Gaussians, paint: Paint, flat: float) -> Discs:
    """Discs for what is painted where the picture is opaque, and a little around it.

    Args:
        scene: the original
        paint: see `Paint`
        flat: root mean square of color, 0..1, that one disc may be off in its pixels
    """
    camera, depth = paint.camera, render_depth(scene, paint.camera)
    opaque = (depth.alpha > OPAQUE).numpy()
    surface = smooth_depth(depth.depth.numpy(), opaque)
    mask = ndimage.binary_dilation(paint.painted.numpy() & opaque, iterations=_GROWN) & opaque
    if not mask.any():
        empty = scene[:0]
        return Discs(empty, np.zeros((0, 4)), torch.zeros(0, dtype=torch.int64), scene)
    cells = merge_pixels(paint.picture.numpy(), mask, flat)
    added, depths = _discs(camera, cells, surface, paint.picture)
    added = replace(
        added,
        shN=torch.zeros(len(added), *scene.shN.shape[1:]),
        antialiased=scene.antialiased,
        origin=scene.origin,
    )
    pixel = float(np.median(depths)) / float(camera.K[0, 0])
    gap = (_BACK + _MERGED_BACK + _GAP) * pixel
    reach = gap + _REACH * _thickness(scene, camera, mask)
    cleared, moved = scene, torch.zeros(len(scene), dtype=torch.bool)
    for _ in range(_CLEARED):  # what stood before others hid them
        rows, factors = _rows_before(cleared, camera, surface + gap, mask, reach)
        if not len(rows):
            break
        cleared, moved = _move_back(cleared, camera, rows, factors), moved.index_fill(0, rows, True)
    return Discs(added, cells, moved.nonzero()[:, 0], cleared)


def smooth_depth(depth: NDArray[np.float32], opaque: NDArray[np.bool_]) -> Array:
    """Depths without noise, edges kept; where there is no surface, those of the nearest. [H,W] each"""
    if not opaque.any():
        return depth.astype(np.float64)
    nearest = ndimage.distance_transform_edt(~opaque, return_distances=False, return_indices=True)
    filled = depth.astype(np.float64)[tuple(nearest)]
    median = ndimage.median_filter(filled, _MEDIAN)
    smooth = ndimage.gaussian_filter(median, _SMOOTH)
    slope = np.hypot(*np.gradient(median))
    near = np.abs(smooth - median) <= _SAME * np.median(slope[opaque]) + 1e-9
    return cast(Array, np.where(near, smooth, median))


def merge_pixels(picture: NDArray[np.float32], mask: NDArray[np.bool_], flat: float) -> Array:
    """Pixels by rectangles that one disc shows well enough, the largest first.

    A disc is round and reaches over its rectangle: what it would be off is counted as far as it reaches.

    Args:
        picture: [H,W,3]
        mask: the pixels to be covered, each once. [H,W]
        flat: root mean square of color that it may be off, over the rectangle's pixels

    Returns:
        Column and row of the centers, and both sides, in pixels. [B,4]
    """
    rows, columns = np.nonzero(mask)
    reach = 3 * _SIDES[0]
    top, left = max(0, rows.min() - reach), max(0, columns.min() - reach)
    free = mask[top : rows.max() + reach + 1, left : columns.max() + reach + 1].copy()
    image = picture[top : rows.max() + reach + 1, left : columns.max() + reach + 1].astype(np.float64)
    found = []
    for height, width in _shapes():
        whole = tuple(side // step * step for side, step in zip(free.shape, (height, width), strict=True))
        blocks = free[: whole[0], : whole[1]].reshape(whole[0] // height, height, whole[1] // width, width)
        fits = blocks.all(axis=(1, 3))
        if height * width > 1 and fits.any():
            fits &= _disc_error(image, height, width)[: fits.shape[0], : fits.shape[1]] <= flat**2
        row, column = np.nonzero(fits)
        for y, x in zip(row * height, column * width, strict=True):
            free[y : y + height, x : x + width] = False
        sides = np.full(len(row), width), np.full(len(row), height)
        center = left + (column + 0.5) * width, top + (row + 0.5) * height
        found.append(np.stack([*center, *sides], axis=1).astype(np.float64))
    return np.concatenate(found)


def _shapes() -> Iterator[tuple[int, int]]:
    """Height and width of rectangles, the largest and squarest first."""
    shapes = ((a, b) for a in _SIDES for b in _SIDES)
    yield from sorted(shapes, key=lambda s: (-s[0] * s[1], abs(s[0] - s[1]), s))


def _disc_error(image: Array, height: int, width: int) -> Array:
    """Mean square of what discs of the rectangles' mean colors are off. [H,W,3] -> [H/height,W/width]"""
    spread = (_MERGED_SPREAD * height / 2**0.5, _MERGED_SPREAD * width / 2**0.5)
    rows, columns = (side // step for side, step in zip(image.shape[:2], (height, width), strict=True))
    blocks = image[: rows * height, : columns * width].reshape(rows, height, columns, width, 3)
    color = blocks.mean(axis=(1, 3))

    def weigh(values: Array) -> Array:
        blurred = ndimage.gaussian_filter(values, spread, mode="nearest", truncate=4.0)
        y = height * (np.arange(rows) + 0.5) - 0.5
        x = width * (np.arange(columns) + 0.5) - 0.5
        low = blurred[np.floor(y).astype(int)] + blurred[np.ceil(y).astype(int)]
        return cast(Array, 0.25 * (low[:, np.floor(x).astype(int)] + low[:, np.ceil(x).astype(int)]))

    channels = [weigh(image[..., c] ** 2) - 2 * color[..., c] * weigh(image[..., c]) for c in range(3)]
    # the blur's weights add up to 1, a disc's to 2π times both standard deviations
    area = 2 * np.pi * spread[0] * spread[1] / (height * width)
    return cast(Array, area * (sum(channels) + (color**2).sum(axis=2)) / 3)


def _discs(camera: Camera, cells: Array, surface: Array, picture: Tensor) -> tuple[Gaussians, Array]:
    """Discs that fill cells of the picture, on its surface, and their depths. [B,4], [H,W], [H,W,3]"""
    x, y, width, height = cells.T
    K, c2w = camera.K.double().numpy(), camera.c2w.double().numpy()
    focal, middle = np.array([K[0, 0], K[1, 1]]), K[:2, 2]

    def sample(values: Array) -> Array:
        return cast(Array, ndimage.map_coordinates(values, [y - 0.5, x - 0.5], order=1, mode="nearest"))

    slopes = [sample(ndimage.gaussian_filter1d(surface, 1.0, axis=axis, order=1)) for axis in (1, 0)]
    rays = np.stack([*((np.stack([x, y], 1) - middle) / focal).T, np.ones_like(x)], axis=1)
    depth = sample(surface)
    pixel = depth / focal[0]
    merged = width * height > 1
    placed = depth + (_BACK + np.where(merged, _MERGED_BACK, 0.0)) * pixel
    right, down = (_step(rays, depth, slope, axis, focal) for axis, slope in enumerate(slopes))
    normal = np.cross(right, down)
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    steep = np.abs((normal * rays).sum(axis=1, keepdims=True)) < _STEEP * length
    normal = np.where(steep, rays / length, normal)
    sides = []  # the steps in the disc's plane that are one cell in the picture
    for axis, side in enumerate((width, height)):
        step = np.zeros_like(rays)
        step[:, axis] = placed / focal[axis]
        step -= rays * ((normal * step).sum(axis=1) / (normal * rays).sum(axis=1))[:, None]
        sides.append(step * (side * np.where(side > 1, _MERGED_SPREAD, _SPREAD))[:, None])
    axes, scales, _ = np.linalg.svd(np.stack(sides, axis=2), full_matrices=True)
    axes[:, :, 2] *= np.linalg.det(axes)[:, None]
    means = (rays * placed[:, None]) @ c2w[:3, :3].T + c2w[:3, 3]
    color = picture[torch.from_numpy(y.astype(np.int64)), torch.from_numpy(x.astype(np.int64))]
    discs = Gaussians(
        torch.from_numpy(means).float(),
        matrix_quats(torch.from_numpy(c2w[:3, :3] @ axes)).float(),
        torch.from_numpy(np.log(np.concatenate([scales, _THIN * pixel[:, None]], axis=1))).float(),
        torch.full((len(x),), DISC_LOGIT),
        rgb_to_sh0(color),
        torch.zeros(len(x), 0, 3),
    )
    return discs, placed


def _step(rays: Array, depth: Array, slope: Array, axis: int, focal: Array) -> Array:
    """What a step of one pixel is on the surface. [B,3]"""
    step = rays * slope[:, None]
    step[:, axis] += depth / focal[axis]
    return step


def _rows_before(
    scene: Gaussians, camera: Camera, behind: Array, mask: NDArray[np.bool_], reach: float
) -> tuple[Tensor, Tensor]:
    """Rows of the surface whose centers lie before the depths `behind` [H,W] of some pixels.

    What lies more than `reach` before them, world units, hides the paint as it hides the surface.

    Returns:
        Their indices, and by what their depth grows. [M] int64, [M]
    """
    rows, columns = np.nonzero(mask)
    box: Crop = (int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1)
    listed = color_map(activate(scene), camera, box, torch.arange(len(scene)))
    if not isinstance(listed, ListedWeights):
        raise TypeError("discs are placed by the CPU engine's lists")
    runs, axis = listed.runs, camera.viewmat[2]
    depths = (scene.means.double() @ axis[:3].double() + axis[3].double()).numpy()
    counts = np.diff(runs.starts)
    owner = np.repeat(runs.rows, counts)
    pixel = np.repeat(runs.firsts.astype(np.int64), counts) + runs.pixels
    window = slice(box[1], box[3]), slice(box[0], box[2])
    short = behind[window].reshape(-1)[pixel] - depths[owner]
    before = mask[window].reshape(-1)[pixel] & (short > _SETTLED * reach) & (runs.weights > _LEAST_LIGHT)
    before &= short <= reach
    needed = np.zeros(len(scene))
    np.maximum.at(needed, owner[before], short[before])
    moved = np.nonzero(needed)[0]
    return torch.from_numpy(moved), torch.from_numpy(1.0 + needed[moved] / depths[moved])


def _thickness(scene: Gaussians, camera: Camera, mask: NDArray[np.bool_]) -> float:
    """Typical standard deviation of the depths at which light is taken, world units, a pixel at least."""
    axis = camera.viewmat[2].double()
    depths = scene.means.double() @ axis[:3] + axis[3]
    z = (depths - depths.median()).float()
    colors = torch.stack([z, z.square(), torch.ones_like(z)], dim=1)
    mean, square, total = render(scene, camera, (0.0, 0.0, 0.0), colors=colors).image[mask].double().unbind(1)
    variance = square / total - (mean / total).square()
    pixel = float(depths.median()) / float(camera.K[0, 0])
    return max(pixel, float(variance.clamp_min(0.0).sqrt().median()))


def _move_back(scene: Gaussians, camera: Camera, rows: Tensor, factors: Tensor) -> Gaussians:
    """The scene with rows scaled about the camera's center, which leaves their outlines as they are."""
    position = camera.position.double()
    means = position + factors[:, None] * (scene.means[rows].double() - position)
    log_scales = scene.log_scales[rows].double() + factors.log()[:, None]
    return replace(
        scene,
        means=scene.means.index_copy(0, rows, means.float()),
        log_scales=scene.log_scales.index_copy(0, rows, log_scales.float()),
    )


def faint(added: Gaussians) -> Gaussians:
    """Added rows as they are at strength 0."""
    return replace(added, logit_opacities=torch.full((len(added),), ADDED_LOGIT))
