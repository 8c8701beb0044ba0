"""Rendering one view's box of the scene with other values in the region's rows, and nothing more than that.

An edit changes the members of a region only, so a view is prepared once: the Gaussians that its box can
show, their activated values, the colors seen from there. What a training step pays for is the members and
the box.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import ATTRIBUTES, Gaussians, attribute_slices, unpack
from progdf.rasterize import Crop, rasterize
from progdf.rasterize.color_maps import ColorMap, color_map
from progdf.rasterize.cpu.parallel import threads
from progdf.sh import C0, basis

from .clamp import clamp_towards
from .tiles import live_pixels, live_tiles, may_reach
from .view import seen_colors


@dataclass(frozen=True)
class CropScene:
    """What one view's box can show, ready to be rendered with other member rows.

    Args:
        camera: the whole view
        box: the pixels that are rendered
        means, quats, scales, opacities, colors: activated values of the n Gaussians of the box, colors
            as seen from this camera; members hold the original's values. [n,3], [n,4], [n,3], [n], [n,3]
        rows: where the members are among them, in the region's order. [M] int64
        member_shN: higher SH bands of the members in the original. [M,K,3]
        background: what shows through. [3]
        antialiased: see `Gaussians`
        cached: pixels that are drawn [h,w,1] bool, and the original picture [h,w,3], which the others are;
            None where all are drawn
        still: nothing but the members' colors ever differs
    """

    camera: Camera
    box: Crop
    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    rows: Tensor
    member_shN: Tensor
    background: Tensor
    antialiased: bool = False
    cached: tuple[Tensor, Tensor] | None = None
    still: bool = False

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the box in pixels."""
        return self.box[3] - self.box[1], self.box[2] - self.box[0]

    def original(self) -> Tensor:
        """The box of the unedited view, not clamped. [h,w,3]"""
        image, _ = self._draw(self.means, self.quats, self.scales, self.opacities, self.colors)
        return image

    def render(self, packed: Tensor, moving: Collection[str] = ATTRIBUTES) -> tuple[Tensor, Tensor]:
        """The box with these raw values in the region's rows, differentiable in them.

        Args:
            packed: member rows as `gaussians.pack` gives them. [M,14] or [M,14+3K]
            moving: attributes whose values differ from the original's; the others are not looked at

        Returns:
            image [h,w,3], 0..1 with the clamp's gradient kept where it points inwards; transmittance [h,w]
        """
        members = unpack(packed, self.member_shN)
        colors = member_colors(members, self.camera.position)

        def put(values: Tensor, into: Tensor) -> Tensor:
            return into.index_copy(0, self.rows, values)

        if self.still and not colors.requires_grad:
            weighed, others, transmittance = self._linear
            image = others + weighed.picture(colors)
        else:
            image, transmittance = self._draw(
                put(members.means, self.means) if "means" in moving else self.means,
                put(members.quats, self.quats) if "quats" in moving else self.quats,
                put(members.scales, self.scales) if "log_scales" in moving else self.scales,
                put(members.opacities, self.opacities) if "logit_opacities" in moving else self.opacities,
                put(colors, self.colors),
            )
        if self.cached is not None:
            live, original = self.cached
            image = torch.where(live, image, original)
        return clamp_towards(image, 0.0, 1.0), transmittance

    @cached_property
    def _linear(self) -> tuple[ColorMap, Tensor, Tensor]:
        """While nothing moves: what each member weighs in each pixel, what all others show, transmittance."""
        camera = self.camera
        weighed = color_map(
            self.means,
            self.quats,
            self.scales,
            self.opacities,
            camera.viewmat,
            camera.K,
            camera.width,
            camera.height,
            camera.near,
            self.box,
            self.rows,
            self.antialiased,
        )
        image, transmittance = self._draw(self.means, self.quats, self.scales, self.opacities, self.colors)
        return weighed, image - weighed.picture(self.colors[self.rows]), transmittance

    def _draw(
        self, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor
    ) -> tuple[Tensor, Tensor]:
        camera = self.camera
        image, transmittance, _ = rasterize(
            means,
            quats,
            scales,
            opacities,
            colors,
            camera.viewmat,
            camera.K,
            camera.width,
            camera.height,
            background=self.background,
            near=camera.near,
            antialiased=self.antialiased,
            crop=self.box,
            grad_rows=self.rows,
        )
        return image, transmittance


