"""The keyframe field: K snapshots, linear between them: what anyone would do first, and must be beaten."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from progdf.field.baked import AttributeBases, BakedField
from progdf.field.separable import check_trajectory, moving_attributes, stored_bases


def fit_keyframes(
    strengths: Tensor,
    offsets: Tensor,
    count: int,
    recorded: Sequence[float] | None = None,
    rest_type: torch.dtype = torch.float32,
) -> BakedField:
    """Keep `count` snapshots at even strengths, that is at even visible change once a trajectory is re-timed.

    Args:
        strengths: of the snapshots, ascending from 0 to 1. [T]
        offsets: raw offsets of the members; the first row is 0, the last the recorded end. [T,M,C] float32
        count: snapshots kept, both ends among them, ≥ 2; as many as there are or more keeps all
        recorded: strengths for the slider's ticks; `strengths` when None
        rest_type: float32 keeps the snapshots exactly; int8 keeps what each differs from s times the end

    Returns:
        A field with the kept snapshots as nodes; attributes that never move are absent.

    Raises:
        ValueError: no trajectory, or fewer than 2 snapshots asked for.
    """
    check_trajectory(strengths, offsets)
    if count < 2:
        raise ValueError(f"{count} keyframes, expected at least 2")
    kept = even_snapshots(strengths, count)
    nodes = strengths[kept].float()
    inner = offsets[kept[1:-1]]
    attributes = {}
    for name, columns in moving_attributes(offsets).items():
        full = offsets[-1, :, columns].contiguous()
        table = torch.zeros(len(nodes), len(nodes) - 1)
        table[1:-1, 1:] = torch.eye(len(nodes) - 2)
        table[-1, 0] = 1.0
        exact = inner[:, :, columns]
        if rest_type == torch.float32:
            attributes[name] = AttributeBases(
                full, exact.clone(), torch.ones(len(inner), full.shape[1]), table
            )
            continue
        table[1:-1, 0] = nodes[1:-1]
        rest, step = stored_bases(exact - nodes[1:-1, None, None] * full, rest_type)
        attributes[name] = AttributeBases(full, rest, step, table)
    ticks = strengths.tolist() if recorded is None else recorded
    return BakedField("keyframes", nodes, attributes, offsets.shape[2], tuple(ticks))


def even_snapshots(strengths: Tensor, count: int) -> Tensor:
    """Indices of the `count` snapshots nearest to even strengths, ascending, ends included. [K] int64"""
    wanted = torch.linspace(0, 1, count, dtype=strengths.dtype)
    kept: Tensor = torch.unique((strengths[:, None] - wanted).abs().argmin(dim=0))
    return kept
