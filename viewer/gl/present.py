"""A finished picture on its way into a window's framebuffer."""

from __future__ import annotations

import moderngl

from .programs import load_program


class Presenter:
    """Copies a picture whose row 0 is on top into a framebuffer whose row 0 is at the bottom."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self._program = load_program(ctx, "present.vert", "present.frag")
        self._vao = ctx.vertex_array(self._program, [])

    def show(
        self,
        picture: moderngl.Texture,
        framebuffer: moderngl.Framebuffer,
        size: tuple[int, int] | None = None,
    ) -> None:
        """Fill the lower left `size` pixels of `framebuffer` with `picture`; pixel by pixel where it has as
        many, which is so without `size`, and else smoothly."""
        framebuffer.use()
        self.ctx.viewport = (0, 0, *(size or picture.size))
        self._program["shown_size"] = size or picture.size
        self.ctx.enable_only(moderngl.NOTHING)
        picture.use(0)
        self._program["picture"] = 0
        self._vao.render(moderngl.TRIANGLES, vertices=3)

    def release(self) -> None:
        self._vao.release()
        self._program.release()
