"""One SVD for all that moves, as a baseline: every attribute has the same bases in time and the same rank."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from progdf.field.baked import AttributeBases, BakedField
from progdf.field.separable import (
    channel_weights,
    check_trajectory,
    fit_amplitude,
    moving_attributes,
    principal_modes,
    quantize_bases,
)


def fit_joint(
    strengths: Tensor,
    offsets: Tensor,
    rank: int,
    weights: Tensor | None = None,
    recorded: Sequence[float] | None = None,
) -> BakedField:
    """The truncated SVD of all numbers at once, each attribute in units of what its end leaves unexplained.

    Args:
        strengths: of the snapshots, ascending from 0 to 1. [T]
        offsets: raw offsets of the members; the first row is 0, the last the recorded end. [T,M,C] float32
        rank: bases beside the full offset, the same for all attributes, ≥ 0; stored as int8
        weights: how much an error shows: visibility [M] or sensitivity [M,C]; None is evenly
        recorded: strengths for the slider's ticks; `strengths` when None

    Returns:
        A field with the snapshots as nodes, whose attributes share the coefficients of bases 1..R; attributes
        that never move are absent.

    Raises:
        ValueError: no trajectory, a negative rank, or weights that do not fit.
    """
    check_trajectory(strengths, offsets)
    if rank < 0:
        raise ValueError(f"rank is {rank}, expected 0 or more")
    spread = channel_weights(weights, offsets.shape[1], offsets.shape[2])
    courses = {
        name: fit_amplitude(offsets[:, :, columns], spread[:, columns])
        for name, columns in moving_attributes(offsets).items()
    }
    gram = torch.zeros(len(strengths), len(strengths), dtype=torch.float64)
    for course in courses.values():
        power = float(course.gram.diagonal().sum())
        gram += course.gram / power if power > 0 else 0.0
    mix, table = (part[:, :rank] for part in principal_modes(gram))
    attributes = {}
    for name, course in courses.items():
        exact = (mix.T.float() @ course.residual.flatten(1)).reshape(-1, *course.offsets.shape[1:])
        rest, step = quantize_bases(exact, torch.int8)
        coefficients = torch.cat([course.amplitude[:, None], table.float()], dim=1)
        coefficients[[0, -1]] = 0.0
        coefficients[-1, 0] = 1.0
        attributes[name] = AttributeBases(course.offsets[-1].contiguous(), rest, step, coefficients)
    ticks = strengths.tolist() if recorded is None else recorded
    return BakedField("separable", strengths.float(), attributes, offsets.shape[2], tuple(ticks))
