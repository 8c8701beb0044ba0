"""Removing, moving and copying regions: edits whose whole course is known, so that nothing is trained.

    remove      opacity falls to nothing, linear in opacity
    transform   a region is shifted, turned and scaled about the mean of its centers, along an arc
    duplicate   a copy of it, so placed, appears as added rows

Each is an edit with a slider, a `Gdf`, and `bake` writes the same steps into a scene for good.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from progdf.field.baked import interpolate_at
from progdf.field.separable import course_field, opacity_course
from progdf.gaussians import Gaussians, attribute_slices, concatenate, pack
from progdf.gdf.file import ADDED_LOGIT, Gdf, fingerprint
from progdf.region import Region, from_mask
from progdf.similarity import Motion, make_parts, move_rows

_KNOT = 1 / 8
"""Radians, and log of a scale, between knots: the chord of such an arc is off it by 1/500 of its radius, half
a pixel of a thing that fills 512."""
_OPACITY = attribute_slices(14)["logit_opacities"].start


Deed = Literal["remove", "transform", "duplicate"]


@dataclass(frozen=True)
class Step:
    """One thing that is done to a region of a scene."""

    does: Deed
    region: Region
    motion: Motion | None = None  # of the region as one part; None: it stays where it is

    def move(self, rows: Tensor, share: float) -> Tensor:
        """Packed raw rows a share of the way along the motion. [M,C] float64 -> [M,C]"""
        if self.motion is None or not len(rows):
            return rows
        motion = Motion(*(share * part.double() for part in vars(self.motion).values()))
        return move_rows(rows, make_parts(rows, torch.zeros(len(rows), dtype=torch.int64)), motion)


def similarity(
    shift: Sequence[float] = (0.0, 0.0, 0.0), turn: Sequence[float] = (0.0, 0.0, 0.0), scale: float = 1.0
) -> Motion:
    """The motion of a region as a whole.

    Args:
        shift: of its center, world units. [3]
        turn: axis times angle in radians, more than a turn too. [3]
        scale: > 0
    """
    parts = [shift], [math.log(scale)], [turn]
    moved, size, turned = (torch.tensor(part, dtype=torch.float64) for part in parts)
    return Motion(moved, size, turned)


def tidy(
    scene: Gaussians,
    steps: Sequence[Step],
    name: str,
    instruction: str = "",
    added: Gaussians | None = None,
) -> Gdf:
    """The steps as one edit with a slider: 0 the scene, 1 all of them done.

    Args:
        scene: the original; all regions are of it
        steps: later ones move what earlier ones have moved; copies are of what the scene has
        name: of the layer
        instruction: as the .gdf repeats it
        added: rows that appear beside the copies, as they are at 1

    Returns:
        An edit of all Gaussians that are removed or moved; copies are its added rows.

    Raises:
        ValueError: a number is not finite.
    """
    mask = torch.zeros(len(scene), dtype=torch.bool)
    for step in steps:
        if step.does != "duplicate":
            mask |= step.region.mask
    region = from_mask(name, mask)
    members = region.members
    bands = scene.sh_degree > 0 and any(_turns(step) for step in steps)
    rows = pack(scene[members], with_shN=bands)
    added = _copies(scene, steps, added)
    start = rows[:, _OPACITY]
    end = _end_logits(scene, steps)[members]
    if added is not None:
        end = torch.cat([end, added.logit_opacities])
        added = replace(added, logit_opacities=torch.full_like(added.logit_opacities, ADDED_LOGIT))
        start = torch.cat([start, added.logit_opacities])
    opacity_knots, logits = opacity_course(start, end)
    motions = [step.motion for step in steps if step.does == "transform" and step.motion is not None]
    count = max(1, *(math.ceil(_reach(motion) / _KNOT) for motion in motions)) if motions else 1
    knots = torch.linspace(0.0, 1.0, 1 + count)
    if bool(logits.any()):
        knots = torch.cat([knots, opacity_knots]).unique()  # type: ignore[no-untyped-call]
    offsets = rows.new_zeros(len(knots), len(end), rows.shape[1])
    for i, s in enumerate(knots.tolist()):
        offsets[i, : len(members)] = _rows_at(scene, members, steps, bands, s) - rows if s else 0.0
        offsets[i, :, _OPACITY] = interpolate_at(opacity_knots, logits, s)
    field = course_field(knots, offsets)
    return Gdf(name, region, field, fingerprint(scene), instruction, added=added)


def bake(scene: Gaussians, steps: Sequence[Step]) -> Gaussians:
    """The scene with the steps done for good: what is removed has no rows, copies come last."""
    everything = torch.arange(len(scene))
    bands = scene.sh_degree > 0 and any(_turns(step) for step in steps)
    rows = _rows_at(scene, everything, steps, bands, 1.0)
    mask = torch.ones(len(scene), dtype=torch.bool)
    for step in steps:
        if step.does == "remove":
            mask[step.region.members] = False
    remaining = scene.replace_rows(everything, rows)[mask]
    added = _copies(scene, steps)
    return remaining if added is None else concatenate([remaining, added])


def _turns(step: Step) -> bool:
    return step.motion is not None and bool(step.motion.turn.any())


def _reach(motion: Motion) -> float:
    """The larger of the angle, in radians, and the log of the scale."""
    return max(float(motion.turn.norm()), float(motion.log_scale.abs()))


def _rows_at(scene: Gaussians, members: Tensor, steps: Sequence[Step], bands: bool, share: float) -> Tensor:
    """Raw rows of members, sorted, where the steps have moved them; what none moves keeps its bits. [M,C]"""
    rows = pack(scene[members], with_shN=bands)
    moved = rows.double()
    for step in steps:
        if step.does == "transform":
            index = torch.searchsorted(members, step.region.members)
            moved[index] = step.move(moved[index], share)
    return moved.to(rows.dtype)


def _copies(scene: Gaussians, steps: Sequence[Step], added: Gaussians | None = None) -> Gaussians | None:
    """All copies, in order, after what is added; None where there is neither."""
    parts = [] if added is None else [added]
    for step in steps:
        if step.does == "duplicate":
            part = scene[step.region.members]
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
