"""Evaluation of an edit on held-out views, over the region's own pixels.

In a whole picture of which the region is 3 %, every figure would look too good. Errors are therefore measured
over the pixels that show the region or that the edit changes (docs/method.md 7).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.field import BakedField
from progdf.field.choose import Field
from progdf.gaussians import Gaussians, pack
from progdf.metrics.image import decibels, edge_weights, ssim
from progdf.metrics.slider import Pictures
from progdf.region import Region
from progdf.system.equality import equal_fields
from trainer.optimize.losses import Perceptual
from trainer.views.choose import split_held_out
from trainer.views.crops import CropScene, crop_scene, moving_attributes, render_all
from trainer.views.view import View, crop

from .still_path import still_path

PACKING_MEMBERS = 20_000
"""Number of members up to which a packing is chosen on all of them, and of members in a sample."""

_SQUARE_PX = 8  # side of a sampled square, pixels
_MIN_SHARE = 1 / 64  # smallest sampled share of the squares


@dataclass(frozen=True)
class Evaluator:
    """Held-out views prepared for comparison."""

    __eq__ = equal_fields

    original: Tensor  # raw member rows, packed. [M,C]
    crops: Sequence[CropScene]  # boxes of the views, with the scene around the region
    pixels: Sequence[Tensor]  # masks of the evaluated pixels. [h,w] bool each
    edited: Mapping[float, Sequence[Tensor]]  # strength → the editor's pictures of the boxes
    names: Sequence[str]  # names of the views
    looked: Callable[[], None] | None = None  # called at every render of all views, for a progress bar

    def pictures(self, offsets: Tensor) -> list[Tensor]:
        """Render every view with these offsets. [M,C] -> [h,w,3] each"""
        if not len(offsets):  # a field that moves nothing stores no number of members
            offsets = torch.zeros_like(self.original)
        if self.looked is not None:
            self.looked()
        rows = self.original[:, : offsets.shape[1]] + offsets
        is_still = all(crop.still for crop in self.crops)
        return render_all(self.crops, rows, () if is_still else moving_attributes(offsets))

    def course(self, field: Field) -> Pictures:
        """Return a function that renders every view at a slider value of a field.

        It is fastest at ascending values, see `StillPath`.
        """
        path = still_path(self.crops, self.original, field) if isinstance(field, BakedField) else None
        if path is None:
            return lambda s: self.pictures(field.offsets(s))

        def pictures(s: float) -> list[Tensor]:
            if self.looked is not None:
                self.looked()
            return path(s)

        return pictures

    def picture(self, offsets: Tensor, view: int) -> Tensor:
        """Render one view with these offsets. [M,C] -> [h,w,3]"""
        return replace(self, crops=[self.crops[view]]).pictures(offsets)[0]

    def psnr(self, pictures: Sequence[Tensor], expected: Sequence[Tensor]) -> float:
        """Return the PSNR over the evaluated pixels of all views, dB; 99 if nothing differs."""
        return decibels(self.mse(pictures, expected))

    def mse(self, pictures: Sequence[Tensor], expected: Sequence[Tensor]) -> float:
        """Return the mean squared error over the evaluated pixels of all views."""
        error = count = 0.0
        for a, b, pixels in zip(pictures, expected, self.pixels, strict=True):
            error += float((a[pixels] - b[pixels]).double().square().sum())
            count += 3 * int(pixels.sum())
        return error / max(count, 1)

    def edge_psnr(self, pictures: Sequence[Tensor], expected: Sequence[Tensor]) -> float:
        """Return the PSNR over the evaluated pixels, weighted by the expected gradients, dB.

        It is the same as `psnr` if the expected pictures have no edges.
        """
        error = total = 0.0
        for a, b, pixels in zip(pictures, expected, self.pixels, strict=True):
            weights = edge_weights(b)[pixels].double()
            error += float(((a[pixels] - b[pixels]).double().square().mean(dim=1) * weights).sum())
            total += float(weights.sum())
        return decibels(error / total) if total else self.psnr(pictures, expected)

    def ssim(self, pictures: Sequence[Tensor], expected: Sequence[Tensor]) -> float:
        """Return the SSIM over the evaluated pixels of all views, at most 1."""
        total = count = 0.0
        for a, b, pixels in zip(pictures, expected, self.pixels, strict=True):
            pixel_count = int(pixels.sum())
            if pixel_count:
                total += pixel_count * float(ssim(a, b, pixels))
                count += pixel_count
        return total / count if count else 1.0

    def perceptual(
        self,
        pictures: Sequence[Tensor],
        expected: Sequence[Tensor],
        measure: Perceptual,
        key: Hashable = None,
    ) -> float:
        """Return the mean perceptual distance of the boxes.

        `key`: cache key of the expected pictures, see `Perceptual`
        """
        keys = [None if key is None else (key, i) for i in range(len(expected))]
        with torch.no_grad():
            values = [float(measure(a, b, k)) for a, b, k in zip(pictures, expected, keys, strict=True)]
        return sum(values) / max(1, len(values))

    def halves(self) -> tuple[Evaluator, Evaluator]:
        """Split the views into those that fields are chosen on and those that errors are reported on."""
        choosing, reporting = (self.only(views) for views in split_held_out(range(len(self.crops))))
        return choosing, reporting

    def only(self, views: Sequence[int]) -> Evaluator:
        """Return an evaluator of the views with these indices."""
        return replace(
            self,
            crops=[self.crops[i] for i in views],
            pixels=[self.pixels[i] for i in views],
            edited={s: [pictures[i] for i in views] for s, pictures in self.edited.items()},
            names=[self.names[i] for i in views],
        )

    def counted_pixels(self, offsets: Tensor) -> Tensor:
        """Render the evaluated pixels of all views with these offsets. [M,C] -> [P,3]"""
        return self.count(self.pictures(offsets))

    def count(self, pictures: Sequence[Tensor]) -> Tensor:
        """Gather the evaluated pixels from pictures of all views. [h,w,3] each -> [P,3]"""
        return torch.cat([picture[pixels] for picture, pixels in zip(pictures, self.pixels, strict=True)])


def make_evaluator(
    scene: Gaussians,
    region: Region,
    views: Sequence[View],
    edited: Mapping[float, Sequence[Tensor]],
    background: Tensor,
    channels: int,
    still: bool = False,
) -> Evaluator:
    """Prepare held-out views.

    Args:
        scene: the original
        region: the edited region
        views: held-out views
        edited: strength → the editor's whole pictures of these views. [H,W,3]
        background: rgb. [3]
        channels: width of a packed row
        still: only colors will change, see `crop_scene`
    """
    if edited:
        views = [v.widen([pictures[i] for pictures in edited.values()]) for i, v in enumerate(views)]
    crops = [crop_scene(scene, region.members, v.camera, v.box, background, still) for v in views]
    pixels = []
    for i, view in enumerate(views):
        evaluated = view.mask > 0.05
        for pictures in edited.values():
            evaluated = evaluated | ((pictures[i] - view.image).abs().amax(dim=2) > 2 / 255)
        pixels.append(crop(evaluated, view.box))
    boxes = {s: [crop(p, v.box) for p, v in zip(ps, views, strict=True)] for s, ps in edited.items()}
    original = pack(scene[region.members], with_shN=channels > 14)
    return Evaluator(original, crops, pixels, boxes, [view.camera.name for view in views])


def sample_members(evaluator: Evaluator, budget: int = PACKING_MEMBERS) -> tuple[Tensor, Evaluator]:
    """Return the members that are visible in sampled squares, and an evaluator of them and these squares.

    The packings of one solution differ little, so each is measured on the same squares, with only the members
    that are visible there.

    The share of the squares is halved until at most `budget` members are visible. With at most `budget`
    members, nothing is left out.

    Args:
        evaluator: views of an edit that changes only colors
        budget: number of members, > 0

    Returns:
        Indices of the members, ascending. [m] int64. The evaluator, for offsets of these members. [m,C]
    """
    count = len(evaluator.original)
    everything = torch.arange(count)
    if count <= budget:
        return everything, evaluator
    generator = torch.Generator().manual_seed(0)
    orders = [_square_order(pixels, generator) for pixels in evaluator.pixels]
    visible = torch.ones(count, dtype=torch.bool)
    sampled = list(evaluator.pixels)
    share = 1.0
    while int(visible.sum()) > budget and share > _MIN_SHARE:
        share = share / 2
        sampled = [p & (order < share) for p, order in zip(evaluator.pixels, orders, strict=True)]
        views = zip(evaluator.crops, sampled, strict=True)
        visible = torch.stack([crop.visible_members(pixels) for crop, pixels in views]).any(dim=0)
    if not bool(visible.any()):
        return everything, evaluator
    members = visible.nonzero()[:, 0]
    crops = [crop.take(members) for crop in evaluator.crops]
    original = evaluator.original[members]
    return members, replace(evaluator, original=original, crops=crops, pixels=sampled)


def _square_order(pixels: Tensor, generator: torch.Generator) -> Tensor:
    """Return a random number from 0 to 1 for each square, at its pixels. [h,w] -> [h,w]"""
    height, width = pixels.shape
    rows = -(-height // _SQUARE_PX)
    columns = -(-width // _SQUARE_PX)
    order = torch.rand(rows, columns, generator=generator)
    order = order.repeat_interleave(_SQUARE_PX, dim=0).repeat_interleave(_SQUARE_PX, dim=1)
    return order[:height, :width]
