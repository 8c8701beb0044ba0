"""A region: which Gaussians an edit may change, and how sure we are of each; set operations, plain shapes.

The language in which a region is written is in `progdf.scene.regions`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from .gaussians import Gaussians


@dataclass(frozen=True)
class Region:
    """A named set of Gaussians with a soft score."""

    name: str  # what the person calls it
    members: Tensor  # sorted, unique row indices into the scene. [M] int64
    # membership of every Gaussian of the scene, 0..1; the viewer moves its threshold. [N] float32
    score: Tensor

    def __post_init__(self) -> None:
        if self.members.dtype != torch.int64 or self.members.ndim != 1:
            raise ValueError(
                f"members is {self.members.dtype} {list(self.members.shape)}, expected int64 [M]"
            )
        if len(self.members) and (
            bool((self.members[1:] <= self.members[:-1]).any())
            or int(self.members[0]) < 0
            or int(self.members[-1]) >= len(self.score)
        ):
            raise ValueError("members must be sorted, unique and smaller than the number of Gaussians")

    def __len__(self) -> int:
        return len(self.members)

    @property
    def mask(self) -> Tensor:
        """Which Gaussians of the scene are members. [N] bool"""
        return torch.zeros_like(self.score, dtype=torch.bool).index_fill(0, self.members, True)


def from_mask(name: str, mask: Tensor) -> Region:
    """The region of a boolean mask over the scene. [N] bool"""
    return Region(name, mask.nonzero()[:, 0], mask.float())


def whole_scene(scene: Gaussians) -> Region:
    """All Gaussians of the scene."""
    return from_mask("all", torch.ones(len(scene), dtype=torch.bool))


def from_labels(name: str, labels: Tensor, ids: Sequence[int]) -> Region:
    """The Gaussians whose label is one of `ids`. [N] integer"""
    return from_mask(name, torch.isin(labels, torch.tensor(list(ids), dtype=labels.dtype)))


def inside_box(name: str, scene: Gaussians, corner: Tensor, opposite: Tensor) -> Region:
    """The Gaussians whose mean lies in the axis-aligned box between two opposite corners, edges included.

    `corner`, `opposite`: in the world. [3], float64 where the scene is far from 0
    """
    corner, opposite = _relative(corner, scene), _relative(opposite, scene)
    low, high = torch.minimum(corner, opposite), torch.maximum(corner, opposite)
    return from_mask(name, ((scene.means >= low) & (scene.means <= high)).all(dim=1))


def inside_sphere(name: str, scene: Gaussians, center: Tensor, radius: float) -> Region:
    """The Gaussians whose mean is at most `radius` world units from `center`; see `inside_box`."""
    return from_mask(name, (scene.means - _relative(center, scene)).norm(dim=1) <= radius)


def _relative(point: Tensor, scene: Gaussians) -> Tensor:
    """A point of the world [3] as the means are kept."""
    return (point.double() - torch.tensor(scene.origin, dtype=torch.float64)).to(scene.means)


def union(a: Region, b: Region, name: str = "") -> Region:
    """Members of either; the larger score."""
    _same_scene(a, b)
    members = torch.cat([a.members, b.members]).unique(sorted=True)  # type: ignore[no-untyped-call]
    return Region(name or f"{a.name}+{b.name}", members, torch.maximum(a.score, b.score))


def difference(a: Region, b: Region, name: str = "") -> Region:
    """Members of `a` that are not members of `b`; the score of `a`, at most what `b` leaves."""
    _same_scene(a, b)
    members = a.members[~torch.isin(a.members, b.members)]
    return Region(name or f"{a.name}-{b.name}", members, torch.minimum(a.score, 1 - b.score))


def intersection(a: Region, b: Region, name: str = "") -> Region:
    """Members of both; the smaller score."""
    _same_scene(a, b)
    members = a.members[torch.isin(a.members, b.members)]
    return Region(name or f"{a.name}&{b.name}", members, torch.minimum(a.score, b.score))


def _same_scene(a: Region, b: Region) -> None:
    if a.score.shape != b.score.shape:
        raise ValueError(
            f"{a.name} is a region of {len(a.score)} Gaussians, {b.name} of {len(b.score)}; "
            "both must belong to one scene"
        )
