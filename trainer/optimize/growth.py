"""Growth: Gaussians that an edit adds where no member is that could show it, such as a hat on a head.

Members that are cloned where the gradient is large have to travel to what is new, and smear on the way. So
rows are seeded where the pictures say that they are: at pixels that are drawn by how wrong they are, each at
the nearest depth of its ray at which the other views show its color too. They are trained with the members,
from the original on, and fade in at their last place: their opacity rises linearly along the slider.
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
from trainer.setup import TrainingSetup
from trainer.views.crops import CropScene
from trainer.views.view import View

from .pgs import TargetStage

SEED_LOGIT = 2.0
"""Of what is seeded, at strength 1: nearly opaque, and free to fade."""

_SIZE = 0.5  # standard deviation of a seed, of the distance to its three neighbors
_DEPTHS = 256  # along a ray, at most; one for two pixels
_CLIP = 0.3  # of color: views disagree by no more
_ALIKE = 0.03  # a nearer depth is as good as the best
_MIN_VIEWS = 3  # that can see a place, beside its own
_FAINT = 2 / 255  # of color; below, a pixel is as it should be


def seed_rows(
    setup: TrainingSetup, views: Sequence[View], targets: Sequence[Tensor], count: int, seed: int
) -> Gaussians:
    """Rows for what the scene is farthest from showing, as they are at strength 0.

    Args:
        setup: scene and region
        views: some views of it
        targets: the edited pictures of these. [H,W,3] each
        count: rows, at most
        seed: of the draw
    """
    scene = setup.scene
    cameras = [view.camera for view in views]
    targets = list(targets)
    errors = [(a - view.image).square().mean(dim=2) for a, view in zip(targets, views, strict=True)]
    errors = [torch.where(error > _FAINT**2, error, 0.0) for error in errors]
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
    rows = len(means) if len(means) > 3 else 0  # fewer have no neighbors to be sized by
    spread = torch.ones(0)
    if rows:
        near = torch.from_numpy(PointTree(means.numpy(), 4).query(means.numpy(), 4)[0]).float()
        spread = near[:, 1:].square().mean(dim=1).sqrt()
        spread = spread.clamp(spread.quantile(0.1), spread.quantile(0.9)).clamp_min(1e-3 * radius)
    return replace(
        scene[torch.zeros(rows, dtype=torch.int64)],
        means=means[:rows],
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(rows, 1),
        log_scales=(_SIZE * spread).log()[:, None].repeat(1, 3),
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
    """The place of each pixel of a view: the nearest at which the views that can see it show its color.

    Args:
        index: which view
        pixels: row by row. [n]
        cameras, targets: of all views
        depths: of the original in all views, behind which nothing is seen
        center: of the region, around which as far is looked as the view is wide there

    Returns:
        [n,3], and which of them enough views can see. [n] bool
    """
    camera = cameras[index]
    v = pixels // camera.width
    u = pixels % camera.width
    x = (u + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    rays = torch.stack([x, (v + 0.5 - camera.K[1, 2]) / camera.K[1, 1], torch.ones_like(x)], dim=1)
    middle = float(camera.viewmat[2, :3] @ center + camera.viewmat[2, 3])
    reach = middle * max(camera.width, camera.height) / (2 * float(camera.K[0, 0]))
    count = min(_DEPTHS, max(camera.width, camera.height) // 2)
    along = torch.linspace(max(camera.near, middle - reach), max(2 * camera.near, middle + reach), count)
    behind = 2 * float(along[1] - along[0])  # of a surface: what is nearer is on it
    points = (rays[:, None] * along[:, None] - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    colors = targets[index].flatten(0, 1)[pixels, None]
    apart = torch.zeros(len(pixels), count)
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
        apart += sees * (torch.stack(drawn, dim=2) - colors).abs().mean(dim=2).clamp_max(_CLIP)
        seen += sees
    off = apart / seen.clamp_min(1.0)
    allowed = (seen >= _MIN_VIEWS) & (along < _surface(depths[index]).flatten()[pixels, None] + behind)
    off = torch.where(allowed, off, 1.0)
    first = (off <= off.amin(dim=1, keepdim=True) + _ALIKE).float().argmax(dim=1)
    return points[torch.arange(len(pixels)), first], allowed.any(dim=1)


def _surface(depth: Depth) -> Tensor:
    """Camera z behind which a view shows nothing; far away where it is mostly clear. [H,W]"""
    return torch.where(depth.alpha > 0.5, depth.depth, 1e9)


def place_seeds(stage: TargetStage, count: int) -> TargetStage:
    """The stage with its last `count` members, which are seeded, as opaque as its strength says."""
    opacity = stage.strength * torch.tensor(SEED_LOGIT).sigmoid()

    def place(offsets: Tensor) -> Tensor:
        logits = torch.zeros_like(offsets[0])
        logits[attribute_slices(offsets.shape[1])["logit_opacities"]] = opacity.logit() - ADDED_LOGIT
        return torch.cat([stage.place(offsets[:-count]), offsets[-count:] + logits])

    return replace(stage, place=place)


def add_rows(trajectory: Trajectory, rows: Gaussians) -> Trajectory:
    """A recording of the region's members with others, given as they are at strength 1."""
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
    """By how much half the squared error over all views would rise without each member. [M]

    To second order in its opacity o: -g o + h o² / 2. The curvature h, Σ (dI/do)², is the mean square of the
    gradient of a picture of random signs (Hutchinson), of which one a view is enough.

    Args:
        crops: the training views
        rows: raw member rows. [M,C]
        targets: what these views are to show. [h,w,3] each
        seed: of the signs
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
    clear = 1.0 - rows[:, logit][:, 0].sigmoid()  # of logits x, do/dx = o (1 - o)
    return curvature / (2 * clear.square()) - slope / clear


def fade_in(trajectory: Trajectory) -> Trajectory:
    """The opacities of the added rows linear along the slider, with recordings where logits bend."""
    added = trajectory.added
    if added is None:
        return trajectory
    logit = attribute_slices(trajectory.end.shape[1])["logit_opacities"]
    last = added.logit_opacities + trajectory.end[-len(added) :, logit][:, 0]
    s = torch.unique(torch.cat([trajectory.s, opacity_course(added.logit_opacities, last)[0]]))
    offsets = torch.stack([trajectory.at(float(at)).half() for at in s])
    opacity = torch.lerp(added.opacities.double(), last.double().sigmoid(), s[:, None].double())
    offsets[:, -len(added) :, logit] = (opacity.logit() - ADDED_LOGIT).half()[..., None]
    offsets[0, -len(added) :] = 0.0
    ends = torch.searchsorted(s, trajectory.s[list(trajectory.stage_ends)])
    steps = trajectory.steps[torch.searchsorted(trajectory.s, s)]
    return replace(trajectory, s=s, offsets=offsets, steps=steps, stage_ends=tuple(ends.tolist()))
