"""Draws the grid on the ground over a picture that OpenGL made: see viewer/render/ground_grid.py."""

from __future__ import annotations

import moderngl
import numpy as np
from numpy.typing import NDArray

from .layout import GRID_LINE
from .programs import load_program
from .splats import vertex_format


class GridPass:
    """Draws lines behind the splats of a picture that is already in a framebuffer.

    Args:
        ctx: to draw in
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
        """Draw into the lower `size` pixels of `framebuffer` from the column `left` on.

        Args:
            lines: of `GRID_LINE`, in pixels of the picture. [L]
            picture: what is there; its alpha is what the scene covers of a pixel
        """
        if not len(lines):
            return
        self._lines.orphan(lines.nbytes)
        self._lines.write(np.ascontiguousarray(lines))
        framebuffer.use()
        self._ctx.viewport = (left, 0, *size)
        self._ctx.enable_only(moderngl.BLEND)
        self._ctx.blend_equation = moderngl.FUNC_ADD, moderngl.FUNC_ADD
        ways = (moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA, moderngl.ZERO, moderngl.ONE)
        self._ctx.blend_func = ways  # type: ignore[assignment]  # its annotation forgets that alpha has its own
        picture.use(0)
        self._program["picture"], self._program["shown_size"], self._program["left"] = 0, size, left
        self._vao.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=len(lines))

    def release(self) -> None:
        for held in (self._vao, self._lines, self._program):
            held.release()