GEOMETRY = ("means", "quats", "log_scales", "logit_opacities")
"""Attributes that decide which pixels a Gaussian contributes to."""

COLORS = ("sh0", "shN")
"""The others."""


def member_colors(members: Gaussians, eye: Tensor) -> Tensor:
    """SH colors seen from `eye`; a channel clamped at 0 keeps the gradient that would raise it. [M,3]

    Directions are constants here: their share of the means' gradient is small and mostly noise.
    """
    degree = min(members.sh_degree, 3)
    if degree == 0:
        return clamp_towards(members.sh0 * C0 + 0.5, 0.0, float("inf"))
    directions = torch.nn.functional.normalize(members.means.detach() - eye, dim=1)
    weights = basis(degree, directions)
    raw = (weights[..., None] * members.sh[:, : weights.shape[1]]).sum(dim=1) + 0.5
    return clamp_towards(raw, 0.0, float("inf"))


def crop_scene(
    scene: Gaussians,
    members: Tensor,
    camera: Camera,
    box: Crop,
    background: Tensor,
    still: bool = False,
) -> CropScene:
    """Prepare one view.

    Args:
        scene: the original
        members: rows of the region. [M] int64
        camera: the whole view
        box: the pixels that are rendered
        background: rgb. [3]
        still: nothing but colors will move, so only the tiles that show a member are drawn, see `tiles`, and
            without gradients a linear map of the members' colors; transmittance is right in these only
    """
    colors = seen_colors(scene, camera)
    _, _, seen = rasterize(
        scene.means,
        scene.quats,
        scene.scales,
        scene.opacities,
        colors,
        camera.viewmat,
        camera.K,
        camera.width,
        camera.height,
        background=background,
        near=camera.near,
        antialiased=scene.antialiased,
        crop=box,
    )
    kept = seen.visible.clone()
    kept[members] = True  # a member that is out of sight now may come into it
    index = kept.nonzero()[:, 0]
    whole = CropScene(
        camera,
        box,
        scene.means[index],
        scene.quats[index],
        scene.scales[index],
        scene.opacities[index],
        colors[index],
        torch.searchsorted(index, members),
        scene.shN[members],
        background,
        scene.antialiased,
    )
    return _keep_live_tiles(replace(whole, still=True)) if still else whole


def _keep_live_tiles(view: CropScene) -> CropScene:
    """The view with all that no member contributes to taken from the original picture."""
    member = torch.zeros_like(view.opacities)
    member[view.rows] = 1.0
    share, _ = replace(view, background=torch.zeros(3))._draw(
        view.means, view.quats, view.scales, view.opacities, member[:, None].expand(-1, 3).contiguous()
    )
    live = live_tiles((share > 0).any(dim=2), view.box)
    if bool(live_pixels(live, view.box).all()):
        return view
    kept = may_reach(view.means, view.scales, view.camera, live)
    kept[view.rows] = True
    index = kept.nonzero()[:, 0]
    return replace(
        view,
        means=view.means[index],
        quats=view.quats[index],
        scales=view.scales[index],
        opacities=view.opacities[index],
        colors=view.colors[index],
        rows=torch.searchsorted(index, view.rows),
        cached=(live_pixels(live, view.box)[..., None], view.original()),
    )


def render_all(
    crops: Sequence[CropScene], packed: Tensor, moving: Collection[str] = ATTRIBUTES
) -> list[Tensor]:
    """Every prepared view with these member rows, without gradients. [M,C] -> images [h,w,3]"""
    with torch.no_grad():
        if len(crops) > 1 and threads() > 1 and all(crop.still for crop in crops):
            with ThreadPoolExecutor(threads()) as pool:  # the maps work on one thread each
                return list(pool.map(lambda crop: crop.render(packed, moving)[0].detach(), crops))
        return [crop.render(packed, moving)[0] for crop in crops]


def only_recolors(offsets: Tensor) -> bool:
    """Whether nothing but colors ever moves. [...,14] or [...,14+3K]"""
    slices = attribute_slices(offsets.shape[-1])
    return not any(bool(offsets[..., slices[name]].any()) for name in GEOMETRY)


def moving_attributes(offsets: Tensor, among: Collection[str] = ATTRIBUTES) -> list[str]:
    """The attributes (`among` these) that these offsets [M,14] or [M,14+3K] move at all."""
    slices = attribute_slices(offsets.shape[1])
    return [name for name, columns in slices.items() if name in among and bool(offsets[:, columns].any())]
