"""Group stage: before members descend on their own, the region moves to where the edit shows it.

Free descent smears a part that has to travel half its own size: every Gaussian fades to the color behind it.
The motions of the parts are therefore found first, each part as a whole. If parts leave much of the error,
for example for an ear that is bent or an arm that is stretched, control points bend the region. The members'
own offsets then live in the moved frames: the offsets of a hand move, rotate and scale with it
(docs/method.md 3). Between two strengths the region follows the interpolated motion, not the optimizer's
path, so a slider shows the hand in motion.

Parts that only fade are found first, since a motion out of sight shows the same finished pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from progdf.gaussians import Gaussians, attribute_slices
from progdf.scene.bounds import scene_sphere
from progdf.similarity import Motion, Parts, make_parts
from trainer.motion.fade import FadePlacement, FadeSearch
from trainer.motion.node_search import NodeSearch
from trainer.motion.nodes import NodeMotion, NodePlacement, place_nodes, rest_nodes
from trainer.motion.parts import GroupSearch, OnStep, connected_parts, mean_distance
from trainer.motion.warp import (
    LEVELS,
    PartsPlacement,
    RegionMotion,
    WarpMotion,
    WarpPlacement,
    WarpSearch,
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
# Share of the distance that may remain for a fade by whole parts. A part that moves leaves about half of it,
# as it appears at its new place. A true fade left 0.13 in small views of the trial.
_MAX_FADE_ERROR = 0.2
# Control points must leave at most this share of the distance that whole parts leave: they cost more and are
# less stable.
_MAX_WARP_ERROR = 0.9
# Nodes must leave at most this share of the distance that the others leave.
_MAX_NODES_ERROR = 0.9
# Share of the members' own steps within the frames of nodes. Longer steps lose what the nodes found
# (docs/benchmarks.md, Parts that move smoothly).
_NODE_STEP_SHARE = 0.3


@dataclass(frozen=True)
class Groups:
    """Parts of a region and their motion at the end of every stage."""

    parts: Parts  # parts of the region
    motions: tuple[Motion, ...]  # motions of the parts, one per stage
    # motions of control points, one per stage; empty if parts move as wholes
    warps: tuple[WarpPlacement, ...] = ()
    nodes: tuple[NodePlacement, ...] = ()  # motions of nodes, one per stage, which replace the others
    fades: tuple[FadePlacement, ...] = ()  # opacity that is left, one per stage; the parts then do not move

    @property
    def extent(self) -> float:
        """Length scale of the members' own motion within their frames, world units."""
        return _EXTENT_IN_PART_SIZES * float(self.parts.sizes.mean())

    @property
    def placements(self) -> tuple[RegionMotion, ...]:
        """Motion at the end of each stage."""
        rigid = tuple(PartsPlacement(self.parts, motion) for motion in self.motions)
        return self.fades or self.nodes or self.warps or rigid

    @property
    def rest(self) -> RegionMotion:
        """Motion at the start of the first stage."""
        return self.placements[0].rest()

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
            if self.nodes:
                length *= _NODE_STEP_SHARE
            staged.append(replace(stage, place=carried, length=max(0.02, length)))
            before = stage.targets
        return staged

    def lines(self) -> list[str]:
        """Return the log lines about the finished edit."""
        return self.placements[-1].lines()

    def capture_state(self) -> dict[str, Tensor]:
        """Return the state for `restore_groups`.

        These are the part of each member [M], and per stage the motions of parts [T,P,7], control points
        [T,C,12] and nodes [T,n,6], and the opacity that is left of the parts [T,P].
        """
        motions = [torch.cat([m.shift, m.log_scale[:, None], m.turn], dim=1) for m in self.motions]
        state = {"part": self.parts.part, "motions": torch.stack(motions)}
        if self.warps:
            warps = [torch.cat([w.motion.shift, w.motion.turn, w.motion.stretch], dim=1) for w in self.warps]
            state["warps"] = torch.stack(warps)
        if self.nodes:
            nodes = [torch.cat([n.motion.positions, n.motion.turn], dim=1) for n in self.nodes]
            state["nodes"] = torch.stack(nodes)
        if self.fades:
            state["fades"] = torch.stack([fade.share for fade in self.fades])
        return state


