"""Consistency between views of a finished edit, and its changes outside the region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor
from torch.nn.functional import grid_sample

from progdf.camera import Camera
from progdf.compose.reference import edited_scene
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.metrics.image import psnr
from progdf.metrics.slider import visible_change
from progdf.rasterize.engines import Depth, render_depth
from progdf.system.equality import equal_fields
from trainer.fit.evaluate import Evaluator
from trainer.optimize.losses import Perceptual
from trainer.report.clip import CLIP_MODEL, load_clip
from trainer.store.run_folder import read_views
from trainer.views.view import View, crop, make_view, render_view

from .opened import OpenedRun

# sources of the warped pictures
EDITED = "slider"  # the finished edit
EDITOR = "the editor"  # the editor's pictures
UNEDITED = "unedited"  # the original, whose difference is the lower bound

_MIN_SHARED = 0.1  # two views are compared if they share at least this part of the evaluated pixels
_REGION_WEIGHT = 0.05  # a pixel shows the region if the members' weight is above this


@dataclass(frozen=True)
class WarpedPair:
    """A view warped onto a held-out one."""

    __eq__ = equal_fields

    source: str  # name of the warped view
    target: str  # name of the held-out view
    shared: float  # share of the target's evaluated pixels that the source sees too, 0 to 1
    # by source of the pictures: target's box, and the source warped onto it where both see. [h,w,3] each
    pictures: dict[str, tuple[Tensor, Tensor]]
    both: Tensor  # mask of the compared pixels. [h,w] bool
    depth: Tensor  # edited scene in the target's box, world units; 0 where it is not opaque. [h,w]


@dataclass(frozen=True)
class Consistency:
    """Similarity of views of the same surface, by source of the pictures."""

    lpips: dict[str, float]  # mean over the pairs, in the targets' boxes
    psnr: dict[str, float]  # mean over the pairs, over the shared pixels, dB
    # compared views; empty if no other view sees enough of the same surface
    pairs: tuple[WarpedPair, ...]


def view_consistency(opened: OpenedRun, perceptual: Perceptual) -> Consistency:
    """Compare each held-out view with the view of the run that shares most with it, warped onto it.

    The comparison covers the evaluated pixels (see `Evaluator`) whose surface both views see, before and
    after the edit. The other pixels are copied from the target, so that they do not differ.
    """
    scene = opened.run.scene
    background = opened.setup.background
    targets = opened.setup.judging
    names = {view.camera.name for view in targets}
    views = [*targets, *(view for view in opened.setup.train if view.camera.name not in names)]
    edited = edited_scene(opened.setup.scene, opened.gdf)
    pictures_by_side = {
        EDITED: [render_view(edited, view.camera, background).clamp(0, 1) for view in views],
        EDITOR: read_views(opened.run.folder, "edited", [view.camera for view in views]),
        UNEDITED: [view.image for view in views],
    }
    seen = {
        EDITED: [see_depth(edited, view.camera) for view in views],
        UNEDITED: [see_depth(scene, view.camera) for view in views],
    }
    seen[EDITOR] = seen[EDITED]  # the editor's pictures have no depth
    pairs = []
    for target in range(len(targets)):
        best = None
        for source in range(len(views)):
            if source == target:
                continue
            pair = _warp(views, opened.evaluator, pictures_by_side, seen, source, target)
            best = pair if best is None or pair.shared > best.shared else best
        if best is not None and best.shared >= _MIN_SHARED:
            pairs.append(best)
    lpips = {}
    decibels = {}
    for whose in pictures_by_side:
        compared = [pair.pictures[whose] for pair in pairs]
        with torch.no_grad():
            distances = [float(perceptual(warped, shown)) for shown, warped in compared]
        errors = [psnr(w, s, p.both) for (s, w), p in zip(compared, pairs, strict=True)]
        if pairs:
            lpips[whose] = sum(distances) / len(distances)
            decibels[whose] = sum(min(99.0, e) for e in errors) / len(errors)
    return Consistency(lpips, decibels, tuple(pairs))


def outside_change(opened: OpenedRun) -> dict[str, float]:
    """Return the mean absolute change outside the region, 0 to 1, of the finished edit and of the editor's
    pictures.

    It covers the pixels of the held-out boxes that show the region neither before nor after the edit.
    """
    views = opened.setup.judging
    evaluator = opened.evaluator
    edited = edited_scene(opened.setup.scene, opened.gdf)
    after = [make_view(edited, opened.setup.region, view.camera, opened.setup.background) for view in views]
    boxes = [scene.box for scene in evaluator.crops]
    outside = [
        crop((a.mask <= _REGION_WEIGHT) & (b.mask <= _REGION_WEIGHT), box)
        for a, b, box in zip(views, after, boxes, strict=True)
    ]
    original = [crop(view.image, box) for view, box in zip(views, boxes, strict=True)]
    finished = evaluator.pictures(opened.gdf.field.offsets(1.0))
    return {
        EDITED: visible_change(original, finished, outside),
        EDITOR: visible_change(original, evaluator.edited[1.0], outside),
    }


def _warp(
    views: Sequence[View],
    evaluator: Evaluator,
    whole: dict[str, Sequence[Tensor]],
    seen: dict[str, list[SeenDepth]],
    source: int,
    target: int,
) -> WarpedPair:
    box = evaluator.crops[target].box
    counted = evaluator.pixels[target]
    warped = {w: warp_view(whole[w][source], seen[w][source], seen[w][target]) for w in whole}
    both = counted.clone()
    for _, visible in warped.values():
        both &= crop(visible, box)
    pictures = {}
    for whose, (picture, _) in warped.items():
        target_picture = crop(whole[whose][target], box)
        pictures[whose] = (target_picture, torch.where(both[..., None], crop(picture, box), target_picture))
    depth, alpha = (crop(plane, box) for plane in seen[EDITED][target].depth)
    shared = float(both.sum()) / max(1, int(counted.sum()))
    return WarpedPair(
        views[source].camera.name,
        views[target].camera.name,
        shared,
        pictures,
        both,
        torch.where(alpha > 0.5, depth, 0.0),
    )


_MIN_OPACITY = 0.9  # below this the background, which has no depth, is visible


_SAME_SURFACE_DEPTH = 0.02  # relative depth difference; a larger one is another surface


@dataclass(frozen=True)
class SeenDepth:
    """A camera and its rendered depth."""

    camera: Camera
    depth: Depth


def see_depth(scene: Gaussians, camera: Camera) -> SeenDepth:
    """Render the depth of a scene from a camera, without gradients."""
    with torch.no_grad():
        return SeenDepth(camera, render_depth(scene, camera))


def warp_view(image: Tensor, source: SeenDepth, target: SeenDepth) -> tuple[Tensor, Tensor]:
    """Warp the source's picture to the target's camera.

    Args:
        image: the source's picture. [H,W,3]
        source, target: cameras, with the depth of the same scene

    Returns:
        The warped picture, sampled bilinearly [h,w,3]; the mask of pixels whose surface the source sees too,
        with both opaque and depths equal to 2 % [h,w] bool
    """
    target_camera = target.camera
    source_camera = source.camera
    rows, columns = torch.meshgrid(
        torch.arange(target_camera.height) + 0.5, torch.arange(target_camera.width) + 0.5, indexing="ij"
    )
    pixels = torch.stack([columns, rows, torch.ones_like(rows)], dim=2)
    rays = pixels @ torch.linalg.inv(target_camera.K).T
    points = rays * target.depth.depth[..., None]
    relative = source_camera.viewmat @ target_camera.c2w
    moved = points @ relative[:3, :3].T + relative[:3, 3]
    z = moved[..., 2]
    front = z > source_camera.near
    projected = moved @ source_camera.K.T / torch.where(front, z, 1.0)[..., None]
    u = projected[..., 0]
    v = projected[..., 1]
    inside = (
        front & (u >= 0.5) & (v >= 0.5) & (u <= source_camera.width - 0.5) & (v <= source_camera.height - 0.5)
    )
    # pixel centers lie at +0.5, as those of `grid_sample` without align_corners do
    grid = torch.stack([2 * u / source_camera.width - 1, 2 * v / source_camera.height - 1], dim=2).clamp(
        -2, 2
    )
    planes = torch.cat([image, source.depth.depth[..., None], source.depth.alpha[..., None]], dim=2)
    sampled = grid_sample(
        planes.permute(2, 0, 1)[None], grid[None], align_corners=False, padding_mode="border"
    )
    warped = sampled[0, :3].permute(1, 2, 0)
    depth = sampled[0, 3]
    alpha = sampled[0, 4]
    both = inside & (target.depth.alpha > _MIN_OPACITY) & (alpha > _MIN_OPACITY)
    return warped, both & ((depth - z).abs() <= _SAME_SURFACE_DEPTH * z)


FRAMES = 5
"""Frames from one view to the next on the path."""

_MAX_PATH_VIEWS = 6  # views of the run on the path; straight lines between distant ones cross the object


def camera_path(cameras: Sequence[Camera]) -> list[Camera]:
    """Return a path from each camera to the nearest unvisited one, with linear positions and slerped
    rotations.

    `cameras`: at least one; the path begins at the first
    """
    remaining = list(cameras[1:])
    route = [cameras[0]]
    while remaining:
        current = route[-1].position
        nearest = min(range(len(remaining)), key=lambda i: float((remaining[i].position - current).norm()))
        route.append(remaining.pop(nearest))
    path = []
    for a, b in pairwise(route):
        turns = Slerp([0.0, 1.0], Rotation.from_matrix([c.viewmat[:3, :3].double().numpy() for c in (a, b)]))
        path += [_between(a, b, turns, i / FRAMES) for i in range(FRAMES)]
    return [*path, route[-1]]


def clip_consistency(opened: OpenedRun) -> tuple[float | None, str]:
    """Return the consistency of CLIP's direction along a path at strength 1, −1 to 1.

    If it is undefined, the result is None and the reason.
    """
    try:
        clip = load_clip(CLIP_MODEL)
    except ProgdfError as error:
        return None, str(error)
    views = opened.setup.views
    if len(views) < 2:
        return None, "a path needs at least two views"
    path = camera_path([view.camera for view in views[:: -(-len(views) // _MAX_PATH_VIEWS)]])
    before, after = (
        clip.pictures([render_view(scene, camera, opened.setup.background) for camera in path])
        for scene in (opened.run.scene, edited_scene(opened.setup.scene, opened.gdf))
    )
    similarity = neighbor_similarity(before, after)
    return similarity, "" if similarity is not None else "the edit does not change CLIP's features"


def neighbor_similarity(before: Tensor, after: Tensor) -> float | None:
    """Return the mean cosine of the changes of neighboring frames; None if no two neighbors change.

    Args:
        before, after: features of the frames, of unit length. [n,D]
    """
    change = (after - before).double()
    lengths = change.norm(dim=1)
    # features of equal pictures differ by rounding, which has a direction too
    pairs = (lengths[:-1] > 1e-6) & (lengths[1:] > 1e-6)
    if not bool(pairs.any()):
        return None
    cosines = (change[:-1] * change[1:]).sum(dim=1) / (lengths[:-1] * lengths[1:]).clamp_min(1e-30)
    return float(cosines[pairs].mean())


def _between(a: Camera, b: Camera, turns: Slerp, share: float) -> Camera:
    rotation = torch.from_numpy(turns(share).as_matrix())
    eye = torch.lerp(a.position.double(), b.position.double(), share)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ eye
    size = torch.tensor([[b.width], [b.height], [1.0]]) / torch.tensor([[a.width], [a.height], [1.0]])
    K = torch.lerp(a.K, b.K / size, share)
    return replace(a, viewmat=viewmat.float(), K=K)
