"""Drawing with OpenGL: a context without a window, and the depth sort."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

import moderngl
import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.rasterize import ActivatedGaussians
from progdf.rasterize.cpu.forward import depth_order
from progdf.sh import C0
from viewer.camera.view_camera import Vec3
from viewer.gl.present import Presenter
from viewer.gl.splats import GridPass, SplatRenderer

from .dynamic_resolution import DrawnView, LiveScene
from .ground_grid import Lines

Image = NDArray[np.float32]
Size = tuple[int, int]  # width and height, pixels

_ROOM = 1 << 14  # Gaussians that textures grow by
_MINIMUM = 1e-30  # of a scale, which has a logarithm

T = TypeVar("T")


class GlRenderer:
    """Keeps a scene ready for drawing and the last picture of it, with OpenGL (see `SplatRenderer`)."""

    wants_order = True
    """Whether `draw` uses the order it is given."""

    begun_ms = 0.0
    """What the last picture took before `draw` was called for it, milliseconds."""

    has_parts = False
    """Whether `show` would show more of the picture that was begun."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._renderer = SplatRenderer(ctx)
        self._moving: tuple[LiveScene, SplatRenderer] | None = None  # what is drawn while something moves
        self._presenter = Presenter(ctx)
        self._picture: moderngl.Texture | None = None
        self._shown: DrawnView | None = None  # by it, unless Gaussians have changed since
        self._grid: GridPass | None = None

    def upload(self, scene: Gaussians) -> None:
        """Take a whole scene."""
        self._scene = scene
        self._shown = None
        self._release_moving()
        self._renderer.upload(scene)
        self._ctx.finish()

    def update(self, scene: Gaussians, attributes: Iterable[str], rows: NDArray[np.int64]) -> None:
        """Take the changed attributes of the changed rows (sorted)."""
        self._scene, self._shown, names = scene, None, tuple(attributes)
        self._renderer.update(scene, names, rows)
        if self._moving is not None:
            self._moving[0].update(scene, names, rows)
        self._ctx.finish()

    def highlight(self, rows: NDArray[np.int64], highlights: NDArray[np.uint8]) -> None:
        """Draw Gaussians (sorted) in other colors from now on, whatever becomes of their own.

        Args:
            highlights: rgb and the share that it takes of a Gaussian's color, 0..255; 0 takes none, 255
                hides the Gaussian. [R,4]
        """
        self._shown = None
        self._renderer.highlight(rows, highlights)
        if self._moving is not None:
            self._moving[0].highlight(rows, highlights)

    def draw(self, camera: Camera, background: Vec3, order: NDArray[np.uint32], pixels: int = 1) -> None:
        """Make the picture and wait until it is done.

        Args:
            order: farthest first, from `back_to_front`
            pixels: of the picture at rest that one of this one stands for, each way
        """
        last = self._shown
        self._shown = DrawnView(camera, background, pixels)
        coarse = self.pixels() if last is not None and last.is_coarse(self._shown) else None
        self._picture = self._draw_fewer(camera, background, pixels) if pixels > 1 else None
        if self._picture is None:
            order = order if pixels == 1 else back_to_front(self._scene.means.numpy(), camera)
            self._renderer.set_order(order)
            self._picture = self._renderer.draw(camera, background)
        self._ctx.finish()
        if coarse is not None and self._moving is not None:
            self._moving[0].measure(coarse, self.pixels())

    def _draw_fewer(self, camera: Camera, background: Vec3, pixels: int) -> moderngl.Texture | None:
        if self._moving is None:
            live = LiveScene(self._scene)
            live.highlight(*self._renderer.highlights)
            self._moving = live, SplatRenderer(self._ctx)
        live, renderer = self._moving

        def draw(fewer: ActivatedGaussians) -> moderngl.Texture:
            gaussians = _to_raw(fewer)
            renderer.upload(gaussians, activated=True)
            renderer.set_order(back_to_front(gaussians.means[: len(fewer.means)].numpy(), camera))
            picture = renderer.draw(camera, background)
            self._ctx.finish()
            return picture

        return live.draw_fewer(draw, camera, pixels)

    def prepare(self, camera: Camera, background: Vec3) -> bool:
        """Begin the picture, if making it may take long, without waiting for it; whether `draw` now has it at
        once. Any other call drops what was begun."""
        return True

    def follow(self, last: object) -> bool:
        """Take over another's picture, to be shown until there is a new one; whether there was one."""
        return False

    def pixels(self) -> Image:
        """The picture, upper row first, not clamped. [H,W,3]"""
        picture = require_picture(self._picture)
        rgba = np.frombuffer(picture.read(), np.float32).reshape(picture.height, picture.width, 4)
        return np.ascontiguousarray(rgba[..., :3])

    def show(
        self, screen: moderngl.Framebuffer, size: Size, left: int = 0, grid: Lines | None = None
    ) -> None:
        """Fill the framebuffer's lower `size` pixels from `left` on with the picture.

        Args:
            grid: lines behind the splats, in pixels of the picture
        """
        picture = require_picture(self._picture)
        self._presenter.show(picture, screen, size, left)
        if grid is not None:
            self._grid = self._grid or GridPass(self._ctx)
            self._grid.draw(grid, picture, screen, size, left)

    def release(self) -> None:
        """Give back what it holds."""
        self._presenter.release()
        self._renderer.release()
        self._release_moving()
        if self._grid is not None:
            self._grid.release()

    def _release_moving(self) -> None:
        if self._moving is not None:
            self._moving[1].release()
            self._moving = None


