"""Similarity motions of a region's parts, and affine motions of a region as one part.

The members' raw rows follow. Similarities translate, rotate and scale each part about its own center: centers
move, the part's log-scale is added to log-scales, and quaternions and higher SH bands are rotated. Affine
motions also stretch along axes and mirror. Opacity and the color of band 0 are unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import torch
from torch import Tensor

from progdf.gaussians import BASE_CHANNELS, attribute_slices
from progdf.quaternions import (
    matrix_quats,
    matrix_turns,
    multiply_quats,
    normalize_quats,
    quat_turns,
    rotate_vectors,
    rotation_matrices,
    turn_quats,
)
from progdf.sh import half_turn, rotation_change
from progdf.system.equality import equal_fields

_COLUMNS = attribute_slices(BASE_CHANNELS)
GEOMETRY = slice(0, _COLUMNS["quats"].stop)  # means, log-scales and quaternions come first in a packed row
APPEARANCE = slice(GEOMETRY.stop, BASE_CHANNELS)  # opacity and color of band 0
_BANDS = slice(BASE_CHANNELS, None)


HINGE_REACH = 2.0
"""Distance of an axis from a part's center, in root mean square sizes, at which it still passes through the
part. The end of a straight rod is at √3."""


@dataclass(frozen=True)
class Motion:
    """Motion of each of P parts."""

    __eq__ = equal_fields

    shift: Tensor  # translation of the part's center, world units. [P,3]
    log_scale: Tensor  # log of the part's scale factor. [P]
    turn: Tensor  # rotation vector, axis times angle in radians. [P,3]


@dataclass(frozen=True)
class Parts:
    """Decomposition of a region into P parts."""

    __eq__ = equal_fields

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


def interpolate_motion(a: Motion, b: Motion, share: float, sizes: Tensor) -> Motion:
    """Interpolate motions: log-scales linearly, rotations along the great circle, centers on arcs or lines.

    A part that turns about an axis through it, like an arm about its joint, stays at rest at that axis. The
    farther away the axis is, the straighter is the way of the center.

    Args:
        a, b: motions of P parts
        share: 0 to 1
        sizes: root mean square sizes of the parts, see `Parts`. [P]
    """
    start = turn_quats(a.turn)
    remaining = quat_turns(multiply_quats(turn_quats(-a.turn), turn_quats(b.turn)))
    turn = quat_turns(multiply_quats(start, turn_quats(share * remaining)))
    world_turn = rotate_vectors(remaining, start)
    distance = b.shift - a.shift
    hinge = _hinges(distance, world_turn, sizes)
    swung = rotate_vectors(hinge, turn_quats(world_turn)) - hinge
    swinging = rotate_vectors(hinge, turn_quats(share * world_turn)) - hinge
    shift = a.shift + share * (distance + swung) - swinging
    return Motion(shift, torch.lerp(a.log_scale, b.log_scale, share), turn)


def _hinges(distance: Tensor, turn: Tensor, sizes: Tensor) -> Tensor:
    """Return the point of each part that moves straight, relative to the center. [P,3]

    Args:
        distance: shift of the center. [P,3]
        turn: rotation vector. [P,3]
        sizes: root mean square sizes. [P]
    """
    angle = turn.norm(dim=1, keepdim=True)
    axis = turn / angle.clamp_min(1e-12)
    across = distance - (distance * axis).sum(dim=1, keepdim=True) * axis
    # the axis is the place that a rotation by the angle moves by nothing
    cotangent = (0.5 * angle).cos() / (0.5 * angle).sin().clamp_min(1e-6)
    foot = 0.5 * (across + cotangent * torch.linalg.cross(axis, across))
    reach = HINGE_REACH * sizes[:, None] / foot.norm(dim=1, keepdim=True).clamp_min(1e-12)
    hinges: Tensor = foot * reach.square().clamp_max(1.0)
    return hinges


def split_geometry(rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return means [M,3], log-scales [M,3] and quaternions [M,4] of packed rows."""
    return rows[:, _COLUMNS["means"]], rows[:, _COLUMNS["log_scales"]], rows[:, _COLUMNS["quats"]]


