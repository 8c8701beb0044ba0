"""Region that an edited picture changes.

1. Render the original at the picture's size and save it in the picture's format, so that JPEG blocks and
   rounding cancel out.
2. Measure the remaining global difference (noise, shifts by a pixel). A pixel has changed if it differs by
   more.
3. Lift the changed pixels to Gaussians by their blending weights, like a mask. The weights account for
   occlusion.
4. Decide members that no picture shows clearly by their neighbors on the same surface, never by Gaussians in
   front of them.
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
from progdf.io.images import saving_loss
from progdf.rasterize import alpha_weights
from progdf.rasterize.engines import bare_weight
from progdf.region import Region
from progdf.scene.point_tree import PointTree
from progdf.sh import sh0_to_rgb
from progdf.terminal import format_count
from trainer.editors.pictures import STEP, STILL, move_image, read_change, undo_shift
from trainer.store.run_folder import quantize_image
from trainer.views.view import fit_size, with_near_plane

from .few_masks import FEW, connected_pieces
from .lift import HIDDEN, Evidence, gather, lift_evidence
from .surface import SurfaceVote, covered_rows

LIFTED_AT = 512
"""Longer side in pixels at which masks are lifted; a smaller one would lose small Gaussians."""

_SHIFT_TOLERANCE_PX = 1  # a changed pixel must differ from every rendered pixel within this distance
# color difference that counts as a change in a shifted or noisy picture, in a small piece, and near larger
# changes
_CHANGED_COLOR = 0.05
_BLOCK_PX = 17  # pixels; contains a JPEG block with subsampled chroma (16 pixels) around its center
_SOFT_EDGE_PX = 8  # width of a soft edge, at the lifting size
_MIN_WIDTH_PX = 2  # narrower changes are noise
_MAX_GAP_PX = 5  # wider gaps stay open
_MAX_HOLE_SHARE = 0.002  # share of the picture; smaller holes in the change are closed
_MIN_CHANGED_SHARE = 0.5  # default minimum share of a member's visible weight in changed pixels
_COVERED_CLEARNESS = 0.5  # below it, more than half of the visible color belongs to occluders
_BOUNDARY_PX = 3.0  # pixels; width of a mask's boundary, at most half of its depth in thin pieces
_MIN_INNER_SHARE = 0.1  # share of a piece's visible weight inside that boundary; a piece with less is a stray
_BOUNDARY_SHARE = 0.3  # share of a member's visible weight on the boundary; with more, its surface decides
_NEGLIGIBLE_SHARE = 1e-3  # share of the largest piece's inner weight; a piece with less is a stray
# A hidden member stays if its score exceeds the minimum by the margin, or if at least this share of the
# visible members lies within the color distance. Fewer similar ones may be part of the boundary.
_OUTLIER_COLOR_DISTANCE = 0.06
_VOTED_SCORE_MARGIN = 0.001
_OUTLIER_SHARE = 0.01


def changed_region(
    scene: Gaussians,
    paths: Sequence[Path],
    cameras: Sequence[Camera],
    threshold: float | None = None,
    say: Callable[[str], None] | None = None,
    seen: Gaussians | None = None,
) -> Region:
    """Return the region of the members that are visible where the pictures differ from the scene.

    Args:
        scene: the original
        paths: the changed pictures
        cameras: their cameras, at the rendered size
        threshold: minimum share of a member's visible weight in changed pixels; None: half
        say: receives a log line
        seen: the scene that the pictures show; None: the original

    Raises:
        ProgdfError: a picture cannot be read, or no picture differs.
    """
    cameras = with_near_plane(cameras, scene)
    masks = []
    small_cameras = []
    for path, camera in zip(paths, cameras, strict=True):
        change = find_change(*read_change(scene if seen is None else seen, path, camera), saving_loss(path))
        small_cameras.append(fit_size(camera.resize(change.shape[1], change.shape[0]), LIFTED_AT))
        masks.append(_close_gaps(_shrink_mask(change, small_cameras[-1])))
    if not any(bool(mask.any()) for mask in masks):
        raise ProgdfError("the pictures do not differ from the scene; change them, or name the region")
    min_score = _MIN_CHANGED_SHARE if threshold is None else threshold
    covered = covered_rows(scene, small_cameras)
    evidence = gather(scene, small_cameras, masks)
    surface_vote = SurfaceVote(scene, covered)
    covered &= evidence.clearness < _COVERED_CLEARNESS
    inner = torch.zeros(len(scene), dtype=torch.float64)  # contributions away from the masks' boundaries
    for camera, mask in zip(small_cameras, masks, strict=True):
        inner += alpha_weights(scene, camera, _inside_boundary(mask))[:, 0]
    few = 2 <= len(masks) <= FEW
    candidates = lift_evidence(scene, evidence, surface_vote, "changed", "share", min_score, few)
    candidates = _vote_on_boundary(candidates, evidence, inner, covered, surface_vote, min_score)
    region = _drop_strays(scene, candidates, evidence, inner, min_score)
    if not len(region):
        raise ProgdfError(
            "no Gaussian lies mostly in changed pixels; change more, or name the region with --region"
        )
    if say is not None:
        share = sum(float(mask.float().mean()) for mask in masks) / len(masks)
        strays = len(candidates) - len(region)
        say(
            f"changed: {100 * share:.1f} % of the pixels differ; {format_count(len(region))} selected"
            + (f" ({format_count(strays)} removed as strays)" if strays else "")
        )
    return region


def find_change(
    original: Tensor, picture: Tensor, save: Callable[[Tensor], Tensor] = quantize_image
) -> Tensor:
    """Return the pixels of a picture that were painted on.

    The effect of saving is known: the render is saved in the same way, once plain and once with the paint on
    it. A pixel has changed if it differs by more than the largest loss within a block. If the picture was
    also shifted or is noisy, which is measured, each pixel is compared with its neighborhood.

    Args:
        original: the render. [H,W,3]
        picture: [H,W,3]
        save: returns an image after saving, see `saving_loss`

    Returns:
        [H,W] bool
    """
    original_values = original.numpy()
    picture_values = undo_shift(original, picture).numpy()
    saved = save(original).numpy()
    exact = quantize_image(original).numpy()
    # bound by the loss of saving within a block
    bound = np.maximum(_local_maximum(np.abs(_smooth(saved - exact))), STEP)
    difference = np.abs(_smooth(picture_values - exact))
    exceeds = difference > bound
    if not exceeds.any():
        return torch.zeros(exceeds.shape[:2], dtype=torch.bool)
    # saving makes paint ring, so a pixel counts as paint only from half of the largest difference nearby
    painted = (exceeds & (difference >= 0.5 * _local_maximum(difference))).any(axis=2)[..., None]
    painted_original = np.where(painted, picture_values, exact)
    bound = np.maximum(
        bound,
        _local_maximum(np.abs(_smooth(save(torch.from_numpy(painted_original)).numpy() - painted_original))),
    )
    # slight differences beside strong paint belong to its soft edge and do not count
    scale = max(1.0, max(exceeds.shape[:2]) / LIFTED_AT)
    edge_width = 1 + 2 * round(_SOFT_EDGE_PX * scale)
    opening = np.ones((round(_MIN_WIDTH_PX * scale),) * 2)
    bound = np.maximum(
        bound,
        np.minimum(_CHANGED_COLOR, 0.5 * _local_maximum(difference.max(axis=2, keepdims=True), edge_width)),
    )
    changed = (difference > bound).any(axis=2) & (np.abs(picture_values - exact) > STEP).any(axis=2)
    if _moved_or_noisy(picture_values - saved, original_values):
        smooth_original = _smooth(original_values)
        smooth_picture = _smooth(picture_values)
        shifts = [
            (y, x)
            for y in range(-_SHIFT_TOLERANCE_PX, _SHIFT_TOLERANCE_PX + 1)
            for x in range(-_SHIFT_TOLERANCE_PX, _SHIFT_TOLERANCE_PX + 1)
        ]
        difference = np.min(
            [np.abs(move_image(smooth_original, shift) - smooth_picture) for shift in shifts], axis=0
        )
        changed = ndimage.binary_opening(
            (difference > np.maximum(bound, _CHANGED_COLOR)).any(axis=2), opening
        )
        # the comparison with neighbors makes areas one pixel too narrow
        return torch.from_numpy(ndimage.binary_dilation(changed, np.ones((3, 3))))
    pieces, count = ndimage.label(ndimage.binary_opening(changed, opening))
    numbers = np.arange(count + 1)
    # another engine, or another program's JPEG, may be slightly off in single areas of a block's size
    large = np.bincount(pieces.ravel(), minlength=count + 1) > _BLOCK_PX**2
    significant = large | (
        np.asarray(ndimage.maximum(difference.max(axis=2), pieces, numbers)) > _CHANGED_COLOR
    )
    significant[0] = False
    return torch.from_numpy(significant[pieces])


def _moved_or_noisy(apart: np.ndarray, original: np.ndarray) -> bool:
    """Return True if the whole picture was changed besides the paint, by noise or a shift. [H,W,3] each

    It is noisy if the deviation from the local mean exceeds one 8-bit step in most of the textured pixels.
    """
    contrast = (_local_maximum(original) + _local_maximum(-original)).max(axis=2)
    noise = np.abs(apart - _smooth(apart)).max(axis=2)
    textured = contrast > STEP
    textured &= contrast >= np.median(contrast[textured], axis=None) if textured.any() else False
    return bool(textured.any() and np.quantile(noise[textured], STILL) > STEP)


def _smooth(image: np.ndarray) -> np.ndarray:
    """Return the mean of 3×3 pixels. [H,W,3]"""
    smooth: np.ndarray = ndimage.uniform_filter(image, (3, 3, 1))
    return smooth


def _local_maximum(apart: np.ndarray, pixels: int = _BLOCK_PX) -> np.ndarray:
    """Return the maximum in a square neighborhood. [H,W,C]"""
    largest: np.ndarray = ndimage.maximum_filter(apart, (pixels, pixels, 1))
    return largest


def _shrink_mask(changed: Tensor, camera: Camera) -> Tensor:
    """Return the pixels of a camera that contain any change; a mask slightly too wide (see `_BOUNDARY_PX`).

    [H,W] -> [h,w] bool
    """
    share = interpolate(changed[None, None].float(), size=(camera.height, camera.width), mode="area")[0, 0]
    return share > 0.0


def _close_gaps(changed: Tensor) -> Tensor:
    """Return the changed pixels with gaps and small holes closed. [H,W] bool"""
    mask = changed.numpy()
    mask = ndimage.binary_closing(mask, np.ones((_MAX_GAP_PX, _MAX_GAP_PX)), border_value=0) | mask
    holes = ndimage.binary_fill_holes(mask) & ~mask
    pieces, count = ndimage.label(holes)
    if count:
        sizes = np.bincount(pieces.ravel())
        small = sizes <= _MAX_HOLE_SHARE * mask.size
        small[0] = False
        mask |= small[pieces]
    return torch.from_numpy(mask)


def _drop_strays(scene: Gaussians, region: Region, evidence: Evidence, inner: Tensor, least: float) -> Region:
    """Return the region without strays.

    Strays are connected pieces that are visible only along the boundary of the change, and Gaussians that no
    picture shows and that match neither the surface nor the color of a visible member.
    """
    if not len(region):
        return region
    members = scene[region.members]
    piece = connected_pieces(members)
    inside, weight = (np.bincount(piece, part[region.members].numpy()) for part in (inner, evidence.weight))
    is_inner = (inside > _MIN_INNER_SHARE * weight) & (inside > _NEGLIGIBLE_SHARE * inside.max()) | (
        inside == inside.max()
    )
    retained = torch.from_numpy(is_inner[piece])
    hidden = _hidden(evidence)[region.members]
    if bool(hidden.any()) and bool((retained & ~hidden).any()):
        colors = sh0_to_rgb(members.sh0).numpy()
        shown_colors = colors[retained & ~hidden]
        rank = min(len(shown_colors), 1 + int(_OUTLIER_SHARE * len(shown_colors)))
        color_distance = PointTree(shown_colors, rank).kth_distances(colors[hidden], rank)
        likely = region.score[region.members[hidden]] > least + _VOTED_SCORE_MARGIN
        retained[hidden] &= likely | torch.from_numpy(color_distance <= _OUTLIER_COLOR_DISTANCE)
    score = region.score.clone()
    score[region.members[~retained]] = 0.0
    return Region(region.name, region.members[retained], score)


def _vote_on_boundary(
    region: Region,
    evidence: Evidence,
    inner: Tensor,
    covered: Tensor,
    surface_vote: SurfaceVote,
    least: float,
) -> Region:
    """Return the region with doubtful Gaussians decided by their own surface.

    Doubtful Gaussians are visible along the boundary of a change, through occluders, or not at all. A mask is
    one or two pixels too wide, and an almost hidden Gaussian may be visible only there. It would pass its
    membership on to all hidden Gaussians of its surface.
    """
    member = region.mask
    at_boundary = evidence.inside - inner > _BOUNDARY_SHARE * evidence.weight
    doubtful = _hidden(evidence) | covered | member & at_boundary
    if not bool((member & ~doubtful).any()):
        return region
    rows = doubtful.nonzero()[:, 0]
    vote = surface_vote(member, rows)
    member[rows] = vote > 0
    score = region.score.clone()
    score[rows] = torch.where(vote > 0, least + (1 - least) * vote, torch.zeros(()))
    return Region(region.name, member.nonzero()[:, 0], score)


def _hidden(evidence: Evidence) -> Tensor:
    """Return the Gaussians that are almost hidden on average over the views. [N] bool

    `Evidence.clearness` is that of the best view instead.
    """
    return evidence.weight < HIDDEN * bare_weight(evidence.opacities) * evidence.pixels.clamp_min(1.0)


def _inside_boundary(mask: Tensor) -> Tensor:
    """Return the pixels of a mask away from its boundary. [H,W] bool -> [H,W] bool"""
    depth = ndimage.distance_transform_edt(mask.numpy())
    pieces, count = ndimage.label(mask.numpy())
    deepest = ndimage.maximum(depth, pieces, np.arange(count + 1))
    return torch.from_numpy(depth > np.minimum(_BOUNDARY_PX, 0.5 * np.asarray(deepest))[pieces])
