"""Fields of edits whose whole course is known: they are written down, not trained."""

from __future__ import annotations

import torch
from torch import Tensor

from .baked import AttributeBases, BakedField
from .separable import (
    check_trajectory,
    decode_bases,
    fit_amplitude,
    moving_attributes,
    principal_modes,
    quantize_bases,
    store_attribute,
)

_TOLERANCE = 0.003  # root mean square that factoring may cost, as a share of the course's own
_MOST_RANK = 8
_OPACITY_KNOTS = (0.0, 0.002, 0.005, 0.01, 0.02, 0.04, 0.07, 0.11, 0.17, 0.25, 0.35)
"""Where a logit bends most when an opacity rises from nothing; mirrored for one that falls to it."""


def course_field(knots: Tensor, offsets: Tensor, kind: str = "separable") -> BakedField:
    """The field of a course: at its last knot exactly what int16 makes of the end.

    Args:
        knots: strengths, ascending from 0 to 1. [S]
        offsets: packed, 0 at the first knot. [S,M,C]
        kind: see `BakedField`

    Raises:
        ValueError: no course.
    """
    check_trajectory(knots, offsets)
    attributes = {}
    for name, columns in moving_attributes(offsets).items():
        course = offsets[:, :, columns].clone()
        stored = quantize_bases(course[-1:], torch.int16)
        course[-1] = decode_bases(*stored)[0]
        attributes[name] = fit_course(course, stored)
    return BakedField(kind, knots.float(), attributes, offsets.shape[2], ())


def fit_course(offsets: Tensor, stored: tuple[Tensor, Tensor] | None = None) -> AttributeBases:
    """The fewest bases by which an attribute's course is met to a three-hundredth. [S,M,c]

    `stored`: what its last row was decoded from, see `quantize_bases`.
    """
    fitted = fit_amplitude(offsets, torch.ones_like(offsets[0]), stored)
    allowed = _TOLERANCE**2 * float(fitted.offsets.double().square().sum())
    power = torch.linalg.eigvalsh(fitted.gram).flip(0).clamp(min=0)
    remaining = float(power.sum()) - power.cumsum(0)
    needed = 0 if float(power.sum()) <= allowed else 1 + int((remaining > allowed).sum())
    return store_attribute(fitted, principal_modes(fitted.gram)[:, : min(needed, _MOST_RANK)])


def opacity_course(start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """Logits of opacities that go linearly from one to another.

    Args:
        start, end: logits at strengths 0 and 1. [M]

    Returns:
        Knots [S] and the offset of each logit from `start` at them [S,M], exact at both ends
    """
    rise = torch.tensor(_OPACITY_KNOTS, dtype=torch.float64)
    knots = torch.cat([rise, torch.tensor([0.5], dtype=torch.float64), 1.0 - rise.flip(0)])
    opacity = torch.lerp(start.double().sigmoid(), end.double().sigmoid(), knots[:, None])
    offsets = (opacity.logit() - start.double()).float()
    offsets[0], offsets[-1] = 0.0, end.float() - start.float()
    return knots.float(), offsets
