"""Scene on the GPU: raw attributes in textures, with partial uploads of changed rows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import moderngl
import numpy as np
from numpy.typing import NDArray

from progdf.gaussians import ATTRIBUTES, Gaussians

SPLATS_PER_ROW = 512
"""Number of Gaussians per texture row. With 15 SH texels each, a row fits the 8192 texels of small GPUs."""

MEAN_LOGIT = np.dtype([("mean", "<f4", 3), ("logit_opacity", "<f4")])
LOG_SCALE = np.dtype([("log_scale", "<f4", 3), ("unused", "<f4")])
QUAT = np.dtype([("quat", "<f4", 4)])
SH0 = np.dtype([("sh0", "<f4", 3), ("unused", "<f4")])

SPLAT_TEXTURES = {"mean_logit": MEAN_LOGIT, "log_scale": LOG_SCALE, "quat": QUAT, "sh0": SH0}
"""Samplers in shaders/include/raw_splats.glsl and their texels: raw parameters, 16 bytes each.

SH bands 1 to 3 are in `shN`: rgb32f, K texels per Gaussian.
"""

HIGHLIGHT = np.dtype([("rgb", "u1", 3), ("share", "u1")])
"""Highlight of a Gaussian: a texel of `highlight` in shaders/project.vert, 0 to 255 read as 0 to 1."""

MAX_DRAWN_SH = 15
"""Largest K. SH coefficients above degree 3 stay in the scene but are not drawn."""


@dataclass(frozen=True)
class TextureSlot:
    """Location of an attribute: texture, first component, number of components."""

    texture: str
    component: int
    components: int


TEXTURE_SLOTS = {
    "means": TextureSlot("mean_logit", 0, 3),
    "logit_opacities": TextureSlot("mean_logit", 3, 1),
    "log_scales": TextureSlot("log_scale", 0, 3),
    "quats": TextureSlot("quat", 0, 4),
    "sh0": TextureSlot("sh0", 0, 3),
    "shN": TextureSlot("shN", 0, 3),
}
"""Location of each attribute."""

PROJECTED = np.dtype([("center", "<f4", 2), ("shape", "<f4", 3), ("r2", "<f4"), ("rgb_opacity", "<f4", 4)])
"""Projected Gaussian, written by shaders/project.vert and read by shaders/splat.vert. 40 bytes."""

ORDER = np.dtype("<u4")
"""Row index of the scene, in drawing order; `splat` in shaders/project.vert."""

GRID_LINE = np.dtype([("ends", "<f4", 4), ("depths", "<f4", 2), ("cells", "<f4", 4), ("color", "<f4", 4)])
"""Line of the ground grid, read by shaders/grid.vert.

