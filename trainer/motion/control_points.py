"""Control points: few places of a region whose motions its members follow."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

_NEAREST = 4  # control points that a member follows
_LINKS = 6  # neighbors that a control point is held to


@dataclass(frozen=True)
class ControlPoints:
    """Where a region is held, and who follows whom.

    Args:
        rows: the members that lie there. [P] int64
        points: their places. [P,3]
        part: connected part each lies in. [P] int64
        nearest: those that each member follows, of its own part. [M,K] int64
        weights: how much, adding up to 1. [M,K]
        links: pairs of neighbors, which are to move alike. [L,2] int64
        spacing: median distance of neighbors, world units, > 0
    """

    rows: Tensor
    points: Tensor
    part: Tensor
    nearest: Tensor
    weights: Tensor
    links: Tensor
    spacing: float

    def __len__(self) -> int:
        return len(self.points)


def make_control_points(means: Tensor, part: Tensor, count: int) -> ControlPoints:
    """Spread control points over a region, farthest first; the same for the same means.

    Args:
        means: centers of the members. [M,3]
        part: connected part of each, see `connected_parts`. [M] int64
        count: control points in all, at most one a member; parts share them by size, at least one each
    """
    rows, part_of, links, begun = [], [], [], 0
    nearest = torch.zeros(len(means), _NEAREST, dtype=torch.int64)
    weights = torch.zeros(len(means), _NEAREST)
    for index, size in enumerate(torch.bincount(part).tolist()):
        mine = (part == index).nonzero()[:, 0]
        wanted = min(size, max(1, round(count * size / len(means))))
        chosen = mine[farthest_points(means[mine], wanted)]
        near = min(_NEAREST, wanted)
        distances = torch.cdist(means[mine], means[chosen])
        found = distances.topk(min(near + 1, wanted), dim=1, largest=False)
        # down to zero at the next farther one, so that nothing jumps where one takes the place of another
        reach = 1.01 * found.values[:, -1:].clamp_min(1e-9)
        share = (1 - found.values[:, :near] / reach).clamp_min(1e-6).square()
        nearest[mine, :near] = begun + found.indices[:, :near]
        weights[mine, :near] = share / share.sum(dim=1, keepdim=True)
        around = min(_LINKS, wanted - 1)
        own = torch.cdist(means[chosen], means[chosen])
        others = own.topk(around + 1, dim=1, largest=False).indices[:, 1:]
        ones = torch.arange(wanted)[:, None].expand_as(others)
        links.append(begun + torch.stack([ones, others], dim=2).reshape(-1, 2))
        rows.append(chosen)
        part_of.append(torch.full((wanted,), index))
        begun += wanted
    at, pairs = torch.cat(rows), torch.cat(links)
    apart = (means[at[pairs[:, 0]]] - means[at[pairs[:, 1]]]).norm(dim=1)
    alone = (means - means.mean(dim=0)).norm(dim=1)
    spacing = float((apart if len(apart) else alone).median())
    return ControlPoints(at, means[at], torch.cat(part_of), nearest, weights, pairs, max(spacing, 1e-9))


def farthest_points(means: Tensor, count: int) -> Tensor:
    """Rows that lie far from each other: first the one farthest from the middle. [M,3] -> [count] int64"""
    distance = (means - means.mean(dim=0)).square().sum(dim=1)
    chosen = [int(distance.argmax())]
    distance = (means - means[chosen[0]]).square().sum(dim=1)
    for _ in range(count - 1):
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (means - means[chosen[-1]]).square().sum(dim=1))
    return torch.tensor(chosen)
