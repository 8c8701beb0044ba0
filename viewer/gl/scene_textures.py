"""The scene on the GPU: raw attributes in textures, of which only what changed is sent again."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import moderngl
import numpy as np
from numpy.typing import NDArray

from progdf.gaussians import ATTRIBUTES, Gaussians

SPLATS_PER_ROW = 512
"""Gaussians in a row of the scene's textures: with 15 SH texels each a row fits the 8192 of small GPUs."""

MEAN_LOGIT = np.dtype([("mean", "<f4", 3), ("logit_opacity", "<f4")])
LOG_SCALE = np.dtype([("log_scale", "<f4", 3), ("unused", "<f4")])
QUAT = np.dtype([("quat", "<f4", 4)])
SH0 = np.dtype([("sh0", "<f4", 3), ("unused", "<f4")])

SPLAT_TEXTURES = {"mean_logit": MEAN_LOGIT, "log_scale": LOG_SCALE, "quat": QUAT, "sh0": SH0}
"""Sampler in shaders/include/raw_splats.glsl -> one texel of it; raw parameters, 16 bytes each.

Bands 1 to 3 lie in `shN`: rgb32f, K texels a Gaussian.
"""

HIGHLIGHT = np.dtype([("rgb", "u1", 3), ("share", "u1")])
"""What is drawn over a Gaussian's color; a texel of `highlight` in shaders/project.vert, 0..255 as 0..1."""

SHOWN_SH = 15
"""Largest K: coefficients above degree 3 ride along in the scene and are not shown."""


@dataclass(frozen=True)
class TextureSlot:
    """Where an attribute lies: the texture, its first component there, and how many."""

    texture: str
    component: int
    components: int


PLACES = {
    "means": TextureSlot("mean_logit", 0, 3),
    "logit_opacities": TextureSlot("mean_logit", 3, 1),
    "log_scales": TextureSlot("log_scale", 0, 3),
    "quats": TextureSlot("quat", 0, 4),
    "sh0": TextureSlot("sh0", 0, 3),
    "shN": TextureSlot("shN", 0, 3),
}
"""Attribute -> its place in each of its texels."""

PROJECTED = np.dtype([("center", "<f4", 2), ("shape", "<f4", 3), ("r2", "<f4"), ("rgb_opacity", "<f4", 4)])
"""One projected Gaussian, written by shaders/project.vert and read by shaders/splat.vert. 40 bytes."""

ORDER = np.dtype("<u4")
"""One row index of the scene, in drawing order; `splat` in shaders/project.vert."""

GRID_LINE = np.dtype([("ends", "<f4", 4), ("depths", "<f4", 2), ("cells", "<f4", 4), ("color", "<f4", 4)])
"""A line of the grid on the ground: both ends in pixels of the picture, their depths, where they lie in the
grid (at 1 it has faded), and its color with the share that it takes; read by shaders/grid.vert."""


_GAP = 4  # texture rows: uploading so many untouched ones costs less than another call


class SplatTextures:
    """The raw attributes of a scene in textures, with a copy in memory that partial uploads are taken from.

    Args:
        ctx: where they live
        count: N
        sh_coefficients: K of shN that are shown: 0, 3, 8 or 15
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
        """Upload what changed.

        Args:
            scene: the present values, N rows
            attributes: names of `ATTRIBUTES` that changed
            rows: sorted indices of the Gaussians that changed; None is all

        Returns:
            Bytes sent.
        """
        runs = [(0, self.rows)] if rows is None else list(row_runs(rows))
        dirty = []
        for attribute in attributes:
            texel = PLACES[attribute]
            if texel.texture not in self._memory:
                continue
            values = getattr(scene, attribute).detach()
            if attribute == "shN":
                values = values[:, : self.sh_coefficients]
            width = math.prod(values.shape[1:]) // texel.components
            numbers = values.reshape(self.count, width, texel.components).numpy()
            memory = self._memory[texel.texture].reshape(self.rows * SPLATS_PER_ROW, width, -1)
            memory = memory[..., texel.component : texel.component + texel.components]
            # whole runs: gathering the changed rows alone takes several times longer
            for first, last in runs:
                begin = first * SPLATS_PER_ROW
                end = min(last * SPLATS_PER_ROW, self.count)
                memory[begin:end] = numbers[begin:end]
            if texel.texture not in dirty:
                dirty.append(texel.texture)
        return sum(_send(self._memory[name], self.textures[name], runs) for name in dirty)

    def bind(self, program: moderngl.Program) -> None:
        """Make them what the samplers of `include/raw_splats.glsl` read."""
        for unit, (name, texture) in enumerate(self.textures.items()):
            texture.use(unit)
            program[name] = unit
        program["sh_coefficients"] = self.sh_coefficients

    def release(self) -> None:
        for texture in self.textures.values():
            texture.release()


def _send(memory: np.ndarray, texture: moderngl.Texture, runs: Iterable[tuple[int, int]]) -> int:
    """Upload texture rows [first, last); the bytes sent."""
    sent = 0
    for first, last in runs:
        part = memory[first * SPLATS_PER_ROW : last * SPLATS_PER_ROW]
        texture.write(part, viewport=(0, first, texture.width, last - first))
        sent += part.nbytes
    return sent


def row_runs(rows: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Texture rows [first, last) that hold the Gaussians `rows` (sorted), near ones joined."""
    if not len(rows):
        return
    texture_rows = rows // SPLATS_PER_ROW
    breaks = np.flatnonzero(np.diff(texture_rows) > _GAP)
    firsts = texture_rows[np.concatenate([[0], breaks + 1])]
    lasts = texture_rows[np.concatenate([breaks, [len(texture_rows) - 1]])]
    for first, last in zip(firsts, lasts, strict=True):
        yield int(first), int(last) + 1


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
        _send(self._memory, self._texture, row_runs(rows))

    def read(self) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Which Gaussians are not in their own colors, and in which. [R] and [R,4]"""
        rows = np.flatnonzero(self._memory[:, 3])
        return rows, self._memory[rows]

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
