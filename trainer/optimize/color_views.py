"""Views as functions of the members' colors, and maps of color fitted to them.

While nothing moves, every view is linear in the members' colors (`progdf.rasterize.cpu.engine`), but for the
clamps at black and white. A map of color, a polynomial of what is drawn (`progdf.field.grade`), is linear in
its coefficients too: its least squares over all views take a tenth of a second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from progdf.field.baked import MONOMIALS, identity_map
from progdf.field.grade import MAX_COLOR, member_bands, monomials
from progdf.gaussians import unpack
from progdf.metrics.image import ROUNDING
from progdf.rasterize.cpu.engine import Array
from progdf.rasterize.cpu.jit import Number, kernel
from progdf.rasterize.engines import ColorMap, color_map
from progdf.sh import basis
from progdf.threads import map_threads, one_thread
from trainer.views.crops import CropScene

_AT_ONCE = 8  # views, whose results are there at the same time
_SQUARES = 6  # of a view's longer side, every other one of which is in one of its halves
_COVERED = 0.05  # the region's weight in a pixel that shows it
_MAX_FIT_PIXELS = 60_000  # that a map is fitted to, of more evenly spread ones (docs/experiments.md, Pixels)
_CLAMP_ROUNDS = 3  # of the map's least squares, for pixels that are white or black anyway
_MAP_RIDGE = 1e-6  # of the diagonal of a map's normal equations, for regions of few colors
_MAP_HELD = 1e-2  # say of the members' own colors beside the pixels: there a map is held to the affine one
_SHIFT_HELD = 1e-2  # of that: the affine map is held to the same change of all
_MASK_WITHIN = 0.98  # of what says what a share is: the largest there is 1, few beyond do not scale it
_MASK_STEPS = 16  # at most, of gradients by pixels
_MASK_SETTLED = 0.01  # of the error, that a step gains
_MASK_LENGTHS = (4.0, 2.0, 1.0, 0.5, 0.25)  # of a step, in units of a bound of the curvature
_MASK_RIDGE = 0.01  # of a typical curvature, for members that hardly show

LOST = 0.5 / 255.0
"""Of a pixel's weights, in all, what is left out: no color that this has would show in 8 bits."""

MORE_PAYS = 0.95
"""Share of the error that a larger model must leave at most, to be worth its bytes."""

_A = TypeVar("_A")
_B = TypeVar("_B")


