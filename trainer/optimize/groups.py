"""The group stage: before anything bends, each connected part is moved as a whole to where the edit shows it.

Free descent smears a part that has to travel half its own size: every Gaussian fades towards whatever color
it lies on. So the parts' motions are found first, and the members' own offsets live in the frames of their
parts from then on: what is learnt of a hand moves, turns and grows with the hand (docs/method.md 3).
The way between two strengths is the parts' way, not the optimizer's: a slider shows the hand in motion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from progdf.gaussians import attribute_slices
from trainer.views.crops import CropScene, render_all

from .group_search import GroupSearch, OnStep
from .motion import Motion, Parts, carry_offsets, interpolate_motion, local_offsets, make_parts
from .parts import connected_parts
from .pgs import TargetStage, visible_way

GROWTH = 2.0
"""How many times a Gaussian may grow beyond its part; larger ones are fog that hides an error."""

# The members' own learning rate is a share of so many part sizes; shorter steps where the parts' motion has
# left less than `_LEFT` to do, a mean over the pixels that still change, and less than `_REST` of what there
# was (docs/experiments.md, Parts that move).
_EXTENT, _LEFT, _REST = 7.0, 0.065, 0.28


@dataclass(frozen=True)
class Groups:
    """The parts of a region and where each is at the end of every stage.

    Args:
        parts: the region taken apart
        motions: of the parts, one per stage
    """

    parts: Parts
    motions: tuple[Motion, ...]

    @property
    def extent(self) -> float:
        """Size of what the members still have to move within their parts, world units."""
        return _EXTENT * float(self.parts.sizes.mean())

    def to_stages(
        self, original: Tensor, crops: Sequence[CropScene], stages: Sequence[TargetStage]
    ) -> list[TargetStage]:
        """The stages, their members' offsets now in the parts' frames. `original`: raw member rows [M,C]"""
        before: Sequence[Tensor] = render_all(crops, original)
        staged = []
        for stage, motion in zip(stages, self.motions, strict=True):
            place = partial(self._place, original, motion)
            found = render_all(crops, original + place(torch.zeros_like(original)))
            whole, _ = visible_way(stage.targets, before)
            rest, left = visible_way(stage.targets, found)
            length = min(1.0, left / _LEFT, rest / (_REST * max(whole, 1e-9)))
            staged.append(replace(stage, place=place, length=max(0.02, length)))
            before = stage.targets
        return staged

    def _place(self, original: Tensor, motion: Motion, offsets: Tensor) -> Tensor:
        return carry_offsets(original, offsets, self.parts, motion)

    def lines(self) -> list[str]:
        """What the log says of the finished edit: where each part went, in its own sizes."""
        motion, sizes = self.motions[-1], self.parts.sizes
        return [
            f"part {index}, {int((self.parts.part == index).sum())} Gaussians: moved by "
            f"{float(motion.shift[index].norm() / sizes[index]):.2f} of its size, turned by "
            f"{math.degrees(float(motion.turn[index].norm())):.0f} degrees, "
            f"{math.exp(float(motion.log_scale[index])):.2f} times as large"
            for index in range(len(sizes))
        ]

    def capture_state(self) -> dict[str, Tensor]:
        """Part of each member [M] and motions [T,P,7]; `restore_groups` takes them."""
        motions = [torch.cat([m.shift, m.log_scale[:, None], m.turn], dim=1) for m in self.motions]
        return {"part": self.parts.part, "motions": torch.stack(motions)}


def group_stage(
    original: Tensor,
    crops: Sequence[CropScene],
    targets: Sequence[Sequence[Tensor]],
    steps: int = 120,
    seed: int = 0,
    on_step: OnStep | None = None,
) -> Groups:
    """Find the parts and their motions; the same inputs give the same bits.

    Args:
        original: raw member rows. [M,C]
        crops: the training views
        targets: of each stage, the edited box of each view. [h,w,3] each
        steps: of a search; a stage takes one or two
        seed: order of the views
        on_step: progress: steps done in all, each stage counting as `steps` however many it takes; loss

    Raises:
        FloatingPointError: the loss is not finite.
    """
    means = original[:, attribute_slices(original.shape[1])["means"]]
    parts = make_parts(original, connected_parts(means))
    search = GroupSearch(original, parts, crops, steps, seed)
    motions: list[Motion] = []
    for stage, pictures in enumerate(targets):

        def step_done(step: int, loss: float, begun: int = stage * steps) -> None:
            if on_step is not None:
                on_step(begun + step, loss)

        start = motions[-1] if motions else parts.rest_motion()
        motions.append(search.find(pictures, start, step_done))
    return Groups(parts, tuple(motions))


def restore_groups(original: Tensor, saved: Mapping[str, Tensor]) -> Groups:
    """What `Groups.capture_state` gave, of the same members."""
    motions = tuple(Motion(m[:, :3], m[:, 3], m[:, 4:]) for m in saved["motions"])
    return Groups(make_parts(original, saved["part"]), motions)


def group_path(
    original: Tensor, groups: Groups, ends: Sequence[Tensor], steps: Sequence[int], count: int
) -> list[tuple[int, int, bool, Tensor]]:
    """Recordings through the stages' ends: parts move as wholes, what bends within them bends evenly.

    Args:
        original: raw member rows. [M,C]
        groups: see `group_stage`
        ends: the members' offsets at the end of each stage. [M,C] each
        steps: optimizer steps done then
        count: recordings over all stages, about

    Returns:
        (step, stage, ends_stage, offsets [M,C] float16) in order, as `trajectory.record` takes them
    """
    motion, own, begun = groups.parts.rest_motion(), torch.zeros_like(original), 0
    each = max(2, count // len(ends))
    found = []
    for stage, (end, step, next_motion) in enumerate(zip(ends, steps, groups.motions, strict=True)):
        next_own = local_offsets(original, end, groups.parts, next_motion)
        for i in range(1, each):
            share = i / each
            halfway = interpolate_motion(motion, next_motion, share)
            offsets = carry_offsets(original, torch.lerp(own, next_own, share), groups.parts, halfway)
            found.append((begun + round(share * (step - begun)), stage, False, offsets.half()))
        found.append((step, stage, True, end.half()))
        motion, own, begun = next_motion, next_own, step
    return found
