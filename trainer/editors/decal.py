"""Editor `decal:LOGO.png`: a picture with transparency placed on the surface that one camera sees."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians, Origin
from progdf.io.cameras import load_cameras
from progdf.io.images import open_picture
from progdf.rasterize.engines import render_depth
from progdf.scene.regions import read_numbers
from progdf.surface.find import PaintSurface, find_surface, surface_pixels
from progdf.surface.footprint import depth_picture, near_surface
from progdf.system.equality import equal_fields
from trainer.options import EditKind, EditorOptions
from trainer.paint.discs import MIN_ALPHA, PaintedView, composite_over, project_paint, sample_image
from trainer.views.view import BACKGROUND, View, make_view, with_near_plane

from .base import EditorInput

_MAX_DECAL_SIDE_PX = 512  # maximum longer side of a decal; the view is shrunk until its decal fits


@dataclass(frozen=True)
class DecalPlacement:
    """Position, size and rotation of a decal in the camera's picture."""

    x: float  # center, pixels
    y: float
    size: float  # longer side, pixels
    angle: float  # degrees, counterclockwise


def parse_place(text: str, camera: Camera) -> DecalPlacement:
    """Parse `x,y,size[,angle]`.

    x, y and size are in pixels of the camera's picture. If none exceeds 1, they are shares: x of the width, y
    of the height, size of the longer side. The angle is in degrees, counterclockwise.

    Raises:
        ProgdfError: the text is not such numbers, or they lie outside the picture.
    """
    wanted = "--at needs x,y,size or x,y,size,angle in pixels of the camera's picture, or in shares of it"
    numbers = read_numbers(text)
    if len(numbers) not in (3, 4):
        raise ProgdfError(f"{wanted}, got '{text}'")
    x, y, size, angle = (*numbers, 0.0)[:4]
    if size <= 0:
        raise ProgdfError(f"--at: the size must be more than 0, got {size:g}")
    if max(abs(x), abs(y), size) <= 1.0:
        longer = max(camera.width, camera.height)
        x = x * camera.width
        y = y * camera.height
        size = size * longer
    if not (
        0 <= x <= camera.width and 0 <= y <= camera.height and size <= 16 * (camera.width + camera.height)
    ):
        raise ProgdfError(
            f"--at {text} lies outside the camera's picture of {camera.width}x{camera.height} pixels"
        )
    return DecalPlacement(x, y, size, angle)


def decal_camera(path: Path | None, origin: Origin = ZERO) -> Camera:
    """Return the camera that places a decal.

    Raises:
        ProgdfError: no camera is given, or several.
    """
    if path is None:
        raise ProgdfError(
            "decal: needs --camera; give a picture that progdf render wrote or a file with one camera"
        )
    cameras = load_cameras(path, origin)
    if len(cameras) != 1:
        raise ProgdfError(f"{path} holds {len(cameras)} cameras; --camera takes one, such as a rendered .png")
    return replace(cameras[0], name="decal", lens=None)


def check_decal(what: str, options: EditorOptions) -> None:
    """Check the picture, its placement and its camera.

    Raises:
        ProgdfError: one of them is invalid.
    """
    if not what:
        raise ProgdfError("decal: needs a picture; write decal:logo.png")
    _open_decal(Path(what).expanduser())
    parse_place(options.at, decal_camera(options.camera))


def _open_decal(path: Path) -> Image.Image:
    picture = open_picture(path).convert("RGBA")
    if not picture.getchannel("A").getextrema()[1]:
        raise ProgdfError(f"{path} is fully transparent; give a picture with visible pixels")
    return picture


def draw_decal(path: Path, place: DecalPlacement, camera: Camera) -> Tensor:
    """Draw the decal into the camera's picture. -> premultiplied colors and alpha, [H,W,4] 0..1"""
    picture = _open_decal(path)
    scale = place.size / max(picture.size)
    width, height = (max(1, round(side * scale)) for side in picture.size)
    scaled = np.asarray(picture.resize((width, height), Image.Resampling.LANCZOS), dtype=np.float32) / 255.0
    image = torch.from_numpy(scaled).clone()
    image[..., :3] *= image[..., 3:]
    rows, columns = torch.meshgrid(
        torch.arange(camera.height) + 0.5 - place.y, torch.arange(camera.width) + 0.5 - place.x, indexing="ij"
    )
    cosine = math.cos(math.radians(place.angle))
    sine = math.sin(math.radians(place.angle))
    across = columns * cosine - rows * sine
    down = columns * sine + rows * cosine
    return sample_image(image, across + 0.5 * width, down + 0.5 * height)


@dataclass(frozen=True)
class DecalEditor:
    """Editor that places a decal on the surface that its camera sees."""

    __eq__ = equal_fields

    scene: Gaussians
    view: View  # the camera's view
    drawn: Tensor  # the part of the decal on the surface: premultiplied colors and alpha. [H,W,4]
    surface: PaintSurface  # the surface under it
    left_out: int  # see `PastingEditor`
    kind: EditKind = "color"
    stages: tuple[float, ...] = ()
    is_confined: bool = False
    finds_colors = False
    """See `PastingEditor`."""

    @property
    def paints(self) -> list[PaintedView]:
        """Decal in the camera's view, as the target of the surface discs."""
        return [PaintedView(self.view.camera, self.edit(self.view, 1.0), self.drawn, self.surface)]

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`."""
        drawn = self.drawn
        if view is not self.view:
            drawn = project_paint(self.scene, self.surface, drawn, view.camera)
        return composite_over(view.image, strength * drawn)


def decal(given: EditorInput) -> DecalEditor:
    """Return the editor of `decal:LOGO.png` with `--at` and `--camera`.

    The decal is visible only on pixels of the camera's view that show a surface of the region, at most the
    decal's size away from the surface under its center.

    Raises:
        ProgdfError: the picture, its placement or its camera is invalid, or the decal does not lie on the
            region.
    """
    scene = given.scene
    region = given.region
    options = given.options
    camera = decal_camera(options.camera, scene.origin)
    place = parse_place(options.at, camera)
    shrink = _MAX_DECAL_SIDE_PX / place.size
    if shrink < 1.0:
        width = max(1, round(camera.width * shrink))
        height = max(1, round(camera.height * shrink))
        camera = camera.resize(width, height)
        place = replace(place, x=place.x * shrink, y=place.y * shrink, size=_MAX_DECAL_SIDE_PX)
    (camera,) = with_near_plane([camera], scene)
    view = make_view(scene, region, camera, torch.tensor(BACKGROUND))
    drawn = draw_decal(Path(given.what).expanduser(), place, camera)
    seen = render_depth(scene, camera)
    alpha = seen.alpha
    near = near_surface(depth_picture(scene, camera), place.x, place.y, place.size)
    has_surface = torch.from_numpy(surface_pixels(alpha.numpy()) & near)
    wanted = drawn[..., 3] > MIN_ALPHA
    drawn = drawn * (has_surface & (view.mask > 0.5 * alpha))[..., None]
    painted = drawn[..., 3] > MIN_ALPHA
    if not bool(painted.any()):
        raise ProgdfError(
            f"{given.what} does not lie on an opaque part of the region '{region.name}'; "
            "give another position with --at"
        )
    surface = find_surface(scene, camera, painted.numpy(), seen)
    return DecalEditor(scene, view, drawn, surface, int((wanted & ~painted).sum()))
