"""Warps of a region: control points that shift, rotate and stretch, and the members that follow.

The method is embedded deformation (Sumner, Schmid and Pauly 2007). Control point k maps x to A_k (x − c_k) +
c_k + t_k with A_k = R_k exp(S_k). A member blends the maps of its nearest control points by smooth weights,
which stay constant while it moves. Each member thus has one affine map, x → J x + b. Its own offsets are
carried along and can be carried back.

The search starts from the motion of whole parts, with a small number of control points, then more.
Neighboring control points are held to each other's motion, as rigidly as the views allow, so that hidden
areas follow visible ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, Self

import torch
from torch import Tensor

from progdf.gaussians import BASE_CHANNELS, attribute_slices
from progdf.quaternions import (
    matrix_turns,
    multiply_quats,
    normalize_quats,
    quat_turns,
    rotate_vectors,
    rotation_matrices,
    turn_quats,
)
from progdf.similarity import (
    GEOMETRY,
    Motion,
    Parts,
    carry_offsets,
    interpolate_motion,
    local_offsets,
    offsets_to,
    split_geometry,
)
from progdf.system.equality import equal_fields
from trainer.views.crops import CropScene

from .parts import OnStep, descend, falling, mean_distance, view_distance

LEVELS = (6, 18, 54)
"""Number of control points per level, coarse to fine."""

_MIN_FOLLOWERS = 8  # minimum mean number of members per control point
_RATES = (0.04, 0.02, 0.015)  # step of shift in spacings of the level, of rotation in radians, of stretch
_WIDE_STEP_SHARE = 0.4  # share of the coarsest level's steps with blurred pictures only
_RIGIDITY_WEIGHT = 0.05  # weight of the squared disagreement of neighbors, in squares of their spacing
_STRETCH_WEIGHT = 0.002  # weight of the squared stretch
_DAMPING = 0.1  # see `descend`
_STILL_SQUARE = 1e-5  # squared way, in spacings, at which a point loses half its tether to the straight line
_CONTROLS_PER_MEMBER = 4  # control points per member
_LINKS_PER_CONTROL = 6  # neighbors per control point
_QUATS = attribute_slices(BASE_CHANNELS)["quats"]
_SYMMETRIC_INDICES = (0, 3, 4, 3, 1, 5, 4, 5, 2)  # indices of a stretch's numbers in its matrix, row by row


@dataclass(frozen=True)
class ControlPoints:
    """Control points of a region, and the members that follow them."""

    __eq__ = equal_fields

    rows: Tensor  # members at the control points. [P] int64
    points: Tensor  # positions. [P,3]
    part: Tensor  # connected part of each. [P] int64
    nearest: Tensor  # control points that each member follows, of its own part. [M,K] int64
    weights: Tensor  # their weights, with sum 1. [M,K]
    links: Tensor  # pairs of neighbors that should move alike. [L,2] int64
    spacing: float  # median distance of neighbors, world units, > 0

    def __len__(self) -> int:
        return len(self.points)


def make_control_points(means: Tensor, part: Tensor, count: int) -> ControlPoints:
    """Spread control points over a region by farthest-point sampling. The result is deterministic.

    Args:
        means: centers of the members. [M,3]
        part: connected part of each, see `connected_parts`. [M] int64
        count: total number of control points, at most one per member; parts share them by size, at least
            one each
    """
    rows = []
    part_of = []
    links = []
    first = 0
    nearest = part.new_zeros(len(means), _CONTROLS_PER_MEMBER)
    weights = means.new_zeros(len(means), _CONTROLS_PER_MEMBER)
    for index, size in enumerate(torch.bincount(part).tolist()):
        members = (part == index).nonzero()[:, 0]
        points = min(size, max(1, round(count * size / len(means))))
        chosen = members[farthest_points(means[members], points)]
        near = min(_CONTROLS_PER_MEMBER, points)
        distances = torch.cdist(means[members], means[chosen])
        neighbors = distances.topk(min(near + 1, points), dim=1, largest=False)
        # weights fall to 0 at the next farther control point, so they are continuous where it takes over
        reach = 1.01 * neighbors.values[:, -1:].clamp_min(1e-9)
        share = (1 - neighbors.values[:, :near] / reach).clamp_min(1e-6).square()
        nearest[members, :near] = first + neighbors.indices[:, :near]
        weights[members, :near] = share / share.sum(dim=1, keepdim=True)
        link_count = min(_LINKS_PER_CONTROL, points - 1)
        spacings = torch.cdist(means[chosen], means[chosen])
        others = spacings.topk(link_count + 1, dim=1, largest=False).indices[:, 1:]
        selves = torch.arange(points).to(others)[:, None].expand_as(others)
        links.append(first + torch.stack([selves, others], dim=2).reshape(-1, 2))
        rows.append(chosen)
        part_of.append(part.new_full((points,), index))
        first += points
    at = torch.cat(rows)
    pairs = torch.cat(links)
    gaps = (means[at[pairs[:, 0]]] - means[at[pairs[:, 1]]]).norm(dim=1)
    radii = (means - means.mean(dim=0)).norm(dim=1)
    spacing = float((gaps if len(gaps) else radii).median())
    return ControlPoints(at, means[at], torch.cat(part_of), nearest, weights, pairs, max(spacing, 1e-9))


def farthest_points(means: Tensor, count: int) -> Tensor:
    """Return rows far from each other, starting with the one farthest from the mean.

    [M,3] -> [count] int64
    """
    distance = (means - means.mean(dim=0)).square().sum(dim=1)
    chosen = [int(distance.argmax())]
    distance = (means - means[chosen[0]]).square().sum(dim=1)
    for _ in range(count - 1):
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (means - means[chosen[-1]]).square().sum(dim=1))
    return means.new_tensor(chosen, dtype=torch.int64)


@dataclass(frozen=True)
class WarpMotion:
    """Motion of P control points."""

    __eq__ = equal_fields

    shift: Tensor  # world units. [P,3]
    turn: Tensor  # rotation vector, axis times angle in radians. [P,3]
    stretch: Tensor  # logarithm of the stretch, applied before the turn: xx yy zz xy xz yz. [P,6]


@dataclass(frozen=True)
class MemberMaps:
    """Affine map x → J x + b of each member, with its rotation and growth."""

    __eq__ = equal_fields

    matrix: Tensor  # J. [M,3,3]
    shift: Tensor  # b. [M,3]
    turn: Tensor  # unit quaternion. [M,4]
    growth: Tensor  # growth of the log-scales, along the member's axes. [M,3]
    axes_turn: Tensor | None = None  # rotation of the axes, unit quaternion; None: that of the map. [M,4]

    def carry(self, original: Tensor, offsets: Tensor) -> Tensor:
        """Convert offsets within the moved frames to offsets from the original. Differentiable.

        Args:
            original: raw member rows. [M,C]
            offsets: each member's own offsets beside the map. [M,C]

        Returns:
            raw offsets; those of opacity and color are unchanged. [M,C]
        """
        means, log_scales, quats = split_geometry(original[:, GEOMETRY] + offsets[:, GEOMETRY])
        moved = [
            (self.matrix @ means[..., None])[..., 0] + self.shift,
            log_scales + self.growth,
            multiply_quats(self.turn if self.axes_turn is None else self.axes_turn, quats),
        ]
        return offsets_to(torch.cat(moved, dim=1), original, offsets, self.turn)

    def carry_back(self, original: Tensor, offsets: Tensor) -> Tensor:
        """Invert `carry`. [M,C] -> [M,C]"""
        means, log_scales, quats = split_geometry(original[:, GEOMETRY] + offsets[:, GEOMETRY])
        conjugate = self.turn.new_tensor([1.0, -1.0, -1.0, -1.0])
        back = conjugate * self.turn
        axes_back = back if self.axes_turn is None else conjugate * self.axes_turn
        local = [
            torch.linalg.solve(self.matrix, (means - self.shift)[..., None])[..., 0],
            log_scales - self.growth,
            multiply_quats(axes_back, quats),
        ]
        return offsets_to(torch.cat(local, dim=1), original, offsets, back)


def rest_warp(control: ControlPoints) -> WarpMotion:
    """Return the warp that moves nothing."""
    nothing = torch.zeros_like(control.points)
    return WarpMotion(nothing, nothing, nothing.new_zeros(len(nothing), 6))


def warp_of_parts(control: ControlPoints, parts: Parts, motion: Motion) -> WarpMotion:
    """Return the warp in which every control point follows its part: exactly the motion of the parts."""
    part = control.part
    size = motion.log_scale[part, None]
    turn = motion.turn[part]
    arm = control.points - parts.centers[part]
    moved = parts.centers[part] + motion.shift[part] + size.exp() * rotate_vectors(arm, turn_quats(turn))
    nothing = torch.zeros_like(size)
    return WarpMotion(moved - control.points, turn, torch.cat([size] * 3 + [nothing] * 3, dim=1))


def transfer_warp(control: ControlPoints, motion: WarpMotion, other: ControlPoints) -> WarpMotion:
    """Return a motion of the region at other control points: the blended map at each of them."""
    affine, shift = affine_maps(control, motion)
    maps = torch.cat([affine.flatten(1), shift], dim=1)
    blended = (control.weights[other.rows, :, None] * maps[control.nearest[other.rows]]).sum(dim=1)
    matrix = blended[:, :9].reshape(-1, 3, 3)
    left, sizes, right = torch.linalg.svd(matrix)
    log = right.mT @ torch.diag_embed(sizes.clamp_min(1e-3).log()) @ right
    moved = (matrix @ other.points[..., None])[..., 0] + blended[:, 9:]
    stretch = log.flatten(1)[:, [0, 4, 8, 1, 2, 5]]
    return WarpMotion(moved - other.points, matrix_turns(left @ right), stretch)


def affine_maps(control: ControlPoints, motion: WarpMotion) -> tuple[Tensor, Tensor]:
    """Return each control point's map x → A x + b: A [P,3,3], b [P,3]. Differentiable."""
    affine = rotation_matrices(turn_quats(motion.turn)) @ _stretches(motion)
    return affine, motion.shift + control.points - (affine @ control.points[..., None])[..., 0]


