"""The bytes behind every GPU buffer and texture; shaders/ declares the same, and a test compares."""

from __future__ import annotations

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

PROJECTED = np.dtype([("centre", "<f4", 2), ("shape", "<f4", 3), ("r2", "<f4"), ("rgb_opacity", "<f4", 4)])
"""One projected Gaussian, written by shaders/project.vert and read by shaders/splat.vert. 40 bytes."""

ORDER = np.dtype("<u4")
"""One row index of the scene, in drawing order; `splat` in shaders/project.vert."""
