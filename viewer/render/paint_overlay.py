"""Overlay of unfinished paint: an RGBA texture over the picture, and the surfaces that carry it to other
views.

Within a view, a stroke changes only the pixels of its last dab. In another view, paint is drawn as points on
the surface; once the picture is still, the visible surface hides paint behind it.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache, lru_cache

import moderngl
import numpy as np

from progdf.camera import Camera
from progdf.painting.projection import (
    PaintPoints,
    ViewSurface,
    draw_points,
    paint_points,
    project_coverage,
    quick_surface,
    thin_points,
)
from progdf.painting.strokes import (
    NO_BOX,
    Box,
    ColorStroke,
    Floats,
    Pixels,
    composite,
    erase,
    pack,
    painted_box,
    unpack,
)
from progdf.threads import StoppedError, stopped_by
from viewer.camera.view_camera import ViewCamera, to_camera
from viewer.state.transient import ColorDrag
from viewer.state.view_state import PaintedPicture

from .background import run_in_background

Size = tuple[int, int]
SurfaceOf = Callable[[PaintedPicture], ViewSurface]
"""Function that returns the surface under a painted picture."""

_MAX_SURFACES = 20  # surfaces kept, a few megabytes each; a painted view needs one


class SceneSurfaces:
    """Cache of the visible surfaces of the scene on screen, by scene and view."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: OrderedDict[object, ViewSurface] = OrderedDict()
        self._recent: dict[object, ViewSurface] = {}  # the last surface of each view, whatever its scene
        self._awaited: object = None  # key of the last frame's request
        self._requested: object = None  # key of the surface in preparation

    def get(self, key: object, make: Callable[[], ViewSurface]) -> ViewSurface:
        """Return a surface; `make` computes an unknown one."""
        surface = self.peek(key)
        if surface is None:
            surface = make()
            self._keep(key, surface)
        return surface

    def peek(self, key: object) -> ViewSurface | None:
        """Return a surface if it is known."""
        with self._lock:
            surface = self._known.get(key)
            if surface is not None:
                self._known.move_to_end(key)
            return surface

    def recent(self, view: object) -> ViewSurface | None:
        """Return the newest surface of a view, whose key has the scene None."""
        with self._lock:
            return self._recent.get(view)

    def is_awaited(self, key: object) -> bool:
        """Return True if a surface should be requested: two frames in succession need it, none prepares it.

        A moving camera needs another surface in each frame.
        """
        again = key == self._awaited
        self._awaited = key
        return again and key != self._requested

    def request(self, key: object, make: Callable[[], ViewSurface]) -> None:
        """Compute a surface in another thread."""
        self._requested = key
        run_in_background(lambda: self._keep(key, make()))

    def _keep(self, key: object, surface: ViewSurface) -> None:
        with self._lock:
            self._known[key] = surface
            while len(self._known) > _MAX_SURFACES:
                self._known.popitem(last=False)
            self._recent = {surface_key(None, one.camera): one for one in self._known.values()}

    def drop(self) -> None:
        """Forget all surfaces, as another scene is open."""
        with self._lock:
            self._known.clear()
            self._recent.clear()
            self._requested = None


