"""Fast rendering of one view's box with changed member rows.

An edit changes only the members of a region. Each view is prepared once: the Gaussians visible in its box,
their activated values, and their colors from this camera. A training step then costs only the members and the
box.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import ATTRIBUTES, BASE_CHANNELS, Gaussians, attribute_slices, pack, unpack
from progdf.rasterize import ActivatedGaussians, Crop, activate, render
from progdf.rasterize.cpu.engine import Array, rasterize_listed
from progdf.rasterize.cpu.forward import TILE_H, TILE_W
from progdf.rasterize.cpu.jit import kernel
from progdf.rasterize.engines import DILATION, ColorMap, RasterView, color_map
from progdf.sh import basis
from progdf.system.equality import equal_fields
from progdf.threads import map_threads, threads

from .view import seen_colors

_SUPPORT = 2 * 5.55
"""Largest squared Mahalanobis distance with alpha ≥ 1/255: 2 ln 255, rounded up."""


def live_tiles(contributes: Tensor, box: Crop) -> Tensor:
    """Return the tiles in which some pixel of a box is set, on the tile grid of the full image.

    Args:
        contributes: pixels of the box. [h,w] bool
        box: x0, y0, x1, y1 in the full image

    Returns:
        Tiles from the image's top left to the box's bottom right. [rows, columns] bool
    """
    x0, y0, x1, y1 = box
    rows = -(-y1 // TILE_H)
    columns = -(-x1 // TILE_W)
    tiles = contributes.new_zeros(rows * TILE_H, columns * TILE_W)
    tiles[y0:y1, x0:x1] = contributes
    return tiles.view(rows, TILE_H, columns, TILE_W).any(dim=3).any(dim=1)


def live_pixels(live: Tensor, box: Crop) -> Tensor:
    """Return the pixels of a box that lie in live tiles. [rows, columns] bool -> [h,w] bool"""
    x0, y0, x1, y1 = box
    return live.repeat_interleave(TILE_H, dim=0).repeat_interleave(TILE_W, dim=1)[y0:y1, x0:x1]


def may_reach(means: Tensor, scales: Tensor, camera: Camera, live: Tensor) -> Tensor:
    """Return the Gaussians that may reach into a live tile; a conservative superset.

    The bound on a projected axis is the largest axis times the Jacobian of the projection, taken where the
    rasterizer takes it (Kerbl 2023 clamps the position to 1.3 times the field of view).

    Args:
        means, scales: activated. [n,3], [n,3]
        camera: the whole view
        live: as from `live_tiles`

    Returns:
        [n] bool
    """
    camera_means = means.double() @ camera.viewmat[:3, :3].T.double() + camera.viewmat[:3, 3].double()
    z = camera_means[:, 2].clamp_min(camera.near)
    K = camera.K.double()
    focal = torch.stack([K[0, 0], K[1, 1]])
    size = K.new_tensor([camera.width, camera.height])
    slope = camera_means[:, :2] / z[:, None]
    center = slope * focal + K[:2, 2]
    # at least as far out as the rasterizer's clamp, at 0.15 of the picture beyond each edge
    max_slope = torch.maximum(K[:2, 2], size - K[:2, 2]) / focal + 0.2 * size / focal
    stretch = 1 + slope.abs().minimum(max_slope).square().sum(dim=1)
    variance = (
        scales.double().amax(dim=1) * focal.max() / z
    ).square() * stretch + DILATION / camera.sampling**2
    radius = (_SUPPORT * variance).sqrt() + 1.0
    rows, columns = live.shape
    step = K.new_tensor([TILE_W, TILE_H])
    last = K.new_tensor([columns, rows])
    low = ((center - radius[:, None]) / step).floor().clamp(min=0).minimum(last).nan_to_num(0.0).long()
    high = ((center + radius[:, None]) / step).floor().clamp(min=-1).minimum(last - 1).nan_to_num(
        0.0
    ).long() + 1
    sums = live.new_zeros(rows + 1, columns + 1, dtype=torch.int64)
    sums[1:, 1:] = live.long().cumsum(0).cumsum(1)
    (left, top), (right, bottom) = low.unbind(1), high.unbind(1)
    counts = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    return counts > 0


@dataclass(frozen=True)
class CropScene:
    """Content of one view's box, prepared for rendering with other member rows."""

    __eq__ = equal_fields

    camera: Camera  # the whole view
    box: Crop  # the pixels that are rendered
    scene: Gaussians  # the original
    index: Tensor  # rows of the n Gaussians of the box in the scene, ascending. [n] int64
    rows: Tensor  # indices of the members among them, in the region's order. [M] int64
    background: Tensor  # rgb. [3]
    original: Tensor  # the unedited picture, not clamped. [h,w,3]
    live: Tensor | None = None  # pixels to draw, others are the original's; None: all. [h,w,1] bool
    still: bool = False  # only the members' colors may differ from the original's
    engine: str = "cpu"  # rasterizer, on the device of the Gaussians
    weight_map: ColorMap | None = None  # weights of a still view's members; None: made on first use

    @cached_property
    def gaussians(self) -> ActivatedGaussians:
        """The Gaussians of the box with their colors from this camera; members have the original's values."""
        colors = seen_colors(self.scene[self.index], self.camera)
        return self._shapes()._replace(colors=colors)

    @property
    def members(self) -> Tensor:
        """Rows of the members in the scene. [M] int64"""
        return self.index[self.rows]

    @cached_property
    def higher_bands(self) -> Tensor:
        """Higher SH bands of the members in the original. [M,K,3]"""
        return self.scene.shN[self.members]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the box in pixels."""
        return self.box[3] - self.box[1], self.box[2] - self.box[0]

    def render(self, packed: Tensor, moving: Collection[str] = ATTRIBUTES) -> Tensor:
        """Render the box with these raw values in the region's rows, differentiable in them.

        Args:
            packed: member rows from `gaussians.pack`, on any device. [M,14] or [M,14+3K]
            moving: attributes whose values differ from the original's; the others are ignored

        Returns:
            The image, 0 to 1 (see `clamp_towards`). [h,w,3]
        """
        if self.still and not (packed.requires_grad and torch.is_grad_enabled()):
            return self.draw_colors(self.still_colors(packed))
        members = self._unpack(packed)
        new = {"colors": self._member_colors(members)}
        if "means" in moving:
            new["means"] = members.means
        if "quats" in moving:
            new["quats"] = members.quats
        if "log_scales" in moving:
            new["scales"] = members.scales
        if "logit_opacities" in moving:
            new["opacities"] = members.opacities
        gaussians = self.with_members(new)
        rows = self.rows
        output = render(
            gaussians, self.camera, self.background, crop=self.box, grad_rows=rows, engine=self.engine
        )
        return self._limit(output.image)

    def draw_colors(self, colors: Tensor) -> Tensor:
        """Render the box of a still view with these colors of the members, at least 0. [M,3] -> [h,w,3]"""
        weight_map, remainder = self._linear
        return self._limit(remainder + weight_map.picture(colors))

    def _shapes(self) -> ActivatedGaussians:
        """Return the box's Gaussians in black.

        The whole scene is activated, as the exponentials of a few rows can differ in their last bits.
        """
        return activate(self.scene, torch.zeros_like(self.scene.means)).select(self.index)

    def _unpack(self, packed: Tensor) -> Gaussians:
        """Return the members of packed rows, with the original's higher bands if the rows hold none."""
        rows = packed.to(self.background.device)
        unused = self.scene.shN[:0]
        return unpack(rows, self.higher_bands if rows.shape[1] == BASE_CHANNELS else unused)

    def _limit(self, image: Tensor) -> Tensor:
        """Return an image with the original's pixels where no member is drawn, 0 to 1. [h,w,3]"""
        if self.live is not None:
            image = torch.where(self.live, image, self.original)
        return clamp_towards(image, 0.0, 1.0)

    def _member_colors(self, members: Gaussians) -> Tensor:
        """Return the members' drawn colors, at least 0, differentiable. [M,3]"""
        weights = self._still_weights if self.still else self._weights(members.means)
        return clamp_towards((weights * members.sh[:, : weights.shape[1]]).sum(dim=1) + 0.5, 0.0, math.inf)

    def still_colors(self, packed: Tensor) -> Tensor:
        """Return `_member_colors` of a still view without gradients. [M,14] or [M,14+3K] -> [M,3]

        On the CPU one pass over the rows replaces products of the size of all SH coefficients.
        """
        if self.background.device.type != "cpu":
            return self._member_colors(self._unpack(packed))
        weights = self._still_weights[..., 0]
        colors = np.full((len(packed), 3), 0.5, np.float32)
        if packed.shape[1] == BASE_CHANNELS:
            _add_bands(weights[:, 1:].numpy(), self.higher_bands.flatten(1).numpy(), 0, colors)
            weights = weights[:, :1]
        rows = packed.detach().contiguous().float().numpy()
        _add_bands(weights.numpy(), rows, BASE_CHANNELS - 3, colors)
        return torch.from_numpy(np.maximum(colors, 0.0, out=colors))

    def change(self, bands: Tensor, shown: Tensor | None = None) -> Tensor:
        """Return the change of a still view on the CPU by changes of the members' lowest SH functions.

        It is linear: the limits at black and white are left out.

        Args:
            bands: changes. [M,b,3]
            shown: channels of the members that can change; None: all. [M,3] bool

        Returns:
            [h,w,3]
        """
        weights = self._still_weights[:, : bands.shape[1], 0].contiguous()
        colors = np.zeros((len(bands), 3), np.float32)
        _add_bands(weights.numpy(), bands.flatten(1).contiguous().numpy(), 0, colors)
        if shown is not None:
            colors *= shown.numpy()
        return self._linear[0].picture(torch.from_numpy(colors))

    def visible_members(self, pixels: Tensor) -> Tensor:
        """Return the members with a weight in some of these pixels of a still view. [h,w] bool -> [M] bool"""
        chosen = pixels[..., None].to(self.original).expand_as(self.original)
        return self._linear[0].gradient(chosen.contiguous())[:, 0] > 0.0

    def take(self, members: Tensor) -> CropScene:
        """Return the view for some of its members; the others keep the original's values. [m] int64"""
        return replace(self, rows=self.rows[members], weight_map=None)

    def _weights(self, means: Tensor) -> Tensor:
        """Return the weight of each SH band in the members' colors from this camera. [M,3] -> [M,B,1]

        Directions are constants, as their share of the means' gradient is small and mostly noise.
        """
        directions = torch.nn.functional.normalize(means.detach() - self.camera.position, dim=1)
        return basis(min(self.scene.sh_degree, 3), directions)[..., None]

    @cached_property
    def _still_weights(self) -> Tensor:
        return self._weights(self.scene.means[self.members])

    @cached_property
    def _linear(self) -> tuple[ColorMap, Tensor]:
        """Linear model for constant geometry: each member's weight in each pixel, and the image of all other
        Gaussians."""
        weight_map = self.weight_map
        if weight_map is None:
            weight_map = color_map(self._shapes(), self.camera, self.box, self.rows, self.engine)
        colors = self.still_colors(pack(self.scene[self.members], with_shN=True))
        return weight_map, self.original - weight_map.picture(colors)

    def with_members(self, new: Mapping[str, Tensor]) -> ActivatedGaussians:
        """Return the box's Gaussians with other activated values of the members, by name. [M,...] each"""
        old = self.gaussians._asdict()
        return self.gaussians._replace(
            **{name: old[name].index_copy(0, self.rows, values) for name, values in new.items()}
        )


