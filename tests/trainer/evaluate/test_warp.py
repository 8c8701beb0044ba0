"""Warp of one view onto another by depth: shared surfaces match, all other pixels are excluded."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from progdf.camera import Camera, look_at
from progdf.gaussians import Gaussians
from progdf.metrics.image import psnr
from progdf.rasterize import render
from progdf.rasterize.engines import Depth
from progdf.sh import rgb_to_sh0
from tests.helpers.scenes import concatenate, front_camera
from trainer.evaluate.consistency import SeenDepth, see_depth, warp_view


def _picture(scene: Gaussians, camera: Camera) -> Tensor:
    return render(scene, camera, (0.0, 0.0, 0.0)).image


def _wall(depth: float, half: float, count: int = 60, seed: int = 0) -> Gaussians:
    """Return a square of opaque Gaussians across the view, in smooth random colors."""
    side = torch.linspace(-half, half, count)
    x, y = torch.meshgrid(side, side, indexing="xy")
    coarse = torch.rand(1, 3, 7, 7, generator=torch.Generator().manual_seed(seed))
    colors = torch.nn.functional.interpolate(coarse, (count, count), mode="bicubic").clamp(0, 1)[0]
    n = count * count
    return Gaussians(
        means=torch.stack([x.flatten(), y.flatten(), torch.full((n,), depth)], dim=1),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(n, 4),
        log_scales=torch.tensor([1.2 * half / count, 1.2 * half / count, 1e-3]).log().expand(n, 3),
        logit_opacities=torch.full((n,), 4.0),
        sh0=rgb_to_sh0(colors.flatten(1).T),
        shN=torch.zeros(n, 0, 3),
    )


def _from(x: float, y: float = 0.0) -> Camera:
    camera = front_camera(96, 72, focal=80.0)
    viewmat = look_at(
        torch.tensor([x, y, 0.0]), torch.tensor([0.0, 0.0, 4.0]), torch.tensor([0.0, -1.0, 0.0])
    )
    return replace(camera, viewmat=viewmat)


def test_view_warped_onto_itself_is_unchanged() -> None:
    scene = _wall(4.0, 5.0)
    camera = _from(0.3)
    image = _picture(scene, camera)
    seen = see_depth(_wall(4.0, 5.0), camera)
    warped, both = warp_view(image, seen, seen)
    assert bool(both[1:-1, 1:-1].all())
    assert float((warped - image).abs()[1:-1, 1:-1].max()) < 1e-4


def _painted_wall(camera: Camera, depth: float = 4.0) -> tuple[Tensor, SeenDepth]:
    """Return a smooth pattern on a plane across the z axis, and its depth, both analytic."""
    rows, columns = torch.meshgrid(
        torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij"
    )
    rays = torch.stack([columns, rows, torch.ones_like(rows)], dim=2) @ torch.linalg.inv(camera.K).T
    c2w = camera.c2w
    directions = rays @ c2w[:3, :3].T
    z = (depth - c2w[2, 3]) / directions[..., 2]
    places = c2w[:3, 3] + z[..., None] * directions
    image = torch.stack(
        [0.5 + 0.4 * torch.sin(3 * places[..., 0] + k) * torch.cos(2 * places[..., 1]) for k in range(3)],
        dim=2,
    )
    return image, SeenDepth(camera, Depth(z, torch.ones_like(z)))


def test_plane_warps_exactly_up_to_resampling() -> None:
    (image, here), (other, there) = _painted_wall(_from(0.0)), _painted_wall(_from(1.2, 0.4))
    warped, both = warp_view(other, there, here)
    assert float(both.float().mean()) > 0.7
    assert float((warped - image).abs()[both].max()) < 5e-3
    assert psnr(other, image, both) < 20


def test_wall_warps_between_two_views() -> None:
    scene = _wall(4.0, 5.0)
    here = _from(0.0)
    there = _from(1.2, 0.4)
    image = _picture(scene, here)
    other = _picture(scene, there)
    warped, both = warp_view(other, see_depth(scene, there), see_depth(scene, here))
    assert float(both.float().mean()) > 0.7
    # the order of overlapping Gaussians differs between views, which shifts colors by half a Gaussian
    assert psnr(warped, image, both) > 27
    assert psnr(other, image, both) < 25


def test_occluded_pixels_are_not_shared() -> None:
    back = _wall(4.0, 6.0)
    front = _wall(2.0, 0.4, 30, seed=1)
    scene = concatenate(back, front)
    here = _from(0.0)
    there = _from(1.2)
    seen_here = see_depth(scene, here)
    seen_there = see_depth(scene, there)
    warped, both = warp_view(_picture(scene, there), seen_there, seen_here)
    image = _picture(scene, here)
    everywhere = torch.ones_like(both)
    assert psnr(warped, image, both) > psnr(warped, image, everywhere) + 6
    # hidden behind the small square in the other view
    covered = (seen_here.depth.depth > 3.5) & ~both
    assert 50 < int(covered.sum()) < 0.4 * covered.numel()


def test_pixels_outside_the_other_view_or_empty_are_excluded() -> None:
    scene = _wall(4.0, 1.0)
    here = _from(0.0)
    there = _from(0.5)
    seen = see_depth(scene, here)
    _, both = warp_view(_picture(scene, there), see_depth(scene, there), seen)
    assert not bool(both[seen.depth.alpha < 0.9].any())
    away = replace(there, viewmat=torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ there.viewmat)
    _, none = warp_view(_picture(scene, away), see_depth(scene, away), seen)
    assert not bool(none.any())
