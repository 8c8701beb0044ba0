"""Region, the Gaussians that an edit may change, with soft scores; set operations and simple shapes.

`progdf.scene.regions` parses the text form of a region.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.system.equality import equal_fields

from .gaussians import Gaussians


@dataclass(frozen=True)
class Region:
    """Named set of Gaussians with a soft score."""

    __eq__ = equal_fields

    name: str
    members: Tensor  # sorted, unique row indices into the scene. [M] int64
    score: Tensor  # membership of every Gaussian of the scene, 0 to 1. [N] float32

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
        """Membership of every Gaussian of the scene. [N] bool"""
        return torch.zeros_like(self.score, dtype=torch.bool).index_fill(0, self.members, True)


def from_mask(name: str, mask: Tensor) -> Region:
    """Return the region of a mask over the scene. [N] bool"""
    return Region(name, mask.nonzero()[:, 0], mask.float())


def whole_scene(scene: Gaussians) -> Region:
    """Return the region of all Gaussians of the scene."""
    return from_mask("all", torch.ones(len(scene), dtype=torch.bool))


def from_labels(name: str, labels: Tensor, ids: Sequence[int]) -> Region:
    """Return the Gaussians whose label is one of `ids`. [N] integer"""
    return from_mask(name, torch.isin(labels, torch.tensor(list(ids), dtype=labels.dtype)))


def inside_box(name: str, scene: Gaussians, corner: Tensor, opposite: Tensor) -> Region:
    """Return the Gaussians whose mean lies in an axis-aligned box, boundary included.

    Args:
        name: name of the region
        scene: N Gaussians
        corner, opposite: two opposite corners in the world; float64 for scenes far from 0. [3]
    """
    corner = _relative(corner, scene)
    opposite = _relative(opposite, scene)
    low = torch.minimum(corner, opposite)
    high = torch.maximum(corner, opposite)
    return from_mask(name, ((scene.means >= low) & (scene.means <= high)).all(dim=1))


def inside_sphere(name: str, scene: Gaussians, center: Tensor, radius: float) -> Region:
    """Return the Gaussians whose mean is at most `radius` world units from `center`; see `inside_box`."""
    return from_mask(name, (scene.means - _relative(center, scene)).norm(dim=1) <= radius)


def _relative(point: Tensor, scene: Gaussians) -> Tensor:
    """Return a point of the world relative to the origin of the scene. [3]"""
    return (point.double() - torch.tensor(scene.origin, dtype=torch.float64)).to(scene.means)


def union(a: Region, b: Region, name: str = "") -> Region:
    """Return the members of either region, with the larger score."""
    _check_same_scene(a, b)
    members = torch.cat([a.members, b.members]).unique(sorted=True)  # type: ignore[no-untyped-call]
    return Region(name or f"{a.name}+{b.name}", members, torch.maximum(a.score, b.score))


def difference(a: Region, b: Region, name: str = "") -> Region:
    """Return the members of `a` that are not in `b`, with the score min(a, 1 − b)."""
    _check_same_scene(a, b)
    members = a.members[~torch.isin(a.members, b.members)]
    return Region(name or f"{a.name}-{b.name}", members, torch.minimum(a.score, 1 - b.score))


def intersection(a: Region, b: Region, name: str = "") -> Region:
    """Return the members of both regions, with the smaller score."""
    _check_same_scene(a, b)
    members = a.members[torch.isin(a.members, b.members)]
    return Region(name or f"{a.name}&{b.name}", members, torch.minimum(a.score, b.score))


def _check_same_scene(a: Region, b: Region) -> None:
    if a.score.shape != b.score.shape:
        raise ValueError(
            f"{a.name} is a region of {len(a.score)} Gaussians, {b.name} of {len(b.score)}; "
            "both must belong to one scene"
        )
