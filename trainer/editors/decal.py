"""A picture with transparency laid on the surface, as one camera sees it: `decal:LOGO.png`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import grid_sample

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians, Origin
from progdf.io.cameras import load_cameras
from progdf.io.images import open_picture
from progdf.rasterize.engines import Depth, render_depth
from progdf.region import Region
from trainer.options import EditKind, EditorOptions
from trainer.paint.discs import OPAQUE, Paint, smooth_depth
from trainer.views.view import BACKGROUND, View, make_view, with_near_plane

Array = NDArray[np.float64]

LEAST_ALPHA = 1 / 255
"""Below it nothing is painted."""

_MOST_SIDE = 512  # pixels of a decal's longer side: of a larger one the view is shrunk
_KNOTS = 20_000  # points of the surface, between which it is taken for flat where views are painted
_IN_FRONT = 0.02  # of the depth, by which something may lie before the surface and be of it
_NEWTON = 8  # steps of finding what a pixel shows
_MARGIN = 4  # pixels around a decal in which its surface is looked at


@dataclass(frozen=True)
class Place:
    """Where a decal lies in a picture."""

    x: float  # of its center, pixels
    y: float
    size: float  # of its longer side, pixels
    angle: float  # degrees, counterclockwise


def parse_place(text: str, camera: Camera) -> Place:
    """`x,y,size[,angle]` in pixels of the camera's picture, or x, y and size in shares of its sides, 0..1.

    Raises:
        ProgdfError: no such numbers.
    """
    wanted = "--at needs x,y,size or x,y,size,angle in pixels of the camera's picture, or in shares of it"
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (3, 4) or not all(map(math.isfinite, numbers)):
        raise ProgdfError(f"{wanted}, got '{text}'")
    x, y, size, angle = (*numbers, 0.0)[:4]
    if size <= 0:
        raise ProgdfError(f"--at: the size must be more than 0, got {size:g}")
    if max(abs(x), abs(y), size) <= 1.0:
        longer = max(camera.width, camera.height)
        x, y, size = x * camera.width, y * camera.height, size * longer
    if not (
        0 <= x <= camera.width and 0 <= y <= camera.height and size <= 16 * (camera.width + camera.height)
    ):
        raise ProgdfError(
            f"--at {text} lies outside the camera's picture of {camera.width}x{camera.height} pixels"
        )
    return Place(x, y, size, angle)


def decal_camera(path: Path | None, origin: Origin = ZERO) -> Camera:
    """The camera from which a decal is laid on.

    Raises:
        ProgdfError: none is given, or several.
    """
    if path is None:
        raise ProgdfError(
            "a decal needs --camera, a picture that progdf render wrote or a file of one camera"
        )
    cameras = load_cameras(path, origin)
    if len(cameras) != 1:
        raise ProgdfError(f"{path} holds {len(cameras)} cameras; --camera takes one, such as a rendered .png")
    return replace(cameras[0], name="decal", lens=None)


def check_decal(what: str, options: EditorOptions) -> None:
    """ProgdfError if no run can begin so: the picture, the place or the camera will not do."""
    if not what:
        raise ProgdfError("decal: needs a picture; write decal:logo.png")
    _open_decal(Path(what).expanduser())
    parse_place(options.at, decal_camera(options.camera))


def _open_decal(path: Path) -> Image.Image:
    picture = open_picture(path).convert("RGBA")
    if not picture.getchannel("A").getextrema()[1]:
        raise ProgdfError(f"{path} is all transparent; give a picture that shows something")
    return picture


def draw_decal(path: Path, place: Place, camera: Camera) -> Tensor:
    """The decal as it lies in the camera's picture, colors times alpha, and alpha. [H,W,4] 0..1"""
    picture = _open_decal(path)
    scale = place.size / max(picture.size)
    width, height = (max(1, round(side * scale)) for side in picture.size)
    scaled = np.asarray(picture.resize((width, height), Image.Resampling.LANCZOS), dtype=np.float32) / 255.0
    image = torch.from_numpy(scaled).clone()
    image[..., :3] *= image[..., 3:]
    rows, columns = torch.meshgrid(
        torch.arange(camera.height) + 0.5 - place.y, torch.arange(camera.width) + 0.5 - place.x, indexing="ij"
    )
    cosine, sine = math.cos(math.radians(place.angle)), math.sin(math.radians(place.angle))
    across, down = columns * cosine - rows * sine, columns * sine + rows * cosine
    return _sample(image, across + 0.5 * width, down + 0.5 * height)