MIN_FLATNESS = 0.01
"""Thickness of a Gaussian half way through a mirror, where it is flat, as a share of its thickness."""
MIN_STRETCH = 1e-3  # smallest factor of a stretch
_MIRROR_FACTORS = (1.0, 0.75, 0.5, 0.35, 0.25, 0.15, 0.08, 0.03, MIN_FLATNESS, 0.002, 0.0)
_UNIFORM_TOLERANCE = 1e-9  # smallest difference between the log-stretches of two axes that counts
_SAME_ANGLE = 1e-6  # angles that differ less are equal, radians
_JACOBI_SWEEPS = 5
_PLANES = ((0, 1), (0, 2), (1, 2))


@dataclass(frozen=True)
class AffineMotion:
    """Motion of a region as one part: mirrored, stretched, rotated and then translated about a pivot.

    On the way, a part of the motion is done: the pivot moves straight, the rotation turns about one axis, and
    factors grow evenly in their logarithm. A mirror flattens the region and unfolds it on the other side.
    """

    __eq__ = equal_fields

    shift: Tensor  # translation of the pivot, world units. [3]
    turn: Tensor  # rotation vector, axis times angle in radians, which may exceed a full turn. [3]
    stretch: Tensor  # matrix logarithm of the stretch, symmetric. [3,3]
    mirror: int | None = None  # axis that changes its sign first, 0 to 2; None: no mirror
    # fixed point of rotation, stretch and mirror, in the scene's coordinates; None: mean of the centers. [3]
    pivot: Tensor | None = None

    @property
    def turns_colors(self) -> bool:
        """True if view-dependent colors change."""
        return bool(self.turn.any()) or self.mirror is not None

    @property
    def is_uniform(self) -> bool:
        """True if all axes are stretched by the same factor."""
        values = torch.linalg.eigvalsh(self.stretch)
        return float(values[-1] - values[0]) <= _UNIFORM_TOLERANCE

    @property
    def is_similar(self) -> bool:
        """True if Gaussians keep their proportions on the whole way."""
        return self.is_uniform and self.mirror is None

    @property
    def is_shift(self) -> bool:
        """True if the region is only translated."""
        return not bool(self.turn.any() or self.stretch.any()) and self.mirror is None

    @property
    def size(self) -> float:
        """Angle, in radians, or the largest magnitude of a log-stretch if that is larger."""
        stretch = float(torch.linalg.eigvalsh(self.stretch).abs().max())
        return max(float(self.turn.norm()), stretch)

    def strengths(self, spacing: float) -> Tensor:
        """Return strengths from 0 to 1 between which the path is nearly straight. [S]

        Args:
            spacing: rotation, radians, or log-stretch between two of them
        """
        even = torch.linspace(0.0, 1.0, 1 + max(1, math.ceil(self.size / spacing)))
        if self.mirror is None:
            return even
        factors = torch.tensor(_MIRROR_FACTORS)
        strengths: Tensor = torch.cat([even, (1.0 - factors) / 2.0, (1.0 + factors) / 2.0]).unique()  # type: ignore[no-untyped-call]
        return strengths

    def linear(self, share: float = 1.0) -> Tensor:
        """Return the matrix of mirror, stretch and rotation after a share, 0 to 1, of the motion. [3,3]"""
        turned = rotation_matrices(turn_quats(share * self.turn[None]))[0]
        flip = torch.ones(3, dtype=torch.float64)
        if self.mirror is not None:
            flip[self.mirror] = 1.0 - 2.0 * share
        stretched: Tensor = torch.linalg.matrix_exp(share * self.stretch)
        return turned @ (stretched * flip)


def affine_motion(linear: Tensor, shift: Tensor, pivot: Tensor | None = None) -> AffineMotion:
    """Return the motion of an invertible matrix. Factors below `MIN_STRETCH` are raised to it.

    A matrix that mirrors is a mirrored axis and a rotation. The axis is the one with the smallest rotation.

    Args:
        linear: maps offsets from the pivot. [3,3]
        shift: translation of the pivot, world units. [3]
        pivot: see `AffineMotion`
    """
    linear = linear.double()
    axes: Sequence[int | None] = (None,) if float(torch.linalg.det(linear)) >= 0.0 else (0, 1, 2)
    best: tuple[float, int | None, Tensor, Tensor] | None = None
    for axis in axes:
        flipped = linear.clone()
        if axis is not None:
            flipped[:, axis] *= -1.0
        left, values, right = torch.linalg.svd(flipped)
        if float(torch.linalg.det(left @ right)) < 0.0:  # a singular matrix has no sign of its own
            left[:, 2] *= -1.0
        stretch = (right.T * values.clamp_min(MIN_STRETCH).log()) @ right
        turn = matrix_turns((left @ right)[None])[0]
        angle = float(turn.norm())
        if best is None or angle < best[0] - _SAME_ANGLE:
            best = angle, axis, turn, stretch
    assert best is not None
    _, axis, turn, stretch = best
    turn = torch.where(turn.abs() < 1e-12, torch.zeros_like(turn), turn)
    stretch = torch.where(stretch.abs() < 1e-12, torch.zeros_like(stretch), (stretch + stretch.T) / 2.0)
    return AffineMotion(shift.double(), turn, stretch, axis, None if pivot is None else pivot.double())


