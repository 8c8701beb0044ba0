"""Similarity motions of a region's parts: each is translated, rotated and scaled about its own center.

The members' raw rows follow. Centers move, the part's log-scale is added to log-scales, and quaternions and
higher SH bands are rotated. Opacity and the color of band 0 are unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.gaussians import BASE_CHANNELS, attribute_slices
from progdf.quaternions import multiply_quats, quat_turns, rotate_vectors, turn_quats
from progdf.sh import rotation_change

_COLUMNS = attribute_slices(BASE_CHANNELS)
GEOMETRY = slice(0, _COLUMNS["quats"].stop)  # means, log-scales and quaternions come first in a packed row
APPEARANCE = slice(GEOMETRY.stop, BASE_CHANNELS)  # opacity and color of band 0
_BANDS = slice(BASE_CHANNELS, None)


@dataclass(frozen=True)
class Motion:
    """Motion of each of P parts."""

    shift: Tensor  # translation of the part's center, world units. [P,3]
    log_scale: Tensor  # log of the part's scale factor. [P]
    turn: Tensor  # rotation vector, axis times angle in radians. [P,3]


@dataclass(frozen=True)
class Parts:
    """Decomposition of a region into P parts."""

    part: Tensor  # index of each member's part. [M] int64
    centers: Tensor  # mean of each part's centers, the pivot of rotation and scale. [P,3]
    sizes: Tensor  # root mean square distance from that center, world units, > 0. [P]

    def __len__(self) -> int:
        return len(self.centers)

    def rest_motion(self) -> Motion:
        """Return the motion that moves no part."""
        nothing = torch.zeros_like(self.centers)
        return Motion(nothing, nothing[:, 0], nothing)


def make_parts(rows: Tensor, part: Tensor) -> Parts:
    """Return the parts of packed members [M,C]; `part` [M] int64 uses every index below P."""
    means, log_scales, _ = split_geometry(rows)
    counts = torch.bincount(part).to(means)
    nothing = means.new_zeros(len(counts), 3)
    centers = nothing.index_add(0, part, means) / counts[:, None]
    squares = (means - centers[part]).square().sum(dim=1)
    sizes = (nothing[:, 0].index_add(0, part, squares) / counts).sqrt()
    largest = log_scales.exp().amax(dim=1).mean()  # a part of one Gaussian has that Gaussian's size
    return Parts(part, centers, torch.maximum(sizes, 1e-3 * largest).clamp_min(1e-9))


def move_rows(rows: Tensor, parts: Parts, motion: Motion) -> Tensor:
    """Return raw rows after the motion; differentiable. [M,C] -> [M,C]"""
    bands = rows[:, _BANDS]
    turned = bands + band_change(bands, turn_quats(motion.turn), parts.part)
    return torch.cat([_move_geometry(rows, parts, motion), rows[:, APPEARANCE], turned], dim=1)


def carry_offsets(original: Tensor, offsets: Tensor, parts: Parts, motion: Motion) -> Tensor:
    """Convert offsets within the parts' frames to offsets from the original after a motion.

    Args:
        original: raw member rows. [M,C]
        offsets: offsets of each member relative to its part. [M,C]
        parts, motion: parts and their motion

    Returns:
        Raw-space offsets, differentiable. Those of opacity and color are unchanged. [M,C]
    """
    moved = _move_geometry(original[:, GEOMETRY] + offsets[:, GEOMETRY], parts, motion)
    return offsets_to(moved, original, offsets, turn_quats(motion.turn), parts.part)


def local_offsets(original: Tensor, offsets: Tensor, parts: Parts, motion: Motion) -> Tensor:
    """Invert `carry_offsets`. [M,C] -> [M,C]"""
    part = parts.part
    means, log_scales, quats = split_geometry(original[:, GEOMETRY] + offsets[:, GEOMETRY])
    turns = turn_quats(-motion.turn)
    size = motion.log_scale[part, None]
    back = turns[part]
    arm = means - parts.centers[part] - motion.shift[part]
    local = [
        parts.centers[part] + rotate_vectors(arm, back) * (-size).exp(),
        log_scales - size,
        multiply_quats(back, quats),
    ]
    return offsets_to(torch.cat(local, dim=1), original, offsets, turns, part)


def offsets_to(
    geometry: Tensor, original: Tensor, offsets: Tensor, turns: Tensor, part: Tensor | None = None
) -> Tensor:
    """Return the offsets from the original to moved geometry, with rotated higher SH bands. [M,C]

    Offsets of opacity and color are unchanged. See also `sh.rotation_change`.

    Args:
        geometry: moved means, log-scales and quaternions. [M,10]
        original, offsets: raw member rows, and offsets within their frames. [M,C]
        turns: unit quaternions of the members [M,4] or of parts [P,4]
        part: index of each member's part. [M] int64
    """
    bands = offsets[:, _BANDS]
    turned = bands + band_change(original[:, _BANDS] + bands, turns, part)
    return torch.cat([geometry - original[:, GEOMETRY], offsets[:, APPEARANCE], turned], dim=1)


def band_change(bands: Tensor, turns: Tensor, part: Tensor | None = None) -> Tensor:
    """Return the change of packed higher bands by rotations. [M,3K] -> [M,3K]"""
    return rotation_change(bands.reshape(len(bands), bands.shape[1] // 3, 3), turns, part).flatten(1)


def _move_geometry(rows: Tensor, parts: Parts, motion: Motion) -> Tensor:
    """Return means, log-scales and quaternions after the motion. [M,≥10] -> [M,10]"""
    part = parts.part
    means, log_scales, quats = split_geometry(rows)
    turn = turn_quats(motion.turn)[part]
    size = motion.log_scale[part, None]
    arm = means - parts.centers[part]
    means = parts.centers[part] + motion.shift[part] + size.exp() * rotate_vectors(arm, turn)
    return torch.cat([means, log_scales + size, multiply_quats(turn, quats)], dim=1)


def interpolate_motion(a: Motion, b: Motion, share: float) -> Motion:
    """Interpolate motions: shift and log-scale linearly, the rotation along the great circle."""
    start = turn_quats(a.turn)
    remaining = quat_turns(multiply_quats(turn_quats(-a.turn), turn_quats(b.turn)))
    return Motion(
        torch.lerp(a.shift, b.shift, share),
        torch.lerp(a.log_scale, b.log_scale, share),
        quat_turns(multiply_quats(start, turn_quats(share * remaining))),
    )


def split_geometry(rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return means [M,3], log-scales [M,3] and quaternions [M,4] of packed rows."""
    return rows[:, _COLUMNS["means"]], rows[:, _COLUMNS["log_scales"]], rows[:, _COLUMNS["quats"]]
