"""Reference rasterizer in plain torch: any floating type, fully differentiable, the oracle of the tests.

Conventions: Kerbl et al. 2023 (3D Gaussian Splatting) with the choices listed in `progdf.rasterize`. Tiles of
16x16 pixels bound the memory. Within a tile every Gaussian is evaluated at every pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.quaternions import normalize_quats, rotation_matrices
from progdf.sh import shade
from progdf.system.equality import equal_fields

from .engines import (
    ALPHA_MAX,
    ALPHA_MIN,
    ANTIALIAS_FLOOR,
    FRUSTUM_MARGIN,
    TRANSMITTANCE_MIN,
    ActivatedGaussians,
    ColorMap,
    Crop,
    RasterInfo,
    RasterView,
)

TILE = 16


@dataclass(frozen=True)
class ReferenceSplats:
    """V Gaussians visible in a window, nearest first."""

    __eq__ = equal_fields

    rows: Tensor  # indices of the Gaussians. [V] int64
    means2d: Tensor  # centers in pixels. [V,2]
    whitening: Tensor  # L with σ = ½|Lᵀd|² for a pixel offset d: l11, l21, l22. [V,3]
    opacities: Tensor  # activated, with antialiasing. [V]
    colors: Tensor  # rgb. [V,3]
    extents: Tensor  # half sides of the box around {alpha ≥ 1/255}, pixels. [V,2]


def rasterize(
    gaussians: ActivatedGaussians, view: RasterView, background: Tensor, grad_rows: Tensor | None
) -> tuple[Tensor, Tensor, RasterInfo]:
    """Draw an image, see `progdf.rasterize.render`.

    Computed in the type of `means`, projection in float64.
    """
    splats, info = project(of_rows(gaussians, grad_rows), view)
    image, transmittance = blend(splats, view.crop, background)
    return image, transmittance, info


def of_rows(gaussians: ActivatedGaussians, rows: Tensor | None) -> ActivatedGaussians:
    """Return the Gaussians with gradients for these rows only; None keeps all gradients."""
    if rows is None:
        return gaussians
    return gaussians.each(lambda tensor: tensor.detach().index_copy(0, rows, tensor[rows]))


def color_map(
    gaussians: ActivatedGaussians, view: RasterView, rows: Tensor, pixels: Tensor | None, lost: float
) -> ColorMap:
    """Return a color map, see `progdf.rasterize.engines.color_map`. No weight is omitted."""
    with torch.no_grad():
        splats, _ = project(gaussians, view)
    black = splats.colors.new_zeros(3)
    count = len(gaussians.means)
    return DrawnColors(splats, rows, count, pixels, lambda some: blend(some, view.crop, black)[0])


@dataclass(frozen=True)
class DrawnColors:
    """Color map that draws its splats again at each call."""

    __eq__ = equal_fields

    splats: ReferenceSplats
    rows: Tensor  # rows of the colored Gaussians, all others are black. [M] int64
    count: int  # number of Gaussians N
    pixels: Tensor | None  # selected pixels of the window; None selects all. [P] int64
    draw: Callable[[ReferenceSplats], Tensor]  # on black, differentiable in the splats' colors. -> [h,w,3]

    def picture(self, colors: Tensor) -> Tensor:
        """Draw an image, see `ColorMap`."""
        channels = colors.shape[1]
        threes = torch.nn.functional.pad(colors, (0, -channels % 3))
        every = threes.new_zeros(self.count, threes.shape[1]).index_copy(0, self.rows, threes)
        drawn: tuple[Tensor, ...] = torch.split(every[self.splats.rows].to(self.splats.colors), 3, dim=1)
        images = [self.draw(replace(self.splats, colors=part)) for part in drawn]
        image = torch.cat(images, dim=2)[..., :channels]
        return image if self.pixels is None else image.flatten(0, 1)[self.pixels]

    def gradient(self, image: Tensor) -> Tensor:
        """Return the gradient of the colors, see `ColorMap`."""
        colors = image.new_zeros(len(self.rows), 3, requires_grad=True)
        with torch.enable_grad():
            return torch.autograd.grad(self.picture(colors), colors, image)[0]


def blend(splats: ReferenceSplats, crop: Crop, background: Tensor) -> tuple[Tensor, Tensor]:
    """Blend projected Gaussians tile by tile, front to back.

    Returns:
        Image [h,w,3] and transmittance [h,w] of the window, in the splats' type.
    """
    x0, y0, x1, y1 = crop
    left = x0 // TILE * TILE
    top = y0 // TILE * TILE
    bands = []
    for y in range(top, y1, TILE):
        tiles = []
        for x in range(left, x1, TILE):
            _, weights, transmittance, members = tile_weights(splats, x, y)
            rgb = weights @ splats.colors[members]
            tiles.append(torch.cat([rgb, transmittance[:, None]], dim=1).reshape(TILE, TILE, 4))
        bands.append(torch.cat(tiles, dim=1))
    window = torch.cat(bands, dim=0)[y0 - top : y1 - top, x0 - left : x1 - left]
    transmittance = window[..., 3]
    return window[..., :3] + transmittance[..., None] * background.to(window), transmittance


def project(gaussians: ActivatedGaussians, view: RasterView) -> tuple[ReferenceSplats, RasterInfo]:
    """Project, cull and sort the Gaussians of a view."""
    dtype = gaussians.means.dtype
    dilation = view.dilation
    sh_degree = view.sh_degree
    means, quats, scales, opacities, colors, viewmat, K = (
        tensor.double() for tensor in (*gaussians.tensors, view.viewmat, view.K)
    )
    used = colors if sh_degree is None else colors[:, : (sh_degree + 1) ** 2]
    usable = means.isfinite().all(1) & scales.isfinite().all(1)
    usable = usable & opacities.isfinite() & (opacities >= ALPHA_MIN)
    colored = used.isfinite().flatten(1).all(1)
    quats = torch.where(quats.isfinite().all(1, keepdim=True), quats, quats.new_tensor([1.0, 0.0, 0.0, 0.0]))
    rotation = viewmat[:3, :3]
    translation = viewmat[:3, 3]
    rows = usable.nonzero()[:, 0]
    points = means[rows] @ rotation.T + translation
    front = points[:, 2] > view.near
    rows = rows[front]
    x, y, z = points[front].unbind(1)
    fx = K[0, 0]
    fy = K[1, 1]
    cx = K[0, 2]
    cy = K[1, 2]
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=1)

    a, b, c, det0 = covariances(points[front], normalize_quats(quats[rows]), scales[rows], view)
    det = det0 + dilation * (a + c) + dilation**2
    opacity = opacities[rows]
    if view.antialiased:
        opacity = opacity * (det0 / det).clamp_min(ANTIALIAS_FLOOR).sqrt()
    whitening = torch.stack(
        [((c + dilation) / det).sqrt(), -b / (det * (c + dilation)).sqrt(), (c + dilation).rsqrt()], dim=1
    )

    radius = (2.0 * torch.log(opacity.detach() / ALPHA_MIN).clamp_min(0.0)).sqrt()
    extents = radius[:, None] * torch.stack([a + dilation, c + dilation], dim=1).detach().sqrt()
    low = (means2d - extents).detach()
    high = (means2d + extents).detach()
    x0, y0, x1, y1 = view.crop
    inside = (high[:, 0] >= x0) & (low[:, 0] <= x1) & (high[:, 1] >= y0) & (low[:, 1] <= y1)
    inside = inside & (opacity.detach() >= ALPHA_MIN) & colored[rows]
    depths = torch.zeros_like(opacities).index_copy(0, rows, z).detach().float()
    # float32 depth, ties by index: sortable by viewers and the same in every engine
    order = z.detach().float().argsort(stable=True)
    order = order[inside[order]]
    if sh_degree is None:
        rgb = colors[rows[order]]
    else:
        eye = -rotation.T @ translation
        direction = torch.nn.functional.normalize(means[rows[order]] - eye, dim=1, eps=1e-300)
        rgb = shade(sh_degree, direction, colors[rows[order]])
    splats = ReferenceSplats(
        rows[order],
        means2d[order].to(dtype),
        whitening[order].to(dtype),
        opacity[order].to(dtype),
        rgb.to(dtype),
        extents[order].to(dtype),
    )
    visible = torch.zeros_like(usable).index_fill(0, splats.rows, True)
    centers = torch.zeros_like(means[:, :2]).index_copy(0, rows, means2d).detach().float()
    return splats, RasterInfo(centers, depths, visible)


def tile_weights(splats: ReferenceSplats, x: int, y: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the alphas and blending weights of one 16x16 tile whose first pixel is (x, y).

    Returns:
        Alphas, 0 for Gaussians that do not contribute [256,n]; weights αT [256,n]; final transmittance [256];
        the n rows of `splats` that may touch the tile, nearest first [n] int64.
    """
    low = splats.means2d - splats.extents
    high = splats.means2d + splats.extents
    near_x = (high[:, 0] >= x) & (low[:, 0] <= x + TILE)
    near_y = (high[:, 1] >= y) & (low[:, 1] <= y + TILE)
    members = (near_x & near_y).nonzero()[:, 0]
    center = splats.means2d.new_ones(TILE).cumsum(0) - 0.5
    pixels = torch.cartesian_prod(y + center, x + center).flip(1)
    dx, dy = (pixels[:, None] - splats.means2d[members]).unbind(2)
    l11, l21, l22 = splats.whitening[members].unbind(1)
    raw = splats.opacities[members] * torch.exp(-0.5 * ((l11 * dx + l21 * dy).square() + (l22 * dy).square()))
    alphas = torch.where(raw >= ALPHA_MIN, raw.clamp_max(ALPHA_MAX), 0.0)
    after = torch.cumprod(1.0 - alphas, dim=1)
    # this omits all later Gaussians too: `after` only decreases
    alphas = torch.where(after > TRANSMITTANCE_MIN, alphas, 0.0)
    after = torch.cumprod(1.0 - alphas, dim=1)
    before = torch.cat([after.new_ones(len(after), 1), after], dim=1)
    return alphas, alphas * before[:, :-1], before[:, -1], members


