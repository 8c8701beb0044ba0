"""Group stage: before members descend on their own, the region moves to where the edit shows it.

Free descent smears a part that has to travel half its own size: every Gaussian fades to the color behind it.
The motions of the parts are therefore found first, each part as a whole. If parts leave much of the error,
for example for an ear that is bent or an arm that is stretched, control points bend the region. The members'
own offsets then live in the moved frames: the offsets of a hand move, rotate and scale with it
(docs/method.md 3). Between two strengths the region follows the interpolated motion, not the optimizer's
path, so a slider shows the hand in motion.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from progdf.gaussians import attribute_slices
from progdf.similarity import Motion, Parts, make_parts
from trainer.motion.parts import GroupSearch, OnStep, connected_parts
from trainer.motion.warp import (
    PartsPlacement,
    RegionMotion,
    WarpMotion,
    WarpPlacement,
    WarpSearch,
    interpolate_placement,
    rest_warp,
    warp_of_parts,
)
from trainer.views.crops import CropScene, render_all

from .pgs import ParameterSnapshot, TargetStage, mean_visible_change

GROUP_STEPS = 120
"""Steps of the group stage per strength if parts move as wholes."""

# The members' own learning rate is a share of this many part sizes. After the motion of the parts, a color
# change remains. Steps are shorter if it is below `_FULL_STEP_CHANGE` (mean over the pixels that still
# change) or below the share `_FULL_STEP_REMAINDER` of the whole change (docs/lab/experiments.md, Parts that
# move).
_EXTENT_IN_PART_SIZES = 7.0  # extent of the learning rates, in mean part sizes
_FULL_STEP_CHANGE = 0.065  # remaining mean color change from which steps have full length
_FULL_STEP_REMAINDER = 0.28  # remaining share of the change from which steps have full length

_MAX_PARTS_ERROR = 0.1  # share of the distance that may remain for a motion by whole parts to be accepted
# Control points must leave at most this share of the distance that whole parts leave: they cost more and are
# less stable.
_MAX_WARP_ERROR = 0.9


@dataclass(frozen=True)
class Groups:
    """Parts of a region and their motion at the end of every stage."""

    parts: Parts  # parts of the region
    motions: tuple[Motion, ...]  # motions of the parts, one per stage
    # motions of control points, one per stage; empty if parts move as wholes
    warps: tuple[WarpPlacement, ...] = ()

    @property
    def extent(self) -> float:
        """Length scale of the members' own motion within their frames, world units."""
        return _EXTENT_IN_PART_SIZES * float(self.parts.sizes.mean())

    @property
    def placements(self) -> tuple[RegionMotion, ...]:
        """Motion at the end of each stage."""
        return self.warps or tuple(PartsPlacement(self.parts, motion) for motion in self.motions)

    @property
    def rest(self) -> RegionMotion:
        """Motion at the start of the first stage."""
        if self.warps:
            return WarpPlacement(self.warps[0].control, rest_warp(self.warps[0].control))
        return PartsPlacement(self.parts, self.parts.rest_motion())

    def to_stages(
        self, original: Tensor, crops: Sequence[CropScene], stages: Sequence[TargetStage]
    ) -> list[TargetStage]:
        """Return the stages with the members' offsets in the moved frames.

        `original`: raw member rows. [M,C]
        """
        before: Sequence[Tensor] = render_all(crops, original)
        staged = []
        for stage, placement in zip(stages, self.placements, strict=True):
            carried = partial(placement.carry, original)
            moved = render_all(crops, original + carried(torch.zeros_like(original)))
            total, _ = mean_visible_change(stage.targets, before)
            remaining, left = mean_visible_change(stage.targets, moved)
            length = min(1.0, left / _FULL_STEP_CHANGE, remaining / (_FULL_STEP_REMAINDER * max(total, 1e-9)))
            staged.append(replace(stage, place=carried, length=max(0.02, length)))
            before = stage.targets
        return staged

    def lines(self) -> list[str]:
        """Return the log lines about the finished edit."""
        return self.placements[-1].lines()

    def capture_state(self) -> dict[str, Tensor]:
        """Return the part of each member [M], motions [T,P,7] and warps [T,C,12], for `restore_groups`."""
        motions = [torch.cat([m.shift, m.log_scale[:, None], m.turn], dim=1) for m in self.motions]
        state = {"part": self.parts.part, "motions": torch.stack(motions)}
        if self.warps:
            warps = [torch.cat([w.motion.shift, w.motion.turn, w.motion.stretch], dim=1) for w in self.warps]
            state["warps"] = torch.stack(warps)
        return state