def region_extent(members: Gaussians) -> float:
    """Return the length scale of members that move on their own, world units: the diameter of the region."""
    return 2.0 * scene_sphere(members)[1]


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

    def step_done(stage: int, step: int, loss: float) -> None:
        if on_step is not None:
            on_step(stage * steps + step, loss)

    fades = fade_parts(FadeSearch(original, parts, crops, seed), targets, step_done)
    if fades:
        return Groups(parts, tuple(parts.rest_motion() for _ in targets), fades=fades)
    search = GroupSearch(original, parts, crops, steps, seed)
    motions: list[Motion] = []
    for stage, pictures in enumerate(targets):
        start = motions[-1] if motions else parts.rest_motion()
        motions.append(search.find(pictures, start, partial(step_done, stage)))
    groups = Groups(parts, tuple(motions))
    left = search.distance(targets[-1], motions[-1])
    if left <= _MAX_PARTS_ERROR * search.distance(targets[-1], parts.rest_motion()):
        return groups
    strengths = strengths or range(1, len(targets) + 1)
    groups = bend_groups(groups, search, targets, strengths, step_done)
    moving = NodeSearch(original, crops, steps)
    if len(moving.nodes) <= LEVELS[-1]:  # no finer than the control points
        return groups
    return move_nodes(groups, moving, targets, strengths, step_done)


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
    nodes: tuple[NodePlacement, ...] = ()
    if "nodes" in saved:
        graph = NodeSearch(original, ()).nodes
        nodes = tuple(NodePlacement(graph, NodeMotion(n[:, :3], n[:, 3:])) for n in saved["nodes"])
    parts = make_parts(original, saved["part"])
    fades = tuple(FadePlacement(parts, share) for share in saved.get("fades", ()))
    return Groups(parts, motions, warps, nodes, fades)


def fade_parts(
    search: FadeSearch, targets: Sequence[Sequence[Tensor]], on_step: Callable[[int, int, float], None]
) -> tuple[FadePlacement, ...]:
    """Return the opacity that is left of each part at the end of every stage, if fading is all they do.

    Args:
        search: search for the opacity of the parts
        targets: target pictures of the stages
        on_step: progress: stage, steps done in it, loss

    Returns:
        One placement per stage; empty if the finished edit is not a fade of whole parts.
    """
    whole = FadePlacement(search.parts, search.parts.sizes.new_ones(len(search.parts)))
    finished = search.find(targets[-1], whole)
    left = search.distance(targets[-1], finished)
    if left > _MAX_FADE_ERROR * search.distance(targets[-1], whole):
        return ()
    fades = list[FadePlacement]()
    for stage, pictures in enumerate(targets[:-1]):
        start = fades[-1] if fades else whole
        fades.append(search.find(pictures, start, partial(on_step, stage)))
    return (*fades, finished)


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


def move_nodes(
    groups: Groups,
    moving: NodeSearch,
    targets: Sequence[Sequence[Tensor]],
    strengths: Sequence[float],
    on_step: Callable[[int, int, float], None],
) -> Groups:
    """Move the nodes of a deformation graph, from rest or from the motion of `groups`.

    Args:
        groups: parts or control points, moved
        moving: search for the motion of the nodes
        targets, strengths, on_step: see `bend_groups`

    Returns:
        The groups with nodes, or `groups` if nodes are not clearly closer to the finished edit.
    """
    original = moving.original
    graph = moving.nodes
    motions = list[NodeMotion]()
    for stage, pictures in enumerate(targets):
        done = partial(on_step, stage)
        if stage:
            further = strengths[stage] / strengths[stage - 1]
            motions.append(moving.find_next(pictures, motions[-1], further, done))
        else:
            found = place_nodes(original, graph, groups.placements[0])
            start = min((rest_nodes(graph), found), key=lambda motion: moving.distance(targets[0], motion))
            motions.append(moving.find(pictures, start, on_step=done))
    offsets = groups.placements[-1].carry(original, torch.zeros_like(original))
    left = mean_distance(moving.crops, original + offsets, targets[-1])
    if moving.distance(targets[-1], motions[-1]) > _MAX_NODES_ERROR * left:
        return groups
    return replace(groups, nodes=tuple(NodePlacement(graph, motion) for motion in motions))


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
            halfway = placement.interpolate(after, share)
            offsets = halfway.carry(original, torch.lerp(own, next_own, share))
            done = start_step + round(share * (step - start_step))
            placements.append(ParameterSnapshot(done, False, offsets.half().cpu(), {}))
        placements.append(ParameterSnapshot(step, True, end.half().cpu(), {}))
        placement = after
        own = next_own
        start_step = step
    return placements