class FittedSurfaces:
    """Cache of the model surfaces under painted pictures, computed in another thread, one at a time."""

    def __init__(self) -> None:
        self._known: OrderedDict[tuple[object, PaintedPicture], ViewSurface] = OrderedDict()
        # paint of each view whose model was computed last, and this model
        self._recent: dict[tuple[ViewCamera, Size], tuple[PaintedPicture, ViewSurface]] = {}
        self._requested: object = None  # key of the model in preparation
        self._stop = threading.Event()
        self.is_busy = False
        """True while a model is computed."""
        self.count = 0
        """Number of models computed so far."""

    def get(self, scene: object, picture: PaintedPicture) -> ViewSurface | None:
        """Return the model under a picture on a scene, None if it is unknown."""
        return self._known.get((scene, picture))

    def is_requested(self, scene: object, picture: PaintedPicture) -> bool:
        """Return True if the model is in preparation, or could not be computed."""
        return self._requested == (scene, picture)

    def recent(self, picture: PaintedPicture) -> ViewSurface | None:
        """Return the last model in the view of a picture, whatever the strengths and the strokes were.

        Paint that was added after this model lies on a quick model, see `quick_surface`.
        """
        recent = self._recent.get((picture.camera, picture.size))
        return None if recent is None else quick_under(picture, recent[1], recent[0])

    def request(self, scene: object, picture: PaintedPicture, make: Callable[[], ViewSurface]) -> None:
        """Compute a model in another thread, in place of the one in preparation."""
        self.stop()
        key = (scene, picture)
        self._requested = key
        self._stop = threading.Event()
        self.is_busy = True
        # not the other background work's thread: a fit stops only between its renders
        _fit_worker().submit(self._compute, key, make, self._stop)

    def stop(self) -> None:
        """Stop the computation: a stroke needs the processor."""
        self._stop.set()
        self._requested = None
        self.is_busy = False

    def _compute(
        self, key: tuple[object, PaintedPicture], make: Callable[[], ViewSurface], stop: threading.Event
    ) -> None:
        if stop.is_set():
            return
        try:
            with stopped_by(stop), suppress(StoppedError):
                surface = make()
                if key == self._requested and not stop.is_set():
                    self._known[key] = surface
                    while len(self._known) > _MAX_SURFACES:
                        self._known.popitem(last=False)
                    known = list(self._known.items())
                    self._recent = {
                        (picture.camera, picture.size): (picture, one) for (_, picture), one in known
                    }
                    self.count += 1
        finally:
            if key == self._requested:
                self.is_busy = False

    def drop(self) -> None:
        """Forget all models, as another scene is open."""
        self.stop()
        self._known.clear()
        self._recent = {}


