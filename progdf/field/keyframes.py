"""The keyframe field: K snapshots, and a line or a curve through them: what anyone would do first, and must
be beaten.

What even, bending and cubic keyframes give is in docs/experiments.md, Keyframes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from .baked import AttributeBases, BakedField
from .separable import check_trajectory, moving_attributes, quantize_bases

Between = Literal["linear", "cubic"]


def fit_keyframes(
    strengths: Tensor,
    offsets: Tensor,
    count: int,
    recorded: Sequence[float] | None = None,
    rest_type: torch.dtype = torch.float32,
    kept: Tensor | None = None,
    between: Between = "linear",
) -> BakedField:
    """Keep `count` snapshots, at even strengths (even visible change in a re-timed trajectory) if None.

    Args:
        strengths: of the snapshots, ascending from 0 to 1. [T]
        offsets: raw offsets of the members; the first row is 0, the last the recorded end. [T,M,C] float32
        count: snapshots kept, both ends among them, ≥ 2; as many as there are or more keeps all
        recorded: strengths for the slider's ticks; `strengths` when None
        rest_type: float32 keeps the snapshots exactly; int8 keeps what each differs from s times the end
        kept: which snapshots, ascending, both ends among them; None is `even_snapshots`. [K] int64
        between: a line from one to the next, or a Catmull-Rom curve through all, as lines between snapshots

    Returns:
        A field with the kept snapshots as nodes, all of them for a curve; attributes that never move are
        absent.

    Raises:
        ValueError: no trajectory, fewer than 2 snapshots asked for, or ends that are not kept.
    """
    check_trajectory(strengths, offsets)
    if count < 2:
        raise ValueError(f"{count} keyframes, expected at least 2")
    kept = even_snapshots(strengths, count) if kept is None else kept
    if kept.ndim != 1 or len(kept) < 2 or int(kept[0]) != 0 or int(kept[-1]) != len(strengths) - 1:
        raise ValueError(f"kept is {kept.tolist()}, expected 0 first and {len(strengths) - 1} last")
    if bool((kept.diff() <= 0).any()):
        raise ValueError(f"kept is {kept.tolist()}, expected it to ascend")
    frames = strengths[kept].double()
    nodes = frames.float() if between == "linear" else strengths.float()
    shares = torch.eye(len(kept), dtype=torch.float64)
    if between == "cubic":
        shares = _cubic_shares(frames, strengths.double())
    straight = frames[1:-1] if rest_type == torch.int8 else torch.zeros(len(kept) - 2, dtype=torch.float64)
    table = torch.cat([(shares[:, -1] + shares[:, 1:-1] @ straight)[:, None], shares[:, 1:-1]], dim=1).float()
    table[[0, -1]] = 0.0
    table[-1, 0] = 1.0
    attributes = {}
    for name, columns in moving_attributes(offsets).items():
        full = offsets[-1, :, columns].contiguous()
        inner = offsets[kept[1:-1]][:, :, columns]
        if rest_type != torch.int8 and torch.equal(inner.to(rest_type).float(), inner):
            # as it is: a unit of another size would round it
            rest, step = inner.to(rest_type), torch.ones(len(inner), full.shape[1])
        else:
            rest, step = quantize_bases(inner - straight.float()[:, None, None] * full, rest_type)
        attributes[name] = AttributeBases(full, rest, step, table.clone())
    ticks = strengths.tolist() if recorded is None else recorded
    return BakedField("keyframes", nodes, attributes, offsets.shape[2], tuple(ticks))


def fit_lossless(strengths: Tensor, offsets: Tensor, recorded: Sequence[float] | None = None) -> BakedField:
    """Every snapshot, bit for bit; in half precision where nothing is lost by it, as recordings are.

    Arguments and errors as for `fit_keyframes`.
    """
    check_trajectory(strengths, offsets)
    inner = offsets[1:-1]
    halves = torch.equal(inner.half().float(), inner)
    rest_type = torch.float16 if halves else torch.float32
    return fit_keyframes(
        strengths, offsets, len(strengths), recorded, rest_type, torch.arange(len(strengths))
    )


def even_snapshots(strengths: Tensor, count: int) -> Tensor:
    """Indices of the `count` snapshots nearest to even strengths, ascending, ends included. [K] int64"""
    wanted = torch.linspace(0, 1, count, dtype=strengths.dtype)
    kept: Tensor = torch.unique((strengths[:, None] - wanted).abs().argmin(dim=0))
    return kept


def bending_snapshots(strengths: Tensor, gram: Tensor, count: int) -> Tensor:
    """The `count` snapshots between which lines miss least: where the way bends, not at even lengths.

    The largest error of any snapshot that is left out is as small as it can be (dynamic programming).

    Args:
        strengths: of the snapshots, ascending. [T]
        gram: inner products of what is seen at the snapshots. [T,T] float64
        count: snapshots kept, both ends among them, ≥ 2

    Returns:
        Ascending indices, ends included; fewer where there are not as many. [K] int64
    """
    total = len(strengths)
    missed = torch.zeros(total, total, dtype=torch.float64)
    s = strengths.double()
    for a in range(total):
        for b in range(a + 2, total):
            inner = torch.arange(a + 1, b)
            share = (s[inner] - s[a]) / (s[b] - s[a])
            weights = torch.zeros(len(inner), total, dtype=torch.float64)
            weights[torch.arange(len(inner)), inner] = 1.0
            weights[:, a], weights[:, b] = share - 1.0, -share
            missed[a, b] = torch.einsum("it,tu,iu->i", weights, gram, weights).max()
    least, came_from = missed[0].clone(), []
    for _ in range(min(count, total) - 2):
        tried = torch.maximum(least[:, None], missed)
        tried.masked_fill_(torch.ones_like(missed, dtype=torch.bool).tril(), torch.inf)
        least, before = tried.min(dim=0)
        came_from.append(before)
    path = [total - 1]
    for before in reversed(came_from):
        path.append(int(before[path[-1]]))
    kept: Tensor = torch.unique(torch.tensor([0, *path]))
    return kept


def _cubic_shares(frames: Tensor, at: Tensor) -> Tensor:
    """How much of each keyframe a Catmull-Rom curve holds at other strengths. [K], [S] -> [S,K] float64"""
    count = len(frames)
    unit = torch.eye(count, dtype=torch.float64)
    gaps = frames.diff()
    slopes = unit.diff(dim=0) / gaps[:, None]
    tangents = torch.zeros_like(unit)
    left, right = gaps[:-1, None], gaps[1:, None]
    tangents[1:-1] = (right * slopes[:-1] + left * slopes[1:]) / (left + right)
    tangents[0], tangents[-1] = slopes[0], slopes[-1]
    if count > 2:  # the ends bend as their neighbors do: a parabola is met
        tangents[0] = 2 * slopes[0] - tangents[1]
        tangents[-1] = 2 * slopes[-1] - tangents[-2]
    i = torch.searchsorted(frames, at).clamp(1, count - 1)
    gap = gaps[i - 1][:, None]
    u = ((at - frames[i - 1]) / gaps[i - 1])[:, None]
    shares: Tensor = (
        (1 + 2 * u) * (1 - u) ** 2 * unit[i - 1]
        + u**2 * (3 - 2 * u) * unit[i]
        + gap * (u * (1 - u) ** 2 * tangents[i - 1] - u**2 * (1 - u) * tangents[i])
    )
    return shares
