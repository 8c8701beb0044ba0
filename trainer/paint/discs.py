"""Conversion of painted pixels to thin discs on the surface, and projection of paint to other cameras.

Splats are drawn in the order of their centers. A large Gaussian with a nearer center than a disc covers the
disc, even where the surface of the Gaussian lies behind it. Such a Gaussian is moved back along its ray and
grows with the distance, which preserves its outline in the painted view (docs/method.md 3).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import csr_array
from torch import Tensor
from torch.nn.functional import grid_sample

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.gdf.file import ADDED_LOGIT
from progdf.quaternions import matrix_quats
from progdf.rasterize.cpu.weights import ListedWeights
from progdf.rasterize.engines import activate, color_map, render_depth
from progdf.sh import rgb_to_sh0
from progdf.surface.find import MIN_COSINE, PaintSurface, light_thickness
from progdf.system.equality import equal_fields

Array = NDArray[np.float64]

DISC_LOGIT = 4.0
"""Opacity logit of a disc at strength 1."""
MIN_ALPHA = 1 / 255
"""Minimum alpha of a painted pixel."""
BORDER_PX = 2
"""Pixels; width of the border around the paint that discs reproduce unchanged.

The border is needed because Gaussians drawn there were moved.
"""

# Sides of the rectangles that share a disc, pixels. Splats are drawn in the order of their centers. From
# aside, larger discs would cut through discs of other layers and through the Gaussians behind them.
_CELL_SIDES_PX = (4, 2, 1)
_PIXEL_SPREAD = 0.28  # standard deviation of a single pixel's disc, in pixels
_MERGED_SPREAD = 0.6  # standard deviation of a merged rectangle's disc, as a share of its sides
_COVER_SPREADS = (0.56, 0.7)  # both spreads, for discs with nothing behind them
# pixels²; part of the engine's blur (0.3) that counts as an error of a disc; the solved colors undo the rest
_BLUR_PX2 = 0.1
_DEPTH_OFFSET_PX = 0.5  # pixels; discs lie deeper by this, as nearer neighbors cover them
_RELIEF_PX = 1.25  # pixels per unit of color; discs lie deeper than darker neighbors, see `_rise_beside`
_THICKNESS_PX = 0.1  # pixels; standard deviation across the disc
_MIN_LIGHT = 0.005  # blending weight in a pixel; Gaussians with less need not move
# Gaussians within this many standard deviations of the blended depth belong to the surface
_REACH_DEVIATIONS = 4.0
# share of the reach; a Gaussian that needs to move by less is already behind, apart from rounding
_SETTLED_SHARE = 1e-3
_MAX_CLEARING_ROUNDS = 12  # maximum number of rounds that move occluding Gaussians behind the discs
_MARGIN_PX = 16  # pixels; margin around the paint in which the surface is evaluated
_MAX_GRID_POINTS = 20_000  # maximum number of surface points for projection; the surface is flat between them
# thicknesses of the light within a pixel; Gaussians this far in front of the paint belong to its surface
_SAME_SURFACE_THICKNESSES = 2.0
_NEWTON_STEPS = 8  # Newton steps per pixel of the projection


@dataclass(frozen=True)
class PaintedView:
    """Painted view that surface discs have to reproduce."""

    __eq__ = equal_fields

    camera: Camera
    picture: Tensor  # painted view over the run's background. [H,W,3] 0..1
    drawn: Tensor  # paint on the surface: premultiplied colors and alpha. [H,W,4]
    surface: PaintSurface  # surface under the paint

    @property
    def mask(self) -> Tensor:
        """Changed pixels. [H,W] bool"""
        return self.drawn[..., 3] > MIN_ALPHA


@dataclass(frozen=True)
class Discs:
    """Surface discs to add, and the rows of the scene that are moved behind them."""

    __eq__ = equal_fields

    added: Gaussians  # state at strength 1
    rim: Tensor  # share of each disc that lies beside the paint, 0 to 1. [B]
    moved: Tensor  # rows of the scene that had to move, ascending. [M] int64
    scene: Gaussians  # scene with these rows moved


def place_discs(
    scene: Gaussians, paint: PaintedView, flat: float, gap: float, cleared: Gaussians | None = None
) -> Discs:
    """Return discs for the painted pixels of the opaque surface and a narrow border around them.

    Args:
        scene: the original
        paint: see `PaintedView`
        flat: maximum root mean square color error of one disc over its pixels, 0..1
        gap: distance in pixels between a disc and the Gaussians moved behind it. The moved Gaussians are wide
            and therefore also visible from the side
        cleared: the scene after the moves for other paint
    """
    camera = paint.camera
    cleared = scene if cleared is None else cleared
    surface = paint.surface
    opaque = surface.opaque
    mask = ndimage.binary_dilation(paint.mask.numpy() & opaque, iterations=BORDER_PX) & opaque
    if not mask.any():
        return Discs(scene[:0], torch.zeros(0), torch.zeros(0, dtype=torch.int64), cleared)
    cells = merge_pixels(paint.picture.numpy(), mask, flat, surface.is_continuous)
    added, depths = _discs(cells, surface, paint.picture)
    added = _like(added, scene)
    behind = surface.depth + (_DEPTH_OFFSET_PX + gap) * float(np.median(depths)) / float(camera.K[0, 0])
    reach = float((behind - surface.depth).max()) + _REACH_DEVIATIONS * surface.thickness
    moved = torch.zeros(len(scene), dtype=torch.bool)
    for _ in range(_MAX_CLEARING_ROUNDS):  # Gaussians behind the moved ones become visible
        rows, factors = _rows_before(cleared, camera, behind, mask, reach, surface.pieces)
        if not len(rows):
            break
        cleared = _move_back(cleared, camera, rows, factors)
        moved = moved.index_fill(0, rows, True)
    return Discs(added, _share_beside(cells, paint.drawn[..., 3]), moved.nonzero()[:, 0], cleared)


def cover_pixels(
    scene: Gaussians, surface: PaintSurface, picture: Tensor, mask: NDArray[np.bool_], flat: float
) -> Gaussians:
    """Return discs that show pixels of a picture on its surface, wide enough to leave no gap between them.

    No row of the scene moves.

    Args:
        scene: scene from which the number of SH bands, the filter and the origin are taken
        surface: surface of the picture, in its camera
        picture: colors to show, 0 to 1. [H,W,3]
        mask: pixels to cover, at least one. [H,W]
        flat: see `place_discs`
    """
    cells = merge_pixels(picture.numpy(), mask, flat, surface.is_continuous)
    return _like(_discs(cells, surface, picture, _COVER_SPREADS)[0], scene)


def _like(added: Gaussians, scene: Gaussians) -> Gaussians:
    """Return discs with the SH bands, the filter and the origin of a scene."""
    bands = torch.zeros(len(added), *scene.shN.shape[1:])
    return replace(added, shN=bands, antialiased=scene.antialiased, origin=scene.origin)


def merge_pixels(
    picture: NDArray[np.float32], mask: NDArray[np.bool_], flat: float, even: NDArray[np.bool_]
) -> Array:
    """Merge pixels into rectangles that one disc reproduces well enough, the largest first.

    A disc is round and reaches beyond its rectangle. Its error is counted over that whole area.

    Args:
        picture: [H,W,3]
        mask: pixels to cover, each once. [H,W]
        flat: maximum root mean square color error over the rectangle's pixels
        even: pixels that may share a disc with neighbors. [H,W]

    Returns:
        column and row of the centers and both sides, in pixels. [B,4]
    """
    rows, columns = np.nonzero(mask)
    reach = 3 * _CELL_SIDES_PX[0]
    top = max(0, rows.min() - reach)
    left = max(0, columns.min() - reach)
    window = slice(top, rows.max() + reach + 1), slice(left, columns.max() + reach + 1)
    free = mask[window].copy()
    image = picture[window].astype(np.float64)
    cells = list[tuple[float, float, int, int]]()
    for height, width in _shapes():
        fits = free
        if height * width > 1:
            fits = (
                _box_means((free & even[window]).astype(float)[..., None], height, width)[..., 0] > 1 - 1e-9
            )
            if fits.any():
                fits &= _disc_error(image, height, width) <= flat**2
        for y, x in zip(*np.nonzero(fits), strict=True):
            if free[y : y + height, x : x + width].all():
                free[y : y + height, x : x + width] = False
                cells.append((left + x + 0.5 * width, top + y + 0.5 * height, width, height))
    return np.array(cells)


def _shapes() -> Iterator[tuple[int, int]]:
    """Yield height and width of rectangles, the largest and squarest first."""
    shapes = ((a, b) for a in _CELL_SIDES_PX for b in _CELL_SIDES_PX)
    yield from sorted(shapes, key=lambda s: (-s[0] * s[1], abs(s[0] - s[1]), s))


def _box_means(values: Array, height: int, width: int) -> Array:
    """Return the means of the rectangles with their top left at each pixel; values beyond the border are 0.

    [H,W,C] -> [H,W,C]
    """
    rows, columns = values.shape[:2]
    sums = np.pad(values, ((1, height), (1, width), (0, 0))).cumsum(axis=0).cumsum(axis=1)
    low = sums[:rows]
    high = sums[height : height + rows]
    right = slice(width, width + columns)
    boxes = high[:, right] - low[:, right] - high[:, :columns] + low[:, :columns]
    return cast(Array, boxes / (height * width))


def _disc_error(image: Array, height: int, width: int) -> Array:
    """Return the mean squared error of discs for the rectangles with their top left at each pixel.

    A disc has the mean color of its rectangle.

    [H,W,3] -> [H,W]
    """
    spread = [
        ((_MERGED_SPREAD * side if side > 1 else _PIXEL_SPREAD) ** 2 + _BLUR_PX2) ** 0.5 / 2**0.5
        for side in (height, width)
    ]
    rows, columns = image.shape[:2]
    padded = np.pad(image, ((0, height), (0, width), (0, 0)), mode="edge")
    color = _box_means(padded, height, width)[:rows, :columns]
    weighed = ndimage.gaussian_filter(
        np.concatenate([padded, (padded**2).sum(axis=2, keepdims=True)], axis=2),
        (*spread, 0.0),
        mode="nearest",
        truncate=4.0,
    )
    y = slice(height // 2, height // 2 + rows)
    x = slice(width // 2, width // 2 + columns)
    above = slice((height - 1) // 2, (height - 1) // 2 + rows)
    before = slice((width - 1) // 2, (width - 1) // 2 + columns)
    seen = 0.25 * (weighed[y, x] + weighed[above, x] + weighed[y, before] + weighed[above, before])
    # the weights of the blur add up to 1, those of a disc to 2π times both standard deviations
    area = 2 * np.pi * spread[0] * spread[1] / (height * width)
    return cast(Array, area * (seen[..., 3] + (color * (color - 2 * seen[..., :3])).sum(axis=2)) / 3)


def _discs(
    cells: Array,
    surface: PaintSurface,
    picture: Tensor,
    spreads: tuple[float, float] = (_PIXEL_SPREAD, _MERGED_SPREAD),
) -> tuple[Gaussians, Array]:
    """Return discs that fill cells of the picture on its surface, and their depths. [B,4] and [H,W,3]

    `spreads`: standard deviation along a side of one pixel, pixels; and along a longer side, as its share
    """
    camera = surface.camera
    x, y, width, height = cells.T
    K = camera.K.double().numpy()
    c2w = camera.c2w.double().numpy()
    focal = np.array([K[0, 0], K[1, 1]])
    middle = K[:2, 2]

    slopes = surface.slopes[:, y.astype(np.int64), x.astype(np.int64)]  # not blended across an edge
    rays = np.stack([*((np.stack([x, y], 1) - middle) / focal).T, np.ones_like(x)], axis=1)
    depth = ndimage.map_coordinates(surface.depth, [y - 0.5, x - 0.5], order=1, mode="nearest")
    pixel = depth / focal[0]
    placed = depth + (_DEPTH_OFFSET_PX + _RELIEF_PX * _rise_beside(cells, picture)) * pixel
    right, down = (_step(rays, depth, slope, axis, focal) for axis, slope in enumerate(slopes))
    normal = np.cross(right, down)
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    is_steep = np.abs((normal * rays).sum(axis=1, keepdims=True)) < MIN_COSINE * length
    normal = np.where(is_steep, rays / length, normal)
    sides = []  # steps in the disc's plane that span one cell in the picture
    for axis, side in enumerate((width, height)):
        step = np.zeros_like(rays)
        step[:, axis] = placed / focal[axis]
        step -= rays * ((normal * step).sum(axis=1) / (normal * rays).sum(axis=1))[:, None]
        sides.append(step * (side * np.where(side > 1, spreads[1], spreads[0]))[:, None])
    axes, scales, _ = np.linalg.svd(np.stack(sides, axis=2), full_matrices=True)
    axes[:, :, 2] *= np.linalg.det(axes)[:, None]
    means = (rays * placed[:, None]) @ c2w[:3, :3].T + c2w[:3, 3]
    color = picture[torch.from_numpy(y.astype(np.int64)), torch.from_numpy(x.astype(np.int64))]
    discs = Gaussians(
        torch.from_numpy(means).float(),
        matrix_quats(torch.from_numpy(c2w[:3, :3] @ axes)).float(),
        torch.from_numpy(np.log(np.concatenate([scales, _THICKNESS_PX * pixel[:, None]], axis=1))).float(),
        torch.full((len(x),), DISC_LOGIT),
        rgb_to_sh0(color),
        torch.zeros(len(x), 0, 3),
    )
    return discs, placed


def _share_beside(cells: Array, alpha: Tensor) -> Tensor:
    """Return one minus the mean alpha of the paint over each cell. [B,4], [H,W] -> [B] float32"""
    low, high = ((cells[:, :2] + side * cells[:, 2:]).astype(int) for side in (-0.5, 0.5))
    paint = alpha.double().numpy()
    boxes = zip(low.tolist(), high.tolist(), strict=True)
    means = [paint[top:bottom, left:right].mean() for (left, top), (right, bottom) in boxes]
    levels = (255 * (1.0 - torch.tensor(means, dtype=torch.float32))).round()  # as stored
    return levels / 255


def _rise_beside(cells: Array, picture: Tensor) -> Array:
    """Return how much brighter each cell is than the darkest adjacent pixel: the maximum over its pixels.

    [B] 0..1

    The engine draws no disc smaller than about one pixel. At a color edge, light that the nearer disc adds to
    its neighbor can be subtracted from the neighbor's own color only if the nearer disc is the darker one, as
    no color is below black.
    """
    brightness = picture.mean(dim=2).double().numpy()
    rise = brightness - ndimage.minimum_filter(brightness, 3)
    low, high = ((cells[:, :2] + side * cells[:, 2:]).astype(int) for side in (-0.5, 0.5))
    boxes = zip(low.tolist(), high.tolist(), strict=True)
    return np.array([rise[top:bottom, left:right].max() for (left, top), (right, bottom) in boxes])


def _step(rays: Array, depth: Array, slope: Array, axis: int, focal: Array) -> Array:
    """Return the step of one pixel on the surface. [B,3]"""
    step = rays * slope[:, None]
    step[:, axis] += depth / focal[axis]
    return step


def _rows_before(
    scene: Gaussians,
    camera: Camera,
    behind: Array,
    mask: NDArray[np.bool_],
    reach: float,
    pieces: NDArray[np.int64],
) -> tuple[Tensor, Tensor]:
    """Return surface rows with centers in front of the depths `behind` [H,W], and their depth factors.

    Gaussians more than `reach` (world units) in front stay, as they occlude the paint like the surface.
    Gaussians with most of their weight in another one of the surface's `pieces` [H,W] stay too, even if they
    extend across the edge between the pieces.

    Returns:
        indices [M] int64; factors by which their depths grow [M]
    """
    rows, columns = np.nonzero(mask)
    box = (
        max(0, int(columns.min()) - _MARGIN_PX),
        max(0, int(rows.min()) - _MARGIN_PX),
        min(camera.width, int(columns.max()) + _MARGIN_PX + 1),
        min(camera.height, int(rows.max()) + _MARGIN_PX + 1),
    )
    listed = color_map(activate(scene), camera, box, torch.arange(len(scene)))
    if not isinstance(listed, ListedWeights):
        raise TypeError("place_discs needs the weight lists of the CPU engine")
    axis = camera.viewmat[2]
    depths = (scene.means.double() @ axis[:3].double() + axis[3].double()).numpy()
    owner, pixel, weights = listed.entries()
    window = slice(box[1], box[3]), slice(box[0], box[2])
    piece = pieces[window].reshape(-1)[pixel]
    missing = behind[window].reshape(-1)[pixel] - depths[owner]
    is_before = mask[window].reshape(-1)[pixel] & (missing > _SETTLED_SHARE * reach) & (weights > _MIN_LIGHT)
    is_before &= (missing <= reach) & (piece == _main_pieces(owner, piece, weights, len(scene))[owner])
    needed = np.zeros(len(scene))
    np.maximum.at(needed, owner[is_before], missing[is_before])
    moved = np.nonzero(needed)[0]
    return torch.from_numpy(moved), torch.from_numpy(1.0 + needed[moved] / depths[moved])


def _main_pieces(
    owner: NDArray[np.int32], piece: NDArray[np.int64], weights: NDArray[np.float32], count: int
) -> NDArray[np.int64]:
    """Return the piece of the surface in which each row has most weight. -> [N]"""
    size = (count, int(piece.max()) + 1)
    sums = csr_array((weights, (owner, piece)), shape=size).tocoo()  # one entry per row and piece
    by_weight = np.lexsort((-sums.col, sums.data))
    main = np.zeros(count, np.int64)
    main[sums.row[by_weight]] = sums.col[by_weight]  # the largest weight is written last
    return main


def _move_back(scene: Gaussians, camera: Camera, rows: Tensor, factors: Tensor) -> Gaussians:
    """Return the scene with rows scaled about the camera's center, which preserves their outlines."""
    position = camera.position.double()
    means = position + factors[:, None] * (scene.means[rows].double() - position)
    log_scales = scene.log_scales[rows].double() + factors.log()[:, None]
    return replace(
        scene,
        means=scene.means.index_copy(0, rows, means.float()),
        log_scales=scene.log_scales.index_copy(0, rows, log_scales.float()),
    )