It holds both ends in picture pixels, their depths, their grid positions (1 is fully faded), and rgb with
alpha.
"""


_MAX_GAP_ROWS = 4  # unchanged texture rows to upload rather than start another call


class SplatTextures:
    """Textures of a scene's raw attributes, with a copy in memory as the source of partial uploads.

    Args:
        ctx: GL context
        count: N
        sh_coefficients: number K of drawn shN coefficients: 0, 3, 8 or 15
    """

    def __init__(self, ctx: moderngl.Context, count: int, sh_coefficients: int) -> None:
        self.count = count
        self.sh_coefficients = sh_coefficients
        self.rows = max(1, -(-count // SPLATS_PER_ROW))
        self._channels = dict.fromkeys(SPLAT_TEXTURES, 4)
        self._channels["shN"] = 3 * max(1, sh_coefficients)
        self._memory = {
            name: np.zeros((self.rows * SPLATS_PER_ROW, channels), np.float32)
            for name, channels in self._channels.items()
            if name != "shN" or sh_coefficients
        }
        self.textures: dict[str, moderngl.Texture] = {}
        for name in self._channels:
            size = (SPLATS_PER_ROW, self.rows)
            components = 4
            if name == "shN":
                size = (SPLATS_PER_ROW * sh_coefficients, self.rows) if sh_coefficients else (1, 1)
                components = 3
            texture = ctx.texture(size, components, dtype="f4")
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
            self.textures[name] = texture

    def write(
        self, scene: Gaussians, attributes: Iterable[str] = ATTRIBUTES, rows: NDArray[np.int64] | None = None
    ) -> int:
        """Upload the changed attributes of the changed rows.

        Args:
            scene: the current values, N rows
            attributes: changed attributes, names of `ATTRIBUTES`
            rows: sorted indices of the changed Gaussians; None for all

        Returns:
            Number of uploaded bytes.
        """
        runs = [(0, self.rows)] if rows is None else list(row_runs(rows))
        dirty = []
        for attribute in attributes:
            texel = TEXTURE_SLOTS[attribute]
            if texel.texture not in self._memory:
                continue
            values = getattr(scene, attribute).detach()
            if attribute == "shN":
                values = values[:, : self.sh_coefficients]
            width = math.prod(values.shape[1:]) // texel.components
            numbers = values.reshape(self.count, width, texel.components).numpy()
            memory = self._memory[texel.texture].reshape(self.rows * SPLATS_PER_ROW, width, -1)
            memory = memory[..., texel.component : texel.component + texel.components]
            # whole runs, as gathering only the changed rows takes several times longer
            for first, last in runs:
                begin = first * SPLATS_PER_ROW
                end = min(last * SPLATS_PER_ROW, self.count)
                memory[begin:end] = numbers[begin:end]
            if texel.texture not in dirty:
                dirty.append(texel.texture)
        return sum(_send(self._memory[name], self.textures[name], runs) for name in dirty)

    def bind(self, program: moderngl.Program) -> None:
        """Bind the textures to the samplers of `include/raw_splats.glsl`."""
        for unit, (name, texture) in enumerate(self.textures.items()):
            texture.use(unit)
            program[name] = unit
        program["sh_coefficients"] = self.sh_coefficients

    def release(self) -> None:
        for texture in self.textures.values():
            texture.release()


def _send(memory: np.ndarray, texture: moderngl.Texture, runs: Iterable[tuple[int, int]]) -> int:
    """Upload texture rows [first, last) of each run. Return the number of bytes."""
    sent = 0
    for first, last in runs:
        part = memory[first * SPLATS_PER_ROW : last * SPLATS_PER_ROW]
        texture.write(part, viewport=(0, first, texture.width, last - first))
        sent += part.nbytes
    return sent


def row_runs(rows: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Yield the texture rows [first, last) that hold the sorted Gaussians `rows`, with small gaps closed."""
    if not len(rows):
        return
    texture_rows = rows // SPLATS_PER_ROW
    breaks = np.flatnonzero(np.diff(texture_rows) > _MAX_GAP_ROWS)
    firsts = texture_rows[np.concatenate([[0], breaks + 1])]
    lasts = texture_rows[np.concatenate([breaks, [len(texture_rows) - 1]])]
    for first, last in zip(firsts, lasts, strict=True):
        yield int(first), int(last) + 1


class HighlightTexture:
    """Texture of highlights (rgb and share) in the layout of the scene's textures.

    A share of 0 keeps a Gaussian's own color, 255 hides it.

    Args:
        ctx: GL context
        count: N
    """

    def __init__(self, ctx: moderngl.Context, count: int) -> None:
        rows = max(1, -(-count // SPLATS_PER_ROW))
        self._memory = np.zeros((rows * SPLATS_PER_ROW, HIGHLIGHT.itemsize), np.uint8)
        self._texture = ctx.texture((SPLATS_PER_ROW, rows), HIGHLIGHT.itemsize, self._memory.tobytes())
        self._texture.filter = (moderngl.NEAREST, moderngl.NEAREST)

    def write(self, rows: NDArray[np.int64], highlights: NDArray[np.uint8]) -> None:
        """Set the highlights [R,4] of the sorted Gaussians `rows` [R]."""
        self._memory[rows] = highlights
        _send(self._memory, self._texture, row_runs(rows))

    def read(self) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Return the highlighted rows and their highlights. [R] and [R,4]"""
        rows = np.flatnonzero(self._memory[:, 3])
        return rows, self._memory[rows]

    @property
    def empty(self) -> bool:
        """True if no Gaussian is highlighted."""
        return not self._memory[:, 3].any()

    def bind(self, program: moderngl.Program, unit: int) -> None:
        """Bind the texture to the sampler `highlight` of `program`."""
        self._texture.use(unit)
        program["highlight"] = unit

    def release(self) -> None:
        self._texture.release()
