"""From 2D masks to Gaussians: which of them the masks of several views mean (docs/method.md 4)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize import alpha_weights
from progdf.rasterize.engines import ALPHA_MIN
from progdf.region import Region
from trainer.options import LiftRule

from .few_masks import FEW, drop_strays, find_holes
from .surface import SurfaceVote

THRESHOLDS: dict[LiftRule, float] = {"share": 0.7, "paper": 0.8}
"""Least score of a member under each rule."""

HIDDEN = 0.06
"""Below this clearness a Gaussian counts as never seen: what shines through tells of what covers it."""

_HALF_HIDDEN = 0.3
_DOUBTFUL = (0.3, 0.7)
"""Below this clearness and with a share between these, what was seen decides nothing either."""


@dataclass(frozen=True)
class Evidence:
    """What the views say of each Gaussian; w = αT, sums run over the pixels it contributes to, and views."""

    inside: Tensor  # Σ w·m, its contribution inside the masks. [N]
    pixels_inside: Tensor  # Σ m. [N]
    weight: Tensor  # Σ w, its contribution in all. [N]
    pixels: Tensor  # n. [N]
    # mean transmittance in front of it in the view that shows it best, 0 hidden .. 1 bare. [N]
    clearness: Tensor
    views: Tensor  # how many views show it: clearer than `HIDDEN`. [N]
    views_inside: Tensor  # in how many of these more than half of its contribution falls inside the mask. [N]
    opacities: Tensor  # σ. [N]


def bare_weight(opacities: Tensor) -> Tensor:
    """The mean α of Gaussians over the ellipse {α ≥ 1/255}, where nothing covers them. [N] -> [N]"""
    bare = (opacities - ALPHA_MIN) / (opacities / ALPHA_MIN).clamp_min(1.001).log()
    return bare.clamp_min(1e-6)


def gather(scene: Gaussians, cameras: Sequence[Camera], masks: Sequence[Tensor]) -> Evidence:
    """Collect the evidence of all views.

    Args:
        scene: N Gaussians
        cameras: one a view
        masks: 0..1 or bool, of its camera's size. [H,W] each
    """
    sums = torch.zeros(len(scene), 4, dtype=torch.float64)
    mean_weight = torch.zeros(len(scene))
    views = torch.zeros(len(scene))
    views_inside = torch.zeros(len(scene))
    bare = bare_weight(scene.opacities)
    for camera, mask in zip(cameras, masks, strict=True):
        weights = alpha_weights(scene, camera, mask)
        sums += weights
        mean = (weights[:, 2] / weights[:, 3].clamp_min(1.0)).float()
        mean_weight = torch.maximum(mean_weight, mean)
        visible = mean > HIDDEN * bare
        views += visible
        views_inside += visible & (weights[:, 0] > 0.5 * weights[:, 2])
    clearness = (mean_weight / bare).clamp(0.0, 1.0)
    inside, pixels_inside, weight, pixels = sums.float().unbind(1)
    return Evidence(inside, pixels_inside, weight, pixels, clearness, views, views_inside, scene.opacities)


def score(evidence: Evidence, rule: LiftRule = "share") -> Tensor:
    """How surely the masks mean each Gaussian. [N] 0..1; 0 where no view shows it.

    share: Σ w·m / Σ w, the part of its visible contribution that falls inside the masks. paper: Σ m / n, as
    the kernel of GaussianEditor counts that the paper refers to. The sum that is printed, Σ σ·α·T·m / n, has
    σ twice and comes to a fifth at most, far below the printed threshold of .8.
    """
    if rule == "share":
        return evidence.inside / evidence.weight.clamp_min(1e-12)
    return evidence.pixels_inside / evidence.pixels.clamp_min(1.0)


def lift_masks(
    scene: Gaussians,
    cameras: Sequence[Camera],
    masks: Sequence[Tensor],
    name: str = "masks",
    rule: LiftRule = "share",
    threshold: float | None = None,
    say: Callable[[str], None] | None = None,
) -> Region:
    """The Gaussians that the masks select (ProGDF appendix, region extraction; see docs/method.md 4).

    Args:
        scene: N Gaussians
        cameras: one a view
        masks: 0..1 or bool, of its camera's size. [H,W] each
        name: the region's name
        rule: see `score`
        threshold: least score of a member, 0..1; None is the rule's own, see `THRESHOLDS`
        say: hears what few masks were cleaned of, see `few_masks`

    Returns:
        The members, and the score of every Gaussian, by which these are the members: `score` ≥ threshold. It
        is the rule's for Gaussians that the views decide; for the others it tells how much of the surface
        around them belongs to the members (see `surface.SurfaceVote`), half of it being the threshold.
        Where the views decide on no member there is none. Under the rule `paper` the score alone decides:
        there is no surface, and no cleaning.

    How the rules and thresholds do against exact labels is in docs/experiments.md, Regions from masks.
    """
    least = THRESHOLDS[rule] if threshold is None else threshold
    evidence = gather(scene, cameras, masks)
    return lift_evidence(scene, evidence, SurfaceVote(scene), name, rule, least, 2 <= len(masks) <= FEW, say)


def lift_evidence(
    scene: Gaussians,
    evidence: Evidence,
    surface_vote: SurfaceVote,
    name: str,
    rule: LiftRule,
    least: float,
    few: bool,
    say: Callable[[str], None] | None = None,
) -> Region:
    """`lift_masks` of gathered evidence; `few`: whether the region is cleaned as that of few masks."""
    scores = score(evidence, rule)
    if rule == "paper":
        return Region(name, (scores >= least).nonzero()[:, 0], scores)
    rows = undecided_rows(evidence, least).nonzero()[:, 0]
    member = (scores >= least).index_fill(0, rows, False)
    if few:
        # what rough borders cut through, and what one of two masks holds, is as its surroundings are
        mixed = (scores > min(_DOUBTFUL[0], least)) & (scores < least)
        single = member & (evidence.views >= 2) & (evidence.views_inside < 2)
        member = drop_strays(scene, member, evidence.views, evidence.views_inside, say)
        scores = torch.where(member, scores, scores.clamp_max(_below(least)))
        open_ = (mixed | single).index_fill(0, rows, True)
        rows = open_.nonzero()[:, 0]
    scores[rows] = 0.0
    if bool(member.any()):
        vote = surface_vote(member, rows)
        below = (least * (1 + vote)).clamp_max(_below(least))
        scores[rows] = torch.where(vote > 0, least + (1 - least) * vote, below)
        member[rows] = vote > 0
    if few:
        holes = find_holes(scene, member, evidence.views - evidence.views_inside, say)
        member[holes] = True
        scores[holes] = scores[holes].clamp_min(least)
    return Region(name, member.nonzero()[:, 0], scores.clamp(0.0, 1.0))


def _below(least: float) -> float:
    """The largest score of no member."""
    return float(torch.nextafter(torch.tensor(least), torch.tensor(0.0)))


def undecided_rows(evidence: Evidence, least: float) -> Tensor:
    """Which Gaussians the views tell nothing sure of: hidden, or half hidden and of mixed share. [N] bool"""
    share = score(evidence, "share")
    mixed = (share > min(_DOUBTFUL[0], 1 - least)) & (share < max(_DOUBTFUL[1], least))
    return (evidence.clearness < HIDDEN) | (mixed & (evidence.clearness < _HALF_HIDDEN))