def faint(added: Gaussians) -> Gaussians:
    """Return added rows with their opacity at strength 0."""
    return replace(added, logit_opacities=torch.full((len(added),), ADDED_LOGIT))


def sample_image(image: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Sample an image bilinearly, 0 outside. [H,W,C], pixels [h,w] each -> [h,w,C]"""
    grid = torch.stack([2 * x / image.shape[1] - 1, 2 * y / image.shape[0] - 1], dim=-1)[None].float()
    return grid_sample(image.permute(2, 0, 1)[None], grid, align_corners=False)[0].permute(1, 2, 0)


def composite_over(image: Tensor, drawn: Tensor) -> Tensor:
    """Composite premultiplied colors and alpha over a picture. [H,W,3], [H,W,4] -> [H,W,3]"""
    return image * (1.0 - drawn[..., 3:]) + drawn[..., :3]


def cover_view(image: Tensor, below: Tensor | None, drawn: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Composite paint over a view; return the picture and its painted pixels.

    Args:
        image: view of the scene. [H,W,3]
        below: picture that is visible under the paint and the border of its discs; None for `image`. [H,W,3]
        drawn: paints as premultiplied colors and alpha, the lowest first. [H,W,4] each

    Returns:
        [H,W,3] and [H,W] bool
    """
    covered = torch.zeros(image.shape[:2], dtype=torch.bool)
    for paint in drawn:
        covered = covered | (paint[..., 3] > 0)
    if below is not None:
        grown = torch.from_numpy(ndimage.binary_dilation(covered.numpy(), iterations=BORDER_PX))
        image = torch.where(grown[..., None], below, image)
    for paint in drawn:
        image = composite_over(image, paint)
    return image, covered


def project_paint(scene: Gaussians, under: PaintSurface, drawn: Tensor, camera: Camera) -> Tensor:
    """Project paint from its surface to another camera.

    Args:
        scene: scene with the surface
        under: the surface, as the camera of the painted picture sees it
        drawn: premultiplied colors and alpha. [H,W,4]
        camera: the other camera

    Returns:
        premultiplied colors and alpha at the other camera's size. [h,w,4]
    """
    own = under.camera
    result = torch.zeros(camera.height, camera.width, 4)
    rows, columns = (drawn[..., 3] > 0).nonzero().T.numpy()
    if not len(rows):
        return result
    left = max(0, columns.min() - _MARGIN_PX)
    top = max(0, rows.min() - _MARGIN_PX)
    right = min(own.width, columns.max() + _MARGIN_PX + 1)
    bottom = min(own.height, rows.max() + _MARGIN_PX + 1)
    surface = under.depth[top:bottom, left:right]
    step = max(1, round(math.sqrt(surface.size / _MAX_GRID_POINTS)))
    y, x = np.mgrid[: surface.shape[0] : step, : surface.shape[1] : step]
    K = own.K.double().numpy()
    other_K = camera.K.double().numpy()
    z = surface[y, x]
    y = y + top + 0.5
    x = x + left + 0.5
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1)
    to_other = (camera.viewmat.double() @ torch.linalg.inv(own.viewmat.double())).numpy()
    points = (rays * z[..., None]) @ to_other[:3, :3].T + to_other[:3, 3]
    front = points[..., 2] > camera.near
    depth = np.where(front, points[..., 2], 1.0)
    u, v = (points[..., i] / depth * other_K[i, i] + other_K[i, 2] for i in (0, 1))
    if min(surface[::step, ::step].shape) < 2:
        return result
    uy, ux = np.gradient(u)
    vy, vx = np.gradient(v)
    front &= ux * vy - uy * vx > 0  # surfaces that face away are hidden by those that face the camera
    if front.sum() < 3 or np.ptp(u[front]) < 1e-6 or np.ptp(v[front]) < 1e-6:
        return result
    box = [int(max(0.0, edge.min() - 1)) for edge in (u[front], v[front])]
    box += [
        int(min(size, edge.max() + 2)) for size, edge in ((camera.width, u[front]), (camera.height, v[front]))
    ]
    if box[0] >= box[2] or box[1] >= box[3]:
        return result
    rows, columns = np.mgrid[box[1] : box[3], box[0] : box[2]] + 0.5
    maps = np.stack([u, v, ux, uy, vx, vy, x, y, depth, front.astype(float)])
    positions = torch.from_numpy(_invert(maps, columns, rows))
    window = (box[0], box[1], box[2], box[3])
    front_depth = render_depth(scene, camera, crop=window).depth
    is_painted = (positions[..., 2] > 0).numpy()
    if not is_painted.any():
        return result
    thickness = light_thickness(scene, camera, is_painted, window)
    visible = positions[..., 2] <= front_depth + _SAME_SURFACE_THICKNESSES * thickness
    projected = sample_image(drawn, positions[..., 0], positions[..., 1])
    result[box[1] : box[3], box[0] : box[2]] = projected * visible[..., None]
    return result


