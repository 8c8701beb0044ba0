"""Growth: Gaussians that an edit adds where no member can show it, such as a hat on a head.

Cloned members would have to travel to the new object and smear on the way. Rows are therefore seeded where
the pictures need them: at pixels sampled in proportion to their error, each at the nearest depth of its ray
at which the other views show its color too. Seeded rows are trained together with the members from the start.
They fade in at their final position: their opacity rises linearly with the slider.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from progdf.camera import Camera
from progdf.field.separable import opacity_course
from progdf.field.trajectory import Trajectory
from progdf.gaussians import Gaussians, attribute_slices
from progdf.gdf.file import ADDED_LOGIT
from progdf.rasterize.engines import Depth, render_depth
from progdf.scene.bounds import scene_sphere
from progdf.scene.point_tree import PointTree
from progdf.sh import rgb_to_sh0
from trainer.views.crops import CropScene
from trainer.views.setup import TrainingSetup
from trainer.views.view import View

from .pgs import TargetStage

SEED_LOGIT = 2.0
"""Opacity logit of seeded rows at strength 1: nearly opaque, and free to fade."""

_SEED_SIZE = 0.5  # standard deviation of a seed, as a share of the distance to its three neighbors
_MAX_DEPTHS = 256  # maximum number of depths per ray; one per two pixels
_MAX_VIEW_DIFFERENCE = 0.3  # maximum color difference that one view contributes
_COLOR_TOLERANCE = 0.03  # color difference within which a nearer depth counts as equal to the best
_MIN_VIEWS = 3  # minimum number of other views that see a position
_MIN_COLOR_ERROR = 2 / 255  # color difference below which a pixel counts as correct


def seed_rows(
    setup: TrainingSetup, views: Sequence[View], targets: Sequence[Tensor], count: int, seed: int
) -> Gaussians:
    """Return rows seeded where the scene differs most from the edit, with their opacity at strength 0.

    Args:
        setup: scene and region
        views: some views of it
        targets: edited pictures of these. [H,W,3] each
        count: maximum number of rows
        seed: seed of the random sampling
    """
    scene = setup.scene
    cameras = [view.camera for view in views]
    targets = list(targets)
    errors = [(a - view.image).square().mean(dim=2) for a, view in zip(targets, views, strict=True)]
    errors = [torch.where(error > _MIN_COLOR_ERROR**2, error, 0.0) for error in errors]
    center, radius = scene_sphere(scene[setup.region.members])
    depths = [render_depth(scene, camera) for camera in cameras]
    total = float(sum(error.sum() for error in errors))
    draw = torch.Generator().manual_seed(seed)
    places = [torch.zeros(0, 3)]
    colors = [torch.zeros(0, 3)]
    for i, error in enumerate(errors):
        wrong = min(int(count * float(error.sum()) / max(total, 1e-12)), int((error > 0).sum()))
        if wrong:
            pixels = torch.multinomial(error.flatten(), wrong, generator=draw)
            points, known = _place_pixels(i, pixels, cameras, targets, depths, center)
            places.append(points[known])
            colors.append(targets[i].flatten(0, 1)[pixels[known]])
    means = torch.cat(places)
    rows = len(means) if len(means) > 3 else 0  # fewer rows have no neighbors to derive their size from
    spread = torch.ones(0)
    if rows:
        distances = torch.from_numpy(PointTree(means.numpy(), 4).query(means.numpy(), 4)[0]).float()
        spread = distances[:, 1:].square().mean(dim=1).sqrt()
        spread = spread.clamp(spread.quantile(0.1), spread.quantile(0.9)).clamp_min(1e-3 * radius)
    return replace(
        scene[torch.zeros(rows, dtype=torch.int64)],
        means=means[:rows],
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(rows, 1),
        log_scales=(_SEED_SIZE * spread).log()[:, None].repeat(1, 3),
        logit_opacities=torch.full((rows,), ADDED_LOGIT),
        sh0=rgb_to_sh0(torch.cat(colors))[:rows],
        shN=torch.zeros(rows, *scene.shN.shape[1:]),
    )


def _place_pixels(
    index: int,
    pixels: Tensor,
    cameras: Sequence[Camera],
    targets: Sequence[Tensor],
    depths: Sequence[Depth],
    center: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return the nearest position of each pixel at which the views that can see it show its color.

    Args:
        index: index of the view
        pixels: row by row. [n]
        cameras, targets: cameras and edited pictures of all views
        depths: depths of the original in all views; positions behind them are hidden
        center: center of the region; the search range around it is as deep as the view is wide there

    Returns:
        positions [n,3]; True for positions that enough views can see [n] bool
    """
    camera = cameras[index]
    v = pixels // camera.width
    u = pixels % camera.width
    x = (u + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    rays = torch.stack([x, (v + 0.5 - camera.K[1, 2]) / camera.K[1, 1], torch.ones_like(x)], dim=1)
    middle = float(camera.viewmat[2, :3] @ center + camera.viewmat[2, 3])
    reach = middle * max(camera.width, camera.height) / (2 * float(camera.K[0, 0]))
    count = min(_MAX_DEPTHS, max(camera.width, camera.height) // 2)
    depths_along_ray = torch.linspace(
        max(camera.near, middle - reach), max(2 * camera.near, middle + reach), count
    )
    # depth tolerance within which a position counts as on a surface
    behind = 2 * float(depths_along_ray[1] - depths_along_ray[0])
    points = (rays[:, None] * depths_along_ray[:, None] - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    colors = targets[index].flatten(0, 1)[pixels, None]
    difference = torch.zeros(len(pixels), count)
    seen = torch.zeros(len(pixels), count)
    for other, target, depth in zip(cameras, targets, depths, strict=True):
        if other is camera:
            continue
        x, y, z = (points @ other.viewmat[:3, :3].T + other.viewmat[:3, 3]).unbind(2)
        px = x / z * other.K[0, 0] + other.K[0, 2]
        py = y / z * other.K[1, 1] + other.K[1, 2]
        grid = torch.stack([2 * px / other.width - 1, 2 * py / other.height - 1], dim=2)
        planes = torch.cat([target, _surface(depth)[..., None]], dim=2).permute(2, 0, 1)[None]
        *drawn, surface = grid_sample(planes, grid[None].clamp(-2, 2), "nearest", align_corners=False)[0]
        sees = (z > other.near) & (grid.abs() < 1).all(dim=2) & (z < surface + behind)
        difference += sees * (torch.stack(drawn, dim=2) - colors).abs().mean(dim=2).clamp_max(
            _MAX_VIEW_DIFFERENCE
        )
        seen += sees
    mean_difference = difference / seen.clamp_min(1.0)
    allowed = (seen >= _MIN_VIEWS) & (
        depths_along_ray < _surface(depths[index]).flatten()[pixels, None] + behind
    )
    mean_difference = torch.where(allowed, mean_difference, 1.0)
    first = (
        (mean_difference <= mean_difference.amin(dim=1, keepdim=True) + _COLOR_TOLERANCE)
        .float()
        .argmax(dim=1)
    )
    return points[torch.arange(len(pixels)), first], allowed.any(dim=1)


def _surface(depth: Depth) -> Tensor:
    """Return the camera z of the visible surface; 1e9 in pixels that are mostly transparent. [H,W]"""
    return torch.where(depth.alpha > 0.5, depth.depth, 1e9)


def place_seeds(stage: TargetStage, count: int) -> TargetStage:
    """Return the stage with its last `count` members (the seeds) at the opacity of its strength."""
    opacity = stage.strength * torch.tensor(SEED_LOGIT).sigmoid()

    def place(offsets: Tensor) -> Tensor:
        logits = torch.zeros_like(offsets[0])
        logits[attribute_slices(offsets.shape[1])["logit_opacities"]] = opacity.logit() - ADDED_LOGIT
        return torch.cat([stage.place(offsets[:-count]), offsets[-count:] + logits])

    return replace(stage, place=place)


def add_rows(trajectory: Trajectory, rows: Gaussians) -> Trajectory:
    """Add rows, given with their opacity at strength 1, to a trajectory of the region's members."""
    if not len(rows):
        return trajectory
    below = (0, 0, 0, len(rows))
    logit = attribute_slices(trajectory.end.shape[1])["logit_opacities"]
    offsets = pad(trajectory.offsets, below)
    end = pad(trajectory.end, below)
    end[-len(rows) :, logit] = (rows.logit_opacities - ADDED_LOGIT)[:, None]
    added = replace(rows, logit_opacities=torch.full_like(rows.logit_opacities, ADDED_LOGIT))
    return fade_in(replace(trajectory, offsets=offsets, end=end, added=added))


def removal_costs(crops: Sequence[CropScene], rows: Tensor, targets: Sequence[Tensor], seed: int) -> Tensor:
    """Return the increase of half the squared error over all views if each member were removed. [M]

    To second order in its opacity o it is -g o + h o² / 2. The curvature h, Σ (dI/do)², is the mean square of
    the gradient of a picture of random signs (Hutchinson). One such picture per view is enough.

    Args:
        crops: training views
        rows: raw member rows. [M,C]
        targets: target pictures of these views. [h,w,3] each
        seed: seed of the signs
    """
    draw = torch.Generator().manual_seed(seed)
    logit = attribute_slices(rows.shape[1])["logit_opacities"]
    slope = rows.new_zeros(len(rows))
    curvature = rows.new_zeros(len(rows))
    for crop, target in zip(crops, targets, strict=True):
        leaf = rows.clone().requires_grad_()
        image = crop.render(leaf)
        signs = torch.randint(2, image.shape, generator=draw).to(image) * 2 - 1
        (along,) = torch.autograd.grad(image, leaf, (image - target).detach(), retain_graph=True)
        (drawn,) = torch.autograd.grad(image, leaf, signs)
        slope += along[:, logit][:, 0]
        curvature += drawn[:, logit][:, 0].square()
    clear = 1.0 - rows[:, logit][:, 0].sigmoid()  # for a logit x: do/dx = o (1 - o)
    return curvature / (2 * clear.square()) - slope / clear


def fade_in(trajectory: Trajectory) -> Trajectory:
    """Make the opacities of added rows linear in the slider value, with extra recordings as needed."""
    added = trajectory.added
    if added is None:
        return trajectory
    logit = attribute_slices(trajectory.end.shape[1])["logit_opacities"]
    final_logits = added.logit_opacities + trajectory.end[-len(added) :, logit][:, 0]
    s = torch.unique(torch.cat([trajectory.s, opacity_course(added.logit_opacities, final_logits)[0]]))
    offsets = torch.stack([trajectory.at(float(at)).half() for at in s])
    opacity = torch.lerp(added.opacities.double(), final_logits.double().sigmoid(), s[:, None].double())
    offsets[:, -len(added) :, logit] = (opacity.logit() - ADDED_LOGIT).half()[..., None]
    offsets[0, -len(added) :] = 0.0
    ends = torch.searchsorted(s, trajectory.s[list(trajectory.stage_ends)])
    steps = trajectory.steps[torch.searchsorted(trajectory.s, s)]
    return replace(trajectory, s=s, offsets=offsets, steps=steps, stage_ends=tuple(ends.tolist()))