@kernel(cache=True)
def _add_bands(weights: Array, rows: Array, first: int, colors: Array) -> None:
    """Add Σ weight · coefficient to the colors. weights: [M,B]; rows: [M,C] float32; colors: [M,3] float32

    `first`: column of the first coefficient; B times three follow, the channels of a function together
    """
    for m in range(len(colors)):
        red = colors[m, 0]
        green = colors[m, 1]
        blue = colors[m, 2]
        column = first
        for b in range(weights.shape[1]):
            weight = weights[m, b]
            red += weight * rows[m, column]
            green += weight * rows[m, column + 1]
            blue += weight * rows[m, column + 2]
            column += 3
        colors[m, 0] = red
        colors[m, 1] = green
        colors[m, 2] = blue


GEOMETRY = ("means", "quats", "log_scales", "logit_opacities")
"""Attributes that determine the pixels of a Gaussian."""


def crop_scene(
    scene: Gaussians,
    members: Tensor,
    camera: Camera,
    box: Crop,
    background: Tensor,
    still: bool = False,
    engine: str = "cpu",
) -> CropScene:
    """Prepare one view, on the device of the scene.

    Args:
        scene: the original
        members: rows of the region. [M] int64
        camera: the whole view
        box: the pixels to render
        background: rgb. [3]
        still: only colors will change. Then only tiles with members are drawn (`live_tiles`), and renders
            without gradients use a linear map of the members' colors
        engine: rasterizer
    """
    device = scene.means.device
    members = members.to(device)
    camera = camera.to(device)
    background = background.to(device)
    activated = activate(scene)
    member = torch.zeros_like(activated.opacities, dtype=torch.bool).index_fill(0, members, True)
    weight_map: ColorMap | None = None
    if still and engine == "cpu":
        window = RasterView.of(camera, activated, box)
        original, visible, weight_map = rasterize_listed(activated, window, background, members, None, 0.0)
    else:
        original, _, info = render(activated, camera, background, crop=box, engine=engine)
        visible = info.visible
    # members outside the box may move into it
    index = (visible | member).nonzero()[:, 0]
    live = None
    if still:
        weight_map = weight_map or color_map(activated, camera, box, members, engine)
        share = weight_map.picture(torch.ones_like(activated.means[members]))
        tiles = live_tiles(share[..., 0] > 0.0, box)
        pixels = live_pixels(tiles, box)
        if not bool(pixels.all()):
            reachable = may_reach(activated.means[index], activated.scales[index], camera, tiles)
            live = pixels[..., None]
            index = index[reachable | member[index]]
    return CropScene(
        camera,
        box,
        scene,
        index,
        rows=torch.searchsorted(index, members),
        background=background,
        original=original,
        live=live,
        still=still,
        engine=engine,
        weight_map=weight_map,
    )


