"""Two ways to draw a scene, one interface: OpenGL, and the CPU rasteriser where OpenGL is only software."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, TypeVar

import moderngl
import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize import rasterize

from .gl.layout import SPLATS_PER_ROW
from .gl.present import Presenter
from .gl.scene_textures import row_runs
from .gl.splats import SplatRenderer
from .state import Vec3

Image = NDArray[np.float32]
T = TypeVar("T")


class Painter(Protocol):
    """Keeps a scene ready for drawing and the last picture of it."""

    wants_order: bool
    """Whether `draw` uses the order it is given."""

    def upload(self, scene: Gaussians) -> None:
        """Take a whole scene."""

    def update(self, scene: Gaussians, attributes: Iterable[str], rows: NDArray[np.int64]) -> None:
        """Take the changed attributes of the changed rows (sorted)."""

    def draw(self, camera: Camera, background: Vec3, order: NDArray[np.uint32]) -> None:
        """Make the picture and wait until it is done. `order`: farthest first, from `sort.back_to_front`"""

    def pixels(self) -> Image:
        """The picture, upper row first, not clamped. [H,W,3]"""

    def show(self, framebuffer: moderngl.Framebuffer) -> None:
        """Copy the picture to the framebuffer's lower left corner."""

    def release(self) -> None:
        """Give back what it holds."""


class GlPainter:
    """Draws with OpenGL (see `SplatRenderer`)."""

    wants_order = True

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._renderer = SplatRenderer(ctx)
        self._presenter = Presenter(ctx)
        self._picture: moderngl.Texture | None = None

    def upload(self, scene: Gaussians) -> None:
        self._renderer.upload(scene)
        self._ctx.finish()

    def update(self, scene: Gaussians, attributes: Iterable[str], rows: NDArray[np.int64]) -> None:
        self._renderer.update(scene, attributes, rows)
        self._ctx.finish()

    def draw(self, camera: Camera, background: Vec3, order: NDArray[np.uint32]) -> None:
        self._renderer.set_order(order)
        self._picture = self._renderer.draw(camera, background)
        self._ctx.finish()

    def pixels(self) -> Image:
        picture = _drawn(self._picture)
        rgba = np.frombuffer(picture.read(), np.float32).reshape(picture.height, picture.width, 4)
        return np.ascontiguousarray(rgba[..., :3])

    def show(self, framebuffer: moderngl.Framebuffer) -> None:
        self._presenter.show(_drawn(self._picture), framebuffer)

    def release(self) -> None:
        self._presenter.release()
        self._renderer.release()


class CpuPainter:
    """Draws with `progdf.rasterize`, about four times faster than OpenGL in software.

    Args:
        ctx: where pictures are shown; None where they are only read
    """

    wants_order = False

    def __init__(self, ctx: moderngl.Context | None = None) -> None:
        self._ctx = ctx
        self._presenter = None if ctx is None else Presenter(ctx)
        self._texture: moderngl.Texture | None = None
        self._picture: torch.Tensor | None = None
        self._shown: torch.Tensor | None = None  # the picture that the texture holds
        self._scene: Gaussians | None = None

    def upload(self, scene: Gaussians) -> None:
        self._scene = scene
        self._scales, self._opacities = _exp(scene.log_scales), _sigmoid(scene.logit_opacities)
        self._sh = scene.sh
        self._degree = min(scene.sh_degree, 3)

    def update(self, scene: Gaussians, attributes: Iterable[str], rows: NDArray[np.int64]) -> None:
        self._scene = scene
        for first, last in row_runs(rows):  # whole runs, as slices are many times faster than indices
            part = slice(first * SPLATS_PER_ROW, last * SPLATS_PER_ROW)
            for name in attributes:
                if name == "log_scales":
                    self._scales[part] = _exp(scene.log_scales[part])
                elif name == "logit_opacities":
                    self._opacities[part] = _sigmoid(scene.logit_opacities[part])
                elif name == "sh0":
                    self._sh.numpy()[part, 0] = scene.sh0.numpy()[part]
                elif name == "shN":
                    self._sh.numpy()[part, 1:] = scene.shN.numpy()[part]

    def draw(self, camera: Camera, background: Vec3, order: NDArray[np.uint32]) -> None:
        scene = _drawn(self._scene)
        with torch.no_grad():
            self._picture, _, _ = rasterize(
                scene.means,
                scene.quats,
                self._scales,
                self._opacities,
                self._sh,
                camera.viewmat,
                camera.K,
                camera.width,
                camera.height,
                background,
                sh_degree=self._degree,
            )

    def pixels(self) -> Image:
        pixels: Image = _drawn(self._picture).numpy()
        return pixels

    def show(self, framebuffer: moderngl.Framebuffer) -> None:
        assert self._ctx is not None, "nothing to show on without a context"
        assert self._presenter is not None
        if self._shown is not self._picture or self._texture is None:
            image = np.ascontiguousarray(self.pixels())
            size = (image.shape[1], image.shape[0])
            if self._texture is None or self._texture.size != size:
                if self._texture is not None:
                    self._texture.release()
                self._texture = self._ctx.texture(size, 3, dtype="f4")
            self._texture.write(image)
            self._shown = self._picture
        self._presenter.show(self._texture, framebuffer)

    def release(self) -> None:
        if self._texture is not None:
            self._texture.release()
        if self._presenter is not None:
            self._presenter.release()


def _exp(values: torch.Tensor) -> torch.Tensor:
    """With numpy, on one thread: torch's threads would spin against the rasteriser's."""
    with np.errstate(over="ignore", invalid="ignore"):
        return torch.from_numpy(np.exp(values.detach().numpy()))


def _sigmoid(values: torch.Tensor) -> torch.Tensor:
    with np.errstate(over="ignore", invalid="ignore"):
        return torch.from_numpy(1.0 / (1.0 + np.exp(-values.detach().numpy())))


def _drawn(thing: T | None) -> T:
    if thing is None:
        raise ValueError("there is no picture yet; draw first")
    return thing
