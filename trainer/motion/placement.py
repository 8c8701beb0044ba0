"""Where a stage of the edit has put a region: what members go along with while they learn their own."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from .control_points import ControlPoints
from .similarity import Motion, Parts, carry_offsets, interpolate_motion, local_offsets
from .warp import WarpMotion, interpolate_warp, map_members


class Placement(Protocol):
    """A motion of all members of a region."""

    def carry(self, original: Tensor, offsets: Tensor) -> Tensor:
        """Offsets within the moved frames -> offsets from the original; differentiable. [M,C] -> [M,C]"""
        ...

    def carry_back(self, original: Tensor, offsets: Tensor) -> Tensor:
        """The inverse of `carry`. [M,C] -> [M,C]"""
        ...

    def lines(self) -> list[str]:
        """What the log says of it."""
        ...


@dataclass(frozen=True)
class PartsPlacement:
    """Parts that have moved as wholes."""

    parts: Parts
    motion: Motion

    def carry(self, original: Tensor, offsets: Tensor) -> Tensor:
        """See `Placement`."""
        return carry_offsets(original, offsets, self.parts, self.motion)

    def carry_back(self, original: Tensor, offsets: Tensor) -> Tensor:
        """See `Placement`."""
        return local_offsets(original, offsets, self.parts, self.motion)

    def lines(self) -> list[str]:
        """Where each part went, in its own sizes."""
        motion, sizes = self.motion, self.parts.sizes
        return [
            f"part {index}, {int((self.parts.part == index).sum())} Gaussians: moved by "
            f"{float(motion.shift[index].norm() / sizes[index]):.2f} of its size, turned by "
            f"{math.degrees(float(motion.turn[index].norm())):.0f} degrees, "
            f"{math.exp(float(motion.log_scale[index])):.2f} times as large"
            for index in range(len(sizes))
        ]


@dataclass(frozen=True)
class WarpPlacement:
    """A region that was bent by control points."""

    control: ControlPoints
    motion: WarpMotion

    def carry(self, original: Tensor, offsets: Tensor) -> Tensor:
        """See `Placement`."""
        return map_members(original, self.control, self.motion).carry(original, offsets)

    def carry_back(self, original: Tensor, offsets: Tensor) -> Tensor:
        """See `Placement`."""
        return map_members(original, self.control, self.motion).carry_back(original, offsets)

    def lines(self) -> list[str]:
        """How far the control points went, in their spacings."""
        shift = self.motion.shift.norm(dim=1) / self.control.spacing
        turn, stretch = self.motion.turn.norm(dim=1), self.motion.stretch[:, :3]
        return [
            f"bent by {len(self.control)} control points: moved by up to {float(shift.max()):.2f} of their "
            f"spacing, turned by up to {math.degrees(float(turn.max())):.0f} degrees, stretched "
            f"{math.exp(float(stretch.min())):.2f} to {math.exp(float(stretch.max())):.2f} times"
        ]


def between(a: Placement, b: Placement, share: float) -> Placement:
    """On the way from one placement to another of the same kind."""
    if isinstance(a, PartsPlacement) and isinstance(b, PartsPlacement):
        return PartsPlacement(a.parts, interpolate_motion(a.motion, b.motion, share))
    assert isinstance(a, WarpPlacement)
    assert isinstance(b, WarpPlacement)
    return WarpPlacement(a.control, interpolate_warp(a.motion, b.motion, share))
