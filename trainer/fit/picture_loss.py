"""L_GDF of ProGDF (AAAI 2025): what the field shows beside what was recorded, in a training view."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from trainer.optimize.losses import Perceptual, l1, sharpness
from trainer.views.crops import CropScene


@dataclass(frozen=True)
class RenderedLoss:
    """L_GDF = L_pred + L_render: L1 + LPIPS between the renders of Θ0 + GDF(s) and of the snapshot at s, and
    −∇²R of the former. A `PictureLoss`.

    Args:
        crops: the training views
        rows: raw values of the members before the edit, packed. [M,C]
        moving: attributes that differ from these
        perceptual: LPIPS, or what stands in for it
        sharpness: whether L_render is paid
    """

    crops: Sequence[CropScene]
    rows: Tensor
    moving: Collection[str]
    perceptual: Perceptual
    sharpness: bool = True

    @property
    def views(self) -> int:
        """In how many views."""
        return len(self.crops)

    def __call__(self, found: Tensor, recorded: Tensor, view: int) -> Tensor:
        """See `PictureLoss`. [M,C], [M,C] -> []"""
        crop = self.crops[view]
        with torch.no_grad():
            expected, _ = crop.render(self.rows + recorded, self.moving)
        image, _ = crop.render(self.rows + found, self.moving)
        predicted = l1(image, expected) + self.perceptual(image, expected)
        return predicted + sharpness(image, expected, "paper") if self.sharpness else predicted
