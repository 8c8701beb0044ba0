"""Lifting of 2D masks of several views to a region of Gaussians (docs/method.md 4)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize import alpha_weights
from progdf.rasterize.engines import bare_weight
from progdf.region import Region
from progdf.system.equality import equal_fields
from trainer.options import LiftRule

from .few_masks import FEW, drop_strays, find_holes
from .surface import SurfaceVote

THRESHOLDS: dict[LiftRule, float] = {"share": 0.7, "paper": 0.8}
"""Minimum score of a member under each rule."""

HIDDEN = 0.06
"""Clearness below which a Gaussian counts as not visible, as its pixels show its occluders."""

_HALF_HIDDEN = 0.3
"""Clearness below which a mixed share does not decide."""
_MIXED_SHARES = (0.3, 0.7)
"""Range of mixed shares, in which a half-hidden Gaussian stays undecided."""


@dataclass(frozen=True)
class Evidence:
    """Evidence of the views on each Gaussian.

    Here w = αT, and sums run over the pixels that it contributes to, and over views.
    """

    __eq__ = equal_fields

    inside: Tensor  # Σ w·m, contribution inside the masks. [N]
    pixels_inside: Tensor  # Σ m. [N]
    weight: Tensor  # Σ w, total contribution. [N]
    pixels: Tensor  # n, number of pixels. [N]
    # mean transmittance in front of it in the view that shows it best, 0 (hidden) to 1 (unoccluded). [N]
    clearness: Tensor
    views: Tensor  # number of views that show it with a clearness above `HIDDEN`. [N]
    views_inside: Tensor  # number of these with more than half of its contribution inside the mask. [N]
    opacities: Tensor  # σ. [N]


def gather(scene: Gaussians, cameras: Sequence[Camera], masks: Sequence[Tensor]) -> Evidence:
    """Collect the evidence of all views.

    Args:
        scene: N Gaussians
        cameras: one per view
        masks: 0 to 1 or bool, at the size of the camera. [H,W] each
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
    """Return the score of each Gaussian under the masks, 0 to 1; 0 if no view shows it. [N]

    share: Σ w·m / Σ w, the share of its visible contribution inside the masks. paper: Σ m / n, as in the
    kernel of GaussianEditor that the paper refers to. The printed sum, Σ σ·α·T·m / n, has σ twice and is at
    most a fifth, far below the printed threshold of 0.8.
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
    """Return the Gaussians that the masks select (ProGDF appendix, region extraction; see docs/method.md 4).

    Args:
        scene: N Gaussians
        cameras: one per view
        masks: 0 to 1 or bool, at the size of the camera. [H,W] each
        name: the region's name
        rule: see `score`
        threshold: minimum score of a member, 0 to 1; None is the rule's own, see `THRESHOLDS`
        say: receives log lines on the cleanup of a region from a small number of masks, see `few_masks`

    Returns:
        The members, and the score of every Gaussian. Members are those with `score` ≥ threshold. The score is
        the rule's for Gaussians that the views decide. For the others it is the share of the surrounding
        surface that belongs to members (see `surface.SurfaceVote`), scaled so that half of it is the
        threshold. If the views decide on no member, the region is empty. Under the rule `paper` the score
        alone decides, without surface and cleanup.

    The accuracy of rules and thresholds against exact labels is in docs/lab/experiments.md, Regions from
    masks.
    """
    min_score = THRESHOLDS[rule] if threshold is None else threshold
    evidence = gather(scene, cameras, masks)
    return lift_evidence(
        scene, evidence, SurfaceVote(scene), name, rule, min_score, 2 <= len(masks) <= FEW, say
    )


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
    """Return the region of gathered evidence, see `lift_masks`.

    `few`: clean up the region, as there is a small number of masks
    """
    scores = score(evidence, rule)
    if rule == "paper":
        return Region(name, (scores >= least).nonzero()[:, 0], scores)
    rows = undecided_rows(evidence, least).nonzero()[:, 0]
    member = (scores >= least).index_fill(0, rows, False)
    if few:
        # surroundings decide on Gaussians that a rough mask's edge cuts, and on those inside only one mask
        mixed = (scores > min(_MIXED_SHARES[0], least)) & (scores < least)
        single = member & (evidence.views >= 2) & (evidence.views_inside < 2)
        member = drop_strays(scene, member, evidence.views, evidence.views_inside, say)
        scores = torch.where(member, scores, scores.clamp_max(_largest_score_below(least)))
        is_open = (mixed | single).index_fill(0, rows, True)
        rows = is_open.nonzero()[:, 0]
    scores[rows] = 0.0
    if bool(member.any()):
        vote = surface_vote(member, rows)
        lower_scores = (least * (1 + vote)).clamp_max(_largest_score_below(least))
        scores[rows] = torch.where(vote > 0, least + (1 - least) * vote, lower_scores)
        member[rows] = vote > 0
    if few:
        holes = find_holes(scene, member, evidence.views - evidence.views_inside, say)
        member[holes] = True
        scores[holes] = scores[holes].clamp_min(least)
    return Region(name, member.nonzero()[:, 0], scores.clamp(0.0, 1.0))


def _largest_score_below(least: float) -> float:
    """Return the largest score below the minimum of a member."""
    return float(torch.nextafter(torch.tensor(least), torch.tensor(0.0)))


def undecided_rows(evidence: Evidence, least: float) -> Tensor:
    """Return the Gaussians that the views leave open: hidden, or half hidden with a mixed share. [N] bool"""
    share = score(evidence, "share")
    mixed = (share > min(_MIXED_SHARES[0], 1 - least)) & (share < max(_MIXED_SHARES[1], least))
    return (evidence.clearness < HIDDEN) | (mixed & (evidence.clearness < _HALF_HIDDEN))