@dataclass(frozen=True)
class ColorView:
    """Pixels of one training view's box as a function of the members' colors."""

    map: ColorMap  # what each member weighs in each of the pixels
    others: Tensor  # what all but the members show there, unclamped. [P,3]
    basis: Tensor  # weight of each band in each member's color from here. [M,B]
    original: Tensor  # the members' unclamped colors as they were. [M,3]
    size: tuple[int, int]  # height and width of the box
    pixels: Tensor  # which of the box's, row by row. [P] int64
    counts: Tensor  # which of these count. [P,1] bool

    def colors(self, offsets: Tensor) -> Tensor:
        """What is drawn, not below 0. Offsets of the lowest bands [M,b,3] -> [M,3]"""
        colors = self.original.numpy().copy()
        add_colors(self.basis.numpy(), offsets.numpy(), colors)
        return torch.from_numpy(np.maximum(colors, 0.0, out=colors))

    def picture(self, colors: Tensor) -> Tensor:
        """Unclamped. Colors not below 0 [M,3] -> [P,3]"""
        return self.others + self.map.picture(colors)

    @cached_property
    def share(self) -> Tensor:
        """How much of each pixel the members are, 0 where it does not count. [P,1] 0..1"""
        return self.map.picture(torch.ones_like(self.original))[:, :1] * self.counts

    def pick(self, image: Tensor) -> Tensor:
        """The pixels of the box. [h,w,3] -> [P,3]"""
        return image.flatten(0, 1)[self.pixels]

    def pull(self, colors: Tensor, target: Tensor) -> tuple[Tensor, Tensor, float]:
        """Against the gradient of half the squared error to a picture, of what the clamps pass: they do what
        would bring a value back into the range. Colors not below 0 [M,3], [P,3]

        Returns:
            By color [M,3]; channels of the pixels that are passed [P,3] bool; the squared error
        """
        missing = self.map.picture(colors)
        passed = torch.empty_like(missing, dtype=torch.bool)
        squared = _compare(*(x.numpy() for x in (missing, self.others, target, self.counts[:, 0], passed)))
        return self.map.gradient(missing), passed, squared

    def error(self, offsets: Tensor, target: Tensor, power: float) -> float:
        """Sum of differences to some power, of colors 0..1, as far as the members show. [M,b,3], [P,3]"""
        image = self.picture(self.colors(offsets)).clamp(0.0, 1.0)
        return float(((image - target).abs().pow(power) * self.share).sum())

    def halves(self) -> tuple[ColorView, ColorView]:
        """The view with every other square of its pixels, and with the others."""
        side = max(1, max(self.size) // _SQUARES)
        rows = self.pixels // self.size[1] // side
        columns = self.pixels % self.size[1] // side
        even = ((rows + columns) % 2 == 0)[:, None]
        return replace(self, counts=self.counts & even), replace(self, counts=self.counts & ~even)


@kernel(contract=True, cache=True)
def _compare(shown: Array, others: Array, target: Array, counts: Array, passed: Array) -> Number:
    """See `ColorView.pull`. shown: in, what the members show; out, what is missing where it is passed.
    [P,3] float32, [P] and [P,3] bool -> float64"""
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


@kernel(cache=True)
def add_colors(basis: Array, offsets: Array, colors: Array) -> None:
    """colors += Σ basis · offset. Torch's own sums leave holes between what stays, .2 GB of 200 000 members:
    glibc before 2.38 puts aligned memory into no hole of its size. [M,B], [M,b,3], [M,3] float32"""
    for m in range(len(colors)):
        for c in range(3):
            for b in range(offsets.shape[1]):
                colors[m, c] += basis[m, b] * offsets[m, b, c]


@kernel(contract=True, cache=True)
def add_pulls(basis: Array, pull: Array, offsets: Array) -> None:
    """offsets += basis · pull, `add_colors` the other way round. [M,B], [M,3], [M,b,3] float32"""
    for m in range(len(pull)):
        for b in range(offsets.shape[1]):
            for c in range(3):
                offsets[m, b, c] += basis[m, b] * pull[m, c]


def color_view(crop: CropScene, original: Tensor, every: int, index: int) -> ColorView:
    """One of `color_views`, of which it is the `index`th."""
    camera, (height, width) = crop.camera, crop.size
    place = torch.arange(width) + every // 2 * torch.arange(height)[:, None] + index
    pixels = (place % every == 0).flatten().nonzero()[:, 0]
    members = unpack(original, crop.member_shN)
    directions = torch.nn.functional.normalize(members.means - camera.position, dim=1)
    weights = basis(min(members.sh_degree, 3), directions)
    colors = (weights[..., None] * members.sh[:, : weights.shape[1]]).sum(dim=1) + 0.5
    weighed = color_map(crop.gaussians, camera, crop.box, crop.rows, crop.engine, pixels, LOST)
    others = crop.original.flatten(0, 1)[pixels] - weighed.picture(colors.clamp_min(0.0))
    counts = torch.ones_like(others[:, :1], dtype=torch.bool)
    weights = weights[:, : member_bands(original[:1]).shape[1]].contiguous()
    return ColorView(weighed, others, weights, colors, crop.size, pixels, counts)


def color_views(crops: Sequence[CropScene], original: Tensor, every: int = 1) -> list[ColorView]:
    """All views, with all bands that are drawn. Each crop is looked at once, and not needed any more.

    Args:
        crops: their boxes
        original: raw member rows [M,14+]
        every: of so many pixels one is looked at, in each view others: 1, 2 or 4
    """
    views = map_threads(lambda i: color_view(crops[i], original, every, i), range(len(crops)))
    alike = views[0].basis.shape[1] == 1  # from everywhere
    return [replace(v, basis=views[0].basis, original=views[0].original) for v in views] if alike else views


@dataclass(frozen=True)
class MapFit:
    """The views' pixels as monomials of the region's drawn colors: a map's picture is linear in them."""

    design: Tensor  # what each pixel shows of every monomial. [P,20] float64
    original: Tensor  # what it showed before the edit, unclamped. [P,3] float64
    pixels: Sequence[Tensor]  # which of each view's box these are, one view after another. [p] int64
    normal: Tensor  # products of all pixels' monomials. [20,20] float64
    held: Tensor  # the same of the members', hidden or not, as far as they count. [20,20] float64

    def picture(self, table: Tensor) -> Tensor:
        """What the pixels show under a map. [K,3] -> [P,3] 0..1"""
        change = (table - pad(identity_map(1), (0, 0, 0, len(table) - MONOMIALS[1]))).double()
        return (self.original + self.design[:, : len(table)] @ change).clamp(0.0, 1.0).float()

    @one_thread()
    def solve(self, degree: int, targets: Sequence[Tensor]) -> Tensor:
        """The map of least squares. [h,w,3] each -> [K,3]

        A polynomial goes astray beyond the colors that it was fitted to, and members that no picture shows
        may have such: at all members' colors it is held to the affine map, and
        that one to the same change of all.
        """
        pixels = [image.reshape(-1, 3)[p] for image, p in zip(targets, self.pixels, strict=True)]
        return identity_map(degree) + self._change(MONOMIALS[degree], torch.cat(pixels)).float()

    def _change(self, count: int, target: Tensor) -> Tensor:
        """What is added to the identity's first coefficients: 1, 4, 10 or 20. [P,3] -> [count,3]"""
        design = self.design[:, :count]
        normal = self.normal[:count, :count]
        change = pull = design.new_zeros(count, 3)
        if count > 1:
            coarse = self._change(4 if count > 4 else 1, target)
            held = self.held[:count, :count] * (1.0 if count > 4 else _SHIFT_HELD)
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
        views: see `ColorView`
        share: how much of a map each member takes, 0..1. [M]
        most: pixels that the maps are fitted to
    """

    @lru_cache(maxsize=1)
    def expand(colors: Tensor) -> tuple[Tensor, Tensor]:
        terms = monomials(colors.T.clamp(0.0, MAX_COLOR), 3)
        return (share * terms).T.contiguous(), (terms @ terms.T).double()

    def lay_out(index: int) -> tuple[Tensor, Tensor, Tensor]:
        view = views[index]
        some = pixels[index]
        terms, members = expand(view.original)
        original = view.picture(view.original.clamp_min(0.0))[some]
        return view.map.picture(terms)[some], original, members

    covered = map_threads(lambda view: (view.share[:, 0] > _COVERED).nonzero()[:, 0], views)
    stride = max(1, -(-sum(map(len, covered)) // most))
    pixels = [some[::stride].clone() for some in covered]
    laid = map_threads(lay_out, range(len(views)))
    design, original = (torch.cat([one[i] for one in laid]).double() for i in (0, 1))
    members = torch.stack([one[2] for one in laid]).sum(dim=0)
    say = _MAP_HELD * len(design) / max(1, len(views) * len(views[0].original))
    pixels = [view.pixels[some] for view, some in zip(views, pixels, strict=True)]
    return MapFit(design, original, pixels, design.T @ design, say * members)


def mask_of_members(colors: Tensor, change: Tensor, weights: Tensor) -> Tensor:
    """How much of one affine map each member takes, if its change is to be that, as between stripes: a guess.

    The map is that of shares as large as the members' changes; the largest share of it is 1.

    Args:
        colors: as they were. [M,3]
        change: of each member's color. [M,3]
        weights: how much each shows, ≥ 0. [M]

    Returns:
        The shares, 0..1. [M]
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
    along = (change * full).sum(dim=1) / power
    evidence = weights * power
    order = along.argsort()
    reached = evidence[order].cumsum(0) >= _MASK_WITHIN * evidence.sum()
    share: Tensor = (along / along[order][reached][0].clamp_min(1e-6)).clamp(0.0, 1.0)
    return share.float()


@one_thread()
def improve_mask(
    views: Sequence[ColorView], full: Tensor, share: Tensor, targets: Sequence[Tensor]
) -> Tensor:
    """The shares of a map by the pictures: projected gradients, each member's by its own weight. [M] -> [M]

    Args:
        views: see `ColorView`
        full: what the whole of the map adds. [M,B,3]
        share: a guess
        targets: pictures of the views
    """
    changes = [torch.einsum("mb,mbc->mc", view.basis, full) for view in views]
    picked = [view.pick(target) for view, target in zip(views, targets, strict=True)]
    pairs = list(zip(views, changes, picked, strict=True))

    def weigh(pair: tuple[ColorView, Tensor, Tensor]) -> Tensor:
        view = pair[0]
        size = pair[1].abs()
        return (view.map.gradient(view.map.picture(size) * view.counts) * size).sum(dim=1)

    def look(share: Tensor) -> tuple[Tensor, float]:
        def pull(pair: tuple[ColorView, Tensor, Tensor]) -> tuple[Tensor, float]:
            view, change, target = pair
            by_color, _, squared = view.pull((view.original + share[:, None] * change).clamp_min(0.0), target)
            return (by_color * change).sum(dim=1), squared

        looks = map_threads(pull, pairs)
        return torch.stack([one for one, _ in looks]).sum(dim=0), sum(error for _, error in looks)

    curvature = torch.stack(map_threads(weigh, pairs)).sum(dim=0)
    curvature = curvature + _MASK_RIDGE * curvature.mean() + 1e-12
    descent, error = look(share)
    for _ in range(_MASK_STEPS):
        before = error
        for length in _MASK_LENGTHS:
            ahead = (share + length * descent / curvature).clamp(0.0, 1.0)
            next_descent, next_error = look(ahead)
            if next_error < error:
                share = ahead
                descent = next_descent
                error = next_error
                break
        if before - error < _MASK_SETTLED * before:
            break
    return share


@dataclass(frozen=True)
class Judge:
    """Views that are not solved for, and an edit in them."""

    views: Sequence[ColorView]
    targets: Sequence[Tensor]  # [h,w,3] each

    @cached_property
    def _pairs(self) -> list[tuple[ColorView, Tensor]]:
        return [(view, view.pick(target)) for view, target in zip(self.views, self.targets, strict=True)]

    def error(self, offsets: Tensor) -> float:
        """Mean squared difference, with that of the pictures' own rounding. [M,B,3]"""
        return ROUNDING + self.mean(offsets, 2.0)

    def mean(self, offsets: Tensor, power: float) -> float:
        """Mean difference to some power, of the pixels as far as they show the members. [M,B,3]"""
        total = sum(map_threads(lambda pair: pair[0].error(offsets, pair[1], power), self._pairs))
        return total / max(1.0, 3.0 * sum(float(view.share.sum()) for view in self.views))


def iterate_views(work: Callable[[_A], _B], items: Sequence[_A]) -> Iterator[_B]:
    """The same some at a time, for what need not be kept."""
    for begin in range(0, len(items), _AT_ONCE):
        yield from map_threads(work, items[begin : begin + _AT_ONCE])
