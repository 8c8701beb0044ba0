"""Views for training and evaluating an edit: their cameras, and the region in each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from progdf.camera import Camera, intrinsics, look_at
from progdf.gaussians import Gaussians
from progdf.io.picture_files import name_twin, view_name
from progdf.rasterize import ActivatedGaussians, Crop, activate, render
from progdf.rasterize.cpu.engine import rasterize_part, shade_view
from progdf.rasterize.engines import ColorMap, RasterView, color_map
from progdf.region import Region
from progdf.scene.bounds import is_surrounding, near_plane, quantile, scene_sphere
from progdf.scene.orbit_rig import orbit_rig
from progdf.scene.up_axis import guess_up
from progdf.sh import basis, shade
from progdf.system.equality import equal_fields
from progdf.threads import map_threads

from .inner_rig import inner_rig

BACKGROUND = (1.0, 1.0, 1.0)
"""Background of the views, rgb, 0 to 1."""

BACKGROUND_NAMES = ("white", "black", "checker")
"""Backgrounds of `on_backgrounds`."""

_CHECKER_TILES = 16  # tiles of the checker along the longer side of a picture
_MIN_BOX = 64  # pixels per side that LPIPS needs
_SEEN = 0.05  # member weight above which a pixel shows the region
_PIXEL_STRIDE = 23  # stride of a thumbnail's sampled pixels, in row-major order
_CHANGED = 0.05  # difference of a channel above which a pixel counts as changed


@dataclass(frozen=True)
class View:
    """Render of the original scene from one camera, with the region in it."""

    __eq__ = equal_fields

    camera: Camera  # the whole view; its name is the file name of its pictures
    image: Tensor  # the original, 0 to 1. [H,W,3]
    mask: Tensor  # blended weight of the members, Σ αT: soft at edges, lower if occluded. [H,W] 0 to 1
    # color of the members alone, unmixed from other Gaussians in the pixel; undefined if `mask` is 0. [H,W,3]
    inside: Tensor
    box: Crop  # the pixels that an edit can change, at least 64 per side if the image is that large

    def blend(self, edited_inside: Tensor) -> Tensor:
        """Return the view with another color in place of `inside`, mixed as in the original. [H,W,3] ->
        [H,W,3]

        This is exact at soft edges. Other Gaussians in a pixel keep their color, so edges neither bleed nor
        leave a fringe.
        """
        change = torch.where(self.mask[..., None] > 1e-4, edited_inside - self.inside, 0.0)
        return (self.image + self.mask[..., None] * change).clamp(0.0, 1.0)

    def confine(self, edited: Tensor) -> Tensor:
        """Return an edited view with everything outside the region restored. [H,W,3] -> [H,W,3]

        A pixel with at least 20 % of the region keeps the editor's color, which is a mixture already.
        """
        return torch.lerp(self.image, edited, (self.mask[..., None] / 0.2).clamp(0.0, 1.0))

    def cut_out(self, paper: Tensor | None = None) -> Tensor:
        """Return the region without its surroundings. [H,W,3]

        A network that receives the whole picture paints the region differently on every background. The
        result depends on the region alone (docs/lab/experiments.md, Editors that agree, or do not).

        Args:
            paper: sRGB color behind the region; None: the region's own colors, continued outwards. [3]
        """
        behind = continue_colors(self.inside, self.mask) if paper is None else paper
        return torch.lerp(behind.expand_as(self.inside), self.inside, self.mask[..., None])

    def with_painted(self, edited: Sequence[Tensor]) -> View:
        """Return the view with a mask extended to all visible changes in these pictures of it."""
        changed = torch.stack([(picture - self.image).abs().amax(dim=2) for picture in edited]).amax(dim=0)
        return replace(self, mask=torch.maximum(self.mask, (changed > _CHANGED).float()))

    def widen(self, edited: Sequence[Tensor]) -> View:
        """Return the view with a box extended to all visible changes in these pictures of it."""
        return replace(self, box=region_box(self.with_painted(edited).mask))


def crop(image: Tensor, box: Crop) -> Tensor:
    """Return the pixels of a box. [H,W,...] -> [h,w,...]"""
    x0, y0, x1, y1 = box
    return image[y0:y1, x0:x1]


def shrink_image(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the image at another height and width, averaged over areas. [H,W,C] -> [h,w,C]"""
    return interpolate(image.permute(2, 0, 1)[None], size, mode="area")[0].permute(1, 2, 0)