def _to_raw(fewer: ActivatedGaussians) -> Gaussians:
    """As textures hold them, but for opacities, with empty ones behind them up to one of few sizes."""
    room = -(-max(len(fewer.means), 1) // _ROOM) * _ROOM - len(fewer.means)
    means, quats, scales, opacities, rgb = (
        torch.nn.functional.pad(tensor, (0, 0) * (tensor.ndim - 1) + (0, room)) for tensor in fewer.tensors
    )
    return Gaussians(
        means, quats, scales.clamp_min(_MINIMUM).log(), opacities,
        (rgb - 0.5) / C0, rgb.new_zeros(len(rgb), 0, 3),
    )  # fmt: skip


def require_picture(thing: T | None) -> T:
    if thing is None:
        raise ValueError("there is no picture yet; draw first")
    return thing


SOFTWARE = ("llvmpipe", "softpipe", "swiftshader", "microsoft basic render", "swrast")
"""Parts of GL_RENDERER, in lower case, of renderers that run on the processor."""


def headless_context() -> moderngl.Context:
    """A GL 3.3 core context of its own, through EGL where there is one. The caller releases it.

    Raises:
        ProgdfError: this machine has no OpenGL 3.3.
    """
    reasons = []
    for backend in ("egl", None):  # no EGL on Windows and macOS: their own way
        named = {} if backend is None else {"backend": backend}
        try:
            return moderngl.create_context(standalone=True, require=330, **named)  # type: ignore[arg-type]
        except Exception as error:  # each platform's loader raises its own kind
            reasons.append(" ".join(str(error).split()))
    raise ProgdfError(
        f"there is no OpenGL 3.3 here ({reasons[0]}); install libegl1 and libgl1, or use --engine cpu"
    )


def is_software(ctx: moderngl.Context) -> bool:
    """Whether the context draws on the processor; then the CPU rasterizer is several times faster."""
    renderer = str(ctx.info["GL_RENDERER"]).lower()
    return any(name in renderer for name in SOFTWARE)


def back_to_front(means: NDArray[np.float32], camera: Camera) -> NDArray[np.uint32]:
    """Rows in front of the near plane, farthest first; the exact reverse of (float32 depth, index) ascending.

    Args:
        means: centers, world units; a row that is not finite is left out. [N,3]
        camera: only its `viewmat` and `near` count

    Returns:
        [V] uint32, V ≤ N
    """
    row = camera.viewmat[2].double().numpy()
    # float64 as the CPU engine does: another rounding would swap neighbors
    with np.errstate(invalid="ignore", over="ignore"):
        depths = means.astype(np.float64) @ row[:3] + row[3]
        visible = (depths > camera.near) & (depths < np.inf)
        return depth_order(depths.astype(np.float32), visible)[::-1].astype(np.uint32)
