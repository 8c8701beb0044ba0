"""The region that changed pictures tell of by themselves: the Gaussians that show where they differ.

A program that saves a picture changes all of it a little: JPEG's blocks, another rounding, a model that moves
everything by a pixel. So the render is made at the picture's own size and saved as the picture was, what else
differs all over is measured, and a pixel has changed where it differs by more. What is left is lifted as
masks are, by the weights with which Gaussians show there, which know what lies before what; and what the
pictures leave open is as its own surface is, never as what covers it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import interpolate

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.io.images import save_as
from progdf.rasterize import alpha_weights
from progdf.region import Region
from progdf.scene.point_tree import PointTree
from progdf.sh import sh0_to_rgb
from progdf.terminal import format_count
from trainer.editors.pictures import STEP, STILL, lay_over, move_image, read_change
from trainer.setup import quantize_image
from trainer.views.view import fit_size, with_near_plane

from .few_masks import FEW, connected_pieces
from .lift import HIDDEN, Evidence, bare_weight, gather, lift_evidence
from .surface import SurfaceVote, covered_rows

LIFTED_AT = 512
"""Longer side in pixels at which masks are lifted: smaller shows less of small Gaussians."""

_NEAR = 1  # pixels around a place in which the render may have its color
_CHANGED = (
    0.05  # of color: where nothing is known of how a picture was saved, and beside what differs by more
)
_BLOCK = 17  # pixels, a JPEG's block with half the colors, and its middle
_SOFT = 8  # pixels of a soft rim, where masks are lifted
_SPECK = 2  # pixels: what is narrower is none
_GAP = 5  # what is wider than a gap is not closed
_HOLE = 0.002  # of the picture: a smaller hole in what has changed is closed
_MINIMUM = 0.5  # of a member's visible share lies where the pictures differ
_BARELY = 0.5  # clearness: more than half of what shows there is what covers it
_RIM = 3.0  # pixels that a mask is too wide by, at most, or half of what is thinner
_INNER = 0.1  # of a connected piece's visible share lies within that rim; with less it is a stray
_AT_RIM = 0.3  # of a member's visible share lies along the rim: its surface decides
_LITTLE = 1e-3  # of what the largest piece shows there: as good as nothing
_ODD = 0.06  # of color, apart from nearly all that shows
_VOTED = 0.001  # of score, above the least
_FEW = 0.01  # of what shows, on the rim perhaps


def changed_region(
    scene: Gaussians,
    paths: Sequence[Path],
    cameras: Sequence[Camera],
    threshold: float | None = None,
    say: Callable[[str], None] | None = None,
) -> Region:
    """The members that show where the pictures differ from the scene.

    Args:
        scene: the original
        paths: the changed pictures
        cameras: theirs, at the size at which they were rendered
        threshold: least share of a member's visible weight that has to lie there; None: half
        say: hears in a line each what was found

    Raises:
        ProgdfError: a picture cannot be read, or they differ nowhere.
    """
    cameras = with_near_plane(cameras, scene)
    masks = []
    small = []
    for path, camera in zip(paths, cameras, strict=True):
        change = find_change(*read_change(scene, path, camera), save_as(path))
        small.append(fit_size(camera.resize(change.shape[1], change.shape[0]), LIFTED_AT))
        masks.append(_close_gaps(_shrink_mask(change, small[-1])))
    if not any(bool(mask.any()) for mask in masks):
        raise ProgdfError("the pictures differ nowhere from the scene; change them, or name the region")
    least = _MINIMUM if threshold is None else threshold
    covered = covered_rows(scene, small)
    evidence = gather(scene, small, masks)
    surface_vote = SurfaceVote(scene, covered)
    covered &= evidence.clearness < _BARELY
    inner = torch.zeros(len(scene), dtype=torch.float64)  # of a member's contribution, what lies off the rims
    for camera, mask in zip(small, masks, strict=True):
        inner += alpha_weights(scene, camera, _within_rim(mask))[:, 0]
    few = 2 <= len(masks) <= FEW
    found = lift_evidence(scene, evidence, surface_vote, "changed", "share", least, few)
    found = _vote_on_rim(found, evidence, inner, covered, surface_vote, least)
    region = _drop_strays(scene, found, evidence, inner, least)
    if not len(region):
        raise ProgdfError(
            "no Gaussian lies mostly where the pictures differ; change more, or name the region with --region"
        )
    if say is not None:
        share = sum(float(mask.float().mean()) for mask in masks) / len(masks)
        strays = len(found) - len(region)
        say(
            f"changed: {share:.1%} of the pictures differ, which {format_count(len(region))} show"
            + (f"; {format_count(strays)} beside it left out" if strays else "")
        )
    return region


def find_change(
    original: Tensor, picture: Tensor, save: Callable[[Tensor], Tensor] = quantize_image
) -> Tensor:
    """Where a picture was painted on: where it differs by more than it does unpainted.

    What saving does is known: the render is saved in the same way, and with what was painted laid on it; a
    pixel has changed that differs by more than is lost so within a block. A picture to which more happened,
    which is measured, is compared with what is near each pixel.

    Args:
        original: the render. [H,W,3]
        picture: [H,W,3]
        save: what saving makes of an image, see `save_as`

    Returns:
        [H,W] bool
    """
    a = original.numpy()
    b = lay_over(original, picture).numpy()
    saved = save(original).numpy()
    exact = quantize_image(original).numpy()
    # what saving does within a block of it, and what else came
    bound = np.maximum(_around(np.abs(_smooth(saved - exact))), STEP)
    apart = np.abs(_smooth(b - exact))
    over = apart > bound
    if not over.any():
        return torch.zeros(over.shape[:2], dtype=torch.bool)
    # paint brings noise of its own: half of what differs most nearby is paint, less may be what it rings with
    painted = (over & (apart >= 0.5 * _around(apart))).any(axis=2)[..., None]
    laid_on = np.where(painted, b, exact)
    bound = np.maximum(bound, _around(np.abs(_smooth(save(torch.from_numpy(laid_on)).numpy() - laid_on))))
    # beside strong paint what differs a little is its soft rim
    scale = max(1.0, max(over.shape[:2]) / LIFTED_AT)
    rim = 1 + 2 * round(_SOFT * scale)
    speck = np.ones((round(_SPECK * scale),) * 2)
    bound = np.maximum(bound, np.minimum(_CHANGED, 0.5 * _around(apart.max(axis=2, keepdims=True), rim)))
    changed = (apart > bound).any(axis=2) & (np.abs(b - exact) > STEP).any(axis=2)
    if _moved_or_noisy(b - saved, a):
        smooth_a = _smooth(a)
        smooth_b = _smooth(b)
        shifts = [(y, x) for y in range(-_NEAR, _NEAR + 1) for x in range(-_NEAR, _NEAR + 1)]
        apart = np.min([np.abs(move_image(smooth_a, shift) - smooth_b) for shift in shifts], axis=0)
        changed = ndimage.binary_opening((apart > np.maximum(bound, _CHANGED)).any(axis=2), speck)
        # what is compared with its surroundings ends a pixel early
        return torch.from_numpy(ndimage.binary_dilation(changed, np.ones((3, 3))))
    pieces, count = ndimage.label(ndimage.binary_opening(changed, speck))
    numbers = np.arange(count + 1)
    # another engine, or another program's JPEG, is off by a little in a place or two of a block's size
    large = np.bincount(pieces.ravel(), minlength=count + 1) > _BLOCK**2
    significant = large | (np.asarray(ndimage.maximum(apart.max(axis=2), pieces, numbers)) > _CHANGED)
    significant[0] = False
    return torch.from_numpy(significant[pieces])


def _moved_or_noisy(apart: np.ndarray, original: np.ndarray) -> bool:
    """Whether more happened to a picture than was painted: its noise, what pixels differ by from their
    neighbors, is more than a step in most of what is busy. [H,W,3] each"""
    busy = (_around(original) + _around(-original)).max(axis=2)
    fine = np.abs(apart - _smooth(apart)).max(axis=2)
    rows = busy > STEP
    rows &= busy >= np.median(busy[rows], axis=None) if rows.any() else False
    return bool(rows.any() and np.quantile(fine[rows], STILL) > STEP)


def _smooth(image: np.ndarray) -> np.ndarray:
    """The mean of 3×3 pixels. [H,W,3]"""
    smooth: np.ndarray = ndimage.uniform_filter(image, (3, 3, 1))
    return smooth


def _around(apart: np.ndarray, pixels: int = _BLOCK) -> np.ndarray:
    """The largest of so many pixels around. [H,W,C]"""
    largest: np.ndarray = ndimage.maximum_filter(apart, (pixels, pixels, 1))
    return largest


def _shrink_mask(changed: Tensor, camera: Camera) -> Tensor:
    """Which of a camera's pixels have changed anywhere: a rim is expected, see `_RIM`. [H,W] -> [h,w] bool"""
    share = interpolate(changed[None, None].float(), size=(camera.height, camera.width), mode="area")[0, 0]
    return share > 0.0