def map_members(original: Tensor, control: ControlPoints, motion: WarpMotion) -> MemberMaps:
    """Return the maps of the members, differentiable in the motion. `original`: raw rows [M,C]"""
    affine, shift = affine_maps(control, motion)
    numbers = torch.cat(
        [affine.flatten(1), shift, _stretches(motion).flatten(1), turn_quats(motion.turn)], dim=1
    )
    # not numbers[nearest]: threads sum its gradient in any order
    followed = numbers.index_select(0, control.nearest.flatten()).view(*control.nearest.shape, -1)
    blended = (control.weights[..., None] * followed).sum(dim=1)
    axes = rotation_matrices(normalize_quats(original[:, _QUATS]))
    growth = (blended[:, 12:21].reshape(-1, 3, 3) @ axes).norm(dim=1).log()
    turn = torch.nn.functional.normalize(blended[:, 21:], dim=1)
    return MemberMaps(blended[:, :9].reshape(-1, 3, 3), blended[:, 9:12], turn, growth)


def warp_rows(original: Tensor, control: ControlPoints, motion: WarpMotion) -> Tensor:
    """Return raw rows moved by the motion; differentiable in the motion. [M,C] -> [M,C]"""
    maps = map_members(original, control, motion)
    return original + maps.carry(original, torch.zeros_like(original))


