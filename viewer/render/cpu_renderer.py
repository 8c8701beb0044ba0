"""Renderer that draws with the CPU rasterizer and keeps the last picture."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache

import moderngl
import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize import ActivatedGaussians, Crop, render
from progdf.rasterize.cpu.rings import render_rings
from progdf.rasterize.screen import draw_lines_behind, fill_screen
from progdf.threads import stopped_by
from viewer.camera.view_camera import Vec3
from viewer.gl.present import ScreenCopy

from .dynamic_resolution import DrawnView, LiveScene, MovingGrade
from .gl_renderer import Image, Size, require_picture
from .ground_grid import CLEAR, Lines
from .view_modes import RINGS, SPLATS, can_merge, depth_range
from .view_modes import apply as apply_mode

BAND = 300_000
"""Number of Gaussians per additional band of a full picture.

Bands show parts of the picture early, and let it be canceled sooner when motion begins. Each band costs a
pass over all Gaussians.
"""
MAX_BANDS = 5  # largest number of bands
MIN_ROWS = 64  # approximate smallest height of a band, px


@dataclass(frozen=True)
class _Rendered:
    """Finished or partial picture with its transmittance, 0 to 1 [H,W], and the view that it shows."""

    image: Image
    through: Image
    shown: DrawnView


class _PendingPicture:
    """Picture that another thread draws band by band."""

    def __init__(self, scene: LiveScene, shown: DrawnView) -> None:
        size = (shown.camera.height, shown.camera.width)
        self.stop = threading.Event()
        self.picture = _Rendered(np.empty((*size, 3), np.float32), np.empty(size, np.float32), shown)
        self.bands: list[tuple[int, int]] = []  # finished bands: first row, and one past the last
        self.drawn = _worker().submit(self._draw, scene)

    def _draw(self, scene: LiveScene) -> float:
        """Draw all bands and return the time taken, ms."""
        started = time.perf_counter()
        gaussians = _in_mode(scene, self.picture.shown)
        height, width = self.picture.through.shape
        count = min(1 + len(gaussians.means) // BAND, MAX_BANDS, -(-height // MIN_ROWS))
        bands = [(height * k // count, height * (k + 1) // count) for k in range(count)]
        with stopped_by(self.stop):
            for top, end in sorted(bands, key=lambda band: abs(sum(band) - height)):  # middle first
                part = _draw(gaussians, self.picture.shown, (0, top, width, end))
                self.picture.image[top:end], self.picture.through[top:end] = part
                self.bands.append((top, end))
        return 1e3 * (time.perf_counter() - started)


class CpuRenderer:
    """Renderer with `progdf.rasterize`, about four times faster than OpenGL in software.

    Args:
        ctx: GL context to show pictures in; None if they are only read
    """

    wants_order = False

    def __init__(self, ctx: moderngl.Context | None = None) -> None:
        self._ctx = ctx
        self._copy: ScreenCopy | None = None
        self._bands = 0  # number of pending bands that the copy already shows
        self._stale = True  # whether the copy is older than the picture
        self._rendered: _Rendered | None = None
        self._grid: Lines | None = None  # ground grid in the copy
        self._changed = True  # whether Gaussians have changed since the kept picture
        self._pending: _PendingPicture | None = None
        self._released = threading.Event()
        self.begun_ms = 0.0

    def upload(self, scene: Gaussians) -> None:
        """Load a whole scene. The renderer keeps copies, so `scene` may be changed in place afterwards."""
        self._cancel()
        self._scene = LiveScene(scene, self._released)
        self._rendered = None
        for side in (1, 2):  # compile now, not at the first move of a slider
            fill_screen(np.zeros((1, 1, 3), np.float32), np.zeros((side, side, 4), np.uint8))
        if self._ctx is not None:  # only a window shows motion
            self._scene.begin_pyramid()

    def update(self, scene: Gaussians, attributes: Iterable[str], rows: NDArray[np.int64]) -> None:
        self._cancel()
        self._changed = self._changed or len(rows) > 0
        self._scene.update(scene, attributes, rows)

    def show_grade(self, graded: Gaussians | None, rows: NDArray[np.int64]) -> None:
        """See `GlRenderer.show_grade`."""
        self._cancel()
        self._changed = True
        self._scene.show_grade(graded, rows)

    def grade_motion(self, grade: MovingGrade | None) -> bool:
        """See `GlRenderer.grade_motion`."""
        self._scene.moving_grade = grade
        return self._scene.has_pyramid

    def highlight(self, rows: NDArray[np.int64], highlights: NDArray[np.uint8]) -> None:
        """See `GlRenderer.highlight`."""
        self._cancel()
        self._changed = self._changed or len(rows) > 0
        self._scene.highlight(rows, highlights)

    def draw(
        self,
        camera: Camera,
        background: Vec3,
        order: NDArray[np.uint32],
        pixels: int = 1,
        mode: str = SPLATS,
    ) -> None:
        """Draw the picture.

        Args:
            camera: its size is the picture's
            background: rgb behind the scene
            order: not used, as the rasterizer sorts by itself
            pixels: see `GlRenderer.draw`; above 1 the picture has fewer Gaussians
            mode: see `GlRenderer.draw`
        """
        pending = self._pending
        self.begun_ms = 0.0
        picture = None
        shown = DrawnView(camera, background, pixels, mode)
        if pixels > 1 and can_merge(mode, self._scene.highlights is not None):
            ends = depth_range(self._scene.drawn.means, camera) if mode == "depth" else None
            picture = self._scene.draw_fewer(
                lambda fewer: _draw(apply_mode(fewer, None, camera, mode, ends), shown), camera, pixels
            )
        elif pending is not None and pending.picture.shown == shown:
            self.begun_ms = pending.drawn.result()
            picture = pending.picture.image, pending.picture.through
        if picture is None:
            self._scene.begin_full()
            picture = _draw(_in_mode(self._scene, shown), shown)
        coarse = self._coarse(shown)
        if coarse is not None and mode == SPLATS:
            self._scene.measure(coarse.image, picture[0])
        self._cancel()
        self._rendered = _Rendered(*picture, shown)
        self._stale = True
        self._changed = False

    def prepare(self, camera: Camera, background: Vec3, mode: str = SPLATS) -> bool:
        """See `GlRenderer.prepare`."""
        shown = DrawnView(camera, background, mode=mode)
        rendered = None if self._changed else self._rendered
        if rendered is not None and rendered.shown == shown:
            return True
        if self._pending is None or self._pending.picture.shown != shown:
            self._cancel()
            self._scene.begin_full()
            self._pending = _PendingPicture(self._scene, shown)
        return self._pending.drawn.done()

    def _cancel(self) -> None:
        if self._pending is not None:
            self._pending.stop.set()
            self._pending = None

    def follow(self, last: object) -> bool:
        """See `GlRenderer.follow`."""
        if isinstance(last, CpuRenderer) and last._rendered is not None:
            self._rendered = last._rendered
            self._stale = True
            self._changed = True
        return self._rendered is not None

    def pixels(self) -> Image:
        """Return the picture, upper row first, not clamped. Later pictures do not overwrite it. [H,W,3]"""
        return require_picture(self._rendered).image

    def show(
        self, screen: moderngl.Framebuffer, size: Size, left: int = 0, grid: Lines | None = None
    ) -> None:
        """See `GlRenderer.show`."""
        assert self._ctx is not None, "nothing to show on without a context"
        picture = require_picture(self._rendered)
        pending = self._pending
        if self._copy is None or (self._copy.size, self._copy.left) != (size, left):
            if self._copy is not None:
                self._copy.release()
            self._copy = ScreenCopy(self._ctx, size, left)
            self._stale = True
        lines = (
            np.zeros((0, 14), np.float32) if grid is None else grid.view(np.float32).reshape(len(grid), -1)
        )
        if self._stale or grid is not self._grid:
            self._stale = False
            self._grid = grid
            self._bands = 0
            with draw_lines_behind(picture.image, picture.through, lines, CLEAR):
                self._copy.write(picture.image)
        while pending is not None and self.has_parts:
            top, end = pending.bands[self._bands]
            image = pending.picture.image[top:end]
            through = pending.picture.through[top:end]
            ends = lines[:, :4].astype(np.float64) * picture.shown.pixels - [0, top, 0, top]
            band_lines = lines.copy()
            band_lines[:, :4] = ends
            with draw_lines_behind(image, through, band_lines, CLEAR):
                self._copy.write(image, top)
            self._bands += 1
        self._copy.show(screen)

    @property
    def has_parts(self) -> bool:
        """See `GlRenderer.has_parts`."""
        pending = self._pending
        if pending is None or len(pending.bands) <= self._bands:
            return False
        return self._coarse(pending.picture.shown) is not None

    def _coarse(self, full: DrawnView) -> _Rendered | None:
        """Return the last picture if it shows `full` at a lower resolution, else None."""
        rendered = self._rendered
        return None if rendered is None or self._changed or not rendered.shown.is_coarse(full) else rendered

    def release(self) -> None:
        """Release all resources."""
        self._cancel()
        self._released.set()
        if self._copy is not None:
            self._copy.release()


def _in_mode(scene: LiveScene, shown: DrawnView) -> ActivatedGaussians:
    """Return the scene as the view's mode shows it."""
    return apply_mode(scene.drawn, scene.highlights, shown.camera, shown.mode)


def _draw(gaussians: ActivatedGaussians, shown: DrawnView, crop: Crop | None = None) -> tuple[Image, Image]:
    """Return the picture of Gaussians from `_in_mode` and its transmittance."""
    with torch.no_grad():
        if shown.mode == RINGS:
            image, through = render_rings(gaussians, shown.camera, shown.background, crop)
            return image.numpy(), through.numpy()
        rendered = render(gaussians, shown.camera, shown.background, crop=crop)
    return rendered.image.numpy(), rendered.transmittance.numpy()


@cache
def _worker() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="picture")
