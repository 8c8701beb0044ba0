"""Edits that remove, move, pull or copy regions. Their path over strengths is known, so nothing is trained.

1. Remove: a region fades out, until no engine draws it.
2. Transform: a region moves, rotates, stretches and mirrors about a pivot, along an arc.
3. Pull: points of a region move, and the rest follows rigidly (see `progdf.pull`).
4. Duplicate: a transformed copy of a region fades in as added rows.

Fading is even in pictures (see `progdf.fade`). Without pictures it is linear in opacity.

Each operation becomes an edit with a slider, a `Gdf`. `bake` applies the same steps to a scene permanently.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.fade import fading_course
from progdf.field.baked import interpolate_at
from progdf.field.separable import course_field, fit_keyframes, opacity_course
from progdf.gaussians import Gaussians, attribute_slices, concatenate, pack
from progdf.gdf.anchors import free_anchors
from progdf.gdf.file import ADDED_LOGIT, Gdf, anchor_added, fingerprint
from progdf.gdf.motions import PartMotions
from progdf.pull.course import PullCourse
from progdf.region import Region, from_mask
from progdf.scene.bounds import scene_sphere
from progdf.similarity import GEOMETRY, AffineMotion, continue_axes, transform_rows

_KNOT_SPACING = 1 / 8
"""Largest rotation (radians) or log-stretch between two knots, for shapes and colors."""
_PICTURE_PX = 512  # size of the picture that a moved region fills, for the bounds below
# Largest distance of a center from its arc between two knots; 0.35 left 44 dB between the knots of a robot.
_ARC_ERROR_PX = 0.2
_STORED_ERROR_PX = 0.1  # largest error of a center as stored, at the knots
_MAX_ARC_SEGMENTS = 256  # maximum number of segments of an arc
_OPACITY_COLUMN = attribute_slices(14)["logit_opacities"].start


_FADED_SHARE = 0.3  # share of the time until the courses of opacities are known
_MOVED_SHARE = 0.7  # share of the time until the rows at all strengths are known

Operation = Literal["remove", "transform", "duplicate", "pull"]


@dataclass(frozen=True)
class Step:
    """One operation on a region of a scene."""

    does: Operation
    region: Region
    motion: AffineMotion | None = None  # motion of the region as one part; None: no motion
    copied: Gaussians | None = None  # Gaussians to duplicate in place of the region's own
    course: PullCourse | None = None  # course of a pull, the first step of its Gaussians

    def move(self, rows: Tensor, share: float) -> Tensor:
        """Return packed raw rows after a share, 0 to 1, of the motion. [M,C] float64 -> [M,C]"""
        if self.course is not None:
            return rows + self.course.offsets_at(share)
        return rows if self.motion is None else transform_rows(rows, self.motion, share)


def ignore_progress(_share: float) -> None:
    """Report no progress."""


def similarity(
    shift: Sequence[float] = (0.0, 0.0, 0.0), turn: Sequence[float] = (0.0, 0.0, 0.0), scale: float = 1.0
) -> AffineMotion:
    """Return the motion of a whole region about the mean of its centers.

    Args:
        shift: translation of its center, world units. [3]
        turn: axis times angle in radians, which may exceed a full turn. [3]
        scale: scale factor, > 0
    """
    return AffineMotion(
        torch.tensor(shift, dtype=torch.float64),
        torch.tensor(turn, dtype=torch.float64),
        math.log(scale) * torch.eye(3, dtype=torch.float64),
    )


def mirror(axis: int) -> AffineMotion:
    """Return the motion that mirrors a whole region about the mean of its centers; `axis`: 0 to 2."""
    still = torch.zeros(3, dtype=torch.float64)
    return AffineMotion(still, still, torch.zeros(3, 3, dtype=torch.float64), axis)


def tidy(
    scene: Gaussians,
    steps: Sequence[Step],
    name: str,
    instruction: str = "",
    added: Gaussians | None = None,
    cameras: Sequence[Camera] | None = None,
    leaves_paint: bool = False,
    only_end: bool = False,
    *,
    progress: Callable[[float], None] = ignore_progress,
) -> Gdf:
    """Return the steps as one edit: strength 0 is the scene, strength 1 the result of all steps.

    Args:
        scene: the original, which all regions refer to
        steps: operations in order; later ones move the results of earlier ones, but copies are of the
            original
        name: name of the layer
        instruction: text stored in the .gdf
        added: further rows to add, as they are at strength 1; they follow the surface below them
        cameras: views in which fading is even; empty: cameras around the fading Gaussians; None: opacities
            change linearly, which is fast
        leaves_paint: rows that other edits add on the regions stay as they are
        only_end: the edit is for strength 1, a preview that takes little time
        progress: receives the finished share, 0 to 1; an error that it raises ends the work

    Returns:
        Edit of all removed or moved Gaussians. Copies are its added rows.

    Raises:
        ValueError: a number is not finite.
    """
    mask = torch.zeros(len(scene), dtype=torch.bool)
    for step in steps:
        if step.does != "duplicate":
            mask |= step.region.mask
    region = from_mask(name, mask)
    members = region.members
    bands = scene.sh_degree > 0 and any(_rotates(step) for step in steps)
    rows = pack(scene[members], with_shN=bands)
    fill_count = 0 if added is None else len(added)
    added = _copies(scene, steps, added)
    end = _end_logits(scene, steps)[members]
    start_scene = scene
    if added is not None:
        end = torch.cat([end, added.logit_opacities])
        added = replace(added, logit_opacities=torch.full_like(added.logit_opacities, ADDED_LOGIT))
        start_scene = concatenate([scene, added])
    affected = torch.cat([members, torch.arange(len(scene), len(start_scene))])
    opacity_knots, logits = _opacity_course(start_scene, affected, end, cameras)
    progress(_FADED_SHARE)
    knots = _knots(scene, steps, only_end)
    if bool(logits.any()) and not only_end:
        knots = torch.cat([knots, opacity_knots]).unique()  # type: ignore[no-untyped-call]
    offsets = rows.new_zeros(len(knots), len(end), rows.shape[1])
    for i, s in enumerate(knots.tolist()):
        offsets[i, : len(members)] = _rows_at(scene, members, steps, bands, s) - rows if s else 0.0
        progress(_FADED_SHARE + (_MOVED_SHARE - _FADED_SHARE) * (i + 1) / len(knots))
    if any(step.motion is not None and not step.motion.is_similar for step in steps):
        shapes = rows[:, GEOMETRY] + offsets[:, : len(members), GEOMETRY]
        shapes = _continue_shapes(shapes.double(), knots, steps)
        offsets[1:, : len(members), GEOMETRY] = (shapes - rows[:, GEOMETRY])[1:].float()
    for i, s in enumerate(knots.tolist()):
        offsets[i, :, _OPACITY_COLUMN] = interpolate_at(opacity_knots, logits, s)
    if only_end:
        field = fit_keyframes(knots, offsets, 2)
    else:
        field = course_field(knots, offsets, _stored_tolerance(scene, steps))
    adds = all(_adds(step) for step in steps)
    gdf = Gdf(
        name,
        region,
        field,
        fingerprint(scene),
        instruction,
        added=added,
        adds=adds,
        motions=_part_motions(region, steps),
    )
    added_count = 0 if added is None else len(added)
    if fill_count:
        gdf = anchor_added(gdf, scene, free=added_count - fill_count)
    return leave_paint(gdf) if leaves_paint else gdf


def _knots(scene: Gaussians, steps: Sequence[Step], only_end: bool) -> Tensor:
    """Return the strengths between which the paths of all steps are nearly straight. [S]"""
    knots = torch.tensor([0.0, 1.0])
    for step in steps:
        if step.does == "transform" and step.motion is not None and not only_end:
            knots = torch.cat([knots, _path_knots(scene, step.region, step.motion)]).unique()  # type: ignore[no-untyped-call]
        if step.course is not None:
            knots = torch.cat([knots, step.course.strengths]).unique()  # type: ignore[no-untyped-call]
    return knots


def _path_knots(scene: Gaussians, region: Region, motion: AffineMotion) -> Tensor:
    """Return strengths between which chords stay near the arcs of a region's centers. [S]

    The distance is bounded by `_ARC_ERROR_PX` where the region fills the picture: as it is, or as it has
    grown. The pivot may be far away, which makes the arcs longer.
    """
    knots = motion.strengths(_KNOT_SPACING).double()
    moved = scene[region.members]
    center, radius = scene_sphere(moved)
    pivot = moved.means.double().mean(dim=0) if motion.pivot is None else motion.pivot
    arm = center.double() - pivot
    matrices = torch.stack([motion.linear(s) for s in knots.tolist()])
    middles = torch.stack([motion.linear(s) for s in (0.5 * (knots[1:] + knots[:-1])).tolist()])
    # the pivot moves straight, so a chord misses the arc of the arm x by (½ (A + B) − M) x
    missed = 0.5 * (matrices[1:] + matrices[:-1]) - middles
    distance = radius * torch.linalg.matrix_norm(missed, 2) + (missed @ arm).norm(dim=1)
    growth = torch.linalg.matrix_norm(matrices[1:], 2).clamp_min(1.0)
    allowed = _ARC_ERROR_PX / _PICTURE_PX * 2.0 * radius * growth
    finer = float((distance / allowed).max().sqrt())  # the distance falls with the square of the length
    if finer <= 1.0:
        return knots.float()
    return motion.strengths(max(_KNOT_SPACING / finer, motion.size / _MAX_ARC_SEGMENTS))


def _stored_tolerance(scene: Gaussians, steps: Sequence[Step]) -> float:
    """Return the largest error of a stored center, world units, for the smallest region that moves."""
    regions = [step.region for step in steps if step.motion is not None or step.course is not None]
    radii = [scene_sphere(scene[region.members])[1] for region in regions if len(region)]
    return _STORED_ERROR_PX / _PICTURE_PX * 2.0 * min(radii, default=math.inf)


def leave_paint(gdf: Gdf) -> Gdf:
    """Return the edit with the paint of other edits on its regions unchanged, see `Anchors.leaves_paint`."""
    added_count = 0 if gdf.added is None else len(gdf.added)
    anchors = free_anchors(added_count) if gdf.anchors is None else gdf.anchors
    return replace(gdf, anchors=replace(anchors, leaves_paint=True))


def _continue_shapes(shapes: Tensor, knots: Tensor, steps: Sequence[Step]) -> Tensor:
    """Return the geometry of the members at the knots, with principal axes in the order of the knots before.

    After the flat state half way through a mirror, the axes lead to those at the end, which turn like all
    others of the region. [S,M,10] -> [S,M,10]
    """
    if all(step.motion is None or step.motion.mirror is None for step in steps):
        return continue_axes(shapes)
    middle = int((knots <= 0.5).sum())
    return torch.cat([continue_axes(shapes[:middle]), continue_axes(shapes[middle:].flip(0)).flip(0)])


def _opacity_course(
    scene: Gaussians, rows: Tensor, end: Tensor, cameras: Sequence[Camera] | None
) -> tuple[Tensor, Tensor]:
    """Return knots [S] and the offsets of the rows' logits from the scene's at them. [S,M]

    Args:
        scene: all Gaussians at strength 0, with the added ones
        rows: the affected ones. [M]
        end: their logits at strength 1. [M]
        cameras: see `tidy`
    """
    fades = end != scene.logit_opacities[rows]
    if not bool(fades.any()):
        return torch.tensor([0.0, 1.0]), torch.zeros(2, len(rows))
    if cameras is None:
        return opacity_course(scene.logit_opacities[rows], end)
    knots, course = fading_course(scene, rows[fades], end[fades], cameras)
    offsets = torch.zeros(len(knots), len(rows))
    offsets[:, fades] = course
    return knots, offsets


def bake(scene: Gaussians, steps: Sequence[Step]) -> Gaussians:
    """Return the scene after all steps, without removed rows, and with copies at the end."""
    moved = torch.zeros(len(scene), dtype=torch.bool)
    remains = torch.ones(len(scene), dtype=torch.bool)
    for step in steps:
        if step.does in ("transform", "pull"):
            moved[step.region.members] = True
        if step.does == "remove":
            remains[step.region.members] = False
    remaining = scene
    members = moved.nonzero()[:, 0]
    if len(members):  # only these rows are packed, because a pack of a large scene is several times its size
        bands = scene.sh_degree > 0 and any(_rotates(step) for step in steps)
        remaining = scene.replace_rows(members, _rows_at(scene, members, steps, bands, 1.0))
    if not bool(remains.all()):
        remaining = remaining[remains]
    added = _copies(scene, steps)
    return remaining if added is None else concatenate([remaining, added])


def _part_motions(region: Region, steps: Sequence[Step]) -> PartMotions | None:
    """Return the motions of a region's members; None if no step moves them as parts, or one pulls them.

    A pull bends its surface, so rows that lie on it follow their anchors.
    """
    moving = [step for step in steps if step.does == "transform" and step.motion is not None]
    if not moving or any(step.does == "pull" for step in steps):
        return None
    code = torch.zeros(len(region), dtype=torch.int64)  # each step is a bit
    for bit, step in enumerate(moving):
        code += step.region.mask[region.members].long() << bit
    codes, parts = torch.unique(code, return_inverse=True)
    motions = tuple(
        tuple(step.motion for bit, step in enumerate(moving) if step.motion is not None and known >> bit & 1)
        for known in codes.tolist()
    )
    return PartMotions(parts, motions)


def _adds(step: Step) -> bool:
    """Return True if changes by lower layers stay, as those below pulls and shifts do."""
    if step.does == "pull":
        return True
    return step.does == "transform" and step.motion is not None and step.motion.is_shift


def _rotates(step: Step) -> bool:
    return step.course is not None or (step.motion is not None and step.motion.turns_colors)


def _rows_at(scene: Gaussians, members: Tensor, steps: Sequence[Step], bands: bool, share: float) -> Tensor:
    """Return raw rows of sorted members after the steps; rows that no step moves keep their bits. [M,C]"""
    rows = pack(scene[members], with_shN=bands)
    moved = rows.double()
    for step in steps:
        if step.does in ("transform", "pull"):
            index = torch.searchsorted(members, step.region.members)
            moved[index] = step.move(moved[index], share)
    return moved.to(rows.dtype)


def _copies(scene: Gaussians, steps: Sequence[Step], added: Gaussians | None = None) -> Gaussians | None:
    """Return the added rows and then all copies in order; None if there are neither."""
    parts = [] if added is None else [added]
    for step in steps:
        if step.does == "duplicate":
            part = scene[step.region.members] if step.copied is None else step.copied
            rows = pack(part, with_shN=scene.sh_degree > 0)
            parts.append(part.replace_rows(torch.arange(len(part)), step.move(rows.double(), 1.0)))
    return concatenate(parts) if parts else None


def _end_logits(scene: Gaussians, steps: Sequence[Step]) -> Tensor:
    logits = scene.logit_opacities.clone()
    for step in steps:
        if step.does == "remove":
            members = step.region.members
            logits[members] = logits[members].clamp(max=ADDED_LOGIT)
    return logits
