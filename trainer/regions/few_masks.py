"""What a handful of rough masks leaves wrong in a region, and puts right: strays, loose pieces, holes.

Many masks outvote each other's mistakes. With a few, what stands behind the region and is seen past its
border by one view alone would be taken whole: a tree behind a bear.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.scene.neighbors import join_pairs, nearest_rows
from progdf.terminal import format_count

FEW = 8
"""Masks up to which a region is cleaned; exact ones from 12 views would lose a thin scarf's edge to it."""

_LINKS = 8
_REACH = 2.5
_WIDE = 2.0
"""A member is linked to those of its 8 nearest that are nearer than 2.5 times what is usual for the eighth,
or whose 2 σ touch its own: flat surfaces are of few, large Gaussians."""

_PIECE = 0.1
"""Of the largest connected surface: smaller ones are strays."""

_AROUND = 12
_FILLED = 0.75
_ROUNDS = 3
"""A hole is what has three quarters members among its 12 nearest, in up to three rounds."""


def drop_strays(
    scene: Gaussians,
    member: Tensor,
    views: Tensor,
    views_inside: Tensor,
    say: Callable[[str], None] | None = None,
) -> Tensor:
    """The members that two masks hold where two views see them, in large connected surfaces.

    Args:
        scene: N Gaussians
        member: by their score alone. [N] bool
        views: how many views with a mask show each. [N]
        views_inside: in how many of these it lies inside the mask. [N]
        say: hears in a line each what was taken away

    Returns:
        [N] bool
    """
    twice = member & ((views < 2) | (views_inside >= 2))
    _report(
        say,
        int(member.sum()) - int(twice.sum()),
        "inside one mask only, where two views see it, left to what surrounds them",
    )
    if not bool(twice.any()):
        return twice
    rows = twice.nonzero()[:, 0]
    piece = connected_pieces(scene[rows])
    sizes = np.bincount(piece)
    # what two masks hold counts, not what one view alone shows: a tree may be larger than the bear
    sure = np.bincount(piece, weights=(views_inside[rows] >= 2).double().numpy())
    weight = sure if sure.any() else sizes
    large = torch.from_numpy((weight >= _PIECE * weight.max())[piece])
    result = torch.zeros_like(member)
    result[rows[large]] = True
    dropped = int((~large).sum())
    pieces = int((weight >= _PIECE * weight.max()).sum())
    _report(say, dropped, f"apart from the {format_count(pieces, 'largest connected surface')}, left out")
    return result


def find_holes(
    scene: Gaussians, member: Tensor, views_outside: Tensor, say: Callable[[str], None] | None = None
) -> Tensor:
    """The Gaussians to add, as members surround them and no two views see them outside the masks.

    Args:
        scene: N Gaussians
        member: the region so far. [N] bool
        views_outside: how many views show each outside their mask. [N]
        say: hears how many they are

    Returns:
        Sorted rows. [H] int64
    """
    if not bool(member.any()):
        return torch.zeros(0, dtype=torch.int64)
    means = scene.means
    inner = means[member]
    low = inner.amin(dim=0)
    high = inner.amax(dim=0)
    inside = ((means >= low) & (means <= high)).all(dim=1)
    rows = (inside & ~member & (views_outside < 2)).nonzero()[:, 0]
    if not len(rows):
        return rows
    near, _ = nearest_rows(means, rows, _AROUND)
    filled = member.clone()
    for _ in range(_ROUNDS):
        filled[rows[filled[near].double().mean(dim=1) >= _FILLED]] = True
    holes = (filled & ~member).nonzero()[:, 0]
    _report(say, len(holes), "in holes of it, added")
    return holes


def connected_pieces(gaussians: Gaussians) -> np.ndarray:
    """Which connected piece each of P Gaussians belongs to. [P] int"""
    count = len(gaussians)
    if count < 2:
        return np.zeros(count, np.int64)
    near, apart = nearest_rows(gaussians.means, torch.arange(count), _LINKS)
    width = gaussians.scales.median(dim=1).values
    linked = apart <= _REACH * max(float(np.median(apart[:, -1])), 1e-12)
    linked |= apart <= _WIDE * (width[:, None] + width[near])
    first = torch.arange(count)[:, None].expand_as(near)[linked]
    second = near[linked]
    return join_pairs(first.numpy(), second.numpy(), count)


def _report(say: Callable[[str], None] | None, count: int, what: str) -> None:
    if say is not None and count:
        say(f"the masks: {format_count(count)} {what}")
