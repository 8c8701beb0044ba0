"""Draws with the CPU rasterizer and keeps the picture."""

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
from progdf.rasterize.screen import fill_screen, lines_behind
from progdf.threads import stopped_by
from viewer.camera.view_camera import Vec3
from viewer.gl.present import ScreenCopy

from .dynamic_resolution import DrawnView, LiveScene
from .gl_renderer import Image, Size, require_picture
from .ground_grid import CLEAR, Lines

BAND = 300_000
MAX_BANDS = 5
MIN_ROWS = 64
"""Gaussians for which a picture in full is made in one more band, so that some of it shows early and what
moves has little to wait for; each band costs a look at all of them. Rows of one, nearly."""


@dataclass(frozen=True)
class _Kept:
    """The last picture, what shines through it, 0..1 [H,W], and what it shows."""

    image: Image
    through: Image
    shown: DrawnView


class _Begun:
    """A picture that is being made by another thread, band by band."""

    def __init__(self, gaussians: ActivatedGaussians, shown: DrawnView) -> None:
        size = (shown.camera.height, shown.camera.width)
        self.stop = threading.Event()
        self.picture = _Kept(np.empty((*size, 3), np.float32), np.empty(size, np.float32), shown)
        self.bands: list[tuple[int, int]] = []  # that are done: first row, and one past the last
        self.drawn = _worker().submit(self._draw, gaussians)

    def _draw(self, gaussians: ActivatedGaussians) -> float:
        """Gives the milliseconds it took."""
        began, (height, width) = time.perf_counter(), self.picture.through.shape
        count = min(1 + len(gaussians.means) // BAND, MAX_BANDS, -(-height // MIN_ROWS))
        bands = [(height * k // count, height * (k + 1) // count) for k in range(count)]
        with stopped_by(self.stop):
            for top, end in sorted(bands, key=lambda band: abs(sum(band) - height)):  # the middle first
                part = _draw(gaussians, self.picture.shown, (0, top, width, end))
                self.picture.image[top:end], self.picture.through[top:end] = part
                self.bands.append((top, end))
        return 1e3 * (time.perf_counter() - began)


class CpuRenderer:
    """Draws with `progdf.rasterize`, about four times faster than OpenGL in software.

    Args:
        ctx: where pictures are shown; None where they are only read
    """

    wants_order = False

    def __init__(self, ctx: moderngl.Context | None = None) -> None:
        self._ctx = ctx
        self._copy: ScreenCopy | None = None
        self._bands = 0  # of what was begun that the copy shows
        self._stale = True  # whether the copy is behind the picture
        self._kept: _Kept | None = None
        self._grid: Lines | None = None  # what the copy shows of it
        self._changed = True  # whether Gaussians have changed since the kept picture
        self._begun: _Begun | None = None
        self.begun_ms = 0.0

    def upload(self, scene: Gaussians) -> None:
        """Take a whole scene. The renderer's copies are what was drawn, when `scene` is written in place."""
        self._drop()
        self._scene = LiveScene(scene)
        self._kept = None
        for side in (1, 2):  # compiled now, and not under the first touch of a slider
            fill_screen(np.zeros((1, 1, 3), np.float32), np.zeros((side, side, 4), np.uint8))
        if self._ctx is not None:  # in a window something will move
            self._scene.begin_pyramid()

    def update(self, scene: Gaussians, attributes: Iterable[str], rows: NDArray[np.int64]) -> None:
        self._drop()
        self._changed = self._changed or len(rows) > 0
        self._scene.update(scene, attributes, rows)

    def highlight(self, rows: NDArray[np.int64], highlights: NDArray[np.uint8]) -> None:
        """See `GlRenderer.highlight`."""
        self._drop()
        self._changed = self._changed or len(rows) > 0
        self._scene.highlight(rows, highlights)

    def draw(self, camera: Camera, background: Vec3, order: NDArray[np.uint32], pixels: int = 1) -> None:
        """Make the picture; `order` is not used, the rasterizer sorts by itself. With more `pixels` than one
        it has fewer Gaussians."""
        begun = self._begun
        self.begun_ms = 0.0
        picture = None
        shown = DrawnView(camera, background, pixels)
        if pixels > 1:
            picture = self._scene.draw_fewer(lambda fewer: _draw(fewer, shown), camera, pixels)
        elif begun is not None and begun.picture.shown == shown:
            self.begun_ms = begun.drawn.result()
            picture = begun.picture.image, begun.picture.through
        picture = picture or _draw(self._scene.drawn, shown)
        if (coarse := self._coarse(shown)) is not None:
            self._scene.measure(coarse.image, picture[0])
        self._drop()
        self._kept = _Kept(*picture, shown)
        self._stale = True
        self._changed = False

    def prepare(self, camera: Camera, background: Vec3) -> bool:
        """See `GlRenderer.prepare`."""
        shown = DrawnView(camera, background)
        kept = None if self._changed else self._kept
        if kept is not None and kept.shown == shown:
            return True
        if self._begun is None or self._begun.picture.shown != shown:
            self._drop()
            self._begun = _Begun(self._scene.drawn, shown)
        return self._begun.drawn.done()

    def _drop(self) -> None:
        if self._begun is not None:
            self._begun.stop.set()
            self._begun = None

    def follow(self, last: object) -> bool:
        """See `GlRenderer.follow`."""
        if isinstance(last, CpuRenderer) and last._kept is not None:
            self._kept = last._kept
            self._stale = True
            self._changed = True
        return self._kept is not None

    def pixels(self) -> Image:
        """The picture, upper row first, not clamped; it stays as it is when the next one is drawn. [H,W,3]"""
        return require_picture(self._kept).image

    def show(
        self, screen: moderngl.Framebuffer, size: Size, left: int = 0, grid: Lines | None = None
    ) -> None:
        """See `GlRenderer.show`."""
        assert self._ctx is not None, "nothing to show on without a context"
        picture = require_picture(self._kept)
        begun = self._begun
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
            with lines_behind(picture.image, picture.through, lines, CLEAR):
                self._copy.write(picture.image)
        while begun is not None and self.has_parts:
            top, end = begun.bands[self._bands]
            image = begun.picture.image[top:end]
            through = begun.picture.through[top:end]
            here = lines * ([picture.shown.pixels] * 4 + [1] * 10) - ([0, top] * 2 + [0] * 10)
            with lines_behind(image, through, here.astype(np.float32), CLEAR):
                self._copy.write(image, top)
            self._bands += 1
        self._copy.show(screen)

    @property
    def has_parts(self) -> bool:
        """See `GlRenderer.has_parts`."""
        begun = self._begun
        if begun is None or len(begun.bands) <= self._bands:
            return False
        return self._coarse(begun.picture.shown) is not None

    def _coarse(self, full: DrawnView) -> _Kept | None:
        """The last picture, if that is `full` in fewer pixels."""
        kept = self._kept
        return None if kept is None or self._changed or not kept.shown.is_coarse(full) else kept

    def release(self) -> None:
        """Give back what it holds."""
        self._drop()
        if self._copy is not None:
            self._copy.release()


def _draw(gaussians: ActivatedGaussians, shown: DrawnView, crop: Crop | None = None) -> tuple[Image, Image]:
    """The picture and what shines through it."""
    with torch.no_grad():
        rendered = render(gaussians, shown.camera, shown.background, crop=crop)
    return rendered.image.numpy(), rendered.transmittance.numpy()


@cache
def _worker() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="picture")
