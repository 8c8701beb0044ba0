"""Views as linear functions of the members' colors, and color maps fitted to them.

While geometry is fixed, every view is linear in the members' colors (`progdf.rasterize.cpu.engine`) except
for clamping at black and white. A color map is a polynomial of the drawn colors (`progdf.field.grade`) and
linear in its coefficients. Its least-squares fit over all views therefore takes 0.1 s.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from progdf.camera import Camera
from progdf.field.baked import MONOMIALS, identity_map
from progdf.field.grade import MAX_COLOR, member_bands, monomials
from progdf.gaussians import Gaussians, attribute_slices
from progdf.metrics.image import ROUNDING
from progdf.rasterize import activate
from progdf.rasterize.cpu.engine import Array, rasterize_listed
from progdf.rasterize.cpu.jit import Number, kernel
from progdf.rasterize.engines import ColorMap, RasterView, color_map
from progdf.sh import C0, basis
from progdf.system.equality import equal_fields
from progdf.threads import one_thread
from trainer.views.crops import CropScene
from trainer.views.view import View

from . import color_tensors
from .color_kernels import drop_held, keep_drawn, shade_views
from .color_tensors import Scalar, map_views, read_number

_VIEW_BATCH = 8  # views processed at once; limits the memory for results
_TILES_PER_SIDE = 6  # tiles along a view's longer side; half of the tiles are held out, as on a checkerboard
_MIN_REGION_WEIGHT = 0.05  # minimum weight of the region in a pixel that shows it
_MAX_FIT_PIXELS = 60_000  # pixels per fit, evenly spread (docs/lab/experiments.md, Pixels)
_CLAMP_ROUNDS = 3  # least-squares rounds, to treat pixels that stay white or black
_MAP_RIDGE = 1e-6  # share of the diagonal of a map's normal equations, for regions with few colors
# weight, relative to the pixels, of the prior that holds a map to the affine map at members' colors
_MAP_PRIOR_WEIGHT = 1e-2
_SHIFT_PRIOR_SHARE = 1e-2  # share of that weight; holds the affine map to a constant shift
# masks are scaled so that members with this share of the evidence have a share of at most 1
_MASK_EVIDENCE_SHARE = 0.98
_MAX_MASK_STEPS = 16  # maximum number of gradient steps
_MIN_MASK_GAIN = 0.01  # minimum share of the error that a step must remove
# step lengths to try, in units of the inverse curvature bound
_MASK_STEP_LENGTHS = (4.0, 2.0, 1.0, 0.5, 0.25)
_MASK_RIDGE = 0.01  # share of the mean curvature; shortens the steps of hardly visible members

OMITTED_WEIGHT = 0.5 / 255.0
"""Total weight per pixel that may be omitted. No color with this weight is visible in 8 bits."""

MAX_ERROR_SHARE = 0.95
"""Maximum share of the error that a larger model may leave to be worth its bytes."""

_A = TypeVar("_A")
_B = TypeVar("_B")


@dataclass(frozen=True)
class ColorMembers:
    """Members whose colors change, shared by all views."""

    __eq__ = equal_fields

    means: Tensor  # centers, world units. [M,3] float32
    sh: Tensor  # original coefficients of the drawn SH functions. [M,B,3] float32

    @property
    def degree(self) -> int:
        """SH degree that is drawn, 0..3."""
        return math.isqrt(self.sh.shape[1]) - 1

    @cached_property
    def flat_colors(self) -> Tensor:
        """Unclamped colors of members without view dependence (degree 0). [M,3]"""
        return self.sh[:, 0] * C0 + 0.5

    @classmethod
    def of(cls, original: Tensor) -> ColorMembers:
        """Return the members of packed raw rows. [M,C]"""
        means = original[:, attribute_slices(original.shape[1])["means"]]
        return cls(means.float().contiguous(), member_bands(original).float())


@dataclass(frozen=True)
class ColorView:
    """Pixels of one training view's box as a function of the members' colors."""

    __eq__ = equal_fields

    map: ColorMap  # weight of each member in each pixel
    others: Tensor  # color of everything except the members, unclamped. [P,3]
    members: ColorMembers
    position: Tensor  # center of the camera. [3]
    size: tuple[int, int]  # height and width of the box
    pixels: Tensor  # indices into the box, row by row. [P] int64
    counts: Tensor  # pixels that count. [P,1] bool

    @property
    def basis(self) -> Tensor:
        """Weight of each band in each member's color from this camera. [M,B]"""
        directions = torch.nn.functional.normalize(self.members.means - self.position, dim=1)
        return basis(self.members.degree, directions)

    @property
    def original(self) -> Tensor:
        """Unclamped original colors of the members. [M,3]"""
        if self.members.degree == 0:
            return self.members.flat_colors
        return shade([self], self.members.sh, lowest=-math.inf)[0]

    def colors(self, offsets: Tensor) -> Tensor:
        """Return the drawn colors, at least 0. Offsets of the lowest bands [M,b,3] -> [M,3]"""
        return shade([self], add_bands(self.members.sh, offsets))[0]

    def picture(self, colors: Tensor) -> Tensor:
        """Return the unclamped pixels. Colors at least 0 [M,3] -> [P,3]"""
        return self.others + self.map.picture(colors)

    @cached_property
    def share(self) -> Tensor:
        """Weight of the members in each pixel, 0 in pixels that do not count. [P,1] 0..1"""
        return self.map.picture(torch.ones_like(self.members.means))[:, :1] * self.counts

    def pick(self, image: Tensor) -> Tensor:
        """Return this view's pixels of a box. [h,w,3] -> [P,3]"""
        return image.flatten(0, 1)[self.pixels]

    def pull(self, colors: Tensor, target: Tensor) -> tuple[Tensor, Tensor, Scalar]:
        """Return the negative gradient of half the squared error to a picture.

        Clamped channels count only if the gradient moves them back into the range.

        Args:
            colors: at least 0. [M,3]
            target: the picture. [P,3]

        Returns:
            gradient by color [M,3]; channels of the pixels that are not clamped [P,3] bool; squared error
        """
        missing = self.map.picture(colors)
        if not missing.is_cpu:
            residuals, passed, squared = color_tensors.compare(missing, self.others, target, self.counts)
            return self.map.gradient(residuals), passed, squared
        passed = torch.empty_like(missing, dtype=torch.bool)
        total = _compare(*(x.numpy() for x in (missing, self.others, target, self.counts[:, 0], passed)))
        return self.map.gradient(missing), passed, total

    def pull_drawn(self, colors: Tensor, target: Tensor, drawn: Tensor) -> tuple[Tensor, Tensor, Scalar]:
        """Return the results of `pull` without the gradient of channels that stay black.

        `drawn`: out, the members' channels that the clamp lets through. [M,3] bool
        """
        negative, passed, squared = self.pull(colors, target)
        if colors.is_cpu:
            drop_held(colors.numpy(), negative.numpy(), drawn.numpy())
        else:
            color_tensors.drop_held(colors, negative, drawn)
        return negative, passed, squared

    def power(self, changes: Tensor, drawn: Tensor, passed: Tensor) -> Scalar:
        """Return the squared change of the pixels by a change of the colors, with fixed clamps.

        Args:
            changes: overwritten. [M,3]
            drawn: members' channels that the clamp lets through. [M,3] bool
            passed: pixels' channels that the clamps let through. [P,3] bool
        """
        if not changes.is_cpu:
            return (self.map.picture(changes * drawn) * passed).square().sum()
        keep_drawn(changes.numpy(), drawn.numpy())
        return float((self.map.picture(changes) * passed).square().sum())

    def errors(self, colors: Tensor, targets: Sequence[Tensor], powers: Sequence[float]) -> list[Scalar]:
        """Return the sum of differences to each target, weighted by the members' share.

        Args:
            colors: at least 0. [M,3]
            targets: pictures; the view's own pixels are clamped to 0..1. [P,3] each
            powers: power of the difference to each target
        """
        image = self.picture(colors).clamp(0.0, 1.0)
        totals = [
            ((image - target).abs().pow(power) * self.share).sum()
            for target, power in zip(targets, powers, strict=True)
        ]
        return [float(total) if total.is_cpu else total for total in totals]

    def halves(self) -> tuple[ColorView, ColorView]:
        """Return two views that count the even and the odd tiles of a checkerboard."""
        side = max(1, max(self.size) // _TILES_PER_SIDE)
        rows = self.pixels // self.size[1] // side
        columns = self.pixels % self.size[1] // side
        even = ((rows + columns) % 2 == 0)[:, None]
        return replace(self, counts=self.counts & even), replace(self, counts=self.counts & ~even)


@kernel(contract=True, cache=True)
def _compare(shown: Array, others: Array, target: Array, counts: Array, passed: Array) -> Number:
    """Compute residuals for `ColorView.pull`. [P,3] float32, [P] and [P,3] bool -> squared error, float64

    `shown` contains the members' pixels on input and the residuals of unclamped channels on output.
    """
    squared = 0.0
    for p in range(len(shown)):
        for c in range(3):
            image = others[p, c] + shown[p, c]
            wanted = target[p, c]
            error = np.float64(wanted - min(max(image, np.float32(0.0)), np.float32(1.0)))
            squared += error * error if counts[p] else 0.0
            held = (image <= 0.0 and wanted <= 0.0) or (image >= 1.0 and wanted >= 1.0)
            passed[p, c] = counts[p] and not held
            shown[p, c] = wanted - image if passed[p, c] else np.float32(0.0)
    return squared


def add_bands(offsets: Tensor, residual: Tensor) -> Tensor:
    """Return offsets with a residual added to their lowest bands. [M,B,3], [M,b,3] -> [M,B,3]"""
    total = offsets.clone()
    total[:, : residual.shape[1]] += residual
    return total


def shade(views: Sequence[ColorView], sh: Tensor, bias: float = 0.5, lowest: float = 0.0) -> Tensor:
    """Return the members' colors in some views.

    Args:
        views: views of the same members, at most 8
        sh: coefficients of the lowest functions. [M,b,3]
        bias: constant; 0 for changes of colors
        lowest: lower limit of the colors

    Returns:
        [V,M,3]
    """
    means = views[0].members.means
    centers = camera_centers(views)
    if not means.is_cpu:
        return color_tensors.shade_views(means, centers, sh, bias, lowest)
    return torch.from_numpy(shade_views(means.numpy(), centers.numpy(), sh.numpy(), bias, lowest))


def camera_centers(views: Sequence[ColorView]) -> Tensor:
    """Return the centers of the views' cameras. [V,3] float32"""
    return torch.stack([view.position for view in views]).float()


def view_blocks(views: Sequence[_A]) -> list[Sequence[_A]]:
    """Return the views in blocks that are processed at once."""
    return [views[begin : begin + _VIEW_BATCH] for begin in range(0, len(views), _VIEW_BATCH)]


def _chosen_pixels(size: tuple[int, int], every: int, index: int) -> Tensor:
    """Return the pixels of a box that the `index`th view uses, see `color_views`. [P] int64"""
    height, width = size
    place = torch.arange(width) + every // 2 * torch.arange(height)[:, None] + index
    return (place % every == 0).flatten().nonzero()[:, 0]


def _color_view(
    weighed: ColorMap, image: Tensor, pixels: Tensor, members: ColorMembers, camera: Camera
) -> ColorView:
    """Return the view of a box. image: the original, not clamped. [h,w,3]"""
    height, width, _ = image.shape
    original = image.flatten(0, 1)[pixels]
    counts = torch.ones_like(original[:, :1], dtype=torch.bool)
    view = ColorView(weighed, original, members, camera.position, (height, width), pixels, counts)
    return replace(view, others=original - weighed.picture(view.original.clamp_min(0.0)))


def color_views(crops: Sequence[CropScene], original: Tensor, every: int = 1) -> list[ColorView]:
    """Return all views with all bands that are drawn. Every crop is read once and not needed afterwards.

    Args:
        crops: boxes of the views
        original: raw member rows. [M,14+]
        every: use one of this many pixels, different ones in each view: 1, 2 or 4
    """
    members = ColorMembers.of(original)
    device = original.device

    def draw(index: int) -> ColorView:
        crop = crops[index]
        pixels = _chosen_pixels(crop.size, every, index).to(device)
        weighed = color_map(
            crop.gaussians, crop.camera, crop.box, crop.rows, crop.engine, pixels, OMITTED_WEIGHT
        )
        return _color_view(weighed, crop.original, pixels, members, crop.camera)

    return map_views(draw, range(len(crops)), device)


def draw_color_views(
    scene: Gaussians, rows: Tensor, views: Sequence[View], background: Tensor, original: Tensor, every: int
) -> list[ColorView]:
    """Return the same views as `color_views` for the CPU, with one projection per view and no crops.

    Args:
        scene: the original
        rows: rows of the region. [M] int64
        views: views whose boxes are drawn
        background: rgb. [3]
        original, every: see `color_views`
    """
    members = ColorMembers.of(original)
    gaussians = activate(scene)

    def draw(index: int) -> ColorView:
        camera = views[index].camera
        window = RasterView.of(camera, gaussians, views[index].box)
        x0, y0, x1, y1 = window.crop
        pixels = _chosen_pixels((y1 - y0, x1 - x0), every, index)
        image, _, weighed = rasterize_listed(gaussians, window, background, rows, pixels, OMITTED_WEIGHT)
        return _color_view(weighed, image, pixels, members, camera)

    return map_views(draw, range(len(views)), original.device)


@dataclass(frozen=True)
class MapFit:
    """Pixels of the views as monomials of the region's drawn colors.

    The picture of a map is linear in the map's coefficients.
    """

    __eq__ = equal_fields

    design: Tensor  # weight of every monomial in each pixel. [P,20] float64
    original: Tensor  # pixels before the edit, unclamped. [P,3] float64
    pixels: Sequence[Tensor]  # indices into each view's box, one view after another. [p] int64
    normal: Tensor  # normal matrix of the pixels. [20,20] float64
    # normal matrix of all members' colors, hidden ones included, with the prior's weight. [20,20] float64
    held: Tensor

    def picture(self, table: Tensor) -> Tensor:
        """Return the pixels under a map. [K,3] -> [P,3] 0..1"""
        identity = pad(identity_map(1), (0, 0, 0, len(table) - MONOMIALS[1]))
        change = (table - identity.to(table)).double()
        return (self.original + self.design[:, : len(table)] @ change).clamp(0.0, 1.0).float()

    @one_thread()
    def solve(self, degree: int, targets: Sequence[Tensor]) -> Tensor:
        """Return the least-squares map. [h,w,3] each -> [K,3]

        A polynomial extrapolates badly beyond the colors that it was fitted to, and members that no picture
        shows can have such colors. Therefore it is held to the affine map at all members' colors, and the
        affine map to a constant shift.
        """
        pixels = [image.reshape(-1, 3)[p] for image, p in zip(targets, self.pixels, strict=True)]
        change = self._change(MONOMIALS[degree], torch.cat(pixels)).float()
        return identity_map(degree).to(change) + change

    def _change(self, count: int, target: Tensor) -> Tensor:
        """Return the change of the identity's first `count` coefficients: 1, 4, 10 or 20.

        [P,3] -> [count,3]
        """
        design = self.design[:, :count]
        normal = self.normal[:count, :count]
        change = pull = design.new_zeros(count, 3)
        if count > 1:
            coarse = self._change(4 if count > 4 else 1, target)
            held = self.held[:count, :count] * (1.0 if count > 4 else _SHIFT_PRIOR_SHARE)
            normal = normal + held
            pull = held[:, : len(coarse)] @ coarse
        normal = normal + _MAP_RIDGE * (normal.diagonal() + 1e-12).diag()
        for _ in range(_CLAMP_ROUNDS):
            image = self.original + design @ change
            clamped = ((image >= 1.0) & (target >= 1.0)) | ((image <= 0.0) & (target <= 0.0))
            missing = torch.where(clamped, image, target) - self.original
            change = torch.linalg.solve(normal, design.T @ missing + pull)
        return change


@one_thread()
def fit_maps(views: Sequence[ColorView], share: Tensor, most: int = _MAX_FIT_PIXELS) -> MapFit:
    """Prepare the views for maps of any degree.

    Args:
        views: training views
        share: each member's share of the map, 0..1. [M]
        most: maximum number of pixels to fit to
    """

    @lru_cache(maxsize=1)
    def expand(colors: Tensor) -> tuple[Tensor, Tensor]:
        terms = monomials(colors.T.clamp(0.0, MAX_COLOR), 3)
        return (share * terms).T.contiguous(), (terms @ terms.T).double()

    def lay_out(index: int) -> tuple[Tensor, Tensor, Tensor]:
        view = views[index]
        some = pixels[index]
        colors = view.original
        terms, members = expand(colors)
        original = view.picture(colors.clamp_min(0.0))[some]
        return view.map.picture(terms)[some], original, members

    device = share.device
    covered = map_views(lambda v: (v.share[:, 0] > _MIN_REGION_WEIGHT).nonzero()[:, 0], views, device)
    stride = max(1, -(-sum(map(len, covered)) // most))
    pixels = [some[::stride].clone() for some in covered]
    layouts = map_views(lay_out, range(len(views)), device)
    design = torch.cat([one[0] for one in layouts]).double()
    original = torch.cat([one[1] for one in layouts]).double()
    members = torch.stack([one[2] for one in layouts]).sum(dim=0)
    prior_weight = _MAP_PRIOR_WEIGHT * len(design) / max(1, len(views) * len(views[0].members.means))
    pixels = [view.pixels[some] for view, some in zip(views, pixels, strict=True)]
    return MapFit(design, original, pixels, design.T @ design, prior_weight * members)


def mask_of_members(colors: Tensor, change: Tensor, weights: Tensor) -> Tensor:
    """Estimate each member's share of one affine map from its change, for example for stripes.

    The map is fitted with shares proportional to the size of the members' changes. The largest share is 1.

    Args:
        colors: original colors. [M,3]
        change: change of each member's color. [M,3]
        weights: visibility of each member, ≥ 0. [M]

    Returns:
        shares, 0..1. [M]
    """
    weights = weights.double()
    change = change.double()
    size = change.norm(dim=1)
    typical = ((weights @ size.square()) / weights.sum().clamp_min(1e-30)).sqrt()
    terms = monomials(colors.T.clamp(0.0, MAX_COLOR), 1).double()
    design = (size / typical.clamp_min(1e-12)).clamp(0.0, 1.0) * terms
    normal = (design * weights) @ design.T
    normal += _MAP_RIDGE * (normal.diagonal() + 1e-12).diag()
    full: Tensor = terms.T @ torch.linalg.solve(normal, (design * weights) @ change)
    power = full.square().sum(dim=1).clamp_min(1e-12)
    projection = (change * full).sum(dim=1) / power
    evidence = weights * power
    order = projection.argsort()
    is_above = evidence[order].cumsum(0) >= _MASK_EVIDENCE_SHARE * evidence.sum()
    share: Tensor = (projection / projection[order][is_above][0].clamp_min(1e-6)).clamp(0.0, 1.0)
    return share.float()


@one_thread()
def improve_mask(
    views: Sequence[ColorView], full: Tensor, share: Tensor, targets: Sequence[Tensor]
) -> Tensor:
    """Return the members' shares of a map that fit the pictures better. [M] -> [M]

    The method is projected gradient descent with a step size per member, from its own curvature.

    Args:
        views: training views
        full: change by the whole map. [M,B,3]
        share: initial shares. [M]
        targets: pictures of the views
    """
    original = views[0].members.sh
    changes = [change for block in view_blocks(views) for change in shade(block, full, 0.0, -math.inf)]
    picked = [view.pick(target) for view, target in zip(views, targets, strict=True)]
    pairs = list(zip(views, changes, picked, strict=True))

    def weigh(pair: tuple[ColorView, Tensor, Tensor]) -> Tensor:
        view = pair[0]
        size = pair[1].abs()
        return (view.map.gradient(view.map.picture(size) * view.counts) * size).sum(dim=1)

    def pull(item: tuple[tuple[ColorView, Tensor, Tensor], Tensor]) -> tuple[Tensor, Scalar]:
        (view, change, target), colors = item
        by_color, _, squared = view.pull(colors, target)
        return (by_color * change).sum(dim=1), squared

    def look(share: Tensor) -> tuple[Tensor, float]:
        sh = original + share[:, None, None] * full
        descent = torch.zeros_like(share)
        error: Scalar = 0.0
        for block in view_blocks(pairs):
            colors = shade([view for view, _, _ in block], sh)
            for by_share, squared in map_views(pull, list(zip(block, colors, strict=True)), share.device):
                descent += by_share
                error += squared
        return descent, read_number(error)

    curvature = torch.stack(map_views(weigh, pairs, share.device)).sum(dim=0)
    curvature = curvature + _MASK_RIDGE * curvature.mean() + 1e-12
    descent, error = look(share)
    for _ in range(_MAX_MASK_STEPS):
        previous_error = error
        for length in _MASK_STEP_LENGTHS:
            candidate = (share + length * descent / curvature).clamp(0.0, 1.0)
            next_descent, next_error = look(candidate)
            if next_error < error:
                share = candidate
                descent = next_descent
                error = next_error
                break
        if previous_error - error < _MIN_MASK_GAIN * previous_error:
            break
    return share


@dataclass(frozen=True)
class ColorEvaluator:
    """Evaluator of an edit in held-out views."""

    views: Sequence[ColorView]
    targets: Sequence[Tensor]  # [h,w,3] each

    @cached_property
    def _target_pixels(self) -> list[Tensor]:
        """Pixels of the targets that the views draw. [P,3] each"""
        return [view.pick(target) for view, target in zip(self.views, self.targets, strict=True)]

    def error(self, offsets: Tensor) -> float:
        """Return the mean squared error, including the rounding error of 8-bit pictures. [M,B,3]"""
        return ROUNDING + self.mean(offsets, 2.0)

    def mean(self, offsets: Tensor, power: float) -> float:
        """Return the mean difference to a power, weighted by the members' share of the pixels. [M,B,3]"""
        return self._means(offsets, [self], [power])[0]

    def mean_and_error(self, offsets: Tensor, other: ColorEvaluator) -> tuple[float, float]:
        """Return the mean absolute difference, and `error` to other targets in the same views. [M,B,3]"""
        mean, error = self._means(offsets, [self, other], [1.0, 2.0])
        return mean, ROUNDING + error

    def _means(
        self, offsets: Tensor, goals: Sequence[ColorEvaluator], powers: Sequence[float]
    ) -> list[float]:
        """Return the mean difference to the targets of each goal, to its power. Each view is drawn once."""
        sh = add_bands(self.views[0].members.sh, offsets)
        totals: list[Scalar] = [0.0] * len(goals)
        pairs = list(zip(self.views, *(goal._target_pixels for goal in goals), strict=True))
        for block in view_blocks(pairs):
            colors = shade([view for view, *_ in block], sh)
            items = list(zip(block, colors, strict=True))
            errors = map_views(lambda item: item[0][0].errors(item[1], item[0][1:], powers), items, sh.device)
            sums = [sum(parts) for parts in zip(*errors, strict=True)]
            totals = [total + part for total, part in zip(totals, sums, strict=True)]
        return [read_number(total) / self._weight for total in totals]

    @cached_property
    def _weight(self) -> float:
        """Sum of the members' share over the channels of all pixels, at least 1."""
        return max(1.0, 3.0 * sum(float(view.share.sum()) for view in self.views))


def iterate_views(work: Callable[[ColorView], _B], views: Sequence[ColorView]) -> Iterator[_B]:
    """Yield the results of `work` in order. Only a batch of results is in memory at once."""
    for block in view_blocks(views):
        yield from map_views(work, block, block[0].others.device)