def transform_rows(rows: Tensor, motion: AffineMotion, share: float = 1.0) -> Tensor:
    """Return packed raw rows after a share, 0 to 1, of an affine motion. [M,C] float64 -> [M,C]"""
    if not len(rows) or share == 0.0:
        return rows
    means, log_scales, quats = split_geometry(rows)
    pivot = means.mean(dim=0) if motion.pivot is None else motion.pivot
    # the region as it is, or mirrored once it has passed the flat state half way
    signs = torch.ones(3, dtype=rows.dtype)
    thickness = torch.zeros(3, 3, dtype=rows.dtype)
    if motion.mirror is not None:
        factor = 1.0 - 2.0 * share
        signs[motion.mirror] = math.copysign(1.0, factor)
        thickness[motion.mirror, motion.mirror] = math.log(max(abs(factor), MIN_FLATNESS))
    bands = rows[:, _BANDS]
    if motion.mirror is not None and bands.shape[1]:
        parity = [1.0, 1.0, 1.0]
        parity[motion.mirror] = -1.0
        shN = bands.reshape(len(bands), -1, 3)
        bands = torch.lerp(shN, half_turn(shN, (parity[0], parity[1], parity[2])), share).flatten(1)
    turn = turn_quats(share * motion.turn[None])
    bands = bands + _turned_change(bands, turn)
    moved = pivot + share * motion.shift + (means - pivot) @ motion.linear(share).T
    mirrored = quats
    if bool((signs < 0.0).any()):
        # a Gaussian is symmetric about its center: a half turn about the mirrored axis is its mirror image,
        # and all Gaussians turn alike, as rows that follow them need
        half = torch.cat([torch.zeros(1, dtype=rows.dtype), (1.0 - signs) / 2.0])
        mirrored = multiply_quats(half[None], quats)
    is_flat = bool(thickness.any())
    if motion.is_uniform and not is_flat:
        size = share * motion.stretch.diagonal().mean()
        axes = multiply_quats(turn, mirrored)
        return torch.cat([moved, log_scales + size, axes, rows[:, APPEARANCE], bands], dim=1)
    stretch = torch.linalg.matrix_exp(share * motion.stretch) @ torch.linalg.matrix_exp(thickness)
    stretched, axes = stretch_axes(log_scales, mirrored, stretch)
    axes = multiply_quats(turn, axes)
    return torch.cat([moved, stretched, axes, rows[:, APPEARANCE], bands], dim=1)


def _turned_change(bands: Tensor, turn: Tensor) -> Tensor:
    """Return the change of packed higher bands by one rotation. [M,3K], [1,4] -> [M,3K]"""
    count = bands.shape[1] // 3
    if not count:
        return torch.zeros_like(bands)
    matrix = rotation_change(torch.eye(count, dtype=bands.dtype)[None], turn)[0]
    by_band = bands.reshape(-1, count, 3).transpose(0, 1).reshape(count, -1)
    return (matrix @ by_band).reshape(count, -1, 3).transpose(0, 1).flatten(1)


