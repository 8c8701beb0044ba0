"""Cleanup of a region from a small number of rough masks: strays are removed and holes are filled.

Many masks outvote each other's mistakes. With a small number, background that a single view shows inside its
mask would be selected, such as a tree behind a bear.
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
"""Maximum number of masks with cleanup. With exact masks of 12 views it would remove a thin scarf's edge."""

_LINK_NEIGHBORS = 8
"""Number of nearest neighbors that a member may be linked to."""
_LINK_REACH = 2.5
"""Maximum distance of linked members, in median distances to the eighth neighbor."""
_LINK_SIGMAS = 2.0
"""Members are also linked if their ellipsoids of this many σ touch, as flat surfaces have large Gaussians."""

_MIN_PIECE = 0.1
"""Minimum size of a connected surface, as a share of the largest; smaller ones are strays."""

_HOLE_NEIGHBORS = 12
"""Number of nearest neighbors that decide on a hole."""
_HOLE_SHARE = 0.75
"""Minimum share of members among the neighbors of a hole."""
_HOLE_ROUNDS = 3
"""Maximum number of rounds that fill holes."""


def drop_strays(
    scene: Gaussians,
    member: Tensor,
    views: Tensor,
    views_inside: Tensor,
    say: Callable[[str], None] | None = None,
) -> Tensor:
    """Return the members on large connected surfaces. If two views see a member, two masks must contain it.

    Args:
        scene: N Gaussians
        member: members by score alone. [N] bool
        views: number of views with a mask that show each Gaussian. [N]
        views_inside: number of views that show it inside the mask. [N]
        say: receives a log line per kind of removed Gaussian

    Returns:
        [N] bool
    """
    confirmed = member & ((views < 2) | (views_inside >= 2))
    _report(
        say,
        int(member.sum()) - int(confirmed.sum()),
        "inside only one mask although two views see them: their surroundings decide",
    )
    if not bool(confirmed.any()):
        return confirmed
    rows = confirmed.nonzero()[:, 0]
    piece = connected_pieces(scene[rows])
    sizes = np.bincount(piece)
    # size counts members inside two masks, as a tree seen by one view may be larger than the bear
    confirmed_sizes = np.bincount(piece, weights=(views_inside[rows] >= 2).double().numpy())
    weight = confirmed_sizes if confirmed_sizes.any() else sizes
    large = torch.from_numpy((weight >= _MIN_PIECE * weight.max())[piece])
    result = torch.zeros_like(member)
    result[rows[large]] = True
    dropped = int((~large).sum())
    pieces = int((weight >= _MIN_PIECE * weight.max()).sum())
    _report(say, dropped, f"not on the {format_count(pieces, 'largest connected surface')}: removed")
    return result


def find_holes(
    scene: Gaussians, member: Tensor, views_outside: Tensor, say: Callable[[str], None] | None = None
) -> Tensor:
    """Return the Gaussians to add: surrounded by members, and outside the mask in at most one view.

    Args:
        scene: N Gaussians
        member: the region so far. [N] bool
        views_outside: number of views that show each Gaussian outside their mask. [N]
        say: receives a log line with their number

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
    near, _ = nearest_rows(means, rows, _HOLE_NEIGHBORS)
    filled = member.clone()
    for _ in range(_HOLE_ROUNDS):
        filled[rows[filled[near].double().mean(dim=1) >= _HOLE_SHARE]] = True
    holes = (filled & ~member).nonzero()[:, 0]
    _report(say, len(holes), "in holes of the region: added")
    return holes


def connected_pieces(gaussians: Gaussians) -> np.ndarray:
    """Return the index of the connected piece that each of P Gaussians belongs to. [P] int"""
    count = len(gaussians)
    if count < 2:
        return np.zeros(count, np.int64)
    near, distances = nearest_rows(gaussians.means, torch.arange(count), _LINK_NEIGHBORS)
    width = gaussians.scales.median(dim=1).values
    linked = distances <= _LINK_REACH * max(float(np.median(distances[:, -1])), 1e-12)
    linked |= distances <= _LINK_SIGMAS * (width[:, None] + width[near])
    first = torch.arange(count)[:, None].expand_as(near)[linked]
    second = near[linked]
    return join_pairs(first.numpy(), second.numpy(), count)


def _report(say: Callable[[str], None] | None, count: int, what: str) -> None:
    if say is not None and count:
        say(f"the masks: {format_count(count)} {what}")
