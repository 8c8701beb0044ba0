"""The search for how an edit has bent a region: motions of few control points, then of more.

It begins where parts that move as wholes have come. Neighboring control points are held to each other's
motion, as rigidly as the views allow, so that what no view shows follows what they show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from progdf.gaussians import attribute_slices
from trainer.views.crops import CropScene

from .control_points import ControlPoints, make_control_points
from .descent import OnStep, descend, falling
from .part_search import mean_distance, view_distance
from .warp import WarpMotion, affine_maps, extrapolate_warp, transfer_warp, warp_rows

LEVELS = (6, 18, 54)
"""Control points of each level, coarse to fine."""

_FOLLOWERS = 8  # members a control point has at least, in the mean
_RATES = (0.04, 0.02, 0.015)  # a step of shift in spacings of the level, of turn in radians, of stretch
_WIDE = 0.4  # share of the coarsest level's steps that see the pictures blurred only
_RIGID = 0.05  # weight of what neighbors disagree by, squared, in squares of their spacing
_STIFF = 0.002  # weight of the stretch, squared
_DAMPING = 0.1  # see `descend`


@dataclass(frozen=True)
class WarpSearch:
    """What control points are fitted to, and how long.

    Args:
        original: raw member rows. [M,C]
        part: connected part of each member. [M] int64
        crops: the training views
        steps: of each level, each in one view
        seed: order of the views
    """

    original: Tensor
    part: Tensor
    crops: Sequence[CropScene]
    steps: int = 120
    seed: int = 0

    @cached_property
    def levels(self) -> tuple[ControlPoints, ...]:
        """Coarse to fine; the last are those of the motions that are found."""
        means = self.original[:, attribute_slices(self.original.shape[1])["means"]]
        counts = sorted({min(count, max(1, len(means) // _FOLLOWERS)) for count in LEVELS})
        return tuple(make_control_points(means, self.part, count) for count in counts)

    def find_first(
        self, targets: Sequence[Tensor], start: WarpMotion, on_step: OnStep | None = None
    ) -> WarpMotion:
        """The motion that brings the views close to their targets, from a coarse one to a fine one.

        Args:
            targets: the edited box of each view. [h,w,3] each
            start: of the coarsest control points
            on_step: progress: steps done of one level; each counts from 1 again

        Raises:
            FloatingPointError: the loss is no longer finite.
        """
        motion = start
        for level, control in enumerate(self.levels):
            if level:
                motion = transfer_warp(self.levels[level - 1], motion, control)
            motion = self._descend(control, targets, motion, 0.0 if level else _WIDE, on_step)
        return motion

    def find_next(
        self,
        targets: Sequence[Tensor],
        before: WarpMotion,
        further: float,
        on_step: OnStep | None = None,
    ) -> WarpMotion:
        """The same for a strength `further` times as large as that of the motion `before`."""
        control = self.levels[-1]
        start = min(
            (before, extrapolate_warp(before, further)),
            key=lambda motion: self.distance(targets, motion),
        )
        return self._descend(control, targets, start, 0.0, on_step)

    def distance(self, targets: Sequence[Tensor], motion: WarpMotion) -> float:
        """Mean distance of all views from their targets, at full sharpness and blurred."""
        return mean_distance(self.crops, warp_rows(self.original, self.levels[-1], motion), targets)

    def _descend(
        self,
        control: ControlPoints,
        targets: Sequence[Tensor],
        start: WarpMotion,
        wide: float,
        on_step: OnStep | None,
    ) -> WarpMotion:
        size = control.spacing
        shift, turn, stretch = _RATES
        rates = torch.tensor([shift] * 3 + [turn] * 3 + [stretch] * 6)
        widening = round(wide * self.steps)

        def motion_of(values: Tensor) -> WarpMotion:
            return WarpMotion(values[:, :3] * size, values[:, 3:6], values[:, 6:])

        def loss_in(values: Tensor, view: int, step: int) -> Tensor:
            motion = motion_of(values)
            rows = warp_rows(self.original, control, motion)
            held = _RIGID * disagreement(control, motion) + _STIFF * motion.stretch.square().sum(dim=1).mean()
            return view_distance(self.crops[view], rows, targets[view], wide=step < widening) + held

        def rates_at(step: int) -> Tensor:
            return falling(max(0, step - widening), self.steps - widening) * rates

        values = torch.cat([start.shift / size, start.turn, start.stretch], dim=1)
        found = descend(values, loss_in, rates_at, self.steps, len(self.crops), self.seed, _DAMPING, on_step)
        return motion_of(found)


def disagreement(control: ControlPoints, motion: WarpMotion) -> Tensor:
    """How far from each other neighbors would take one another, mean square, in squares of their spacing."""
    if not len(control.links):
        return motion.shift.new_zeros(())
    a, b = control.links.unbind(1)
    affine, shift = affine_maps(control, motion)
    goes = control.points + motion.shift
    error = (affine[a] @ control.points[b][..., None])[..., 0] + shift[a] - goes[b]
    return error.square().sum(dim=1).mean() / control.spacing**2
