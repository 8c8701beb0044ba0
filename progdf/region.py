"""A region: which Gaussians an edit may change, and how sure we are of each."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Region:
    """A named set of Gaussians with a soft score.

    Args:
        name: what the person calls it
        members: sorted, unique row indices into the scene. [M] int64
        score: membership of every Gaussian of the scene, 0..1; the viewer moves its threshold. [N] float32
    """

    name: str
    members: Tensor
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


def from_mask(name: str, mask: Tensor) -> Region:
    """The region of a boolean mask over the scene. [N] bool"""
    return Region(name, mask.nonzero()[:, 0], mask.float())
