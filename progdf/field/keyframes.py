"""Keyframe fields: K snapshots and lines between them, the baseline; all of them, bit for bit."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .baked import AttributeBases, BakedField
from .separable import check_trajectory, moving_attributes


def keyframe_rows(strengths: Tensor, count: int) -> list[int]:
    """The snapshots that `fit_keyframes` keeps, ascending. [T]"""
    even = torch.linspace(0, 1, count, dtype=strengths.dtype)
    nearest = (strengths[:, None] - even).abs().argmin(dim=0)
    return sorted({*(nearest if count < len(strengths) else torch.arange(len(strengths))).tolist()})


def fit_keyframes(
    strengths: Tensor,
    offsets: Tensor,
    count: int,
    recorded: Sequence[float] | None = None,
    basis_type: torch.dtype = torch.float32,
) -> BakedField:
    """Keep the `count` snapshots nearest to even strengths (even visible change in a re-timed trajectory).

    Args:
        strengths: of the snapshots, ascending from 0 to 1. [T]
        offsets: raw offsets of the members; the first row is 0, the last the recorded end. [T,M,C] float32
        count: snapshots kept, both ends among them, ≥ 2; as many as there are or more keeps all
        recorded: strengths for the slider's ticks; `strengths` when None
        basis_type: float32, or float16 for snapshots of such numbers

    Returns:
        A field with those snapshots as knots; attributes that never move are absent.

    Raises:
        ValueError: no trajectory, or fewer than 2 snapshots asked for.
    """
    check_trajectory(strengths, offsets)
    if count < 2:
        raise ValueError(f"{count} keyframes, expected at least 2")
    rows = keyframe_rows(strengths, count)
    table = torch.zeros(len(rows), len(rows) - 1)
    table[-1, 0] = 1.0
    table[1:-1, 1:] = torch.eye(len(rows) - 2)
    attributes = {}
    for name, columns in moving_attributes(offsets).items():
        full = offsets[-1, :, columns].contiguous()
        basis = offsets[rows[1:-1]][:, :, columns].to(basis_type)
        units = torch.ones(1 + len(basis), full.shape[1])  # of another size they would round it
        attributes[name] = AttributeBases(full, basis, units, table.clone())
    ticks = strengths.tolist() if recorded is None else recorded
    return BakedField("keyframes", strengths[rows].float(), attributes, offsets.shape[2], tuple(ticks))


def fit_lossless(strengths: Tensor, offsets: Tensor, recorded: Sequence[float] | None = None) -> BakedField:
    """Every snapshot, bit for bit; in half precision where nothing is lost by it, as recordings are.

    Arguments and errors as for `fit_keyframes`.
    """
    check_trajectory(strengths, offsets)
    inner = offsets[1:-1]
    halves = torch.equal(inner.half().float(), inner)
    return fit_keyframes(
        strengths, offsets, len(strengths), recorded, torch.float16 if halves else torch.float32
    )
