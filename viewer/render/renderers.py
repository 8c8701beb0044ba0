"""Two ways to draw a scene, one interface: OpenGL, and the CPU rasterizer (cpu_renderer.py)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, TypeVar

import moderngl
import numpy as np
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from viewer.camera.up_axis import Vec3
from viewer.gl.grid_pass import GridPass
from viewer.gl.present import Presenter
from viewer.gl.splats import SplatRenderer

from .ground_grid import Lines

Image = NDArray[np.float32]
T = TypeVar("T")


class Renderer(Protocol):
    """Keeps a scene ready for drawing and the last picture of it."""

    wants_order: bool
    """Whether `draw` uses the order it is given."""

    begun_ms: float
    """What the last picture took before `draw` was called for it, milliseconds."""

    def upload(self, scene: Gaussians) -> None:
        """Take a whole scene."""

    def update(self, scene: Gaussians, attributes: Iterable[str], rows: NDArray[np.int64]) -> None:
        """Take the changed attributes of the changed rows (sorted)."""

    def highlight(self, rows: NDArray[np.int64], highlights: NDArray[np.uint8]) -> None:
        """Draw Gaussians (sorted) in other colors from now on, whatever becomes of their own.

        Args:
            highlights: rgb and the share that it takes of a Gaussian's color, 0..255; 0 takes none, 255
                hides the Gaussian. [R,4]
        """

    def draw(self, camera: Camera, background: Vec3, order: NDArray[np.uint32], pixels: int = 1) -> None:
        """Make the picture and wait until it is done.

        Args:
            order: farthest first, from `depth_sort.back_to_front`
            pixels: of the picture at rest that one of this one stands for, each way
        """

    def prepare(self, camera: Camera, background: Vec3) -> bool:
        """Begin the picture, if making it may take long, without waiting for it; whether `draw` now has it at
        once. Any other call drops what was begun."""

    def follow(self, last: Renderer) -> bool:
        """Take over another's picture, to be shown until there is a new one; whether there was one."""

    def pixels(self) -> Image:
        """The picture, upper row first, not clamped. [H,W,3]"""

    def show(
        self,
        framebuffer: moderngl.Framebuffer,
        size: tuple[int, int] | None = None,
        left: int = 0,
        grid: Lines | None = None,
    ) -> None:
        """Fill the framebuffer's lower `size` pixels from `left` on with the picture; None: as many as it
        has.

        Args:
            grid: lines behind the splats, in pixels of the picture
        """

    def release(self) -> None:
        """Give back what it holds."""


class GlRenderer:
    """Draws with OpenGL (see `SplatRenderer`)."""

    wants_order = True
    begun_ms = 0.0

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._renderer = SplatRenderer(ctx)
        self._presenter = Presenter(ctx)
        self._picture: moderngl.Texture | None = None
        self._grid: GridPass | None = None

    def upload(self, scene: Gaussians) -> None:
        self._renderer.upload(scene)
        self._ctx.finish()

    def update(self, scene: Gaussians, attributes: Iterable[str], rows: NDArray[np.int64]) -> None:
        self._renderer.update(scene, attributes, rows)
        self._ctx.finish()

    def highlight(self, rows: NDArray[np.int64], highlights: NDArray[np.uint8]) -> None:
        self._renderer.highlight(rows, highlights)

    def draw(self, camera: Camera, background: Vec3, order: NDArray[np.uint32], pixels: int = 1) -> None:
        self._renderer.set_order(order)
        self._picture = self._renderer.draw(camera, background)
        self._ctx.finish()

    def prepare(self, camera: Camera, background: Vec3) -> bool:
        return True

    def follow(self, last: Renderer) -> bool:
        return False

    def pixels(self) -> Image:
        picture = _require_picture(self._picture)
        rgba = np.frombuffer(picture.read(), np.float32).reshape(picture.height, picture.width, 4)
        return np.ascontiguousarray(rgba[..., :3])

    def show(
        self,
        framebuffer: moderngl.Framebuffer,
        size: tuple[int, int] | None = None,
        left: int = 0,
        grid: Lines | None = None,
    ) -> None:
        picture = _require_picture(self._picture)
        self._presenter.show(picture, framebuffer, size, left)
        if grid is not None:
            self._grid = self._grid or GridPass(self._ctx)
            self._grid.draw(grid, picture, framebuffer, size or picture.size, left)

    def release(self) -> None:
        self._presenter.release()
        self._renderer.release()
        if self._grid is not None:
            self._grid.release()


def _require_picture(thing: T | None) -> T:
    if thing is None:
        raise ValueError("there is no picture yet; draw first")
    return thing
