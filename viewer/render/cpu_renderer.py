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
from progdf.rasterize.simplification import simplify
from progdf.sh import C0
from progdf.threads import stopped_by
from viewer.camera.view_camera import Vec3
from viewer.gl.present import ScreenCopy
from viewer.gl.scene_textures import SPLATS_PER_ROW, row_runs

from .gl_renderer import Renderer
from .ground_grid import CLEAR, Lines
from .highlight import HIDDEN

Image = NDArray[np.float32]

SH = ("sh0", "shN")

BUDGETS = 50_000, 140_000, 500_000
"""How many Gaussians a picture in motion has at most: on a slow machine, at first, on a quick one."""

MOVING_MS = 40.0, 65.0
"""What such a picture shall take; with more or less time, the next one has fewer or more Gaussians."""


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
        self._highlights: Image | None = None  # rgb and its share, 0..1; None is no highlight. [N,4]
        self._begun: _Begun | None = None
        self._budget = BUDGETS[1]
        self.begun_ms = 0.0

    def upload(self, scene: Gaussians) -> None:
        """Take a whole scene. The renderer's copies are what was drawn, when `scene` is written in place."""
        self._drop()
        self._drawn = ActivatedGaussians(
            means=torch.from_numpy(_copy(scene.means)),
            quats=torch.from_numpy(_copy(scene.quats)),
            scales=torch.from_numpy(_exp(scene.log_scales)),
            opacities=torch.from_numpy(_sigmoid(scene.logit_opacities)),
            colors=scene.sh,
            antialiased=scene.antialiased,
        )
        self._scene, self._highlights = scene, None
        self._kept = None
        for side in (1, 2):  # compiled now, and not under the first touch of a slider
            fill_screen(np.zeros((1, 1, 3), np.float32), np.zeros((side, side, 4), np.uint8))
        if len(scene.means) > BUDGETS[2]:
            simplify(self._drawn.select(torch.arange(2)), Camera(torch.eye(4), torch.eye(3), 1, 1), 1)

    def update(self, scene: Gaussians, attributes: Iterable[str], rows: NDArray[np.int64]) -> None:
        self._drop()
        self._scene, names = scene, tuple(attributes)
        highlighted = self._highlights is not None and any(name in SH for name in names)
        names = tuple(dict.fromkeys((*names, *SH))) if highlighted else names
        self._changed = self._changed or len(rows) > 0
        for first, last in row_runs(rows):  # whole runs, as slices are many times faster than indices
            part = slice(first * SPLATS_PER_ROW, last * SPLATS_PER_ROW)
            for name in names:
                self._write(scene, name, part)
            if highlighted:
                self._apply_highlight(part)

    def highlight(self, rows: NDArray[np.int64], highlights: NDArray[np.uint8]) -> None:
        """See `Renderer.highlight`."""
        if self._highlights is None:
            self._highlights = np.zeros((len(self._drawn.means), 4), np.float32)
        hidden = self._highlights[rows, 3] == 1.0
        self._highlights[rows] = highlights.astype(np.float32) / 255.0
        names = SH if (hidden == (highlights[:, 3] == HIDDEN)).all() else ("logit_opacities", *SH)
        self.update(self._scene, names, rows)
        if not self._highlights[:, 3].any():
            self._highlights = None

    def draw(self, camera: Camera, background: Vec3, order: NDArray[np.uint32], pixels: int = 1) -> None:
        """Make the picture; `order` is not used, the rasterizer sorts by itself. With more `pixels` than one
        it has fewer Gaussians."""
        begun, self.begun_ms = self._begun, 0.0
        if pixels > 1:
            picture = self._draw_fewer(camera, background, pixels)
        elif begun is not None and begun.shows(camera, background):
            picture, self.begun_ms = begun.result()
        else:
            picture = _draw(self._drawn, camera, background)
        self._drop()
        self._kept, self._stale, self._changed = _Kept(*picture, camera, background), True, pixels > 1

    def _draw_fewer(self, camera: Camera, background: Vec3, pixels: int) -> tuple[Image, Image]:
        began = time.perf_counter()
        fewer = simplify(self._drawn, camera, self._budget, pixels)
        picture = _draw(fewer, camera, background)
        taken, (low, high) = 1e3 * (time.perf_counter() - began), MOVING_MS
        if taken > high or (taken < low and len(fewer.means) > 0.9 * self._budget):
            budget = int(self._budget * (0.85 if taken > high else 1.15))
            self._budget = min(max(budget, BUDGETS[0]), BUDGETS[2])
        return picture

    def prepare(self, camera: Camera, background: Vec3) -> bool:
        """See `Renderer.prepare`."""
        if self._kept is not None and not self._changed and self._kept.shows(camera, background):
            return True
        if self._begun is None or not self._begun.shows(camera, background):
            self._drop()
            self._begun = _Begun(self._drawn, camera, background)
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

    def _write(self, scene: Gaussians, name: str, part: slice) -> None:
        means, quats, scales, opacities, sh = (tensor.numpy() for tensor in self._drawn.tensors)
        match name:
            case "means":
                means[part] = scene.means[part].numpy()
            case "quats":
                quats[part] = scene.quats[part].numpy()
            case "log_scales":
                scales[part] = _exp(scene.log_scales[part])
            case "logit_opacities":
                opacities[part] = _sigmoid(scene.logit_opacities[part])
                if self._highlights is not None:
                    opacities[part] *= self._highlights[part, 3] < 1.0
            case "sh0":
                sh[part, 0] = scene.sh0[part].numpy()
            case "shN":
                sh[part, 1:] = scene.shN[part].numpy()

    def _apply_highlight(self, part: slice) -> None:
        """Mix the highlights into colors that were just written: all bands, as color is linear in them."""
        assert self._highlights is not None, "nothing to highlight with"
        sh, share = self._drawn.colors.numpy()[part], self._highlights[part, 3:]
        sh *= 1.0 - share[:, :, None]
        sh[:, 0] += share * (self._highlights[part, :3] - 0.5) / C0

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


def _copy(values: torch.Tensor) -> Image:
    return np.array(values.detach().numpy(), np.float32, order="C")


def _exp(values: torch.Tensor) -> Image:
    """With numpy, on one thread: torch's threads would spin against the rasterizer's."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.exp(_copy(values))


def _sigmoid(values: torch.Tensor) -> Image:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(1.0 / (1.0 + np.exp(-_copy(values))), np.float32)
