"""Splat pass: project every Gaussian once, then blend triangles back to front."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.gaussians import Gaussians

from .programs import load_program
from .scene_textures import GRID_LINE, MAX_DRAWN_SH, ORDER, PROJECTED, HighlightTexture, SplatTextures

Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class DrawMode:
    """Colors and shapes of the Gaussians in a picture, see `viewer.render.view_modes`."""

    colors: int = 0  # `view_mode` of include/view_modes.glsl
    dot_px: float = 0.0  # above 0: dots with this standard deviation in pixels
    rings: bool = False  # draw outlines
    depths: tuple[float, float] = (0.0, 1.0)  # depths of the near and far end of the ramp, world units
    ramp: tuple[Rgb, ...] = ((0.0, 0.0, 0.0),) * 5  # its colors at 0, 1/4, 1/2, 3/4 and 1


PLAIN = DrawMode()


@dataclass(frozen=True)
class _Buffers:
    """Buffers with one entry per Gaussian (drawing order, projections) and their vertex arrays."""

    order: moderngl.Buffer
    projected: moderngl.Buffer
    project: moderngl.VertexArray
    splat: moderngl.VertexArray
    rings: moderngl.VertexArray

    def release(self) -> None:
        for resource in (self.project, self.splat, self.rings, self.order, self.projected):
            resource.release()


@dataclass(frozen=True)
class _Target:
    """Target picture: premultiplied rgb over the background, and 1 − transmittance. RGBA32F"""

    texture: moderngl.Texture
    framebuffer: moderngl.Framebuffer

    def release(self) -> None:
        self.framebuffer.release()
        self.texture.release()


class SplatRenderer:
    """Renderer of a scene into an RGBA32F texture. Row 0 of the texture is the top row of the picture.

    The CPU engine, like 3DGS, skips a Gaussian that would reduce a pixel's transmittance to 1e-4 or below,
    and all Gaussians behind it. Back-to-front blending draws them, as it does not know the later Gaussians in
    front. The difference is at most 0.01 of a color, 76 to 80 dB in a picture. Without that rule the engines
    agree to 120 dB and more.
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self._project = load_program(ctx, "project.vert", varyings=PROJECTED.names or ())
        self._splat = load_program(ctx, "splat.vert", "splat.frag")
        self._rings = load_program(ctx, "splat.vert", "rings.frag")
        self._scene: SplatTextures | None = None
        self._highlights: HighlightTexture | None = None
        self._buffers: _Buffers | None = None
        self._target: _Target | None = None
        self._drawn = 0
        # activated: the scene has opacities in place of logits
        self._antialiased = self._activated = False

    @property
    def textures(self) -> SplatTextures:
        """Textures of the drawn scene."""
        assert self._scene is not None, "upload comes first"
        return self._scene

    @property
    def highlights(self) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Highlighted rows and their highlights, in the format of `highlight`."""
        if self._highlights is None:
            return np.zeros(0, np.int64), np.zeros((0, 4), np.uint8)
        return self._highlights.read()

    def upload(self, scene: Gaussians, activated: bool = False) -> int:
        """Upload a whole scene and return the number of bytes. Afterwards the order must be set again.

        Args:
            scene: the scene
            activated: its logits are opacities, which may be above 1
        """
        count = len(scene)
        coefficients = min(int(scene.shN.shape[1]), MAX_DRAWN_SH)
        size = (count, coefficients)
        scene_textures = self._scene
        if scene_textures is None or (scene_textures.count, scene_textures.sh_coefficients) != size:
            self._release_scene()
            self._scene = SplatTextures(self.ctx, count, coefficients)
            self._buffers = self._make_buffers(max(count, 1))
        self._drawn = 0
        self._antialiased = scene.antialiased
        self._activated = activated
        return self.textures.write(scene)

    def update(self, scene: Gaussians, attributes: Iterable[str], rows: NDArray[np.int64]) -> int:
        """Upload the changed attributes of the changed sorted rows and return the number of bytes."""
        return self.textures.write(scene, attributes, rows)

    def highlight(self, rows: NDArray[np.int64], highlights: NDArray[np.uint8]) -> None:
        """Override the colors of the sorted Gaussians `rows` by highlights: rgb and share, 0 to 255. [R,4]"""
        self._highlights = self._highlights or HighlightTexture(self.ctx, self.textures.count)
        self._highlights.write(rows, highlights)
        if self._highlights.empty:
            self._highlights.release()
            self._highlights = None

    def set_order(self, order: NDArray[np.uint32]) -> None:
        """Set the rows to draw, farthest first; see `viewer.render.gl_renderer`."""
        assert self._buffers is not None, "upload comes first"
        self._drawn = len(order)
        if self._drawn:
            self._buffers.order.write(np.ascontiguousarray(order, ORDER))

    def draw(self, camera: Camera, background: Rgb, mode: DrawMode = PLAIN) -> moderngl.Texture:
        """Draw with the uploaded scene and order.

        Args:
            camera: its size is the picture's
            background: rgb behind everything
            mode: colors and shapes of the Gaussians

        Returns:
            rgb over the background, and 1 − transmittance. RGBA32F, overwritten by the next draw
        """
        size = (camera.width, camera.height)
        if self._target is None or self._target.texture.size != size:
            self._release_target()
            self._target = self._make_target(size)
        target = self._target
        target.framebuffer.use()  # also for transform feedback, which writes zeros without one
        target.framebuffer.clear(*background, 0.0)
        if self._drawn and self._scene is not None and self._buffers is not None:
            self._scene.bind(self._project)
            _set_camera(self._project, camera)
            self._project["antialiased"] = self._antialiased and not mode.dot_px
            self._project["view_mode"] = mode.colors
            self._project["dot_px"] = mode.dot_px
            self._project["depth_range"] = mode.depths
            self._project["ramp"] = mode.ramp
            self._project["activated"] = self._activated
            self._project["highlighted"] = self._highlights is not None
            if self._highlights is not None:
                self._highlights.bind(self._project, len(self._scene.textures))
            self._buffers.project.transform(self._buffers.projected, moderngl.POINTS, vertices=self._drawn)
            self.ctx.enable_only(moderngl.BLEND)
            target.framebuffer.viewport = (0, 0, *size)
            self.ctx.blend_equation = moderngl.FUNC_ADD, moderngl.FUNC_ADD
            self.ctx.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
            program = self._rings if mode.rings else self._splat
            program["size"] = size
            triangles = self._buffers.rings if mode.rings else self._buffers.splat
            triangles.render(moderngl.TRIANGLES, vertices=3, instances=self._drawn)
        return target.texture

    def release(self) -> None:
        """Release all GL objects. The renderer is unusable afterwards."""
        self._release_target()
        self._release_scene()
        for program in (self._project, self._splat, self._rings):
            program.release()

    def _make_buffers(self, count: int) -> _Buffers:
        order = self.ctx.buffer(reserve=count * ORDER.itemsize, dynamic=True)
        projected = self.ctx.buffer(reserve=count * PROJECTED.itemsize, dynamic=True)
        per_instance = (projected, f"{vertex_format(PROJECTED)}/i", *(PROJECTED.names or ()))
        return _Buffers(
            order,
            projected,
            self.ctx.vertex_array(self._project, [(order, "1u", "splat")]),
            self.ctx.vertex_array(self._splat, [per_instance]),
            self.ctx.vertex_array(self._rings, [per_instance]),
        )

    def _make_target(self, size: tuple[int, int]) -> _Target:
        texture = self.ctx.texture(size, 4, dtype="f4")
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return _Target(texture, self.ctx.framebuffer([texture]))

    def _release_target(self) -> None:
        if self._target is not None:
            # moderngl binds the current framebuffer again later, so it must not be a deleted one
            self.ctx.detect_framebuffer(0).use()
            self._target.release()
            self._target = None

    def _release_scene(self) -> None:
        for held in (self._buffers, self._scene, self._highlights):
            if held is not None:
                held.release()
        self._highlights = None


def vertex_format(dtype: np.dtype[Any]) -> str:
    """Return moderngl's format string for a dtype of float32 fields, e.g. "2f 3f 1f 4f"."""
    widths = (int(np.prod(dtype[name].shape, dtype=int)) for name in dtype.names or ())
    return " ".join(f"{width}f" for width in widths)


