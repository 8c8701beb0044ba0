"""Editor `paint:A.png[,B.png…]`: paint with transparency over views of the scene, each with its camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.io.images import open_picture
from progdf.rasterize.engines import render_depth
from progdf.surface.find import PaintSurface, find_surface, surface_pixels
from progdf.system.equality import equal_fields
from trainer.options import EditKind, EditorOptions
from trainer.paint.discs import MIN_ALPHA, PaintedView, composite_over, cover_view, project_paint
from trainer.views.picture_cameras import picture_cameras
from trainer.views.view import BACKGROUND, View, make_view, render_view, shrink_image, with_near_plane

from .base import EditorInput
from .pictures import picture_paths

_MAX_PAINT_SIDE_PX = 768  # maximum longer side of the paint in a view; the view is shrunk until it fits


@dataclass(frozen=True)
class PaintLayer:
    """Paint of one view on the surface."""

    __eq__ = equal_fields

    view: View
    drawn: Tensor  # premultiplied colors and alpha. [H,W,4]
    surface: PaintSurface


@dataclass(frozen=True)
class PaintEditor:
    """Editor that places the paint of all pictures on the surface. Later pictures cover earlier ones."""

    scene: Gaussians
    layers: Sequence[PaintLayer]
    left_out: int  # see `PastingEditor`
    seen: Gaussians | None = None  # see `EditorInput`
    kind: EditKind = "color"
    stages: tuple[float, ...] = ()
    is_confined: bool = False
    finds_colors = True
    """See `PastingEditor`."""

    @property
    def view(self) -> View:
        """View of the first picture."""
        return self.layers[0].view

    @property
    def paints(self) -> list[PaintedView]:
        """Paint of each view, as the target of the surface discs."""
        paints = []
        for layer in self.layers:
            view = layer.view
            below = None
            if self.seen is not None:
                below = render_view(self.seen, view.camera, torch.tensor(BACKGROUND)).clamp(0.0, 1.0)
            picture, _ = cover_view(view.image, below, self._drawn(view))
            paints.append(PaintedView(view.camera, picture, layer.drawn, layer.surface))
        return paints

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`."""
        image = view.image
        for drawn in self._drawn(view):
            image = composite_over(image, strength * drawn)
        return image

    def _drawn(self, view: View) -> list[Tensor]:
        """Return the paint of each layer in a view: premultiplied colors and alpha. [H,W,4] each"""
        return [
            layer.drawn
            if view is layer.view
            else project_paint(self.scene, layer.surface, layer.drawn, view.camera)
            for layer in self.layers
        ]


def check_paint(what: str, options: EditorOptions) -> None:
    """Check the pictures.

    Raises:
        ProgdfError: one is missing or broken, or has no transparent pixels or no visible ones.
    """
    for path in picture_paths(what):
        _read_rgba(path)


def paint(given: EditorInput) -> PaintEditor:
    """Return the editor of `paint:A.png[,B.png…]`.

    The paint is visible only on pixels that show a surface of the region.

    Raises:
        ProgdfError: a picture or its camera is invalid, or no paint lies on the region.
    """
    scene = given.scene
    paths = picture_paths(given.what)
    cameras = with_near_plane(picture_cameras(paths, (), scene.origin), scene)
    layers = list[PaintLayer]()
    left_out = 0
    for path, camera in zip(paths, cameras, strict=True):
        rgba = _read_rgba(path)
        camera, rgba = _shrink(camera, rgba)
        view = make_view(scene, given.region, camera, torch.tensor(BACKGROUND))
        seen = render_depth(scene, camera)
        has_surface = torch.from_numpy(surface_pixels(seen.alpha.numpy()))
        drawn = rgba * (has_surface & (view.mask > 0.5 * seen.alpha))[..., None]
        painted = drawn[..., 3] > MIN_ALPHA
        left_out += int(((rgba[..., 3] > MIN_ALPHA) & ~painted).sum())
        if bool(painted.any()):
            surface = find_surface(scene, camera, painted.numpy(), seen)
            layers.append(PaintLayer(view, drawn, surface))
    if not layers:
        raise ProgdfError(
            f"no paint lies on an opaque part of the region '{given.region.name}'; paint on the scene"
        )
    return PaintEditor(scene, layers, left_out, given.seen)


def _shrink(camera: Camera, rgba: Tensor) -> tuple[Camera, Tensor]:
    """Shrink a view so that its paint has at most `_MAX_PAINT_SIDE_PX`."""
    rows, columns = (rgba[..., 3] > MIN_ALPHA).nonzero().T
    side = 1 + max(int(rows.max() - rows.min()), int(columns.max() - columns.min()))
    scale = _MAX_PAINT_SIDE_PX / side
    if scale >= 1.0:
        return camera, rgba
    camera = camera.resize(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    return camera, shrink_image(rgba, (camera.height, camera.width))


def _read_rgba(path: Path) -> Tensor:
    """Return premultiplied colors and alpha of a picture. [H,W,4]

    Raises:
        ProgdfError: it is broken, or has no transparent pixels or no visible ones.
    """
    image = torch.from_numpy(np.asarray(open_picture(path).convert("RGBA"), dtype=np.float32) / 255.0).clone()
    if float(image[..., 3].min()) == 1.0:
        raise ProgdfError(f"{path} has no transparent pixels; paint on a transparent layer over the view")
    if float(image[..., 3].max()) <= MIN_ALPHA:
        raise ProgdfError(f"{path} is fully transparent; paint on it")
    image[..., :3] *= image[..., 3:]
    return image