def _close_gaps(changed: Tensor) -> Tensor:
    """What has changed without its gaps and small holes. [H,W] bool"""
    mask = changed.numpy()
    mask = ndimage.binary_closing(mask, np.ones((_GAP, _GAP)), border_value=0) | mask
    holes = ndimage.binary_fill_holes(mask) & ~mask
    pieces, count = ndimage.label(holes)
    if count:
        sizes = np.bincount(pieces.ravel())
        small = sizes <= _HOLE * mask.size
        small[0] = False
        mask |= small[pieces]
    return torch.from_numpy(mask)


def _drop_strays(scene: Gaussians, region: Region, evidence: Evidence, inner: Tensor, least: float) -> Region:
    """Return the region without strays.

    Strays are connected pieces that show along the rim of the change alone, and Gaussians that no picture
    shows and that have neither the surface nor the color of a visible member.
    """
    if not len(region):
        return region
    members = scene[region.members]
    piece = connected_pieces(members)
    inside, weight = (np.bincount(piece, part[region.members].numpy()) for part in (inner, evidence.weight))
    mostly = (inside > _INNER * weight) & (inside > _LITTLE * inside.max()) | (inside == inside.max())
    kept = torch.from_numpy(mostly[piece])
    hidden = _hidden(evidence)[region.members]
    if bool(hidden.any()) and bool((kept & ~hidden).any()):
        colors = sh0_to_rgb(members.sh0).numpy()
        shown_colors = colors[kept & ~hidden]
        like = min(len(shown_colors), 1 + int(_FEW * len(shown_colors)))
        apart = PointTree(shown_colors, like).kth_distances(colors[hidden], like)
        likely = region.score[region.members[hidden]] > least + _VOTED
        kept[hidden] &= likely | torch.from_numpy(apart <= _ODD)
    score = region.score.clone()
    score[region.members[~kept]] = 0.0
    return Region(region.name, region.members[kept], score)


