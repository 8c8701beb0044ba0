"""From 2D masks to Gaussians: which of them the masks of several views mean (method.md 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize import alpha_weights
from progdf.rasterize.conventions import ALPHA_MIN
from progdf.region import Region
from trainer.neighbours import surface_share

Rule = Literal["share", "count", "paper"]

THRESHOLDS: dict[Rule, float] = {"share": 0.7, "count": 0.8, "paper": 0.8}
"""Least score of a member under each rule; those of `count` and `paper` are the paper's."""

_HIDDEN = 0.06
"""Below this clearness a Gaussian counts as never seen: what shines through tells of what covers it."""

_HALF_HIDDEN, _DOUBTFUL = 0.3, (0.3, 0.7)
"""Below this clearness and with a share between these, what was seen decides nothing either."""


@dataclass(frozen=True)
class Evidence:
    """What the views say of each Gaussian; w = αT, sums run over the pixels it contributes to, and views.

    Args:
        inside: Σ w·m, its contribution inside the masks. [N]
        pixels_inside: Σ m. [N]
        weight: Σ w, its contribution in all. [N]
        pixels: n. [N]
        clearness: mean transmittance in front of it in the view that shows it best, 0 hidden .. 1 bare. [N]
    """

    inside: Tensor
    pixels_inside: Tensor
    weight: Tensor
    pixels: Tensor
    clearness: Tensor


def gather(scene: Gaussians, cameras: Sequence[Camera], masks: Sequence[Tensor]) -> Evidence:
    """Collect the evidence of all views.

    Args:
        scene: N Gaussians
        cameras: one a view
        masks: 0..1 or bool, of its camera's size. [H,W] each
    """
    sums = torch.zeros(len(scene), 4, dtype=torch.float64)
    mean_weight = torch.zeros(len(scene))
    for camera, mask in zip(cameras, masks, strict=True):
        found = alpha_weights(scene, camera, mask)
        sums += found
        mean_weight = torch.maximum(mean_weight, found[:, 2] / found[:, 3].clamp_min(1.0))
    # the mean α of a Gaussian of opacity o over the ellipse {α ≥ 1/255}, where nothing covers it
    bare = (scene.opacities - ALPHA_MIN) / (scene.opacities / ALPHA_MIN).clamp_min(1.001).log()
    clearness = (mean_weight / bare.clamp_min(1e-6)).clamp(0.0, 1.0)
    inside, pixels_inside, weight, pixels = sums.float().unbind(1)
    return Evidence(inside, pixels_inside, weight, pixels, clearness)


def score(evidence: Evidence, rule: Rule = "share") -> Tensor:
    """How surely the masks mean each Gaussian. [N] 0..1; 0 where no view shows it.

    share: Σ w·m / Σ w, the part of its visible contribution that falls inside the masks. count: Σ m / n.
    paper: Σ w·m / n as printed, which is at most the mean of αT, far below the printed threshold of .8.
    """
    if rule == "share":
        return evidence.inside / evidence.weight.clamp_min(1e-12)
    above = evidence.pixels_inside if rule == "count" else evidence.inside
    return above / evidence.pixels.clamp_min(1.0)


def lift_masks(
    scene: Gaussians,
    cameras: Sequence[Camera],
    masks: Sequence[Tensor],
    name: str = "masks",
    rule: Rule = "share",
    threshold: float | None = None,
) -> Region:
    """The Gaussians that the masks select (ProGDF appendix, region extraction; see method.md 4).

    Args:
        scene: N Gaussians
        cameras: one a view
        masks: 0..1 or bool, of its camera's size. [H,W] each
        name: the region's name
        rule: see `score`
        threshold: least score of a member, 0..1; None is the rule's own, see `THRESHOLDS`

    Returns:
        The members, and the score of every Gaussian: the rule's for those that a view shows clearly; the
        share of members among their neighbours, see `neighbours.majority`, for those that none does.
    """
    least = THRESHOLDS[rule] if threshold is None else threshold
    evidence = gather(scene, cameras, masks)
    scores = score(evidence, rule)
    member = scores >= least
    unseen = undecided(evidence)
    if bool(member[~unseen].any()):
        rows = unseen.nonzero()[:, 0]
        scores[rows] = surface_share(scene, member, rows)
        member[rows] = scores[rows] > 0.5
    else:
        scores, member = torch.where(unseen, 0.0, scores), member & ~unseen
    return Region(name, member.nonzero()[:, 0], scores.clamp(0.0, 1.0))


def undecided(evidence: Evidence) -> Tensor:
    """Which Gaussians the views tell nothing sure of: hidden, or half hidden and of mixed share. [N] bool"""
    share = score(evidence, "share")
    mixed = (share > _DOUBTFUL[0]) & (share < _DOUBTFUL[1])
    return (evidence.clearness < _HIDDEN) | (mixed & (evidence.clearness < _HALF_HIDDEN))
