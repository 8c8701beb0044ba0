"""Parts of a region that fade away, as wholes.

An edit that removes a part shows the same pictures as one that moves it out of sight, and a motion fits the
pictures in between badly. One number per part, the share of its opacity that is left, fits them exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.gaussians import attribute_slices
from progdf.similarity import Parts
from progdf.system.equality import equal_fields
from trainer.views.crops import CropScene

from .parts import OnStep, descend, falling, mean_distance, view_distance

_STEPS = 40  # steps of a search, each in one view
_RATE = 0.15  # first step of a share
_LARGEST_START = 0.98  # `_fold` has no slope at 1
_LEAST_OPACITY = 1e-4  # a Gaussian below 1/255 is not drawn; its logit stays finite
_FADING_ATTRIBUTES = ("logit_opacities",)


@dataclass(frozen=True)
class FadePlacement:
    """Opacity that is left of each part, as a `RegionMotion` that moves nothing."""

    __eq__ = equal_fields

    parts: Parts
    share: Tensor  # share of the opacity that is left of each part, 0 to 1. [P]

    def carry(self, original: Tensor, offsets: Tensor) -> Tensor:
        """See `RegionMotion`."""
        return offsets + self._fade(original)

    def carry_back(self, original: Tensor, offsets: Tensor) -> Tensor:
        """See `RegionMotion`."""
        return offsets - self._fade(original)

    def rest(self) -> FadePlacement:
        """See `RegionMotion`."""
        return FadePlacement(self.parts, torch.ones_like(self.share))

    def interpolate(self, other: FadePlacement, share: float) -> FadePlacement:
        """See `RegionMotion`. The opacity changes linearly."""
        return FadePlacement(self.parts, torch.lerp(self.share, other.share, share))

    def lines(self) -> list[str]:
        """Return the opacity that is left of each part."""
        return [
            f"part {index}, {int((self.parts.part == index).sum())} Gaussians: "
            f"{100 * float(share):.0f} % of its opacity is left"
            for index, share in enumerate(self.share)
        ]

    def _fade(self, original: Tensor) -> Tensor:
        """Return the offsets of the members' logits; the other columns are 0. [M,C] -> [M,C]"""
        columns = attribute_slices(original.shape[1])["logit_opacities"]
        logits = original[:, columns]
        least = logits.sigmoid().clamp(max=_LEAST_OPACITY)
        left = torch.maximum(logits.sigmoid() * self.share[self.parts.part, None], least).logit()
        # exactly 0 where nothing fades
        change = torch.where(self.share[self.parts.part, None] < 1.0, left - logits, 0.0)
        before = original.new_zeros(len(original), columns.start)
        after = original.new_zeros(len(original), original.shape[1] - columns.stop)
        return torch.cat([before, change, after], dim=1)


@dataclass(frozen=True)
class FadeSearch:
    """Search for the opacity of the parts that fits the training views."""

    __eq__ = equal_fields

    original: Tensor  # raw member rows. [M,C]
    parts: Parts
    crops: Sequence[CropScene]  # the training views
    seed: int = 0  # seed of the view order

    def find(
        self, targets: Sequence[Tensor], start: FadePlacement, on_step: OnStep | None = None
    ) -> FadePlacement:
        """Return the opacity of each part that brings the views closest to their targets.

        Args:
            targets: edited box of each view. [h,w,3] each
            start: initial opacity
            on_step: progress: steps done in this search, loss

        Raises:
            FloatingPointError: the loss is no longer finite.
        """

        def loss_in(values: Tensor, view: int, step: int) -> Tensor:
            placed = FadePlacement(self.parts, _fold(values[:, 0]))
            return view_distance(self.crops[view], self._rows(placed), targets[view], _FADING_ATTRIBUTES)

        def rates_at(step: int) -> Tensor:
            return falling(step, _STEPS) * start.share.new_full((1,), _RATE)

        begin = start.share.clamp(max=_LARGEST_START)[:, None]
        settled = descend(begin, loss_in, rates_at, _STEPS, len(self.crops), self.seed, on_step=on_step)
        return FadePlacement(self.parts, _fold(settled[:, 0]))

    def distance(self, targets: Sequence[Tensor], placement: FadePlacement) -> float:
        """Return the mean distance of all views from their targets, at full sharpness and blurred."""
        return mean_distance(self.crops, self._rows(placement), targets, _FADING_ATTRIBUTES)

    def _rows(self, placement: FadePlacement) -> Tensor:
        return self.original + placement.carry(self.original, torch.zeros_like(self.original))


def _fold(values: Tensor) -> Tensor:
    """Return shares from 0 to 1 for any numbers. Reflected at both ends, they keep a gradient there."""
    return 1.0 - (1.0 - (values % 2.0)).abs()
