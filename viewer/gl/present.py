"""Copying of finished pictures into a window's framebuffer."""

from __future__ import annotations

import moderngl
import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.screen import fill_screen

from .programs import load_program


class Presenter:
    """Pass that copies a picture with row 0 on top into a framebuffer with row 0 at the bottom."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        # two programs, as software GL would execute both branches of one in every pixel
        self._program = load_program(ctx, "present.vert", "present.frag")
        self._stretch = load_program(ctx, "present.vert", "stretch.frag")
        self._vao = ctx.vertex_array(self._program, [])
        self._stretch_vao = ctx.vertex_array(self._stretch, [])

    def show(
        self,
        picture: moderngl.Texture,
        framebuffer: moderngl.Framebuffer,
        size: tuple[int, int] | None = None,
        left: int = 0,
    ) -> None:
        """Fill the lower `size` pixels of `framebuffer`, from column `left`, with `picture`.

        Args:
            picture: the picture
            framebuffer: target
            size: width and height, px; None for the picture's own size; a different size scales it smoothly
            left: first column, px
        """
        size = size or picture.size
        framebuffer.use()
        self.ctx.viewport = (left, 0, *size)
        self.ctx.enable_only(moderngl.NOTHING)
        picture.use(0)
        if size == picture.size:
            self._program["picture"] = 0
            self._program["left"] = left
            self._vao.render(moderngl.TRIANGLES, vertices=3)
        else:
            picture.filter = (moderngl.LINEAR, moderngl.LINEAR)
            self._stretch["picture"] = 0
            self._stretch["shown_size"] = size
            self._stretch["left"] = left
            self._stretch_vao.render(moderngl.TRIANGLES, vertices=3)

    def release(self) -> None:
        for resource in (self._vao, self._program, self._stretch_vao, self._stretch):
            resource.release()


class ScreenCopy:
    """Copy of a picture as bytes, which is copied to a framebuffer instead of being drawn.

    Software GL copies a picture ten times faster than it draws one.

    Args:
        ctx: GL context
        size: width and height that the picture fills, px; a picture of a different size is scaled smoothly
        left: first column in the framebuffer, px
    """

    def __init__(self, ctx: moderngl.Context, size: tuple[int, int], left: int) -> None:
        self.ctx = ctx
        self.size = size
        self.left = left
        self._texture = ctx.texture((left + size[0], size[1]), 4)
        self._framebuffer = ctx.framebuffer([self._texture])
        self._screen = np.empty((size[1], size[0], 4), np.uint8)

    def write(self, image: NDArray[np.float32], top: int | None = None) -> None:
        """Write a whole picture, or unscaled rows from row `top` on. [H,W,3]"""
        last = self.size[1] - (top or 0)
        fill_screen(image, self._screen if top is None else self._screen[last - len(image) : last])
        self._texture.write(self._screen, viewport=(self.left, 0, *self.size))

    def show(self, framebuffer: moderngl.Framebuffer) -> None:
        """Copy the picture to the lower left of a framebuffer, within its scissor rectangle."""
        framebuffer.use()
        if self.left:
            framebuffer.scissor = (self.left, 0, *self.size)
        self.ctx.copy_framebuffer(framebuffer, self._framebuffer)
        if self.left:
            framebuffer.scissor = None  # type: ignore[assignment]  # its annotation lacks None

    def release(self) -> None:
        self._framebuffer.release()
        self._texture.release()


def picture_texture(ctx: moderngl.Context, pixels: NDArray[np.uint8]) -> moderngl.Texture:
    """Create a texture of a small picture [H,W,3] for the panel."""
    height, width, _ = pixels.shape
    texture = ctx.texture((width, height), 3, np.ascontiguousarray(pixels).tobytes(), alignment=1)
    texture.filter = moderngl.LINEAR, moderngl.LINEAR
    return texture


def read_rgb(framebuffer: moderngl.Framebuffer, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Read the lower left `size` pixels (width, height), upper row first. [H,W,3] uint8

    The size is a parameter because a window's framebuffer does not know its own size after a resize.
    """
    width, height = size
    packed = framebuffer.read((0, 0, width, height), components=3, alignment=1)
    return np.frombuffer(packed, np.uint8).reshape(height, width, 3)[::-1].copy()