def _invert(maps: Array, columns: Array, rows: Array) -> Array:
    """Invert a grid of projected points at some pixels by Newton steps; −1e6 in pixels without a point.

    Args:
        maps: projection u and v of each point; their derivatives to the right and down, ux, uy, vx, vy;
            three values; and a flag for valid points. [10,I,J]
        columns, rows: pixels. [h,w] each

    Returns:
        the three values at the pixels. [h,w,3]
    """
    u = maps[0]
    v = maps[1]
    front = maps[-1] > 0
    size = np.array(u.shape)[:, None, None]
    projected = np.stack([u[front], v[front], np.ones(front.sum())], axis=1)
    start = np.linalg.lstsq(projected, np.stack(np.nonzero(front), axis=1).astype(float), rcond=None)[0]
    position = np.moveaxis(np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ start, -1, 0)
    for _ in range(_NEWTON_STEPS):
        position = position.clip(-0.5, size - 0.5)
        u, v, ux, uy, vx, vy = (
            ndimage.map_coordinates(one, position, order=1, mode="nearest") for one in maps[:6]
        )
        right = columns - u
        down = rows - v
        area = ux * vy - uy * vx
        area = np.where(np.abs(area) > 1e-9, area, 1e-9)
        step = np.stack([ux * down - vx * right, vy * right - uy * down]) / area
        position = position + step.clip(-0.1 * size, 0.1 * size)
    position = position.clip(-0.5, size - 0.5)
    values = np.stack([ndimage.map_coordinates(one, position, order=1, mode="nearest") for one in maps])
    is_outside = np.hypot(values[0] - columns, values[1] - rows) > 0.5
    return cast(
        Array, np.where((is_outside | (values[-1] < 0.5))[..., None], -1e6, np.moveaxis(values[6:9], 0, -1))
    )
