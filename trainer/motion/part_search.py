"""The search for where an edit has taken a region's parts: seven numbers each, fitted to the edited views.

Views are what is fitted, coarse to fine: a part that does not overlap its new place at all is drawn there by
what both are blurred to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from trainer.views.crops import CropScene

from .descent import OnStep, descend, falling
from .similarity import Motion, Parts, move_rows

_BLURS = (9, 21)  # pixels
_WIDE_BLURS = (0.4, 0.2, 0.1)  # of the box's longer side: a part feels a place three times its size away
_WIDE = 0.4  # share of a wide search's steps that see no more than those, shift thrice as fast, never turn
_RATES = (0.06, 0.03, 0.03)  # a step of shift in part sizes, of log-scale, of turn in radians
_MISSED = 0.25  # share of the distance that is left where the near search is taken to have lost its way
_MOVING = ("means", "log_scales", "quats")


@dataclass(frozen=True)
class GroupSearch:
    """What the parts are fitted to, and how long.

    Args:
        original: raw member rows. [M,C]
        parts: the region taken apart
        crops: the training views
        steps: of a search, each in one view
        seed: order of the views
    """

    original: Tensor
    parts: Parts
    crops: Sequence[CropScene]
    steps: int = 120
    seed: int = 0

    def find(self, targets: Sequence[Tensor], start: Motion, on_step: OnStep | None = None) -> Motion:
        """The motion of the parts that brings the views closest to their targets.

        A near search starts at full sharpness. Where it leaves a quarter of the distance, a wide one is tried
        too. The wide one arrives from farther away, but it can overlook what is close
        (docs/experiments.md, Parts that move).

        Args:
            targets: the edited box of each view. [h,w,3] each
            start: where to look first
            on_step: progress: steps done in this search; a wide one counts from 1 again

        Returns:
            The best motion found; `start` where none is better in the mean of all views.

        Raises:
            FloatingPointError: the loss is no longer finite.
        """
        best, least = start, self.distance(targets, start)
        missed = _MISSED * least
        for wide in (False, True):
            found = self._search(targets, start, wide, on_step)
            distance = self.distance(targets, found)
            if distance < least:
                best, least = found, distance
            if least < missed:
                break
        return best

    def distance(self, targets: Sequence[Tensor], motion: Motion) -> float:
        """Mean distance of all views from their targets, at full sharpness and blurred."""
        return mean_distance(self.crops, move_rows(self.original, self.parts, motion), targets)

    def _search(self, targets: Sequence[Tensor], start: Motion, wide: bool, on_step: OnStep | None) -> Motion:
        values = torch.cat(
            [start.shift / self.parts.sizes[:, None], start.log_scale[:, None], start.turn], dim=1
        )
        shift, size, turn = _RATES
        rates = torch.tensor([shift] * 3 + [size] + [turn] * 3)
        wide_rates = torch.tensor([3 * shift] * 3 + [size] + [0.0] * 3)
        widening = round(_WIDE * self.steps) if wide else 0

        def loss_in(values: Tensor, view: int, step: int) -> Tensor:
            rows = move_rows(self.original, self.parts, _motion(values, self.parts))
            return view_distance(self.crops[view], rows, targets[view], wide=step < widening)

        def rates_at(step: int) -> Tensor:
            return wide_rates if step < widening else falling(step - widening, self.steps - widening) * rates

        settled = descend(values, loss_in, rates_at, self.steps, len(self.crops), self.seed, on_step=on_step)
        return _motion(settled, self.parts)


def _motion(values: Tensor, parts: Parts) -> Motion:
    return Motion(values[:, :3] * parts.sizes[:, None], values[:, 3], values[:, 4:])


def mean_distance(crops: Sequence[CropScene], rows: Tensor, targets: Sequence[Tensor]) -> float:
    """Mean distance of all views from their targets, at full sharpness and blurred. `rows`: members' [M,C]"""
    with torch.no_grad():
        pairs = zip(crops, targets, strict=True)
        return sum(float(view_distance(crop, rows, target)) for crop, target in pairs) / len(targets)


def view_distance(scene: CropScene, rows: Tensor, target: Tensor, wide: bool = False) -> Tensor:
    """L1 at full sharpness and blurred, or blurred widely only: so a part feels where it does not lie yet."""
    image, _ = scene.render(rows, _MOVING)
    difference = image - target
    loss = difference.new_zeros(()) if wide else difference.abs().mean()
    longer = max(scene.size)
    planes = difference.permute(2, 0, 1)[None]
    for blur in [round(longer * share) for share in _WIDE_BLURS] if wide else _BLURS:
        width = max(1, min(blur, *scene.size))
        loss = loss + avg_pool2d(planes, width, max(1, width // 3)).abs().mean()
    return loss