def alpha_weights(gaussians: ActivatedGaussians, view: RasterView, mask: Tensor) -> Tensor:
    """Sum blending weights, see `progdf.rasterize.alpha_weights`."""
    means = gaussians.means
    width = view.width
    height = view.height
    splats, _ = project(gaussians, view)
    # two channels, zero beyond the edge of the image: the mask, and 1 inside the image
    mask = mask.to(means)
    inside = torch.stack([mask, torch.ones_like(mask)])
    inside = torch.nn.functional.pad(inside, (0, -width % TILE, 0, -height % TILE))
    totals = means.new_zeros(len(means), 4)
    for y in range(0, height, TILE):
        for x in range(0, width, TILE):
            alphas, weights, _, members = tile_weights(splats, x, y)
            tile = inside[:, y : y + TILE, x : x + TILE].reshape(2, -1)
            covered = (alphas > 0).to(means.dtype)
            sums = torch.stack(
                [tile[0] @ weights, tile[0] @ covered, tile[1] @ weights, tile[1] @ covered], dim=1
            )
            totals.index_add_(0, splats.rows[members], sums)
    return totals


def covariances(
    points: Tensor, unit_quats: Tensor, scales: Tensor, view: RasterView
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return covariances [[a, b], [b, c]] in pixels before dilation, and their determinants. All float64.

    Args:
        points: centers, camera coordinates. [V,3]
    """
    rotation = view.viewmat[:3, :3].double()
    K = view.K.double()
    fx = K[0, 0]
    fy = K[1, 1]
    cx = K[0, 2]
    cy = K[1, 2]
    x, y, z = points.unbind(1)
    # clamp like the original (Kerbl 2023, computeCov2D): off-screen Gaussians would blow up the Jacobian
    margin_x = FRUSTUM_MARGIN * 0.5 * view.width / fx
    margin_y = FRUSTUM_MARGIN * 0.5 * view.height / fy
    tan_x = torch.clamp(x / z, -(cx / fx + margin_x), (view.width - cx) / fx + margin_x)
    tan_y = torch.clamp(y / z, -(cy / fy + margin_y), (view.height - cy) / fy + margin_y)
    axes = rotation_matrices(unit_quats) * scales[:, None, :]
    p0 = ((fx / z)[:, None] * (rotation[0] - tan_x[:, None] * rotation[2]))[:, None] @ axes
    p1 = ((fy / z)[:, None] * (rotation[1] - tan_y[:, None] * rotation[2]))[:, None] @ axes
    p0 = p0[:, 0]
    p1 = p1[:, 0]
    a = (p0 * p0).sum(1)
    b = (p0 * p1).sum(1)
    c = (p1 * p1).sum(1)
    # ac − b² cancels for needles; the cross product does not
    det0 = torch.linalg.cross(p0, p1).square().sum(1)
    return a, b, c, det0