def _sample(image: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Bilinear; 0 outside. [H,W,C], pixels [h,w] each -> [h,w,C]"""
    grid = torch.stack([2 * x / image.shape[1] - 1, 2 * y / image.shape[0] - 1], dim=-1)[None].float()
    return grid_sample(image.permute(2, 0, 1)[None], grid, align_corners=False)[0].permute(1, 2, 0)


@dataclass(frozen=True)
class DecalEditor:
    """A decal on the surface that its camera sees."""

    scene: Gaussians
    view: View  # that of its camera
    drawn: Tensor  # colors times alpha, and alpha, where they lie on the surface. [H,W,4]
    kind: EditKind = "color"
    stages: tuple[float, ...] = ()
    is_confined: bool = False

    @property
    def paint(self) -> Paint:
        """What its own view shall show."""
        return Paint(self.view.camera, self.edit(self.view, 1.0), self.drawn[..., 3] > LEAST_ALPHA)

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`."""
        laid = strength * (self.drawn if view is self.view else self.project(view.camera))
        return view.image * (1.0 - laid[..., 3:]) + laid[..., :3]

    @cached_property
    def _depth(self) -> Depth:
        return render_depth(self.scene, self.view.camera)

    def project(self, camera: Camera) -> Tensor:
        """The decal on the surface as another camera sees it, colors times alpha, and alpha. [H,W,4]"""
        own, result = self.view.camera, torch.zeros(camera.height, camera.width, 4)
        rows, columns = (self.drawn[..., 3] > 0).nonzero().T.numpy()
        if not len(rows):
            return result
        top, left = max(0, rows.min() - _MARGIN), max(0, columns.min() - _MARGIN)
        surface = smooth_depth(self._depth.depth.numpy(), (self._depth.alpha > OPAQUE).numpy())
        surface = surface[top : rows.max() + _MARGIN + 1, left : columns.max() + _MARGIN + 1]
        step = max(1, round(math.sqrt(surface.size / _KNOTS)))
        y, x = np.mgrid[: surface.shape[0] : step, : surface.shape[1] : step]
        K, there = own.K.double().numpy(), camera.K.double().numpy()
        y, x, z = y + top + 0.5, x + left + 0.5, surface[y, x]
        rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1)
        turn = (camera.viewmat.double() @ torch.linalg.inv(own.viewmat.double())).numpy()
        points = (rays * z[..., None]) @ turn[:3, :3].T + turn[:3, 3]
        front = points[..., 2] > camera.near
        depth = np.where(front, points[..., 2], 1.0)
        u, v = (points[..., i] / depth * there[i, i] + there[i, 2] for i in (0, 1))
        if min(surface[::step, ::step].shape) < 2:
            return result
        (uy, ux), (vy, vx) = np.gradient(u), np.gradient(v)
        front &= ux * vy - uy * vx > 0  # what turns away is hidden by what does not
        if front.sum() < 3 or np.ptp(u[front]) < 1e-6 or np.ptp(v[front]) < 1e-6:
            return result
        box = [int(max(0.0, edge.min() - 1)) for edge in (u[front], v[front])]
        box += [
            int(min(size, edge.max() + 2))
            for size, edge in ((camera.width, u[front]), (camera.height, v[front]))
        ]
        if box[0] >= box[2] or box[1] >= box[3]:
            return result
        rows, columns = np.mgrid[box[1] : box[3], box[0] : box[2]] + 0.5
        maps = np.stack([u, v, ux, uy, vx, vy, x, y, depth, front.astype(float)])
        found = torch.from_numpy(_invert(maps, columns, rows))
        seen = render_depth(self.scene, camera).depth[box[1] : box[3], box[0] : box[2]]
        visible = found[..., 2] <= seen * (1.0 + _IN_FRONT)
        laid = _sample(self.drawn, found[..., 0], found[..., 1])
        result[box[1] : box[3], box[0] : box[2]] = laid * visible[..., None]
        return result


def _invert(maps: Array, columns: Array, rows: Array) -> Array:
    """What a grid of points shows at some pixels, by Newton's steps over the grid; far away where nothing is.

    Args:
        maps: where each point is seen, u and v; by how much these grow to the right and down: ux, uy, vx, vy;
            three values and whether it counts. [10,I,J]
        columns, rows: the pixels. [h,w] each

    Returns:
        [h,w,3]
    """
    u, v, front = maps[0], maps[1], maps[-1] > 0
    size = np.array(u.shape)[:, None, None]
    known = np.stack([u[front], v[front], np.ones(front.sum())], axis=1)
    start = np.linalg.lstsq(known, np.stack(np.nonzero(front), axis=1).astype(float), rcond=None)[0]
    at = np.moveaxis(np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ start, -1, 0)
    for _ in range(_NEWTON):
        at = at.clip(-0.5, size - 0.5)
        u, v, ux, uy, vx, vy = (ndimage.map_coordinates(one, at, order=1, mode="nearest") for one in maps[:6])
        right, down, area = columns - u, rows - v, ux * vy - uy * vx
        area = np.where(np.abs(area) > 1e-9, area, 1e-9)
        step = np.stack([ux * down - vx * right, vy * right - uy * down]) / area
        at = at + step.clip(-0.1 * size, 0.1 * size)
    at = at.clip(-0.5, size - 0.5)
    values = np.stack([ndimage.map_coordinates(one, at, order=1, mode="nearest") for one in maps])
    missed = np.hypot(values[0] - columns, values[1] - rows) > 0.5
    return cast(
        Array, np.where((missed | (values[-1] < 0.5))[..., None], -1e6, np.moveaxis(values[6:9], 0, -1))
    )


def decal(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], options: EditorOptions
) -> DecalEditor:
    """`decal:LOGO.png` with --at and --camera: on what that camera sees of the region, where it is opaque.

    Raises:
        ProgdfError: the picture, the place or the camera will not do, or nothing lies on the region.
    """
    camera = decal_camera(options.camera, scene.origin)
    place = parse_place(options.at, camera)
    if (shrunk := _MOST_SIDE / place.size) < 1.0:
        size = max(1, round(camera.width * shrunk)), max(1, round(camera.height * shrunk))
        camera, place = (
            camera.resize(*size),
            replace(place, x=place.x * shrunk, y=place.y * shrunk, size=_MOST_SIDE),
        )
    (camera,) = with_near_plane([camera], scene)
    view = make_view(scene, region, camera, torch.tensor(BACKGROUND))
    drawn = draw_decal(Path(what).expanduser(), place, camera)
    alpha = render_depth(scene, camera).alpha
    drawn = drawn * ((alpha > OPAQUE) & (view.mask > 0.5 * alpha))[..., None]
    if not bool((drawn[..., 3] > LEAST_ALPHA).any()):
        raise ProgdfError(
            f"{what} does not lie on the region '{region.name}': nothing opaque of it is seen there; "
            "give another place with --at"
        )
    return DecalEditor(scene, view, drawn)
