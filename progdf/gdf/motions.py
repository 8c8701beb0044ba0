"""Motions of an edit that moves its members as parts: the linear maps by which it carries other layers.

A field holds the offsets of the members alone. Other layers change these members or add rows on them, so they
need the map itself: x' = a' + L (x − a), where a and a' are a member's center before and after the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import torch
from torch import Tensor

from progdf.quaternions import multiply_quats, turn_quats
from progdf.sh import half_turn, rotation_change
from progdf.similarity import MIN_FLATNESS, AffineMotion
from progdf.system.equality import equal_fields

_SIMILAR_TOLERANCE = 1e-9  # largest relative difference of Lᵀ L from a multiple of the identity


@dataclass(frozen=True)
class PartMotions:
    """Motions of an edit's M members.

    Raises:
        ValueError: a member has no part.
    """

    __eq__ = equal_fields

    parts: Tensor  # index of each member's part. [M] int64
    motions: tuple[tuple[AffineMotion, ...], ...]  # motions of each part, the first one acts first

    def __post_init__(self) -> None:
        if len(self.parts) and not 0 <= int(self.parts.min()) <= int(self.parts.max()) < len(self.motions):
            raise ValueError(f"parts has an index outside 0 to {len(self.motions) - 1}")


@dataclass(frozen=True)
class LinearMap:
    """Linear map of a motion at one strength."""

    __eq__ = equal_fields

    matrix: Tensor  # L, for differences of positions. [3,3] float64
    shape: Tensor  # G, for covariances: L with a mirror at least as thick as its flattest Gaussian. [3,3]
    turn: Tensor  # unit quaternion of its rotation; a mirror counts as a half turn about its axis. [4]
    log_scale: float  # logarithm of the factor of G, if it is a similarity
    is_similar: bool  # True if G keeps proportions
    bands: Tensor  # matrix for the higher SH bands. [K,K] float64

    @property
    def is_identity(self) -> bool:
        """True for translations."""
        still = torch.eye(3, dtype=torch.float64)
        return torch.equal(self.matrix, still) and torch.equal(self.shape, still)


class MotionRecord(msgspec.Struct, frozen=True):
    """Motion in the header of a file. Pivot and translation are part of the field."""

    turn: tuple[float, float, float]
    stretch: tuple[
        tuple[float, float, float],
        tuple[float, float, float],
        tuple[float, float, float],
    ]
    mirror: int | None = None


def linear_map(motions: Sequence[AffineMotion], strength: float, bands: int) -> LinearMap:
    """Return the linear map of motions in a row.

    Args:
        motions: the first one acts first
        strength: slider value of the edit
        bands: number K of SH coefficients above the first
    """
    matrix = torch.eye(3, dtype=torch.float64)
    shape = matrix
    turn = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    by_band = torch.eye(bands, dtype=torch.float64)
    for motion in motions:
        linear = motion.linear(strength)
        matrix = linear @ matrix
        shape = _thick(motion, linear, strength) @ shape
        if motion.mirror is not None and strength > 0.5:
            half = torch.zeros(1, 4, dtype=torch.float64)
            half[0, 1 + motion.mirror] = 1.0
            turn = multiply_quats(half, turn)
        turn = multiply_quats(turn_quats(strength * motion.turn[None]), turn)
        by_band = _bands_after(motion, strength, by_band)
    squares = shape.T @ shape
    square = float(squares.diagonal().mean())
    still = torch.eye(3, dtype=torch.float64)
    is_similar = float((squares / square - still).abs().max()) <= _SIMILAR_TOLERANCE
    log_scale = 0.5 * float(torch.tensor(square, dtype=torch.float64).log())
    return LinearMap(matrix, shape, turn[0], log_scale, is_similar, by_band)


def _thick(motion: AffineMotion, linear: Tensor, strength: float) -> Tensor:
    """Return the matrix of a motion with a mirrored axis that never is flatter than `MIN_FLATNESS`. [3,3]"""
    if motion.mirror is None:
        return linear
    factor = 1.0 - 2.0 * strength
    if abs(factor) >= MIN_FLATNESS:
        return linear
    shift = (MIN_FLATNESS if factor >= 0.0 else -MIN_FLATNESS) - factor
    column = torch.zeros(3, 3, dtype=torch.float64)
    column[motion.mirror, motion.mirror] = shift
    unmirrored = AffineMotion(motion.shift, motion.turn, motion.stretch)
    return linear + unmirrored.linear(strength) @ column


def _bands_after(motion: AffineMotion, strength: float, by_band: Tensor) -> Tensor:
    """Return a matrix of higher SH bands followed by a motion. [K,K]"""
    count = len(by_band)
    if not count or not motion.turns_colors:
        return by_band
    columns = by_band.T[:, :, None].expand(-1, -1, 3)
    if motion.mirror is not None:
        parity = [1.0, 1.0, 1.0]
        parity[motion.mirror] = -1.0
        columns = torch.lerp(columns, half_turn(columns, (parity[0], parity[1], parity[2])), strength)
    turn = strength * motion.turn[None]
    turned = columns + rotation_change(columns.contiguous(), turn_quats(turn).expand(count, 4))
    return turned[:, :, 0].T


def motion_records(motions: PartMotions) -> list[list[MotionRecord]]:
    """Return the records of the motions of each part."""
    return [[_record(motion) for motion in part] for part in motions.motions]


def _record(motion: AffineMotion) -> MotionRecord:
    return msgspec.convert(
        {"turn": motion.turn.tolist(), "stretch": motion.stretch.tolist(), "mirror": motion.mirror},
        MotionRecord,
    )


def part_motions(records: Sequence[Sequence[MotionRecord]], parts: Tensor) -> PartMotions:
    """Return the motions of records; the inverse of `motion_records`.

    Args:
        records: the motions of each part
        parts: index of each member's part. [M] int64

    Raises:
        ValueError: an axis, or the index of a part, does not exist.
    """
    motions = []
    for part in records:
        for record in part:
            if record.mirror not in (None, 0, 1, 2):
                raise ValueError(f"axis {record.mirror} is mirrored, expected 0 to 2")
        motions.append(
            tuple(
                AffineMotion(
                    torch.zeros(3, dtype=torch.float64),
                    torch.tensor(record.turn, dtype=torch.float64),
                    torch.tensor(record.stretch, dtype=torch.float64),
                    record.mirror,
                )
                for record in part
            )
        )
    return PartMotions(parts, tuple(motions))