def interpolate_warp(control: ControlPoints, a: WarpMotion, b: WarpMotion, share: float) -> WarpMotion:
    """Interpolate two motions: stretch linearly, rotations along the great circle, shifts by `rigid_path`."""
    remaining = quat_turns(multiply_quats(turn_quats(-a.turn), turn_quats(b.turn)))
    turn = quat_turns(multiply_quats(turn_quats(a.turn), turn_quats(share * remaining)))
    between = WarpMotion(torch.lerp(a.shift, b.shift, share), turn, torch.lerp(a.stretch, b.stretch, share))
    positions = rigid_path(
        control.points,
        control.links,
        control.spacing,
        (control.points + a.shift, control.points + b.shift),
        tuple(affine_maps(control, motion)[0] for motion in (a, between, b)),
        tuple(rotation_matrices(turn_quats(motion.turn)) for motion in (a, between, b)),
        share,
    )
    return replace(between, shift=positions - control.points)


def rigid_path(
    points: Tensor,
    links: Tensor,
    spacing: float,
    ends: tuple[Tensor, Tensor],
    maps: Sequence[Tensor],
    rotations: Sequence[Tensor],
    share: float,
) -> Tensor:
    """Return positions between two poses, so that parts that turn do not shrink on the way.

    The links between the points follow the maps at their ends. Points that move little stay near the straight
    line, which determines the place of each connected part.

    Args:
        points: positions at rest. [P,3]
        links: pairs of neighbors. [L,2]
        spacing: distance of neighbors, world units
        ends: positions in both poses. [P,3] each
        maps: affine maps of the points in the first pose, between and in the last. [P,3,3] each
        rotations: rotations of these maps. [P,3,3] each
        share: 0 to 1

    Returns:
        [P,3]; the poses themselves at 0 and 1
    """
    first, last = ends
    way = (last - first).norm(dim=1).double() / spacing
    tether = _STILL_SQUARE / (_STILL_SQUARE + way.square())
    start, end = links.unbind(1)
    adjacency = tether.new_zeros(len(points) ** 2)
    adjacency = adjacency.index_add(0, start * len(points) + end, tether.new_ones(len(links)))
    adjacency = adjacency.view(len(points), len(points))
    adjacency = adjacency + adjacency.mT
    factor = torch.linalg.cholesky(torch.diag(tether + adjacency.sum(dim=1)) - adjacency)
    arms = (points[end] - points[start]).double()

    def fit(matrices: Tensor, at: float) -> Tensor:
        """Return the positions whose links fit the maps at their ends. [P,3]"""
        mean = 0.5 * (matrices[start] + matrices[end]).double()
        edges = (mean @ arms[..., None])[..., 0]
        right = tether[:, None] * torch.lerp(first, last, at).double()
        right = right.index_add(0, end, edges).index_add(0, start, -edges)
        return torch.cholesky_solve(right, factor).to(points)

    # the remainder at both ends, which turns with the points
    left_first = rotations[0].mT @ (first - fit(maps[0], 0.0))[..., None]
    left_last = rotations[2].mT @ (last - fit(maps[2], 1.0))[..., None]
    left = (rotations[1] @ torch.lerp(left_first, left_last, share))[..., 0]
    return fit(maps[1], share) + left


