"""Draws with the CPU rasterizer and keeps the picture."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache

import moderngl
import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize import ActivatedGaussians, render
from progdf.rasterize.screen import fill_screen, lines_behind
from progdf.threads import stopped_by
from viewer.camera.view_camera import Vec3
from viewer.gl.present import ScreenCopy

from .dynamic_resolution import LiveScene
from .gl_renderer import Renderer
from .ground_grid import CLEAR, Lines

Image = NDArray[np.float32]


@dataclass(frozen=True)
class _Kept:
    """The last picture, what shines through it, 0..1 [H,W], and what it shows."""

    image: Image
    through: Image
    camera: Camera
    background: Vec3

    def shows(self, camera: Camera, background: Vec3) -> bool:
        return _same(self.camera, self.background, camera, background)


class _Begun:
    """A picture that is being made by another thread.

    Args:
        gaussians: what it shows
        camera, background: how
    """

    def __init__(self, gaussians: ActivatedGaussians, camera: Camera, background: Vec3) -> None:
        self._camera, self._background = camera, background
        self._stop, self._ms = threading.Event(), 0.0
        self._found: Future[tuple[Image, Image]] = _worker().submit(self._draw, gaussians)

    def shows(self, camera: Camera, background: Vec3) -> bool:
        return _same(self._camera, self._background, camera, background)

    def done(self) -> bool:
        return self._found.done()

    def result(self) -> tuple[tuple[Image, Image], float]:
        """The picture, as `_draw`, waited for, and the milliseconds it took."""
        return self._found.result(), self._ms

    def drop(self) -> None:
        self._stop.set()

    def _draw(self, gaussians: ActivatedGaussians) -> tuple[Image, Image]:
        began = time.perf_counter()
        with stopped_by(self._stop):
            picture = _draw(gaussians, self._camera, self._background)
        self._ms = 1e3 * (time.perf_counter() - began)
        return picture


class CpuRenderer:
    """Draws with `progdf.rasterize`, about four times faster than OpenGL in software.

    Args:
        ctx: where pictures are shown; None where they are only read
    """

    wants_order = False

    def __init__(self, ctx: moderngl.Context | None = None) -> None:
        self._ctx = ctx
        self._copy: ScreenCopy | None = None
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
        """See `Renderer.highlight`."""
        self._drop()
        self._changed = self._changed or len(rows) > 0
        self._scene.highlight(rows, highlights)

    def draw(self, camera: Camera, background: Vec3, order: NDArray[np.uint32], pixels: int = 1) -> None:
        """Make the picture; `order` is not used, the rasterizer sorts by itself. With more `pixels` than one
        it has fewer Gaussians."""
        begun, self.begun_ms, picture = self._begun, 0.0, None
        if pixels > 1:
            picture = self._scene.draw_fewer(lambda fewer: _draw(fewer, camera, background), camera, pixels)
        elif begun is not None and begun.shows(camera, background):
            picture, self.begun_ms = begun.result()
        picture = picture or _draw(self._scene.drawn, camera, background)
        self._drop()
        self._kept, self._stale, self._changed = _Kept(*picture, camera, background), True, pixels > 1

    def prepare(self, camera: Camera, background: Vec3) -> bool:
        """See `Renderer.prepare`."""
        if self._kept is not None and not self._changed and self._kept.shows(camera, background):
            return True
        if self._begun is None or not self._begun.shows(camera, background):
            self._drop()
            self._begun = _Begun(self._scene.drawn, camera, background)
        return self._begun.done()

    def _drop(self) -> None:
        if self._begun is not None:
            self._begun.drop()
            self._begun = None

    def follow(self, last: Renderer) -> bool:
        """See `Renderer.follow`."""
        if isinstance(last, CpuRenderer) and last._kept is not None:
            self._kept, self._stale, self._changed = last._kept, True, True
        return self._kept is not None

    def pixels(self) -> Image:
        """The picture, upper row first, not clamped; it stays as it is when the next one is drawn. [H,W,3]"""
        return self._picture().image

    def show(
        self,
        framebuffer: moderngl.Framebuffer,
        size: tuple[int, int] | None = None,
        left: int = 0,
        grid: Lines | None = None,
    ) -> None:
        """See `Renderer.show`."""
        assert self._ctx is not None, "nothing to show on without a context"
        picture = self._picture()
        image = picture.image
        size = size or (image.shape[1], image.shape[0])
        if self._copy is None or (self._copy.size, self._copy.left) != (size, left):
            if self._copy is not None:
                self._copy.release()
            self._copy, self._stale = ScreenCopy(self._ctx, size, left), True
        if grid is not self._grid:
            self._grid, self._stale = grid, True
        if self._stale and grid is None:
            self._copy.write(image)
        elif self._stale and grid is not None:  # cheaper than another picture, or another pass of software GL
            lines = grid.view(np.float32).reshape(len(grid), -1)
            with lines_behind(image, picture.through, lines, CLEAR):
                self._copy.write(image)
        self._stale = False
        self._copy.show(framebuffer)

    def release(self) -> None:
        """Give back what it holds."""
        self._drop()
        if self._copy is not None:
            self._copy.release()

    def _picture(self) -> _Kept:
        if self._kept is None:
            raise ValueError("there is no picture yet; draw first")
        return self._kept


def _draw(gaussians: ActivatedGaussians, camera: Camera, background: Vec3) -> tuple[Image, Image]:
    """The picture and what shines through it."""
    with torch.no_grad():
        rendered = render(gaussians, camera, background)
    return rendered.image.numpy(), rendered.transmittance.numpy()


def _same(camera: Camera, background: Vec3, other: Camera, other_background: Vec3) -> bool:
    """Whether two cameras take the same picture, on the same background."""
    return (
        background == other_background
        and (camera.width, camera.height) == (other.width, other.height)
        and torch.equal(camera.viewmat, other.viewmat)
        and torch.equal(camera.K, other.K)
    )


@cache
def _worker() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="picture")
