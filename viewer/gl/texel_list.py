"""Lists that shaders read by index: moderngl has no buffer textures, so they lie in rows of a 2D texture."""

from __future__ import annotations

from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from .layout import TEXELS_PER_ROW

_TYPES = {"f4": "<f4", "i4": "<i4", "i1": "i1"}  # moderngl's words and numpy's


class TexelList:
    """One list of texels, as long as what was last written into it.

    Args:
        ctx: where it lives
        components: of a texel, 1 or 4
        kind: "f4", "i4" or "i1"
    """

    def __init__(self, ctx: moderngl.Context, components: int, kind: str) -> None:
        self._ctx, self._components, self._kind = ctx, components, kind
        self._texture = ctx.texture((TEXELS_PER_ROW, 1), components, dtype=kind)

    def write(self, texels: NDArray[Any]) -> int:
        """Take a list; gives the bytes sent.

        Args:
            texels: [n,components] of its kind, n ≤ `capacity`
        """
        texels = np.ascontiguousarray(texels, _TYPES[self._kind]).reshape(-1, self._components)
        whole, rest = divmod(len(texels), TEXELS_PER_ROW)
        rows = whole + (rest > 0)
        if rows > self._texture.height:
            self._texture.release()
            self._texture = self._ctx.texture((TEXELS_PER_ROW, rows), self._components, dtype=self._kind)
        if whole:
            self._texture.write(texels[: whole * TEXELS_PER_ROW], viewport=(0, 0, TEXELS_PER_ROW, whole))
        if rest:
            self._texture.write(texels[whole * TEXELS_PER_ROW :], viewport=(0, whole, rest, 1))
        return int(texels.nbytes)

    def use(self, unit: int) -> None:
        """Bind it to a texture unit."""
        self._texture.use(unit)

    def release(self) -> None:
        self._texture.release()


def capacity(ctx: moderngl.Context) -> int:
    """Most texels that a list can hold here."""
    return TEXELS_PER_ROW * int(ctx.info["GL_MAX_TEXTURE_SIZE"])