def extrapolate_warp(motion: WarpMotion, further: float) -> WarpMotion:
    """Return the motion scaled by a factor."""
    return WarpMotion(further * motion.shift, further * motion.turn, further * motion.stretch)


def _stretches(motion: WarpMotion) -> Tensor:
    """Return exp(S) of each control point. [P,3,3]"""
    stretches: Tensor = torch.linalg.matrix_exp(motion.stretch[:, _SYMMETRIC_INDICES].reshape(-1, 3, 3))
    return stretches


@dataclass(frozen=True)
class WarpSearch:
    """Search for the motion of control points that fits the training views."""

    __eq__ = equal_fields

    original: Tensor  # raw member rows. [M,C]
    part: Tensor  # connected part of each member. [M] int64
    crops: Sequence[CropScene]  # the training views
    steps: int = 120  # steps per level, each in one view
    seed: int = 0  # seed of the view order

    @cached_property
    def levels(self) -> tuple[ControlPoints, ...]:
        """Control points, coarse to fine. Found motions belong to the last level."""
        means = self.original[:, attribute_slices(self.original.shape[1])["means"]]
        counts = sorted({min(count, max(1, len(means) // _MIN_FOLLOWERS)) for count in LEVELS})
        return tuple(make_control_points(means, self.part, count) for count in counts)

    def find_first(
        self, targets: Sequence[Tensor], start: WarpMotion, on_step: OnStep | None = None
    ) -> WarpMotion:
        """Return the motion that brings the views close to their targets, from coarse to fine.

        Args:
            targets: edited box of each view. [h,w,3] each
            start: motion of the coarsest control points
            on_step: progress: steps done in one level; each level counts from 1 again

        Raises:
            FloatingPointError: the loss is no longer finite.
        """
        motion = start
        for level, control in enumerate(self.levels):
            if level:
                motion = transfer_warp(self.levels[level - 1], motion, control)
            motion = self._descend(control, targets, motion, 0.0 if level else _WIDE_STEP_SHARE, on_step)
        return motion

    def find_next(
        self,
        targets: Sequence[Tensor],
        before: WarpMotion,
        further: float,
        on_step: OnStep | None = None,
    ) -> WarpMotion:
        """Return the motion for a strength `further` times that of the motion `before`."""
        control = self.levels[-1]
        start = min(
            (before, extrapolate_warp(before, further)),
            key=lambda motion: self.distance(targets, motion),
        )
        return self._descend(control, targets, start, 0.0, on_step)

    def distance(self, targets: Sequence[Tensor], motion: WarpMotion) -> float:
        """Return the mean distance of all views from their targets, at full sharpness and blurred."""
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
        rates = start.shift.new_tensor([shift] * 3 + [turn] * 3 + [stretch] * 6)
        widening = round(wide * self.steps)

        def motion_of(values: Tensor) -> WarpMotion:
            return WarpMotion(values[:, :3] * size, values[:, 3:6], values[:, 6:])

        def loss_in(values: Tensor, view: int, step: int) -> Tensor:
            motion = motion_of(values)
            rows = warp_rows(self.original, control, motion)
            penalty = (
                _RIGIDITY_WEIGHT * disagreement(control, motion)
                + _STRETCH_WEIGHT * motion.stretch.square().sum(dim=1).mean()
            )
            return view_distance(self.crops[view], rows, targets[view], wide=step < widening) + penalty

        def rates_at(step: int) -> Tensor:
            return falling(max(0, step - widening), self.steps - widening) * rates

        values = torch.cat([start.shift / size, start.turn, start.stretch], dim=1)
        settled = descend(
            values, loss_in, rates_at, self.steps, len(self.crops), self.seed, _DAMPING, on_step
        )
        return motion_of(settled)


def disagreement(control: ControlPoints, motion: WarpMotion) -> Tensor:
    """Return by how much neighboring control points disagree, in squared spacings.

    It is the mean squared distance of a moved control point from its position under a neighbor's map.
    """
    if not len(control.links):
        return motion.shift.new_zeros(())
    a, b = control.links.unbind(1)
    affine, shift = affine_maps(control, motion)
    goes = control.points + motion.shift
    error = (affine[a] @ control.points[b][..., None])[..., 0] + shift[a] - goes[b]
    return error.square().sum(dim=1).mean() / control.spacing**2


class RegionMotion(Protocol):
    """Motion of all members of a region."""

    def carry(self, original: Tensor, offsets: Tensor) -> Tensor:
        """Convert offsets within the moved frames to offsets from the original.

        Differentiable. [M,C] -> [M,C]
        """
        ...

    def carry_back(self, original: Tensor, offsets: Tensor) -> Tensor:
        """Invert `carry`. [M,C] -> [M,C]"""
        ...

    def rest(self) -> Self:
        """Return the placement that moves nothing."""
        ...

    def interpolate(self, other: Self, share: float) -> Self:
        """Return the placement at a share of the way to another one."""
        ...

    def lines(self) -> list[str]:
        """Return the log lines about the motion."""
        ...


@dataclass(frozen=True)
class PartsPlacement:
    """Motion of parts as wholes."""

    parts: Parts
    motion: Motion

    def carry(self, original: Tensor, offsets: Tensor) -> Tensor:
        """See `RegionMotion`."""
        return carry_offsets(original, offsets, self.parts, self.motion)

    def carry_back(self, original: Tensor, offsets: Tensor) -> Tensor:
        """See `RegionMotion`."""
        return local_offsets(original, offsets, self.parts, self.motion)

    def rest(self) -> PartsPlacement:
        """See `RegionMotion`."""
        return PartsPlacement(self.parts, self.parts.rest_motion())

    def interpolate(self, other: PartsPlacement, share: float) -> PartsPlacement:
        """See `RegionMotion`."""
        motion = interpolate_motion(self.motion, other.motion, share, self.parts.sizes)
        return PartsPlacement(self.parts, motion)

    def lines(self) -> list[str]:
        """Return the motion of each part, in units of its size."""
        motion = self.motion
        sizes = self.parts.sizes
        return [
            f"part {index}, {int((self.parts.part == index).sum())} Gaussians: shifted by "
            f"{float(motion.shift[index].norm() / sizes[index]):.2f} of its size, rotated by "
            f"{math.degrees(float(motion.turn[index].norm())):.0f} degrees, "
            f"scaled by {math.exp(float(motion.log_scale[index])):.2f}"
            for index in range(len(sizes))
        ]


@dataclass(frozen=True)
class WarpPlacement:
    """Motion of a region that is bent by control points."""

    control: ControlPoints
    motion: WarpMotion

    def carry(self, original: Tensor, offsets: Tensor) -> Tensor:
        """See `RegionMotion`."""
        return map_members(original, self.control, self.motion).carry(original, offsets)

    def carry_back(self, original: Tensor, offsets: Tensor) -> Tensor:
        """See `RegionMotion`."""
        return map_members(original, self.control, self.motion).carry_back(original, offsets)

    def rest(self) -> WarpPlacement:
        """See `RegionMotion`."""
        return WarpPlacement(self.control, rest_warp(self.control))

    def interpolate(self, other: WarpPlacement, share: float) -> WarpPlacement:
        """See `RegionMotion`."""
        return WarpPlacement(self.control, interpolate_warp(self.control, self.motion, other.motion, share))

    def lines(self) -> list[str]:
        """Return the motion of the control points, in units of their spacing."""
        shift = self.motion.shift.norm(dim=1) / self.control.spacing
        turn = self.motion.turn.norm(dim=1)
        stretch = self.motion.stretch[:, :3]
        return [
            f"bent by {len(self.control)} control points: shifted by up to {float(shift.max()):.2f} of their "
            f"spacing, rotated by up to {math.degrees(float(turn.max())):.0f} degrees, stretched "
            f"{math.exp(float(stretch.min())):.2f} to {math.exp(float(stretch.max())):.2f} times"
        ]
