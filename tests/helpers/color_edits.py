"""Color edits at one strength. The default source is the measured color of the input."""

from __future__ import annotations

import torch
from torch import Tensor

from progdf.color import edits
from progdf.color.oklab import ColorPath, Strength


def recolor(
    rgb: Tensor,
    target: Tensor,
    strength: Strength = 1.0,
    source: edits.RegionColor | None = None,
    path: ColorPath = "bowed",
) -> Tensor:
    own = edits.measure_color(rgb) if source is None else source
    return edits.recolor_course(rgb, target, own, path)(strength)


def tint(rgb: Tensor, target: Tensor, strength: Strength = 1.0) -> Tensor:
    return edits.tint_course(rgb, target, edits.measure_color(rgb))(strength)


def stripes(rgb: Tensor, pattern: Tensor, target: Tensor, strength: Strength) -> Tensor:
    return recolor(rgb, target, torch.as_tensor(strength).to(pattern) * pattern)
