"""Hole filling: areas that a removed object hides in every view are closed with surface discs.

A hole in a view is a connected component of pixels of the object without an opaque background, and with an
opaque boundary. An object in front of an empty background leaves no hole. Alpha, inverse depth and color,
weighted by alpha, are continued from the boundary as a membrane (∇² = 0, which the inverse depth of a plane
fulfills). No point of a hole may lie where some view showed another surface, or empty space, before the
removal.

The view with the largest hole is filled with discs, then that with the largest remaining one, until all holes
are small. Views with a given picture come first.

If the ground around a hole has visible texture, the texture continues (`trainer.fill.ground`,
`trainer.fill.texture`). Otherwise, and without the extra `fill`, the membrane closes the hole.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians, concatenate
from progdf.quaternions import matrix_quats
from progdf.rasterize.engines import render, render_depth
from progdf.region import Region
from progdf.sh import rgb_to_sh0, sh0_to_rgb
from progdf.system.equality import equal_fields
from progdf.system.packages import install_extra
from progdf.threads import map_threads
from trainer.paint.discs import cover_pixels
from trainer.paint.solve import ExpectedView, solve_colors
from trainer.views.view import (
    BACKGROUND,
    View,
    crop,
    region_box,
    render_colors,
    render_view,
)

from .ground import REACH_PX, RING_SHARE, Ground, view_ground
from .membrane import membrane
from .texture import (
    VISIBLE_CONTRAST,
    area_to_fill,
    can_continue_texture,
    continue_texture,
    texture_contrast,
)

_OPAQUE = 0.9  # alpha of an opaque boundary pixel; also the minimum share of such pixels in a boundary
_MIN_REGION_WEIGHT = 0.05  # weight of the region in a removed pixel; its soft edge occludes too
_BLOCKS = (8, 4, 2, 1)  # side of a disc's square in pixels, as large as the colors allow
_COLOR_TOLERANCE = 2 / 255  # maximum color range within a disc
_WIDTH = 0.7  # standard deviation of a disc, as a share of the side
_THICKNESS = 0.1  # thickness of a disc, as a share of its width
_OPACITY_LOGIT = 5.0  # opacity logit of a disc
_MIN_COSINE = 0.3  # limits the stretching of slanted discs
_MIN_HOLE_SHARE = 0.01  # share of the region's pixels; smaller holes are irregularities of the boundary
_FLAT_SHARE = 0.1  # maximum color error of one disc of a texture, as a share of the texture's contrast
_CLAMP_PX = 3  # pixels; a disc's color stays in the range of the texture's colors in this window
_MAX_VIEWS = 12  # maximum number of views whose holes become discs


Front = tuple[Camera, Tensor, Tensor]
"""Camera of a view; visible depth (camera z, infinite without a surface); mask of the region. [H,W] each"""


@dataclass(frozen=True)
class Hole:
    """Hole in one view, with the surface continued from its boundary."""

    __eq__ = equal_fields

    camera: Camera
    mask: Tensor  # [H,W] bool
    inverse_depth: Tensor  # 1 / camera z, inside the mask and around it; 0 elsewhere. [H,W]

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return int(self.mask.sum())


@dataclass(frozen=True)
class OpenHoles:
    """Holes that a removal opens, before they are filled."""

    rest: Gaussians  # the remaining scene
    views: Sequence[View]  # views of the original with the removed region's mask
    seen: Sequence[Front]  # depth of these views before the removal
    holes: Sequence[Hole]  # hole in each view


@dataclass(frozen=True)
class Fill:
    """Result of filling the holes."""

    rows: Gaussians | None  # opaque discs at strength 1; None if there is no hole
    views: int  # number of views with discs
    before: int  # pixels of holes in all views
    after: int  # remaining pixels of holes in all views
    notes: tuple[str, ...] = ()  # lines for the log


def _ignore() -> None:
    """Do nothing at a step of the progress."""


def find_holes(
    scene: Gaussians,
    rest: Gaussians,
    views: Sequence[View],
    depths: Sequence[Tensor] | None = None,
    looked: Callable[[], object] = _ignore,
) -> OpenHoles:
    """Find the holes that a removal opens.

    Args:
        scene: the original
        rest: the remaining scene
        views: views of the original with the removed region's mask; only areas hidden in all of them are
            holes
        depths: `visible_depth` of the scene in each view; None computes it. [H,W] each
        looked: called after each view, in any thread, for a progress bar
    """
    if not len(rest):
        return OpenHoles(rest, (), (), ())
    if depths is None:
        depths = map_threads(lambda view: visible_depth(scene, view.camera), views)
    seen = [(view.camera, depth, view.mask > 0.5) for view, depth in zip(views, depths, strict=True)]

    def look(view: View) -> Hole:
        hole = find_hole(rest, view, seen)
        looked()
        return hole

    return OpenHoles(rest, views, seen, map_threads(look, views))


def fill_holes(
    opened: OpenHoles,
    pictures: Mapping[str, Tensor] | None = None,
    close: bool = True,
    is_textured: bool = False,
    looked: Callable[[], object] = _ignore,
) -> Fill:
    """Close the holes of a removal.

    Args:
        opened: the holes
        pictures: by view name, pictures of the finished edit, whose colors the discs take instead of those of
            the boundary. [H,W,3]
        close: False only counts the holes
        is_textured: continue the texture of the ground if it is visible
        looked: called after each further look at a view, in any thread, for a progress bar
    """
    picture_colors = pictures or {}
    views = opened.views
    holes = list(opened.holes)
    before = sum(hole.pixels for hole in holes)
    filled = opened.rest
    discs = list[Gaussians]()
    notes = list[str]()
    min_pixels = [_MIN_HOLE_SHARE * float((view.mask > _MIN_REGION_WEIGHT).sum()) for view in views]
    open_views = {i for i, hole in enumerate(holes) if close and hole.pixels > min_pixels[i]}
    while open_views and len(discs) < _MAX_VIEWS:
        # views with a given picture come first, as their colors are known
        best = max(open_views, key=lambda i: (views[i].camera.name in picture_colors, holes[i].pixels, -i))
        picture = picture_colors.get(views[best].camera.name)
        open_views.discard(best)
        for rows in _discs_for(opened, filled, holes[best], picture, is_textured, notes):
            trial = concatenate([filled, rows])
            closed = _holes_with(trial, opened, holes, looked)
            gain = sum(hole.pixels for hole in holes) - sum(hole.pixels for hole in closed)
            # discs off the surface open as many pixels in other views as they close
            if 2 * gain > holes[best].pixels:
                discs.append(rows)
                filled = trial
                holes = closed
                open_views = {i for i in open_views if holes[i].pixels > min_pixels[i]}
                break
    after = sum(hole.pixels for hole in holes)
    return Fill(concatenate(discs) if discs else None, len(discs), before, after, tuple(notes))


def _holes_with(
    trial: Gaussians, opened: OpenHoles, holes: Sequence[Hole], looked: Callable[[], object]
) -> list[Hole]:
    """Return the holes that remain with added discs; views without a hole have none.

    Args:
        trial: the remaining scene with the discs
        opened: the holes before
        holes: the holes of the last accepted discs
        looked: called after each look at a view
    """

    def look(index: int) -> Hole:
        if not holes[index].pixels:
            return holes[index]
        hole = find_hole(trial, opened.views[index], opened.seen)
        looked()
        return hole

    return map_threads(look, range(len(holes)))


def _discs_for(
    opened: OpenHoles,
    filled: Gaussians,
    hole: Hole,
    picture: Tensor | None,
    is_textured: bool,
    notes: list[str],
) -> Iterator[Gaussians]:
    """Yield discs that fill a hole, the best first: with texture if requested and visible, then smooth ones.

    Args:
        opened: the holes
        filled: the remaining scene with the discs so far
        hole: the hole to fill
        picture: colors of the view, which replace those of the boundary; None if not given. [H,W,3]
        is_textured: continue the texture of the ground
        notes: lines for the log, to which one is added
    """
    if is_textured and picture is None:
        textured, note = _textured_discs(filled, hole, opened.seen)
        if note:
            notes.append(note)
        if textured is not None:
            yield textured
    colors = continued_colors(opened.rest, hole) if picture is None else picture
    yield place_discs(hole, opened.rest, colors)


def _textured_discs(rest: Gaussians, hole: Hole, seen: Sequence[Front]) -> tuple[Gaussians | None, str]:
    """Return discs that continue the texture around a hole, and a line for the log.

    There are no discs if the ground has no visible texture or is too little visible, or without the extra
    `fill`.
    """
    unseen = partial(_unseen, seen=seen, own=hole.camera)
    ground = view_ground(rest, hole.camera, hole.mask, hole.inverse_depth, unseen)
    if ground is None:
        return None, ""
    contrast = texture_contrast(ground.image, ground.hole, ground.known)
    height, width = ground.hole.shape
    about = f"ground around the hole: {ground.name}, texture contrast {contrast:.3f} in OKLab"
    if contrast < VISIBLE_CONTRAST:
        return None, f"{about} (not visible below {VISIBLE_CONTRAST}): filled smoothly"
    clean = ground.known & ~area_to_fill(ground.hole, ground.known)
    if clean.sum() < ground.hole.sum():
        return None, f"{about}: filled smoothly, as less of the ground is visible than is missing"
    if not can_continue_texture():
        return None, f"{about}: filled smoothly; to continue the texture, {install_extra('fill')}"
    picture = continue_texture(ground.image, ground.hole, ground.known)
    rows = _lay_texture(ground, picture, _FLAT_SHARE * contrast)
    return rows, f"{about}: continued over {int(ground.hole.sum())} of {width}x{height} pixels"


def _lay_texture(ground: Ground, picture: Tensor, flat: float) -> Gaussians:
    """Return discs that show the continued texture, with the colors that reproduce it.

    Args:
        ground: see `Ground`
        picture: its texture with the hole filled. [H,W,3]
        flat: maximum root mean square color error of one disc, sRGB 0 to 1
    """
    eye = ground.camera
    area = area_to_fill(ground.hole, ground.known)
    mask = torch.from_numpy(area)
    discs = cover_pixels(ground.rows, ground.surface, picture, area, flat)
    around = render_view(ground.rows, eye, torch.tensor(BACKGROUND))
    expected = torch.where(mask[..., None], picture, around)
    view = ExpectedView(eye, 0.0, expected, mask, mask)
    nothing = torch.zeros(0)
    solved = solve_colors(ground.rows, nothing.long(), discs, [view], nothing)[1]
    # discs at the edge are partly hidden, so their solution may exceed the colors of the texture
    places = solved.means @ eye.viewmat[:3, :3].T + eye.viewmat[:3, 3]
    columns, rows = (places @ eye.K.T / places[:, 2:])[:, :2].long().unbind(1)
    at = rows.clamp(0, eye.height - 1), columns.clamp(0, eye.width - 1)
    window = (_CLAMP_PX, _CLAMP_PX, 1)
    low = torch.from_numpy(ndimage.minimum_filter(picture.numpy(), window))[at]
    high = torch.from_numpy(ndimage.maximum_filter(picture.numpy(), window))[at]
    colors = sh0_to_rgb(solved.sh0).clamp(low, high)
    return replace(solved, sh0=rgb_to_sh0(colors))


def find_hole(rest: Gaussians, view: View, seen: Sequence[Front]) -> Hole:
    """Return the hole in a view where the region was; see the module docstring.

    Args:
        rest: the remaining scene
        view: view of the original with the removed region's mask
        seen: visible depth of all views before the removal
    """
    camera = view.camera
    removed = view.mask > _MIN_REGION_WEIGHT
    mask = torch.zeros_like(removed)
    depth = torch.zeros_like(view.mask)
    if not bool(removed.any()):
        return Hole(camera, mask, depth)
    # the boundary of a hole, and the ring around it in which `view_ground` fits a plane, lie inside the box
    margin = 2 + math.ceil(RING_SHARE * float(removed.sum()) ** 0.5)
    box = region_box(view.mask, margin, _MIN_REGION_WEIGHT)
    x0, y0, x1, y1 = box
    z = (rest.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]).clamp_min(camera.near)
    inverse = torch.stack([1.0 / z, torch.ones_like(z), torch.zeros_like(z)], dim=1)
    known = render_colors(rest, inverse, camera, torch.zeros(3), box)[..., :2]
    unknown = crop(removed, box) & (known[..., 1] < _OPAQUE)
    closed = _closed_pieces(unknown, known[..., 1])
    if not bool(closed.any()):
        return Hole(camera, mask, depth)
    surface = membrane(known, closed)
    inside = surface[..., 0] / surface[..., 1].clamp_min(1e-6)
    pixels = closed.nonzero() + torch.tensor([y0, x0])
    closed[closed.clone()] = _unseen(_unproject(camera, pixels, inside[closed]), seen, camera)
    mask[y0:y1, x0:x1] = closed
    depth[y0:y1, x0:x1] = inside
    return Hole(camera, mask, depth)


def continued_colors(rest: Gaussians, hole: Hole) -> Tensor:
    """Return the colors of a view, continued into a hole from its boundary. [H,W,3], 0 to 1"""
    camera = hole.camera
    with torch.no_grad():
        drawn = render(rest, camera, (0.0, 0.0, 0.0))
    alpha = (1.0 - drawn.transmittance)[..., None]
    surface = membrane(torch.cat([drawn.image, alpha], dim=2), hole.mask)
    return (surface[..., :3] / surface[..., 3:].clamp_min(1e-6)).clamp(0.0, 1.0)


def _closed_pieces(unknown: Tensor, alpha: Tensor) -> Tensor:
    """Return the pixels of the components of `unknown` that are holes. [H,W] bool

    A hole has an opaque boundary and at least one pixel with an alpha below 0.5.
    """
    pieces, count = ndimage.label(unknown.numpy(), np.ones((3, 3)))
    opaque = (alpha >= _OPAQUE).numpy()
    closed = np.zeros(count + 1, bool)
    for number, box in enumerate(ndimage.find_objects(pieces), 1):
        window = tuple(slice(max(0, side.start - 1), side.stop + 1) for side in box)
        piece = pieces[window] == number
        boundary = ndimage.binary_dilation(piece, np.ones((3, 3))) & ~piece
        # the soft edge of a surface may belong to a hole but is not one by itself
        is_open = bool((alpha[window].numpy()[piece] < 0.5).any())
        closed[number] = is_open and bool(boundary.any()) and opaque[window][boundary].mean() > _OPAQUE
    return torch.from_numpy(closed[pieces])


def place_discs(hole: Hole, like: Gaussians, colors: Tensor) -> Gaussians:
    """Return opaque discs on the surface of a hole, one per pixel, or per square of up to 8×8 pixels of equal
    color.

    Args:
        hole: see `Hole`
        like: scene that provides the number of SH bands and the origin
        colors: rgb, 0 to 1. [H,W,3]
    """
    parts = split_squares(hole.mask, colors)
    y, x, side = parts.double().unbind(1)
    camera = hole.camera
    middle = (parts[:, :2] + parts[:, 2:] // 2).long()
    fx, fy, cx, cy = (float(camera.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    rows, columns = middle.unbind(1)
    down, across = torch.gradient(hole.inverse_depth.double())
    rays = torch.stack([(x + side / 2 - cx) / fx, (y + side / 2 - cy) / fy, torch.ones_like(x)], dim=1)
    a = across[rows, columns] * fx
    b = down[rows, columns] * fy
    # inverse depth at the center of the disc, which lies between pixels if the side is even
    half = side / 2 - (parts[:, 2] // 2).double() - 0.5
    inverse = hole.inverse_depth.double()[rows, columns] + half * (a / fx + b / fy)
    z = 1.0 / inverse.clamp_min(1e-12)
    # for a plane n·P = 1, 1 / z = n·(x, y, 1)
    normals = torch.stack([a, b, inverse - a * rays[:, 0] - b * rays[:, 1]], dim=1)
    normals = torch.nn.functional.normalize(normals, dim=1)
    view_directions = torch.nn.functional.normalize(rays, dim=1)
    tangent = torch.linalg.cross(normals, view_directions)
    tangent = torch.where(
        tangent.norm(dim=1, keepdim=True) > 1e-6, tangent, torch.tensor([1.0, 0, 0]).double()
    )
    tangent = torch.nn.functional.normalize(
        torch.linalg.cross(normals, torch.linalg.cross(tangent, normals)), dim=1
    )
    frame = torch.stack([tangent, torch.linalg.cross(normals, tangent), normals], dim=2)
    width = _WIDTH * side * z / min(fx, fy)
    cosine = (normals * view_directions).sum(dim=1).abs().clamp_min(_MIN_COSINE)
    scales = torch.stack([width, width / cosine, _THICKNESS * width], dim=1)
    rotation = camera.viewmat[:3, :3].double().T
    means = (rays * z[:, None] - camera.viewmat[:3, 3].double()) @ rotation.T
    rgb = _square_means(parts, colors)
    count = len(parts)
    return Gaussians(
        means.float(),
        matrix_quats(rotation @ frame).float(),
        scales.log().float(),
        torch.full((count,), _OPACITY_LOGIT),
        rgb_to_sh0(rgb).float(),
        torch.zeros(count, like.shN.shape[1], 3),
        like.antialiased,
        like.origin,
    )


def _square_means(parts: Tensor, colors: Tensor) -> Tensor:
    """Return the mean color of each square, see `split_squares`. [P,3], [H,W,3] -> [P,3]"""
    means = colors.new_zeros(len(parts), 3)
    for length in _BLOCKS:
        own = parts[:, 2] == length
        steps = torch.arange(length)
        rows = parts[own, 0, None, None] + steps[:, None]
        columns = parts[own, 1, None, None] + steps
        means[own] = colors[rows, columns].mean(dim=(1, 2))
    return means


def split_squares(mask: Tensor, colors: Tensor) -> Tensor:
    """Return squares that tile a mask, as large as colors and edge allow: first row, first column, side.
    [P,3]"""
    depth = ndimage.distance_transform_cdt(np.pad(mask.numpy(), 1), "chessboard")[1:-1, 1:-1]
    free = mask.numpy().copy()
    parts = []
    for side in _BLOCKS:
        fits = _squares(free, side).all(axis=(2, 3))
        if side > 1:
            # a large disc extends beyond its square but must stay inside the hole
            fits &= _squares(depth > side // 2, side).all(axis=(2, 3))
            ranges = np.ptp(_squares(colors.numpy(), side), axis=(2, 3)).max(axis=2)
            fits &= ranges <= _COLOR_TOLERANCE
        found = np.argwhere(fits) * side
        parts.append(np.column_stack([found, np.full(len(found), side)]))
        taken = np.repeat(np.repeat(fits, side, axis=0), side, axis=1)
        free[: taken.shape[0], : taken.shape[1]] &= ~taken
    return torch.from_numpy(np.concatenate(parts).astype(np.int64))


def _squares(values: NDArray[Any], side: int) -> NDArray[Any]:
    """Return the whole squares of a grid. [H,W,...] -> [H//side,W//side,side,side,...]"""
    rows = values.shape[0] // side
    columns = values.shape[1] // side
    cut = values[: rows * side, : columns * side]
    return cut.reshape(rows, side, columns, side, *values.shape[2:]).swapaxes(1, 2)


def region_weight(scene: Gaussians, region: Region, camera: Camera) -> Tensor:
    """Return the blended weight of the region in a view, 0 to 1, see `View.mask`. [H,W]"""
    member = torch.zeros(len(scene), 1)
    member[region.members] = 1.0
    weights = member.expand(-1, 3).contiguous()
    return render_colors(scene, weights, camera, torch.zeros(3))[..., 0].clamp(0.0, 1.0)


def visible_depth(scene: Gaussians, camera: Camera) -> Tensor:
    """Return the depth of the visible surface, camera z in world units; infinite without one. [H,W]"""
    with torch.no_grad():
        drawn = render_depth(scene, camera)
    return drawn.depth.masked_fill(drawn.alpha <= 0.5, torch.inf)


def _unproject(camera: Camera, pixels: Tensor, inverse_depth: Tensor) -> Tensor:
    """Return the world points of rows and columns. [P,2], [P] -> [P,3] float64"""
    rows, columns = pixels.double().unbind(1)
    pixel_positions = torch.stack([columns + 0.5, rows + 0.5, torch.ones_like(rows)], dim=1)
    rays = pixel_positions @ torch.linalg.inv(camera.K.double()).T
    points = rays / inverse_depth.double().clamp_min(1e-12)[:, None]
    world: Tensor = (points - camera.viewmat[:3, 3].double()) @ camera.viewmat[:3, :3].double()
    return world


def _unseen(points: Tensor, seen: Sequence[Front], own: Camera) -> Tensor:
    """Return the points that no view showed, as a surface or as empty space, before the removal. [P] bool

    Such a point is outside every picture, or occluded by the region or a nearer surface. `own` is the camera
    from whose pixels the points were made: the tolerance is in its pixels.
    """
    unseen = torch.ones(len(points), dtype=torch.bool)
    reach = REACH_PX * (points - own.position.double()).norm(dim=1) / float(own.K[0, 0])
    for camera, front, region in seen:
        camera_points = points @ camera.viewmat[:3, :3].double().T + camera.viewmat[:3, 3].double()
        x, y, w = (camera_points @ camera.K.double().T).unbind(1)
        column = (x / w).floor()
        row = (y / w).floor()
        framed = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        index = (framed & (w > camera.near)).nonzero()[:, 0]
        pixel = row[index].long(), column[index].long()
        unseen[index[front[pixel] > w[index] + torch.where(region[pixel], reach[index], -reach[index])]] = (
            False
        )
    return unseen
