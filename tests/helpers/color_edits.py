"""Color edits at one strength. The default reference is the typical color of the input."""

from __future__ import annotations

import torch
from torch import Tensor

from progdf.color import edits
from progdf.color.oklab import ColorPath, Strength


def recolor(
    rgb: Tensor,
    target: Tensor,
    strength: Strength = 1.0,
    reference: Tensor | None = None,
    path: ColorPath = "bowed",
) -> Tensor:
    own = edits.typical_color(rgb) if reference is None else reference
    return edits.recolor_course(rgb, target, own, path)(strength)


def tint(rgb: Tensor, target: Tensor, strength: Strength = 1.0) -> Tensor:
    return edits.tint_course(rgb, target, edits.typical_color(rgb))(strength)


def stripes(rgb: Tensor, pattern: Tensor, target: Tensor, strength: Strength) -> Tensor:
    return recolor(rgb, target, torch.as_tensor(strength).to(pattern) * pattern)
