"""The bytes behind every GPU buffer and texture; shaders/ declares the same, and a test compares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
class Place:
    """Where an attribute lies: the texture, its first component there, and how many."""

    texture: str
    component: int
    components: int


PLACES = {
    "means": Place("mean_logit", 0, 3),
    "logit_opacities": Place("mean_logit", 3, 1),
    "log_scales": Place("log_scale", 0, 3),
    "quats": Place("quat", 0, 4),
    "sh0": Place("sh0", 0, 3),
    "shN": Place("shN", 0, 3),
}
"""Attribute -> its place in each of its texels."""

PROJECTED = np.dtype([("center", "<f4", 2), ("shape", "<f4", 3), ("r2", "<f4"), ("rgb_opacity", "<f4", 4)])
"""One projected Gaussian, written by shaders/project.vert and read by shaders/splat.vert. 40 bytes."""

ORDER = np.dtype("<u4")
"""One row index of the scene, in drawing order; `splat` in shaders/project.vert."""

GRID_LINE = np.dtype([("ends", "<f4", 4), ("depths", "<f4", 2), ("cells", "<f4", 4), ("color", "<f4", 4)])
"""A line of the grid on the ground: both ends in pixels of the picture, their depths, where they lie in the
grid (at 1 it has faded), and its color with the share that it takes; read by shaders/grid.vert."""
