"""OpenGL renderer, headless context and depth sort."""

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
from viewer.gl.splats import DrawMode, GridPass, SplatRenderer

from .dynamic_resolution import DrawnView, LiveScene, MovingGrade
from .ground_grid import Lines
from .view_modes import CENTERS, DOT_PX, RAMP_COLORS, RECOLORED, RINGS, SPLATS, can_merge, depth_range

Image = NDArray[np.float32]
Size = tuple[int, int]  # width and height, pixels

_TEXTURE_STEP = 1 << 14  # number of Gaussians by which textures grow
_MIN_SCALE = 1e-30  # smallest scale, so that it has a logarithm

T = TypeVar("T")


class GlRenderer:
    """OpenGL renderer of a scene that keeps the last picture (see `SplatRenderer`)."""

    wants_order = True
    """True if `draw` uses the given order."""

    begun_ms = 0.0
    """Background time spent on the last picture before `draw` was called, ms."""

    has_parts = False
    """True if `show` would show further bands of the pending picture."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._renderer = SplatRenderer(ctx)
        self._moving: tuple[LiveScene, SplatRenderer] | None = None  # scene and renderer during motion
        self._presenter = Presenter(ctx)
        self._picture: moderngl.Texture | None = None
        self._shown: DrawnView | None = None  # view of the picture, None after a change of Gaussians
        self._grid: GridPass | None = None

    def upload(self, scene: Gaussians) -> None:
        """Load a whole scene."""
        self._scene = scene
        self._shown = None
        self._release_moving()
        self._renderer.upload(scene)
        self._ctx.finish()

    def update(self, scene: Gaussians, attributes: Iterable[str], rows: NDArray[np.int64]) -> None:
        """Update the given attributes of the given sorted rows [R]."""
        self._scene = scene
        self._shown = None
        names = tuple(attributes)
        self._renderer.update(scene, names, rows)
        if self._moving is not None:
            self._moving[0].update(scene, names, rows)
        self._ctx.finish()

    def show_grade(self, graded: Gaussians | None, rows: NDArray[np.int64]) -> None:
        """Draw full pictures with other base colors of some rows.

        Args:
            graded: the scene with these base colors; None for its own
            rows: sorted indices. [M]
        """
        self._shown = None
        self._renderer.update(graded or self._scene, ("sh0",), rows)
        self._ctx.finish()

    def grade_motion(self, grade: MovingGrade | None) -> bool:
        """Set the grade of pictures during motion. Return whether they do without the colors of full ones."""
        if self._moving is None:
            return False
        self._moving[0].moving_grade = grade
        return self._moving[0].has_pyramid

    def highlight(self, rows: NDArray[np.int64], highlights: NDArray[np.uint8]) -> None:
        """Override the colors of Gaussians until the next call, also when their own colors change.

        Args:
            rows: sorted indices. [R]
            highlights: rgb and its share of the color, 0 to 255. A share of 0 is none, 255 hides the
                Gaussian. [R,4]
        """
        self._shown = None
        self._renderer.highlight(rows, highlights)
        if self._moving is not None:
            self._moving[0].highlight(rows, highlights)

    def draw(
        self,
        camera: Camera,
        background: Vec3,
        order: NDArray[np.uint32],
        pixels: int = 1,
        mode: str = SPLATS,
    ) -> None:
        """Draw the picture and wait until it is finished.

        Args:
            camera: its size is the picture's
            background: rgb behind the scene
            order: rows, farthest first, from `back_to_front`
            pixels: full-resolution pixels per pixel of this picture, along each axis
            mode: one of `view_state.VIEW_MODES`
        """
        last = self._shown
        self._shown = DrawnView(camera, background, pixels, mode)
        coarse = self.pixels() if last is not None and last.is_coarse(self._shown) else None
        self._picture = None
        if pixels > 1:
            self._picture = self._draw_fewer(camera, background, pixels, mode)
        if self._picture is None:
            order = order if pixels == 1 else back_to_front(self._scene.means.numpy(), camera)
            self._renderer.set_order(order)
            self._picture = self._renderer.draw(camera, background, self._draw_mode(mode, camera))
        self._ctx.finish()
        if coarse is not None and mode == SPLATS and self._moving is not None:
            self._moving[0].measure(coarse, self.pixels())

    def _draw_mode(self, mode: str, camera: Camera) -> DrawMode:
        """Return a mode in the renderer's form."""
        depths = depth_range(self._scene.means, camera) if mode == "depth" else DrawMode.depths
        colors = RECOLORED.index(mode) + 1 if mode in RECOLORED else 0
        dot_px = DOT_PX if mode == CENTERS else 0.0
        return DrawMode(colors, dot_px, mode == RINGS, depths, RAMP_COLORS)

    def _draw_fewer(
        self, camera: Camera, background: Vec3, pixels: int, mode: str
    ) -> moderngl.Texture | None:
        if self._moving is None:
            live = LiveScene(self._scene)
            live.highlight(*self._renderer.highlights)
            self._moving = live, SplatRenderer(self._ctx)
        live, renderer = self._moving
        if not can_merge(mode, live.highlights is not None):
            return None

        def draw(fewer: ActivatedGaussians) -> moderngl.Texture:
            gaussians = _to_raw(fewer)
            renderer.upload(gaussians, activated=True)
            renderer.set_order(back_to_front(gaussians.means[: len(fewer.means)].numpy(), camera))
            picture = renderer.draw(camera, background, self._draw_mode(mode, camera))
            self._ctx.finish()
            return picture

        return live.draw_fewer(draw, camera, pixels)

    def prepare(self, camera: Camera, background: Vec3, mode: str = SPLATS) -> bool:
        """Begin a slow picture in the background. Return whether `draw` can finish it at once.

        Any other call cancels the pending picture. With OpenGL no picture is slow.
        """
        return True

    def follow(self, last: object) -> bool:
        """Take over another renderer's picture until the next draw. Return False if it is not possible."""
        return False

    def pixels(self) -> Image:
        """Return the picture, upper row first, not clamped. [H,W,3]"""
        picture = require_picture(self._picture)
        rgba = np.frombuffer(picture.read(), np.float32).reshape(picture.height, picture.width, 4)
        return np.ascontiguousarray(rgba[..., :3])

    def show(
        self, screen: moderngl.Framebuffer, size: Size, left: int = 0, grid: Lines | None = None
    ) -> None:
        """Fill the framebuffer's lower `size` pixels, from column `left`, with the picture.

        Args:
            screen: target
            size: width and height, px
            left: first column, px
            grid: grid lines behind the splats, in pixels of the picture
        """
        picture = require_picture(self._picture)
        self._presenter.show(picture, screen, size, left)
        if grid is not None:
            self._grid = self._grid or GridPass(self._ctx)
            self._grid.draw(grid, picture, screen, size, left)

    def release(self) -> None:
        """Release all GL objects."""
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
    """Convert to the parameters of textures, with activated opacities.

    Empty Gaussians pad them to a multiple of `_TEXTURE_STEP`, so that texture sizes rarely change.
    """
    padding = -(-max(len(fewer.means), 1) // _TEXTURE_STEP) * _TEXTURE_STEP - len(fewer.means)
    means, quats, scales, opacities, rgb = (
        torch.nn.functional.pad(tensor, (0, 0) * (tensor.ndim - 1) + (0, padding)) for tensor in fewer.tensors
    )
    return Gaussians(
        means, quats, scales.clamp_min(_MIN_SCALE).log(), opacities,
        (rgb - 0.5) / C0, rgb.new_zeros(len(rgb), 0, 3),
    )  # fmt: skip


def require_picture(thing: T | None) -> T:
    if thing is None:
        raise ValueError("there is no picture yet; draw first")
    return thing


SOFTWARE = ("llvmpipe", "softpipe", "swiftshader", "microsoft basic render", "swrast")
"""Lower-case substrings of GL_RENDERER that identify software renderers."""


def headless_context() -> moderngl.Context:
    """Create a standalone GL 3.3 core context, through EGL if available. The caller releases it.

    Raises:
        ProgdfError: this machine has no OpenGL 3.3.
    """
    reasons = []
    for backend in ("egl", None):  # Windows and macOS have no EGL
        options = {} if backend is None else {"backend": backend}
        try:
            return moderngl.create_context(standalone=True, require=330, **options)  # type: ignore[arg-type]
        except Exception as error:  # each platform's loader raises its own type
            reasons.append(" ".join(str(error).split()))
    raise ProgdfError(
        f"OpenGL 3.3 is not available ({reasons[0]}); install libegl1 and libgl1, or use --engine cpu"
    )


def is_software(ctx: moderngl.Context) -> bool:
    """Return whether the context renders in software. The CPU rasterizer is then several times faster."""
    renderer = str(ctx.info["GL_RENDERER"]).lower()
    return any(name in renderer for name in SOFTWARE)


def back_to_front(means: NDArray[np.float32], camera: Camera) -> NDArray[np.uint32]:
    """Sort the rows in front of the near plane, farthest first.

    The order is the exact reverse of ascending (float32 depth, index).

    Args:
        means: centers, world units; rows that are not finite are left out. [N,3]
        camera: only its `viewmat` and `near` are used

    Returns:
        [V] uint32, V ≤ N
    """
    row = camera.viewmat[2].double().numpy()
    # float64 as in the CPU engine, as other rounding would swap neighbors
    with np.errstate(invalid="ignore", over="ignore"):
        depths = means.astype(np.float64) @ row[:3] + row[3]
        visible = (depths > camera.near) & (depths < np.inf)
        return depth_order(depths.astype(np.float32), visible)[::-1].astype(np.uint32)