class PaintOverlay:
    """Texture with the paint of the view on screen. `release` it with the window.

    Args:
        ctx: GL context of the window
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self.surfaces = SceneSurfaces()
        """Surfaces of the scene on screen."""
        self.fits = FittedSurfaces()
        """Models of the surface under painted pictures."""
        self.pending = False
        """True while the surface of the view on screen is computed."""
        self._texture: moderngl.Texture | None = None
        self._shown: object = None  # key of the texture's content
        self._stroke: ColorStroke | None = None  # stroke in the texture
        self._rest: tuple[object, Pixels] = (None, np.zeros((0, 0, 4), np.uint8))  # paint beside the stroke

    def texture(
        self,
        painted: Sequence[PaintedPicture],
        drag: ColorDrag | None,
        camera: ViewCamera,
        size: Size,
        scene: object,
        surface_of: SurfaceOf,
        visible: ViewSurface | None,
    ) -> int:
        """Return the GL name of the texture with all paint in a view.

        Args:
            painted: paint of all views
            drag: stroke in progress in this view; its picture replaces the one of its view
            camera: the view
            size: its width and height, pixels
            scene: key of the scene on screen
            surface_of: returns the surface under a painted picture
            visible: surface of this view, None while it is unknown, as in motion; paint is then coarser
        """
        key = (tuple(painted), drag is not None, camera, size, scene, visible is not None, self.fits.count)
        others = painted
        if drag is not None:
            others = [one for one in painted if not is_in_view(one, camera, size)]
        if key != self._rest[0]:
            rest = paint_in_view(others, camera, size, surface_of, visible)
            self._rest = key, rest
        if self._texture is None or self._texture.size != size:
            self._release_texture()
            self._texture = self._ctx.texture(size, 4)
            self._texture.filter = moderngl.NEAREST, moderngl.NEAREST
            self._shown = None
        stroke = drag.stroke if drag is not None else None
        box = (0, 0, *size) if key != self._shown else changed_box(self._stroke, stroke)
        if box != NO_BOX:
            self._write(box, stroke)
        self._shown = key
        self._stroke = stroke
        return int(self._texture.glo)

    def _write(self, box: Box, stroke: ColorStroke | None) -> None:
        """Write a part of the texture."""
        assert self._texture is not None, "the texture is created before it is written"
        left, top, right, bottom = box
        part = np.s_[top:bottom, left:right]
        pixels = self._rest[1][part]
        if stroke is not None:
            if pixels[..., 3].any():
                pixels = erase(pixels, stroke.coverage[part])
            pixels = composite_part(pixels, stroke.pixels[part])
        viewport = (left, top, right - left, bottom - top)
        self._texture.write(np.ascontiguousarray(pixels).tobytes(), viewport=viewport)

    def _release_texture(self) -> None:
        if self._texture is not None:
            self._texture.release()
            self._texture = None

    def release(self) -> None:
        """Free the texture."""
        self._release_texture()
        self.drop()

    def drop(self) -> None:
        """Forget all surfaces, as another scene is open."""
        self.surfaces.drop()
        self.fits.drop()


def changed_box(before: ColorStroke | None, after: ColorStroke | None) -> Box:
    """Return the pixels in which a stroke differs from its earlier state that is on screen."""
    if after is None or after is before:
        return NO_BOX
    follows = before is not None and before.before is after.before and after.parts == before.parts + 1
    return after.dab if follows else after.box


def is_in_view(picture: PaintedPicture, camera: ViewCamera, size: Size) -> bool:
    """Return True if a picture was painted in this view at this size."""
    return (picture.camera, picture.size) == (camera, size)


def pixels_of(picture: PaintedPicture) -> Pixels:
    """Return the straight RGBA of a painted picture. [H,W,4]

    Raises:
        ProgdfError: see `unpack`.
    """
    return unpack(picture.pixels, *picture.size, picture.box)


def paint_in_view(
    painted: Sequence[PaintedPicture],
    camera: ViewCamera,
    size: Size,
    surface_of: SurfaceOf,
    visible: ViewSurface | None,
) -> Pixels:
    """Return all paint as a view shows it. Arguments as in `PaintOverlay.texture`. [H,W,4] straight RGBA"""
    target = to_camera(camera, *size)
    image: Pixels | None = None
    for picture in painted:
        if is_in_view(picture, camera, size):
            above = pixels_of(picture)
        else:
            points = _points(picture, surface_of(picture), coarse=visible is None)
            above = draw_points(points, target, visible)
        image = composite_part(image, above) if image is not None else above
    return np.zeros((size[1], size[0], 4), np.uint8) if image is None else image


def composite_part(below: Pixels, above: Pixels) -> Pixels:
    """Composite straight RGBA over straight RGBA, in time proportional to the painted box. [h,w,4] each"""
    left, top, right, bottom = painted_box(above)
    part = np.s_[top:bottom, left:right]
    image = below.copy()
    image[part] = composite(below[part], above[part])
    return image


def erase_under(
    picture: PaintedPicture, coverage: Floats, own: ViewSurface, of: ViewSurface
) -> PaintedPicture:
    """Return a painted picture without the paint under a stroke in another view.

    Args:
        picture: paint of another view
        coverage: influence of the stroke on each pixel of its view, 0 to 1. [H,W]
        own: surface of the stroke's view
        of: surface of the picture's view
    """
    points = _points(picture, of)
    influence = project_coverage(coverage, own, points)
    if not influence.any():
        return picture
    rows, columns = points.places
    pixels = pixels_of(picture).copy()
    pixels[rows, columns] = erase(points.colors[:, None], influence[:, None])[:, 0]
    return packed_picture(picture.camera, picture.size, pixels)


def packed_picture(camera: ViewCamera, size: Size, pixels: Pixels) -> PaintedPicture:
    """Return the painted picture of a view from its straight RGBA [H,W,4]."""
    box = painted_box(pixels)
    return PaintedPicture(camera, size, box, pack(pixels, box))


@cache
def _fit_worker() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="fit")


@lru_cache(maxsize=_MAX_SURFACES)
def _points(picture: PaintedPicture, surface: ViewSurface, coarse: bool = False) -> PaintPoints:
    """Return the paint of a picture as points; `coarse`: a quarter of them, for motion."""
    if coarse:
        return thin_points(_points(picture, surface))
    return paint_points(pixels_of(picture), surface)


@lru_cache(maxsize=_MAX_SURFACES)
def quick_under(
    picture: PaintedPicture, seen: ViewSurface, known: PaintedPicture | None = None
) -> ViewSurface:
    """Return the surface of a view with quick models under a painted picture, see `quick_surface`.

    Args:
        picture: the paint
        seen: surface of its view
        known: part of the paint for which `seen` already is the model; None for none
    """
    painted = pixels_of(picture)[..., 3] > 0
    if known is not None:
        painted &= pixels_of(known)[..., 3] == 0
    return quick_surface(seen, painted)


def surface_key(scene: object, camera: Camera) -> object:
    """Return the key of a surface in `SceneSurfaces`."""
    lens = camera.viewmat.numpy().tobytes(), camera.K.numpy().tobytes()
    return scene, lens, camera.width, camera.height