def render_all(
    crops: Sequence[CropScene], packed: Tensor, moving: Collection[str] = ATTRIBUTES
) -> list[Tensor]:
    """Render every prepared view with these member rows, without gradients. [M,C] -> images [h,w,3]"""
    with torch.no_grad():
        if len(crops) > 1 and threads() > 1 and all(crop.still for crop in crops):
            # detach, as no_grad does not extend to the threads of the pool
            return map_threads(lambda crop: crop.render(packed, moving).detach(), crops)
        return [crop.render(packed, moving) for crop in crops]


def only_recolors(offsets: Tensor) -> bool:
    """Return True if only colors change. [...,14] or [...,14+3K]"""
    slices = attribute_slices(offsets.shape[-1])
    return not any(bool(offsets[..., slices[name]].any()) for name in GEOMETRY)


def moving_attributes(offsets: Tensor) -> list[str]:
    """Return the attributes that these offsets [M,14] or [M,14+3K] change."""
    slices = attribute_slices(offsets.shape[1])
    return [name for name, columns in slices.items() if bool(offsets[:, columns].any())]


class _ClampTowards(torch.autograd.Function):
    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, x: Tensor, low: float, high: float) -> Tensor:
        ctx.save_for_backward(x)
        ctx.bounds = (low, high)  # type: ignore[attr-defined]
        return x.clamp(low, high)

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, gradient: Tensor) -> tuple[Tensor, None, None]:
        (x,) = ctx.saved_tensors  # type: ignore[attr-defined]
        low, high = ctx.bounds  # type: ignore[attr-defined]
        # descent moves x against the gradient, so below the range a negative gradient moves it back
        inward = ((x >= low) | (gradient < 0)) & ((x <= high) | (gradient > 0))
        return gradient * inward, None, None


def clamp_towards(x: Tensor, low: float, high: float) -> Tensor:
    """Return `x.clamp(low, high)` with a gradient that also passes if descent would move x back into the
    range.

    A sixth of a trained scene's colors have a channel below 0. With the plain clamp they could never change
    (docs/lab/experiments.md, Rates and steps).
    """
    clamped: Tensor = _ClampTowards.apply(x, low, high)  # type: ignore[no-untyped-call]
    return clamped