def group_stage(
    original: Tensor,
    crops: Sequence[CropScene],
    targets: Sequence[Sequence[Tensor]],
    steps: int = GROUP_STEPS,
    seed: int = 0,
    on_step: OnStep | None = None,
    strengths: Sequence[float] = (),
) -> Groups:
    """Find the parts and their motions, and bend the region if they do not suffice.

    The result is deterministic.

    Args:
        original: raw member rows. [M,C]
        crops: training views
        targets: per stage, the edited box of each view. [h,w,3] each
        steps: per search; a stage takes one or two searches, and one per level of control points if it is
            bent
        seed: seed of the view order
        on_step: progress: steps done in all, with `steps` per stage however many it takes; loss
        strengths: strengths of the stages; evenly spaced if not given

    Raises:
        FloatingPointError: the loss is not finite.
    """
    means = original[:, attribute_slices(original.shape[1])["means"]]
    parts = make_parts(original, connected_parts(means.cpu()).to(means.device))
    search = GroupSearch(original, parts, crops, steps, seed)
    motions: list[Motion] = []

    def step_done(stage: int, step: int, loss: float) -> None:
        if on_step is not None:
            on_step(stage * steps + step, loss)

    for stage, pictures in enumerate(targets):
        start = motions[-1] if motions else parts.rest_motion()
        motions.append(search.find(pictures, start, partial(step_done, stage)))
    groups = Groups(parts, tuple(motions))
    left = search.distance(targets[-1], motions[-1])
    if left <= _MAX_PARTS_ERROR * search.distance(targets[-1], parts.rest_motion()):
        return groups
    return bend_groups(groups, search, targets, strengths or range(1, len(targets) + 1), step_done)


def restore_groups(original: Tensor, saved: Mapping[str, Tensor]) -> Groups:
    """Return the groups saved by `Groups.capture_state`, for the same members."""
    saved = {name: tensor.to(original.device) for name, tensor in saved.items()}
    motions = tuple(Motion(m[:, :3], m[:, 3], m[:, 4:]) for m in saved["motions"])
    warps: tuple[WarpPlacement, ...] = ()
    if "warps" in saved:
        control = WarpSearch(original, saved["part"], ()).levels[-1]
        warps = tuple(
            WarpPlacement(control, WarpMotion(w[:, :3], w[:, 3:6], w[:, 6:])) for w in saved["warps"]
        )
    return Groups(make_parts(original, saved["part"]), motions, warps)


def bend_groups(
    groups: Groups,
    search: GroupSearch,
    targets: Sequence[Sequence[Tensor]],
    strengths: Sequence[float],
    on_step: Callable[[int, int, float], None],
) -> Groups:
    """Bend the region by control points. Each stage starts where the previous one ended.

    Args:
        groups: parts moved as wholes
        search: search that found their motions
        targets, strengths: target pictures and strengths of the stages
        on_step: progress: stage, steps done in it, loss

    Returns:
        The bent groups, or `groups` if control points are not clearly closer to the finished edit.
    """
    parts = groups.parts
    bending = WarpSearch(search.original, parts.part, search.crops, search.steps, search.seed)
    control = bending.levels[-1]
    motions = list[WarpMotion]()
    for stage, pictures in enumerate(targets):
        done = partial(on_step, stage)
        if stage:
            further = strengths[stage] / strengths[stage - 1]
            motions.append(bending.find_next(pictures, motions[-1], further, done))
        else:
            coarse = warp_of_parts(bending.levels[0], parts, groups.motions[0])
            motions.append(bending.find_first(pictures, coarse, done))
    left = bending.distance(targets[-1], motions[-1])
    if left > _MAX_WARP_ERROR * search.distance(targets[-1], groups.motions[-1]):
        return groups
    return replace(groups, warps=tuple(WarpPlacement(control, motion) for motion in motions))


def group_path(
    original: Tensor, groups: Groups, ends: Sequence[Tensor], steps: Sequence[int], count: int
) -> list[ParameterSnapshot]:
    """Return snapshots through the ends of the stages, with interpolated motions of parts or control points.

    Args:
        original: raw member rows. [M,C]
        groups: see `group_stage`
        ends: offsets of the members at the end of each stage. [M,C] each
        steps: optimizer steps done at these ends
        count: approximate number of snapshots over all stages

    Returns:
        snapshots in order, in half precision, without means
    """
    placement = groups.rest
    own = torch.zeros_like(original)
    start_step = 0
    ends = [end.to(original.device) for end in ends]
    each = max(2, count // len(ends))
    placements = []
    for end, step, after in zip(ends, steps, groups.placements, strict=True):
        next_own = after.carry_back(original, end)
        for i in range(1, each):
            share = i / each
            halfway = interpolate_placement(placement, after, share)
            offsets = halfway.carry(original, torch.lerp(own, next_own, share))
            done = start_step + round(share * (step - start_step))
            placements.append(ParameterSnapshot(done, False, offsets.half().cpu(), {}))
        placements.append(ParameterSnapshot(step, True, end.half().cpu(), {}))
        placement = after
        own = next_own
        start_step = step
    return placements
