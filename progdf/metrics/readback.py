"""Differences between a scene that was written and the scene that a reader gets from the file.

The position of every Gaussian is compared with the rounding of the format. A larger difference is an error.
Scales, opacities, colors, SH and rotations may leave the range of a format. Those that differ visibly are
counted and named.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.sh import C0
from progdf.terminal import format_count

SCALE_TOLERANCE = 0.05  # log-scale: 5 %; .spz has steps of 1/16, so it is off by 1/32 at most
OPACITY_TOLERANCE = 0.01
COLOR_TOLERANCE = 0.02  # 0 to 1
SH_TOLERANCE = 0.1  # coefficient of a band above 0; .spz has steps of 1/8
ANGLE_TOLERANCE_DEG = 3.0

FLOAT_ROUNDING = 2.0**-22
"""Share of a coordinate that float32 may round off on the way into a file and back."""


@dataclass(frozen=True)
class ReadBack:
    """Written scene as a reader gets it, and its differences."""

    scene: Gaussians  # rows in the order of the file
    position_error: float  # largest difference of a coordinate, world units
    notes: tuple[str, ...]  # a phrase for each attribute that some Gaussians lost


def check_finite(path: object, scene: Gaussians) -> None:
    """Refuse to write a scene with a number that no format stores.

    Raises:
        ProgdfError: a NaN or an infinity, with its row.
    """
    if not len(scene):
        raise ProgdfError(f"{path} was not written: the scene has no Gaussians; a file needs at least one")
    for name in ATTRIBUTES:
        values = getattr(scene, name)
        finite = values.isfinite().reshape(len(scene), -1).all(dim=1)
        if not bool(finite.all()):
            row = int((~finite).nonzero()[0])
            raise ProgdfError(
                f"{path} was not written: {name} of Gaussian {row} holds NaN or infinity; "
                "repair the scene first"
            )


def compare(path: object, written: Gaussians, read: Gaussians, position_bounds: Tensor) -> ReadBack:
    """Return the differences between a scene and its copy from a file.

    Args:
        path: the file, for the error
        written: N Gaussians, in the order of the file
        read: the scene that was read from the file
        position_bounds: largest allowed difference of each coordinate, world units. [N,3]

    Raises:
        ProgdfError: the number of Gaussians differs, or a position differs by more than its bound.
    """
    if len(read) != len(written):
        raise ProgdfError(
            f"{path} was not written: only {len(read)} of {format_count(len(written))} can be read back; "
            "write a .ply"
        )
    before = written.world_means
    after = read.world_means
    errors = (after - before).abs()
    _check_positions(path, before, after, errors - position_bounds)
    return ReadBack(read, float(errors.max()), _attribute_notes(written, read))


def _check_positions(path: object, before: Tensor, after: Tensor, excess: Tensor) -> None:
    """Raise ProgdfError for the coordinate that exceeds its bound by most, if any. [N,3] each"""
    wrong = ~(excess <= 0)  # NaN is wrong too
    if not bool(wrong.any()):
        return
    at = int(excess.nan_to_num(torch.inf).argmax())
    row, axis = divmod(at, 3)
    count = int(wrong.any(dim=1).sum())
    raise ProgdfError(
        f"{path} was not written: {'xyz'[axis]} of Gaussian {row} is "
        f"{float(before[row, axis]):.7g} and comes back as {float(after[row, axis]):.7g}, "
        f"{format_count(count)} in all; write a .ply, or a scene nearer to 0"
    )


def _attribute_notes(written: Gaussians, read: Gaussians) -> tuple[str, ...]:
    """Return a phrase for each attribute that differs visibly, with the number of Gaussians."""
    columns = {
        "scale": (written.log_scales, read.log_scales, SCALE_TOLERANCE),
        "opacity": (written.opacities[:, None], read.opacities[:, None], OPACITY_TOLERANCE),
        "color": (written.sh0 * C0, read.sh0 * C0, COLOR_TOLERANCE),
    }
    if written.shN.shape == read.shN.shape and written.shN.shape[1]:
        columns["SH"] = (written.shN.flatten(1), read.shN.flatten(1), SH_TOLERANCE)
    notes = []
    for name, (before, after, tolerance) in columns.items():
        largest = (after - before).abs().amax(dim=1)
        count = int((largest > tolerance).sum())
        if not count:
            continue
        worst = float(largest.max())
        size = f"a factor of {torch.tensor(worst).exp():.3g}" if name == "scale" else f"{worst:.2g}"
        notes.append(f"{name} of {format_count(count)} off by up to {size}")
    if written.shN.shape[1] > read.shN.shape[1]:
        notes.append(f"SH of degree {written.sh_degree} cut to degree {read.sh_degree}")
    rotation_note = _rotation_note(written, read)
    if rotation_note:
        notes.append(rotation_note)
    return tuple(notes)


def _rotation_note(written: Gaussians, read: Gaussians) -> str:
    """Return a phrase for rotations that differ visibly, or an empty text."""
    cosines = (written.unit_quats * read.unit_quats).sum(dim=1).abs().clamp(max=1.0)
    angles = (2.0 * cosines.acos()).rad2deg()
    count = int((angles > ANGLE_TOLERANCE_DEG).sum())
    return f"rotation of {format_count(count)} off by up to {float(angles.max()):.2g}°" if count else ""
