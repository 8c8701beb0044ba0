"""What a removed thing hid and nobody saw is a hole: it is closed from its rim, by discs on the surface.

A hole in a view is one piece of pixels where the thing was and nothing opaque lies behind, with a rim that
is opaque: what stood before an empty background leaves none. Alpha, inverse depth and color, weighted by
alpha, are continued from the rim as a membrane (∇² = 0, which a plane's inverse depth fulfills). No point of
a hole may lie where some view saw something else, or nothing, before the removal.

The largest hole of any view becomes discs, then the largest of those that remain, until they are small.
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

_OPAQUE = 0.9  # alpha from which a rim is taken as it is, and share of a rim that must be so
_THERE = 0.05  # of the region's weight: its soft edge is part of what it hid
_BLOCKS = (8, 4, 2, 1)  # pixels of a disc's side, where color allows
_SAME = 2 / 255  # by which colors within a disc may differ
_WIDTH = 0.7  # of a side
_THICKNESS = 0.1  # of that
_LOGIT = 5.0  # of the opacity
_STEEPEST = 0.3  # least cosine by which a disc is lengthened
_MINIMUM = 0.01  # of the region's pixels: a smaller hole in a view is the rim's own raggedness
_MAX_VIEWS = 12
_REACH = 4.0  # pixels


Front = tuple[Camera, Tensor, Tensor]
"""A camera; how far it sees, camera z, infinite where nothing stands; where that is the region. [H,W] each"""


@dataclass(frozen=True)
class Hole:
    """What is missing in one view, and what the rim says of it."""

    camera: Camera
    mask: Tensor  # [H,W] bool
    inverse_depth: Tensor  # 1 / camera z, where the mask is. [H,W]
    colors: Tensor  # rgb 0..1. [H,W,3]

    @property
    def pixels(self) -> int:
        """How many there are."""
        return int(self.mask.sum())


@dataclass(frozen=True)
class Fill:
    """What closes the holes."""

    rows: Gaussians | None  # opaque discs, as they are at strength 1; None where there is no hole
    views: int  # from how many views they were placed
    before: int  # pixels of holes in all views
    after: int  # pixels that remain


def fill_holes(
    scene: Gaussians, rest: Gaussians, views: Sequence[View], pictures: Mapping[str, Tensor] | None = None
) -> Fill:
    """Close what the removal has opened.

    Args:
        scene: the original
        rest: what of it remains
        views: of the original, with the removed region's mask; what they all do not see is what may be filled
        pictures: by name of the view, pictures whose colors are taken in place of the rim's. [H,W,3]
    """
    given = pictures or {}
    seen = [(view.camera, _front(scene, view.camera), view.mask > 0.5) for view in views]
    holes = [find_hole(rest, view, seen) for view in views]
    before = sum(hole.pixels for hole in holes)
    filled = rest
    discs = list[Gaussians]()
    worth = [_MINIMUM * float((view.mask > _THERE).sum()) for view in views]
    left = {i for i, hole in enumerate(holes) if hole.pixels > worth[i]}
    while left and len(discs) < _MAX_VIEWS:
        # a given picture's own view goes first: there its colors are known
        best = max(left, key=lambda i: (views[i].camera.name in given, holes[i].pixels, -i))
        rows = place_discs(holes[best], rest, given.get(views[best].camera.name, holes[best].colors))
        trial = concatenate([filled, rows])
        pairs = zip(views, holes, strict=True)
        closed = [find_hole(trial, view, seen) if old.pixels else old for view, old in pairs]
        gain = sum(hole.pixels for hole in holes) - sum(hole.pixels for hole in closed)
        left.discard(best)
        # discs that stand elsewhere than the surface open as much in other views as they close
        if 2 * gain > holes[best].pixels:
            discs.append(rows)
            filled = trial
            holes = closed
            left = {i for i in left if holes[i].pixels > worth[i]}
    after = sum(hole.pixels for hole in holes)
    return Fill(concatenate(discs) if discs else None, len(discs), before, after)


def find_hole(rest: Gaussians, view: View, seen: Sequence[Front]) -> Hole:
    """The hole that a view shows where the region was; see the head of this file.

    Args:
        rest: what remains of the scene
        view: of the original, with the removed region's mask
        seen: how far all views saw before the removal
    """
    camera = view.camera
    z = (rest.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]).clamp_min(camera.near)
    inverse = torch.stack([1.0 / z, torch.ones_like(z), torch.zeros_like(z)], dim=1)
    black = torch.zeros(3)
    planes = render_colors(rest, inverse, camera, black)[..., :2]
    known = torch.cat([planes, render_colors(rest, seen_colors(rest, camera), camera, black)], dim=2)
    unknown = (view.mask > _THERE) & (known[..., 1] < _OPAQUE)
    if not bool(unknown.any()):
        return Hole(camera, unknown, known[..., 0], known[..., 2:])
    mask = _find_pieces(unknown, known[..., 1])
    surface = membrane(known, mask)
    alpha = surface[..., 1].clamp_min(1e-6)[..., None]
    inverse = (surface / alpha)[..., 0]
    colors = (surface / alpha)[..., 2:].clamp(0.0, 1.0)
    mask[mask.clone()] = _unseen(_unproject(camera, mask.nonzero(), inverse[mask]), seen, camera)
    return Hole(camera, mask, inverse, colors)


def _find_pieces(unknown: Tensor, alpha: Tensor) -> Tensor:
    """The pieces of unknown pixels that are open somewhere, and opaque all around. [H,W] bool"""
    pieces, count = ndimage.label(unknown.numpy(), np.ones((3, 3)))
    opaque = (alpha >= _OPAQUE).numpy()
    closed = np.zeros(count + 1, bool)
    for number, box in enumerate(ndimage.find_objects(pieces), 1):
        around = tuple(slice(max(0, side.start - 1), side.stop + 1) for side in box)
        piece = pieces[around] == number
        rim = ndimage.binary_dilation(piece, np.ones((3, 3))) & ~piece
        # the soft edge of a surface is part of a hole, and by itself none
        is_open = bool((alpha[around].numpy()[piece] < 0.5).any())
        closed[number] = is_open and bool(rim.any()) and opaque[around][rim].mean() > _OPAQUE
    return torch.from_numpy(closed[pieces])


def membrane(values: Tensor, unknown: Tensor) -> Tensor:
    """Values that are continued into unknown pixels without a bend: each is the mean of its four neighbors.

    Args:
        values: [H,W,C]
        unknown: [H,W] bool; those that reach the picture's edge end there evenly

    Returns:
        [H,W,C]; known values are as given
    """
    mask = unknown.numpy()
    known = values.double().numpy()
    index = np.full(mask.shape, -1)
    index[mask] = np.arange(mask.sum())
    count = int(mask.sum())
    # what no known pixel reaches is 0: a surface that nobody has seen
    diagonal = np.full(count, 1e-9)
    right = np.zeros((count, known.shape[2]))
    rows = []
    columns = []
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        neighbor = np.roll(index, step, axis)
        inside = np.ones(mask.shape, bool)
        inside[(0 if step > 0 else -1,) if axis == 0 else (slice(None), 0 if step > 0 else -1)] = False
        here = mask & inside
        diagonal[index[here]] += 1
        right[index[here & (neighbor < 0)]] += np.roll(known, step, axis)[here & (neighbor < 0)]
        rows.append(index[here & (neighbor >= 0)])
        columns.append(neighbor[here & (neighbor >= 0)])
    i = np.concatenate([*rows, np.arange(count)])
    j = np.concatenate([*columns, np.arange(count)])
    entries = np.concatenate([-np.ones(len(i) - count), diagonal])
    result = known.copy()
    result[mask] = splu(coo_matrix((entries, (i, j)), (count, count)).tocsc()).solve(right)
    return torch.from_numpy(result).to(values.dtype)


def place_discs(hole: Hole, like: Gaussians, colors: Tensor) -> Gaussians:
    """Opaque discs on the surface of a hole, one a pixel, or for up to 8×8 where the color is flat.

    Args:
        hole: see `Hole`
        like: gives bands and origin
        colors: rgb 0..1. [H,W,3]
    """
    parts = _split(hole.mask, colors)
    y, x, side = parts.double().unbind(1)
    camera = hole.camera
    middle = (parts[:, :2] + parts[:, 2:] // 2).long()
    fx, fy, cx, cy = (float(camera.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    rows, columns = middle.unbind(1)
    down, across = torch.gradient(hole.inverse_depth.double())
    place = torch.stack([(x + side / 2 - cx) / fx, (y + side / 2 - cy) / fy, torch.ones_like(x)], dim=1)
    a = across[rows, columns] * fx
    b = down[rows, columns] * fy
    # at the middle of the disc, which of an even side lies between pixels
    half = side / 2 - (parts[:, 2] // 2).double() - 0.5
    inverse = hole.inverse_depth.double()[rows, columns] + half * (a / fx + b / fy)
    z = 1.0 / inverse.clamp_min(1e-12)
    # of a plane n·P = 1, 1 / z = n·(x, y, 1)
    normals = torch.stack([a, b, inverse - a * place[:, 0] - b * place[:, 1]], dim=1)
    normals = torch.nn.functional.normalize(normals, dim=1)
    sight = torch.nn.functional.normalize(place, dim=1)
    level = torch.linalg.cross(normals, sight)
    level = torch.where(level.norm(dim=1, keepdim=True) > 1e-6, level, torch.tensor([1.0, 0, 0]).double())
    level = torch.nn.functional.normalize(
        torch.linalg.cross(normals, torch.linalg.cross(level, normals)), dim=1
    )
    frame = torch.stack([level, torch.linalg.cross(normals, level), normals], dim=2)
    width = _WIDTH * side * z / min(fx, fy)
    cosine = (normals * sight).sum(dim=1).abs().clamp_min(_STEEPEST)
    scales = torch.stack([width, width / cosine, _THICKNESS * width], dim=1)
    turn = camera.viewmat[:3, :3].double().T
    means = (place * z[:, None] - camera.viewmat[:3, 3].double()) @ turn.T
    rgb = torch.stack([colors[r : r + s, c : c + s].mean(dim=(0, 1)) for r, c, s in parts.tolist()])
    count = len(parts)
    return Gaussians(
        means.float(),
        matrix_quats(turn @ frame).float(),
        scales.log().float(),
        torch.full((count,), _LOGIT),
        rgb_to_sh0(rgb).float(),
        torch.zeros(count, like.shN.shape[1], 3),
        like.antialiased,
        like.origin,
    )


def _split(mask: Tensor, colors: Tensor) -> Tensor:
    """Squares that cover a mask: first row, first column, side, as large as colors and edge allow. [P,3]"""
    depth = ndimage.distance_transform_cdt(np.pad(mask.numpy(), 1), "chessboard")[1:-1, 1:-1]
    free = mask.numpy().copy()
    image = colors.numpy()
    parts = []
    for side in _BLOCKS:
        inner = depth > side // 2  # a large disc reaches beyond its square, and must not beyond the hole
        for row in range(0, mask.shape[0] - side + 1, side):
            for column in range(0, mask.shape[1] - side + 1, side):
                part = slice(row, row + side), slice(column, column + side)
                if free[part].all() and (
                    side == 1 or (inner[part].all() and np.ptp(image[part], axis=(0, 1)).max() <= _SAME)
                ):
                    free[part] = False
                    parts.append((row, column, side))
    return torch.tensor(parts, dtype=torch.int64).reshape(-1, 3)


def _front(scene: Gaussians, camera: Camera) -> Tensor:
    with torch.no_grad():
        drawn = render_depth(scene, camera)
    return drawn.depth.masked_fill(drawn.alpha <= 0.5, torch.inf)


def _unproject(camera: Camera, pixels: Tensor, inverse_depth: Tensor) -> Tensor:
    """Points of the world at rows and columns. [P,2], [P] -> [P,3] float64"""
    rows, columns = pixels.double().unbind(1)
    place = torch.stack([columns + 0.5, rows + 0.5, torch.ones_like(rows)], dim=1)
    sight = place @ torch.linalg.inv(camera.K.double()).T
    points = sight / inverse_depth.double().clamp_min(1e-12)[:, None]
    world: Tensor = (points - camera.viewmat[:3, 3].double()) @ camera.viewmat[:3, :3].double()
    return world


def _unseen(points: Tensor, seen: Sequence[Front], own: Camera) -> Tensor:
    """Which points no view saw, nor through: the region, or something nearer, stood before each. [P] bool

    `own`: the camera whose pixels they are; the size of these is how far a point may be off a surface.
    """
    unseen = torch.ones(len(points), dtype=torch.bool)
    reach = _REACH * (points - own.position.double()).norm(dim=1) / float(own.K[0, 0])
    for camera, front, region in seen:
        placed = points @ camera.viewmat[:3, :3].double().T + camera.viewmat[:3, 3].double()
        x, y, w = (placed @ camera.K.double().T).unbind(1)
        column = (x / w).floor()
        row = (y / w).floor()
        framed = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        index = (framed & (w > camera.near)).nonzero()[:, 0]
        at = row[index].long(), column[index].long()
        unseen[index[front[at] > w[index] + torch.where(region[at], reach[index], -reach[index])]] = False
    return unseen
