"""Hole filling: areas that a removed object hides in every view are closed with surface discs.

A hole in a view is a connected component of pixels of the object without an opaque background, and with an
opaque boundary. An object in front of an empty background leaves no hole. Alpha, inverse depth and color,
weighted by alpha, are continued from the boundary as a membrane (∇² = 0, which the inverse depth of a plane
fulfills). No point of a hole may lie where some view showed another surface, or empty space, before the
removal.

The view with the largest hole is filled with discs, then that with the largest remaining one, until all holes
are small. Views with a given picture come first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians, concatenate
from progdf.quaternions import matrix_quats
from progdf.rasterize.engines import render_depth
from progdf.sh import rgb_to_sh0
from trainer.views.view import View, render_colors, seen_colors

_OPAQUE = 0.9  # alpha of an opaque boundary pixel; also the minimum share of such pixels in a boundary
_MIN_REGION_WEIGHT = 0.05  # weight of the region in a removed pixel; its soft edge occludes too
_BLOCKS = (8, 4, 2, 1)  # side of a disc's square in pixels, as large as the colors allow
_COLOR_TOLERANCE = 2 / 255  # maximum color range within a disc
_WIDTH = 0.7  # standard deviation of a disc, as a share of the side
_THICKNESS = 0.1  # thickness of a disc, as a share of its width
_OPACITY_LOGIT = 5.0  # opacity logit of a disc
_MIN_COSINE = 0.3  # limits the stretching of slanted discs
_MIN_HOLE_SHARE = 0.01  # share of the region's pixels; smaller holes are irregularities of the boundary
_MAX_VIEWS = 12  # maximum number of views whose holes become discs
_REACH_PX = 4.0  # maximum distance of a point from a surface that still belongs to it


Front = tuple[Camera, Tensor, Tensor]
"""Camera of a view; visible depth (camera z, infinite without a surface); mask of the region. [H,W] each"""


@dataclass(frozen=True)
class Hole:
    """Hole in one view, with the surface continued from its boundary."""

    camera: Camera
    mask: Tensor  # [H,W] bool
    inverse_depth: Tensor  # 1 / camera z, inside the mask. [H,W]
    colors: Tensor  # rgb, 0 to 1. [H,W,3]

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return int(self.mask.sum())


@dataclass(frozen=True)
class Fill:
    """Result of filling the holes."""

    rows: Gaussians | None  # opaque discs at strength 1; None if there is no hole
    views: int  # number of views with discs
    before: int  # pixels of holes in all views
    after: int  # remaining pixels of holes in all views


def fill_holes(
    scene: Gaussians,
    rest: Gaussians,
    views: Sequence[View],
    pictures: Mapping[str, Tensor] | None = None,
    close: bool = True,
) -> Fill:
    """Close the holes of a removal.

    Args:
        scene: the original
        rest: the remaining scene
        views: views of the original with the removed region's mask; only areas hidden in all of them are
            filled
        pictures: by view name, pictures of the finished edit, whose colors the discs take instead of those of
            the boundary. [H,W,3]
        close: False only counts the holes
    """
    picture_colors = pictures or {}
    seen = [(view.camera, _visible_depth(scene, view.camera), view.mask > 0.5) for view in views]
    holes = [find_hole(rest, view, seen) for view in views]
    before = sum(hole.pixels for hole in holes)
    filled = rest
    discs = list[Gaussians]()
    min_pixels = [_MIN_HOLE_SHARE * float((view.mask > _MIN_REGION_WEIGHT).sum()) for view in views]
    open_views = {i for i, hole in enumerate(holes) if close and hole.pixels > min_pixels[i]}
    while open_views and len(discs) < _MAX_VIEWS:
        # views with a given picture come first, as their colors are known
        best = max(open_views, key=lambda i: (views[i].camera.name in picture_colors, holes[i].pixels, -i))
        rows = place_discs(holes[best], rest, picture_colors.get(views[best].camera.name, holes[best].colors))
        trial = concatenate([filled, rows])
        pairs = zip(views, holes, strict=True)
        closed = [find_hole(trial, view, seen) if old.pixels else old for view, old in pairs]
        gain = sum(hole.pixels for hole in holes) - sum(hole.pixels for hole in closed)
        open_views.discard(best)
        # discs off the surface open as many pixels in other views as they close
        if 2 * gain > holes[best].pixels:
            discs.append(rows)
            filled = trial
            holes = closed
            open_views = {i for i in open_views if holes[i].pixels > min_pixels[i]}
    after = sum(hole.pixels for hole in holes)
    return Fill(concatenate(discs) if discs else None, len(discs), before, after)


def find_hole(rest: Gaussians, view: View, seen: Sequence[Front]) -> Hole:
    """Return the hole in a view where the region was; see the module docstring.

    Args:
        rest: the remaining scene
        view: view of the original with the removed region's mask
        seen: visible depth of all views before the removal
    """
    camera = view.camera
    z = (rest.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]).clamp_min(camera.near)
    inverse = torch.stack([1.0 / z, torch.ones_like(z), torch.zeros_like(z)], dim=1)
    black = torch.zeros(3)
    planes = render_colors(rest, inverse, camera, black)[..., :2]
    known = torch.cat([planes, render_colors(rest, seen_colors(rest, camera), camera, black)], dim=2)
    unknown = (view.mask > _MIN_REGION_WEIGHT) & (known[..., 1] < _OPAQUE)
    if not bool(unknown.any()):
        return Hole(camera, unknown, known[..., 0], known[..., 2:])
    mask = _closed_pieces(unknown, known[..., 1])
    surface = membrane(known, mask)
    alpha = surface[..., 1].clamp_min(1e-6)[..., None]
    inverse = (surface / alpha)[..., 0]
    colors = (surface / alpha)[..., 2:].clamp(0.0, 1.0)
    mask[mask.clone()] = _unseen(_unproject(camera, mask.nonzero(), inverse[mask]), seen, camera)
    return Hole(camera, mask, inverse, colors)


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


def membrane(values: Tensor, unknown: Tensor) -> Tensor:
    """Continue values into unknown pixels smoothly: each becomes the mean of its four neighbors.

    Args:
        values: [H,W,C]
        unknown: [H,W] bool; values are constant across the picture's edge

    Returns:
        [H,W,C]; known values are unchanged
    """
    mask = unknown.numpy()
    known = values.double().numpy()
    index = np.full(mask.shape, -1)
    index[mask] = np.arange(mask.sum())
    count = int(mask.sum())
    # pixels without a connection to known ones become 0, as no view shows their surface
    diagonal = np.full(count, 1e-9)
    right = np.zeros((count, known.shape[2]))
    rows = []
    columns = []
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        neighbor = np.roll(index, step, axis)
        inside = np.ones(mask.shape, bool)
        inside[(0 if step > 0 else -1,) if axis == 0 else (slice(None), 0 if step > 0 else -1)] = False
        pixels = mask & inside
        diagonal[index[pixels]] += 1
        right[index[pixels & (neighbor < 0)]] += np.roll(known, step, axis)[pixels & (neighbor < 0)]
        rows.append(index[pixels & (neighbor >= 0)])
        columns.append(neighbor[pixels & (neighbor >= 0)])
    i = np.concatenate([*rows, np.arange(count)])
    j = np.concatenate([*columns, np.arange(count)])
    entries = np.concatenate([-np.ones(len(i) - count), diagonal])
    result = known.copy()
    result[mask] = splu(coo_matrix((entries, (i, j)), (count, count)).tocsc()).solve(right)
    return torch.from_numpy(result).to(values.dtype)


def place_discs(hole: Hole, like: Gaussians, colors: Tensor) -> Gaussians:
    """Return opaque discs on the surface of a hole, one per pixel, or per square of up to 8×8 pixels of equal
    color.

    Args:
        hole: see `Hole`
        like: scene that provides the number of SH bands and the origin
        colors: rgb, 0 to 1. [H,W,3]
    """
    parts = _split_squares(hole.mask, colors)
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
    rgb = torch.stack([colors[r : r + s, c : c + s].mean(dim=(0, 1)) for r, c, s in parts.tolist()])
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


def _split_squares(mask: Tensor, colors: Tensor) -> Tensor:
    """Return squares that tile a mask, as large as colors and edge allow: first row, first column, side.
    [P,3]"""
    depth = ndimage.distance_transform_cdt(np.pad(mask.numpy(), 1), "chessboard")[1:-1, 1:-1]
    free = mask.numpy().copy()
    image = colors.numpy()
    parts = []
    for side in _BLOCKS:
        inner = depth > side // 2  # a large disc extends beyond its square but must stay inside the hole
        for row in range(0, mask.shape[0] - side + 1, side):
            for column in range(0, mask.shape[1] - side + 1, side):
                part = slice(row, row + side), slice(column, column + side)
                if free[part].all() and (
                    side == 1
                    or (inner[part].all() and np.ptp(image[part], axis=(0, 1)).max() <= _COLOR_TOLERANCE)
                ):
                    free[part] = False
                    parts.append((row, column, side))
    return torch.tensor(parts, dtype=torch.int64).reshape(-1, 3)


def _visible_depth(scene: Gaussians, camera: Camera) -> Tensor:
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
    reach = _REACH_PX * (points - own.position.double()).norm(dim=1) / float(own.K[0, 0])
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
