"""Pointer context: the picture under the mouse, and the cursor's position in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from imgui_bundle import imgui
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.painting.projection import ViewSurface, fitted_surface, is_apart, view_surface
from progdf.scene.scribbles import Rows
from progdf.scene.selection import Floats, Mask, Surface
from viewer.camera.view_camera import ViewCamera, half_camera, half_scale, to_camera
from viewer.render.background import run_in_background
from viewer.render.engine import ViewEngine
from viewer.render.paint_overlay import PaintOverlay, pixels_of, quick_under, surface_key
from viewer.render.picking import PREPARE_MIN_GAUSSIANS, Surfaces
from viewer.state.layers import is_visible
from viewer.state.selection import EMPTY_MASK, unpack
from viewer.state.view_state import PaintedPicture, ViewState
from viewer.state.workspace import SceneFacts

from .context import UiContext
from .overlay import Area

_MAX_DOTS = 300  # largest number of dots per kind of stroke
_SURFACE = ("means", "quats", "log_scales", "logit_opacities", "sh0")
"""Attributes of a scene that `Surface` and picking read."""


@dataclass(frozen=True)
class PointerContext:
    """Picture under the mouse in one frame."""

    engine: ViewEngine  # draws the picture
    facts: SceneFacts  # data of the open scene
    shown: ViewState  # the displayed state: the current one, or the original while its key is held
    area: Area  # the part of the window that shows the picture
    ui: UiContext  # fonts and scale
    now: float  # seconds on the main view's clock
    surfaces: Surfaces  # surfaces computed in the background
    paint: PaintOverlay  # unfinished paint over the picture
    # side by side: half of the picture under the mouse, or under the start of its drag; 0 left, 1 right
    half: int = 0

    @property
    def is_beside(self) -> bool:
        """True if the picture consists of two pictures of half the width."""
        return self.shown.compare.mode == "beside"

    @property
    def scale(self) -> float:
        """Size of objects in the picture, relative to a picture that fills the area."""
        return half_scale(*self.size) if self.is_beside else 1.0

    @property
    def left(self) -> int:
        """Column at which the picture under the mouse begins, in framebuffer pixels."""
        return self.half * (self.size[0] // 2) if self.is_beside else 0

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture in framebuffer pixels."""
        density = imgui.get_io().display_framebuffer_scale
        return max(round(self.area.width * density.x), 1), max(round(self.area.height * density.y), 1)

    @property
    def cursor(self) -> tuple[float, float]:
        """Position of the mouse in pixels of the picture."""
        mouse = imgui.get_io().mouse_pos
        density = imgui.get_io().display_framebuffer_scale
        return mouse.x * density.x - self.left, mouse.y * density.y

    def camera(self, camera: ViewCamera) -> Camera:
        """Return `camera` with the size and intrinsics of the picture."""
        full = to_camera(camera, *self.size)
        return half_camera(full) if self.is_beside else full

    @property
    def scene(self) -> Gaussians:
        """Gaussians of the picture without the hidden ones; valid until another strength is drawn."""
        scene = self.engine.gaussians(self.shown)
        hidden = self.shown.selection.hidden
        if hidden == EMPTY_MASK:
            return scene
        drawn = torch.from_numpy(np.where(unpack(hidden, len(scene)), np.float32(-np.inf), np.float32(0.0)))
        return replace(scene, logit_opacities=scene.logit_opacities + drawn)

    @property
    def surface(self) -> Surface:
        """Surface of the picture for tools; valid until another strength is drawn."""
        return self.surfaces.at(self._surface_key) or Surface(self.scene, self.camera(self.shown.camera))

    def still_surface(self) -> Surface:
        """Return the surface of the picture for another thread: later strengths do not change it."""
        return self.surfaces.at(self._surface_key) or self._copy_surface()

    def visible_dots(self, strokes: tuple[Rows, Rows]) -> tuple[Floats, Floats]:
        """Return the visible dots of both kinds of strokes, pixels of the picture. [M,2], [K,2]"""
        thinned = [rows[:: len(rows) // _MAX_DOTS + 1] for rows in strokes]
        rows = np.concatenate(thinned)
        key = self._surface_key, rows.tobytes()

        def find() -> tuple[Floats, Mask]:
            surface = self.surface
            return surface.centers.points[rows], surface.front(rows)

        points, front = self.surfaces.dots(key, find)
        first = len(thinned[0])
        return points[:first][front[:first]], points[first:][front[first:]]

    def look_ahead(self) -> None:
        """Compute in another thread the data of a still picture that the active tool will need."""
        tool = self.shown.select.tool
        if self.shown.color_brush.tool:
            self.known_surface(self.shown.camera, self.size, request=True)
        self.fit_paint()
        if self.facts.count < PREPARE_MIN_GAUSSIANS or not (tool or self.shown.brush.active):
            return
        another = self.surfaces.look(self._surface_key, self._copy_surface, tool in ("flood", "color"))
        if another and tool in ("flood", "scribble"):
            run_in_background(self.facts.neighborhood if tool == "flood" else self.facts.scribbles)

    @property
    def scene_key(self) -> object:
        """Key of the scene on screen, without the camera."""
        view = self.shown
        return self.engine, self.engine.version, view.layers, view.blend, view.selection.hidden

    def view_surface(self, camera: ViewCamera, size: tuple[int, int]) -> ViewSurface:
        """Return the visible surface of the scene in a view of this size, pixels."""
        view = to_camera(camera, *size)
        key = surface_key(self.scene_key, view)
        return self.paint.surfaces.get(key, lambda: view_surface(self.scene, view))

    def paint_surface(self, picture: PaintedPicture) -> ViewSurface:
        """Return the surface under a painted picture.

        It is the model of this paint, or that of earlier strokes in its view. Until one is computed, it is a
        quick model.
        """
        fitted = self.paint.fits.get(self.scene_key, picture)
        if fitted is None and not self.shown.layers:  # no strength has changed the surface
            fitted = self.paint.fits.recent(picture)
        return fitted or quick_under(picture, self.view_surface(picture.camera, picture.size))

    def recent_surface(self, picture: PaintedPicture) -> ViewSurface:
        """Return the last known surface under a painted picture, which takes little time during motion."""
        view = to_camera(picture.camera, *picture.size)
        fitted = self.paint.fits.recent(picture)
        if fitted is not None:
            return fitted
        seen = self.paint.surfaces.recent(surface_key(None, view))
        return quick_under(picture, seen or self.view_surface(picture.camera, picture.size))

    def fit_paint(self) -> None:
        """Compute the model of the surface under a painted picture in another thread, if one is missing."""
        fits = self.paint.fits
        for picture in self.shown.painted:
            if fits.get(self.scene_key, picture) is None:
                view = to_camera(picture.camera, *picture.size)
                seen = self.paint.surfaces.peek(surface_key(self.scene_key, view))
                if seen is not None and not fits.is_requested(self.scene_key, picture):
                    scene = self.copy_scene()
                    painted = pixels_of(picture)[..., 3] > 0
                    fits.request(self.scene_key, picture, partial(fitted_surface, scene, seen, painted))
                return

    def unpaintable_at_cursor(self) -> str:
        """Return the reason why the visible surface at the cursor cannot hold paint; "" if it can.

        Paint can lie on the scene's own Gaussians, also where layers move them, and on lower paint.
        """
        view = self.shown
        hides = view.selection.hidden != EMPTY_MASK
        added = self._added_surface()
        if not hides and not added.any():
            return ""
        shown = self.view_surface(view.camera, self.size)
        camera = to_camera(view.camera, *self.size)

        def make() -> ViewSurface:
            scene = self.engine.gaussians(view)
            removed = torch.from_numpy(np.where(added, np.float32(-np.inf), np.float32(0.0)))
            return view_surface(replace(scene, logit_opacities=scene.logit_opacities + removed), camera)

        paintable = self.paint.surfaces.get(surface_key((self.scene_key, "paintable"), camera), make)
        x = min(max(int(self.cursor[0]), 0), camera.width - 1)
        y = min(max(int(self.cursor[1]), 0), camera.height - 1)
        if not is_apart(shown, paintable, x, y):
            return ""
        if hides:
            return "hidden splats lie here; show all splats first"
        return "a copy, a fill or grown splats lie here; paint only lies on the scene's own splats"

    def _added_surface(self) -> NDArray[np.bool_]:
        """Return the mask of the rows that visible layers add, except paint. [N]"""
        mask = np.zeros(len(self.engine.composer.gaussians), bool)
        own_count = self.facts.count - self.facts.added
        for layer in self.shown.layers:
            gdf = self.engine.gdfs[layer.gdf]
            is_paint = gdf.anchors is not None and bool(gdf.anchors.pushes)
            if is_visible(self.shown, layer) and layer.strength and not is_paint and not gdf.from_others:
                members = gdf.region.members.numpy()
                mask[members[members >= own_count]] = True
        return mask

    def known_surface(
        self, camera: ViewCamera, size: tuple[int, int], request: bool = False
    ) -> ViewSurface | None:
        """Return that surface if it is known; `request`: else compute it in another thread."""
        view = to_camera(camera, *size)
        key = surface_key(self.scene_key, view)
        known = self.paint.surfaces.peek(key)
        self.paint.pending = request and known is None
        if self.paint.pending and self.paint.surfaces.is_awaited(key):
            self.paint.surfaces.request(key, partial(view_surface, self.copy_scene(), view))
        return known

    @property
    def _surface_key(self) -> object:
        return surface_key(self.scene_key, self.camera(self.shown.camera))

    def copy_scene(self) -> Gaussians:
        """Return the scene; later strengths do not change the attributes of `_SURFACE` in it."""
        scene = self.scene
        if self.shown.layers:
            copies: dict[str, Any] = {name: getattr(scene, name).clone() for name in _SURFACE}
            scene = replace(scene, **copies)
        return scene

    def _copy_surface(self) -> Surface:
        return Surface(self.copy_scene(), self.camera(self.shown.camera))
