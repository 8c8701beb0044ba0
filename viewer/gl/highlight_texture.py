"""Colors drawn over those of the scene: one texel a Gaussian, made when they are first asked for."""

from __future__ import annotations

import moderngl
import numpy as np
from numpy.typing import NDArray

from .layout import HIGHLIGHT, SPLATS_PER_ROW
from .scene_textures import row_runs


class HighlightTexture:
    """rgb and the share of it, laid out as the scene's textures are; 0 leaves a Gaussian its own color,
    255 hides it.

    Args:
        ctx: where it lives
        count: N
    """

    def __init__(self, ctx: moderngl.Context, count: int) -> None:
        rows = max(1, -(-count // SPLATS_PER_ROW))
        self._memory = np.zeros((rows * SPLATS_PER_ROW, HIGHLIGHT.itemsize), np.uint8)
        self._texture = ctx.texture((SPLATS_PER_ROW, rows), HIGHLIGHT.itemsize, self._memory.tobytes())
        self._texture.filter = (moderngl.NEAREST, moderngl.NEAREST)

    def write(self, rows: NDArray[np.int64], highlights: NDArray[np.uint8]) -> None:
        """Take other highlights [R,4] for Gaussians (sorted)."""
        self._memory[rows] = highlights
        for first, last in row_runs(rows):
            part = self._memory[first * SPLATS_PER_ROW : last * SPLATS_PER_ROW]
            self._texture.write(part, viewport=(0, first, SPLATS_PER_ROW, last - first))

    @property
    def empty(self) -> bool:
        """Whether it leaves every Gaussian its own color."""
        return not self._memory[:, 3].any()

    def bind(self, program: moderngl.Program, unit: int) -> None:
        """Make it what the sampler `highlight` of `program` reads."""
        self._texture.use(unit)
        program["highlight"] = unit

    def release(self) -> None:
        self._texture.release()