def continue_colors(colors: Tensor, weights: Tensor) -> Tensor:
    """Continue weighted colors to all pixels, with more blur at larger distances (pull-push).

    Args:
        colors: [H,W,3]
        weights: weight of each pixel, 0 to 1; pixels of weight 0 take the colors of others. [H,W]

    Returns:
        Pixels of weight 1 are unchanged. Others mix their color with the mean over the smallest surrounding
        square that has weight. [H,W,3]
    """
    weight = weights[None, None]
    levels = [((colors * weights[..., None]).permute(2, 0, 1)[None], weight)]
    while max(weight.shape[-2:]) > 1:
        color, weight = (avg_pool2d(plane, 2, ceil_mode=True) for plane in levels[-1])
        levels.append((color, weight))
    color, weight = levels.pop()
    continued = color / weight.clamp_min(1e-12)
    for color, weight in reversed(levels):
        enlarged = interpolate(continued, color.shape[-2:], mode="bilinear", align_corners=False)
        continued = color + (1.0 - weight) * enlarged
    return continued[0].permute(1, 2, 0)


def make_view(scene: Gaussians, region: Region, camera: Camera, background: Tensor) -> View:
    """Render the original view and the region's share of it."""
    return make_views(scene, region, [camera], background)[0]


def make_views(scene: Gaussians, region: Region, cameras: Sequence[Camera], background: Tensor) -> list[View]:
    """Render the original views and the region's share of them. background: rgb. [3]"""
    gaussians = activate(scene)

    def draw(camera: Camera) -> View:
        view = RasterView.of(camera, gaussians)
        image, share, part = rasterize_part(gaussians, view, background, region.members)
        mask = share.clamp_(0.0, 1.0)
        inside = part.div_(mask.clamp_min(1e-4)[..., None]).clamp_(0.0, 1.0)
        return View(camera, image.clamp_(0.0, 1.0), mask, inside, region_box(mask))

    return map_threads(draw, cameras)


def seen_colors(scene: Gaussians, camera: Camera) -> Tensor:
    """Return each Gaussian's color from this camera, at least 0. [N,3]"""
    if scene.means.device.type == "cpu":
        return shade_view(scene, camera)
    directions = torch.nn.functional.normalize(scene.means - camera.position, dim=1)
    return shade(min(scene.sh_degree, 3), directions, scene.sh)


def render_colors(
    scene: Gaussians, colors: Tensor, camera: Camera, background: Tensor, crop: Crop | None = None
) -> Tensor:
    """Render the scene in these colors instead of its own, without gradients. [N,3] -> [H,W,3]"""
    with torch.no_grad():
        return render(scene, camera, background, colors=colors, crop=crop).image


def render_view(scene: Gaussians | ActivatedGaussians, camera: Camera, background: Tensor) -> Tensor:
    """Render the scene, without gradients. [H,W,3]"""
    with torch.no_grad():
        return render(scene, camera, background).image