def stretch_axes(log_scales: Tensor, quats: Tensor, stretch: Tensor) -> tuple[Tensor, Tensor]:
    """Return log-scales and quaternions of Gaussians whose covariance Σ becomes G Σ Gᵀ.

    Cyclic Jacobi rotations of at most 45° from the given axes keep their order, so that sliders interpolate
    like axes. The quaternions keep their lengths.

    Args:
        log_scales, quats: the Gaussians' shapes. [M,3], [M,4]
        stretch: G. [3,3]
    """
    axes = rotation_matrices(normalize_quats(quats))
    largest = log_scales.amax(dim=1, keepdim=True)
    half = axes.mT @ stretch @ axes * (log_scales - largest).exp()[:, None, :]
    matrix = half @ half.mT
    for _ in range(_JACOBI_SWEEPS):
        for i, j in _PLANES:
            cosine, sine = _jacobi(matrix[:, i, i], matrix[:, j, j], matrix[:, i, j])
            matrix = _turn_columns(matrix, cosine, sine, i, j)
            matrix = _turn_columns(matrix.mT, cosine, sine, i, j).mT
            axes = _turn_columns(axes, cosine, sine, i, j)
    values = matrix.diagonal(dim1=1, dim2=2).clamp_min(1e-300)
    turned = matrix_quats(axes)
    sign = torch.where((turned * quats).sum(dim=1, keepdim=True) < 0.0, -1.0, 1.0)
    length = quats.norm(dim=1, keepdim=True)
    length = torch.where(length > 0.0, length, torch.ones_like(length))
    return largest + 0.5 * values.log(), turned * sign * length


def continue_axes(rows: Tensor) -> Tensor:
    """Return packed rows whose principal axes are those nearest to the axes in the row before, in order.

    The Gaussians stay the same. Sliders interpolate between such rows as the axes turn and stretch.

    Args:
        rows: geometry at S strengths. [S,M,10]
    """
    orders = torch.tensor(list(permutations(range(3))))
    continued = rows.clone()
    _, _, quats = split_geometry(continued[0])
    last = rotation_matrices(normalize_quats(quats))
    for row in continued[1:]:
        _, log_scales, now = split_geometry(row)
        axes = rotation_matrices(normalize_quats(now))
        likeness = last.mT @ axes
        scores = likeness.abs()[:, torch.arange(3), orders].sum(dim=2)
        order = orders[scores.argmax(dim=1)]
        at = order[:, None, :].expand(-1, 3, -1)
        chosen = likeness.gather(2, at).diagonal(dim1=1, dim2=2)
        signs = torch.where(chosen < 0.0, -1.0, 1.0).to(axes)
        axes = axes.gather(2, at) * signs[:, None, :]
        flipped = torch.where(torch.linalg.det(axes) < 0.0, -1.0, 1.0).to(axes)
        weakest = chosen.abs().argmin(dim=1)
        axes[torch.arange(len(axes)), :, weakest] *= flipped[:, None]
        turned = matrix_quats(axes)
        turned = torch.where((turned * quats).sum(dim=1, keepdim=True) < 0.0, -turned, turned)
        is_new = (order != torch.arange(3)).any(dim=1, keepdim=True)
        kept = torch.where((now * quats).sum(dim=1, keepdim=True) < 0.0, -now, now)
        # other signs of the axes are a half turn, which a quaternion of the same axes would make
        is_new = is_new | (signs < 0.0).any(dim=1, keepdim=True)
        quats = torch.where(is_new, turned * now.norm(dim=1, keepdim=True), kept)
        row[:, _COLUMNS["log_scales"]] = log_scales.gather(1, order)
        row[:, _COLUMNS["quats"]] = quats
        last = axes
    return continued


def _jacobi(first: Tensor, second: Tensor, mixed: Tensor) -> tuple[Tensor, Tensor]:
    """Return cosine and sine of the smaller rotation that removes the mixed entry. [M] each"""
    is_done = mixed.abs() <= 1e-16 * (first + second)
    ratio = (second - first) / (2.0 * torch.where(is_done, torch.ones_like(mixed), mixed))
    tangent = torch.where(ratio < 0.0, -1.0, 1.0) / (ratio.abs() + (1.0 + ratio.square()).sqrt())
    tangent = torch.where(is_done, torch.zeros_like(tangent), tangent)
    cosine = 1.0 / (1.0 + tangent.square()).sqrt()
    return cosine, tangent * cosine


def _turn_columns(matrices: Tensor, cosine: Tensor, sine: Tensor, i: int, j: int) -> Tensor:
    turned = matrices.clone()
    turned[:, :, i] = cosine[:, None] * matrices[:, :, i] - sine[:, None] * matrices[:, :, j]
    turned[:, :, j] = sine[:, None] * matrices[:, :, i] + cosine[:, None] * matrices[:, :, j]
    return turned