def _vote_on_rim(
    region: Region,
    evidence: Evidence,
    inner: Tensor,
    covered: Tensor,
    surface_vote: SurfaceVote,
    least: float,
) -> Region:
    """The region, with what shows along the rim of a change, through what covers it, or not at all, as its
    own surface is inside it.

    A mask is a pixel or two too wide, and a Gaussian that something changed all but hides shows there alone:
    it would hand its membership on to all that is hidden of its surface.
    """
    member = region.mask
    at_rim = evidence.inside - inner > _AT_RIM * evidence.weight
    doubtful = _hidden(evidence) | covered | member & at_rim
    if not bool((member & ~doubtful).any()):
        return region
    rows = doubtful.nonzero()[:, 0]
    vote = surface_vote(member, rows)
    member[rows] = vote > 0
    score = region.score.clone()
    score[rows] = torch.where(vote > 0, least + (1 - least) * vote, torch.zeros(()))
    return Region(region.name, member.nonzero()[:, 0], score)


def _hidden(evidence: Evidence) -> Tensor:
    """Which Gaussians are next to hidden in the mean of the views, not only in the best one. [N] bool"""
    return evidence.weight < HIDDEN * bare_weight(evidence.opacities) * evidence.pixels.clamp_min(1.0)


def _within_rim(mask: Tensor) -> Tensor:
    """The pixels of a mask that do not lie along its rim. [H,W] bool -> [H,W] bool"""
    depth = ndimage.distance_transform_edt(mask.numpy())
    pieces, count = ndimage.label(mask.numpy())
    deepest = ndimage.maximum(depth, pieces, np.arange(count + 1))
    return torch.from_numpy(depth > np.minimum(_RIM, 0.5 * np.asarray(deepest))[pieces])