def on_backgrounds(scene: Gaussians, camera: Camera) -> list[Tensor]:
    """Return the scene rendered on each of `BACKGROUND_NAMES`. [H,W,3] each"""
    with torch.no_grad():
        output = render(scene, camera, (0.0, 0.0, 0.0))
    side = max(1, max(camera.width, camera.height) // _CHECKER_TILES)
    rows = torch.arange(camera.height)[:, None] // side
    columns = torch.arange(camera.width) // side
    checker = ((rows + columns) % 2).float()
    shades = (torch.ones_like(checker), torch.zeros_like(checker), checker)
    return [(output.image + (output.transmittance * shade)[..., None]).clamp(0.0, 1.0) for shade in shades]


class RegionThumbnail(NamedTuple):
    """Subset of the pixels of a small picture of the region."""

    camera: Camera
    pixels: Tensor  # indices of the pixels, in row-major order. [P] int64
    map: ColorMap  # nonnegative colors of the members -> their contribution to these pixels
    basis: Tensor  # weight of each SH band in each member's color from this camera. [M,B]
    colors: Tensor  # the members', unclamped. [M,3]
    mask: Tensor  # see `View`. [P]
    inside: Tensor  # see `View`. [P,3]


def make_glances(
    scene: Gaussians, region: Region, cameras: Sequence[Camera], count: int
) -> list[RegionThumbnail]:
    """Return thumbnails from the first `count` cameras that show the region."""
    activated = activate(scene, torch.zeros_like(scene.means))
    members = scene[region.members]
    degree = min(scene.sh_degree, 3)
    sh = members.sh
    glances = list[RegionThumbnail]()

    def color_from(camera: Camera) -> tuple[Tensor, Tensor]:
        weights = basis(degree, torch.nn.functional.normalize(members.means - camera.position))
        return weights, torch.einsum("nb,nbc->nc", weights, sh[:, : weights.shape[1]]) + 0.5

    def look(camera: Camera) -> RegionThumbnail:
        box = (0, 0, camera.width, camera.height)
        pixels = torch.arange(camera.width * camera.height)
        weight_map = color_map(activated, camera, box, region.members, pixels=pixels[::_PIXEL_STRIDE])
        weights, colors = color_from(camera) if degree else plain
        mask = weight_map.picture(torch.ones_like(colors))[:, 0].clamp(0.0, 1.0)
        inside = (weight_map.picture(colors.clamp_min(0.0)) / mask.clamp_min(1e-4)[:, None]).clamp(0.0, 1.0)
        return RegionThumbnail(camera, pixels[::_PIXEL_STRIDE], weight_map, weights, colors, mask, inside)

    plain = color_from(cameras[0])
    while cameras and len(glances) < count:
        batch = cameras[: count - len(glances)]
        cameras = cameras[count - len(glances) :]
        glances += [glance for glance in map_threads(look, batch) if bool(glance.mask.any())]
    return glances


def region_box(mask: Tensor, margin: int = 6, least: float = 0.5 * _SEEN) -> Crop:
    """Return the smallest box around pixels above `least`, with a margin, extended to 64 pixels. [H,W]"""
    height, width = mask.shape
    visible = mask > least
    if not bool(visible.any()):
        return (0, 0, width, height)
    spans = []
    for axis, side in ((0, width), (1, height)):
        hit = visible.any(dim=axis).nonzero()[:, 0]
        low = int(hit[0]) - margin
        high = int(hit[-1]) + 1 + margin
        missing = _MIN_BOX - (high - low)
        if missing > 0:
            low = low - (missing + 1) // 2
            high = high + missing // 2
        low = max(0, min(low, side - _MIN_BOX))
        high = min(side, max(high, _MIN_BOX))
        spans.append((low, high))
    (x0, x1), (y0, y1) = spans
    return (x0, y0, x1, y1)


_FRAMED_SHARE = 0.97  # share of a region's means along each axis that its box holds
_MAX_FRAMED = 10_000  # members that determine the box; more are sampled evenly
_AIMS = 2  # passes: aim at the middle of the means, then at the middle of the box
_MAX_HALF_FOV_TAN = 0.98  # tangent of half the widest field of view

_PLASTIC = 1.324718
"""Plastic number, the root of x³ = x + 1.

Its multiples, with the rig's azimuths and elevations, fill three dimensions evenly.
"""


def region_rig(
    scene: Gaussians, region: Region, count: int, image_size: int, up: Tensor | None = None,
    elevations: tuple[float, float] = (5.0, 60.0), fills: bool = False,
) -> list[Camera]:  # fmt: skip
    """Return a rig that is aimed at the region and zoomed in on it.

    The cameras have the positions of a rig for the whole scene, so nothing new occludes the region. In a
    scene that surrounds its cameras they stand at free places around the region, and there may be fewer, see
    `inner_rig`. A hand that is 3 % of the scene is trained on as many pixels as the whole body. The
    region's bounding sphere fills 80 to 50 % of the pictures, in an order that also leaves no gap between the
    nearer views.

    Args:
        scene: see `orbit_rig`
        region: the region to look at
        count: number of cameras, ≥ 1
        image_size: both sides in pixels
        up: world up direction, [3]; None guesses it
        elevations: see `orbit_rig`
        fills: True for edits that stay inside the region and need no surroundings. The longer side of the
            region's box then fills 95 to 75 % of the pictures, see `frame_box`

    Raises:
        ProgdfError: the scene surrounds its cameras, and no free place shows the region.
    """
    up = guess_up(scene) if up is None else up
    center, radius = region_sphere(scene, region)
    if is_surrounding(scene, up):
        rig = inner_rig(scene, region, count, image_size, up, (center, radius))
    else:
        rig = orbit_rig(scene, count, image_size, image_size, up=up, elevations=elevations)
    steps = [(0.5 + i / _PLASTIC) % 1.0 for i in range(len(rig))]
    if not fills:
        return [
            frame_sphere(camera, center, radius, 0.8 - 0.3 * step, up)
            for camera, step in zip(rig, steps, strict=True)
        ]
    members = region.members[:: -(-len(region) // _MAX_FRAMED)]
    means = scene.means[members]
    extent = float(scene.scales[members].amax(dim=1).median())
    return [
        frame_box(camera, means, extent, 0.95 - 0.2 * step, up)
        for camera, step in zip(rig, steps, strict=True)
    ]


def frame_box(camera: Camera, means: Tensor, extent: float, share: float, up: Tensor) -> Camera:
    """Return the camera turned to Gaussians and zoomed in on them, with a square picture.

    Their box holds 97 % of the means along each axis of the picture. Its longer side fills a share of the
    picture's side.

    Args:
        camera: its position and its shorter side are kept
        means: centers of the Gaussians. [M,3]
        extent: margin of the box around the means, world units
        share: share of the picture's side that the box fills, above 0, at most 1
        up: world direction that is up. [3]
    """
    side = min(camera.width, camera.height)
    target = means.median(dim=0).values
    for _ in range(_AIMS):
        viewmat = look_at(camera.position, target, up)
        x, y, depth = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(1)
        depth = depth.clamp_min(1e-3 * float(depth.median().abs().clamp_min(1e-9)))
        margin = extent / float(depth.median())
        low_x, high_x, low_y, high_y = (
            float(quantile(slope / depth, share_below))
            for slope in (x, y)
            for share_below in ((1 - _FRAMED_SHARE) / 2, (1 + _FRAMED_SHARE) / 2)
        )
        half = max(high_x - low_x, high_y - low_y) / 2 + margin
        ray = torch.tensor([(low_x + high_x) / 2, (low_y + high_y) / 2, 1.0])
        target = camera.position + viewmat[:3, :3].T @ ray
    fov = 2 * math.atan(min(_MAX_HALF_FOV_TAN, half / share))
    return replace(camera, viewmat=viewmat, K=intrinsics(fov, side, side), width=side, height=side)


def region_sphere(scene: Gaussians, region: Region) -> tuple[Tensor, float]:
    """Return center [3] and radius of a region's visible extent."""
    center, radius = scene_sphere(scene[region.members])
    return center, radius + float(scene.scales[region.members].amax(dim=1).median())


def frame_sphere(camera: Camera, center: Tensor, radius: float, share: float, up: Tensor) -> Camera:
    """Return the camera turned to a sphere, with a square picture.

    The sphere's diameter fills a share of the picture's side, 0 to 1. `up`: world direction, [3]
    """
    distance = float((camera.position - center).norm())
    fov = 2 * math.asin(min(0.7, radius / (share * max(distance, radius))))
    aimed = look_at(camera.position, center, up)
    side = min(camera.width, camera.height)
    return replace(camera, viewmat=aimed, K=intrinsics(fov, side, side), width=side, height=side)


def with_near_plane(cameras: Sequence[Camera], scene: Gaussians) -> list[Camera]:
    """Return the cameras with a near plane scaled to the scene; a fixed one would clip a tiny scene."""
    near = near_plane(scene_sphere(scene)[1])
    return [replace(camera, near=near) for camera in cameras]


def fit_size(camera: Camera, image_size: int) -> Camera:
    """Return the camera with its longer side at `image_size` pixels, never enlarged."""
    scale = image_size / max(camera.width, camera.height)
    if scale >= 1.0:
        return camera
    return camera.resize(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def name_cameras(cameras: Sequence[Camera]) -> list[Camera]:
    """Return the cameras with names that are relative paths and valid on every system (`view_name`).

    Names differ in more than case. A duplicate or invalid name becomes view_000, view_001, ….
    """
    taken: set[str] = set()
    result = []
    for i, camera in enumerate(cameras):
        name = view_name(camera.name)
        if name is None or name_twin(name) in taken:
            name = f"view_{i:03d}"
        taken.add(name_twin(name))
        result.append(replace(camera, name=name))
    return result