def _set_camera(program: moderngl.Program, camera: Camera) -> None:
    """Set the camera uniforms of project.vert."""
    viewmat = camera.viewmat.double().numpy()
    # not −Rᵀt: the rotation is orthonormal only up to rounding, and coordinates may be large
    eye = np.linalg.solve(viewmat[:3, :3], -viewmat[:3, 3])
    high = eye.astype(np.float32)
    K = camera.K.double().numpy()
    program["rotation"] = tuple(viewmat[:3, :3].T.ravel())  # column-major for GL
    program["eye_high"] = tuple(high)
    program["eye_low"] = tuple(eye - high)
    program["intrinsics"] = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    program["size"] = (float(camera.width), float(camera.height))


class GridPass:
    """Pass that draws grid lines behind the splats of a picture in a framebuffer.

    Args:
        ctx: GL context
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._program = load_program(ctx, "grid.vert", "grid.frag")
        self._lines = ctx.buffer(reserve=GRID_LINE.itemsize, dynamic=True)
        content = (self._lines, f"{vertex_format(GRID_LINE)}/i", *(GRID_LINE.names or ()))
        self._vao = ctx.vertex_array(self._program, [content])

    def draw(
        self,
        lines: NDArray[np.void],
        picture: moderngl.Texture,
        framebuffer: moderngl.Framebuffer,
        size: tuple[int, int],
        left: int = 0,
    ) -> None:
        """Draw into the lower `size` pixels of `framebuffer`, from column `left`.

        Args:
            lines: lines in pixels of the picture. [L] `GRID_LINE`
            picture: the picture in the framebuffer; its alpha is the scene's coverage of a pixel
            framebuffer: target
            size: width and height, px
            left: first column, px
        """
        if not len(lines):
            return
        self._lines.orphan(lines.nbytes)
        self._lines.write(np.ascontiguousarray(lines))
        framebuffer.use()
        self._ctx.viewport = (left, 0, *size)
        self._ctx.enable_only(moderngl.BLEND)
        self._ctx.blend_equation = moderngl.FUNC_ADD, moderngl.FUNC_ADD
        blend_factors = (moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA, moderngl.ZERO, moderngl.ONE)
        self._ctx.blend_func = blend_factors  # type: ignore[assignment]  # its annotation lacks separate factors for alpha
        picture.use(0)
        self._program["picture"] = 0
        self._program["shown_size"] = size
        self._program["left"] = left
        self._vao.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=len(lines))

    def release(self) -> None:
        for resource in (self._vao, self._lines, self._program):
            resource.release()
