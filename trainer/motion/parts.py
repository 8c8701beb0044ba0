"""Connected parts of a region, and the search for their motion.

Gaussians within a few spacings of each other are neighbors, and each chain of neighbors is one part. Seven
numbers per part are fitted to the edited views, coarse to fine. Blurred pictures attract a part that does not
overlap its new position at all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import avg_pool2d

from progdf.scene.neighbors import join_pairs, nearest_rows
from progdf.scene.point_tree import PointTree
from progdf.similarity import Motion, Parts, move_rows
from progdf.system.equality import equal_fields
from trainer.views.crops import CropScene

_NEIGHBOR_RANK = 8  # neighbor whose distance is a Gaussian's spacing: the first neighbor can be a duplicate
_MAX_SAMPLES = 512  # maximum number of Gaussians whose spacing is measured
_REACH_IN_SPACINGS = 2.5  # spacings; wider gaps separate parts
_CELLS_PER_REACH = 2.0  # cells per reach, so that any two Gaussians of a cell are neighbors (√3 / 2 < 1)
_BLURS_PX = (9, 21)  # pixels; box blurs of the near search
# widths of the box blurs, as shares of the box's longer side; they attract a part over three times its size
_WIDE_BLUR_SHARES = (0.4, 0.2, 0.1)
# share of a wide search's steps with wide blurs only, shifts three times as fast and no rotation
_WIDE_STEP_SHARE = 0.4
_RATES = (0.06, 0.03, 0.03)  # step of shift in part sizes, of log-scale, of rotation in radians
# share of the initial distance that may remain before the near search counts as failed
_FAILED_SEARCH_SHARE = 0.25
MOVING_ATTRIBUTES = ("means", "log_scales", "quats")
"""Attributes that motion changes."""
_AVERAGED_STEP_SHARE = 0.25  # final share of the steps over which the numbers are averaged

OnStep = Callable[[int, float], None]
"""Callback after every step: steps done, loss."""


def connected_parts(means: Tensor, least: float = 0.02) -> Tensor:
    """Return the part of each Gaussian.

    Time and memory grow with the number of Gaussians, so these are grouped into cells first. Cells are
    neighbors if their centroids are within reach, so the width of a gap is exact only to half a reach.

    Args:
        means: centers of the region's members. [M,3]
        least: minimum share of the members, and at least 8 of them, for a part of its own; strays join the
            nearest such part

    Returns:
        part of each, 0 the one with most members. [M] int64; deterministic
    """
    if len(means) == 0:
        return torch.zeros(0, dtype=torch.int64)
    points = means.detach().double()
    reach = _REACH_IN_SPACINGS * _spacing(points)
    if reach <= 0:
        return torch.zeros(len(points), dtype=torch.int64)
    cells = ((points - points.amin(dim=0)) / (reach / _CELLS_PER_REACH)).floor().long()
    occupied, cell_of = torch.unique(cells, dim=0, return_inverse=True)
    counts = torch.bincount(cell_of, minlength=len(occupied))
    sums = torch.zeros(len(occupied), 3, dtype=torch.float64)
    centroids = sums.index_add(0, cell_of, points) / counts[:, None]
    return _join_strays(_join_cells(centroids, reach), centroids, counts, max(8.0, least * len(points)))[
        cell_of
    ]


def _spacing(points: Tensor) -> float:
    """Return the median distance to the eighth neighbor of up to 512 of the points.

    With few points, a nearer neighbor is used.
    """
    rows = torch.arange(len(points))[:: max(1, len(points) // _MAX_SAMPLES)][:_MAX_SAMPLES]
    nearest = min(_NEIGHBOR_RANK, max(2, len(points) // 8), len(points) - 1)
    if not nearest:
        return 0.0
    return float(nearest_rows(points, rows, nearest)[1][:, -1].median())


def _join_cells(centroids: Tensor, reach: float) -> Tensor:
    """Return the group of each cell: cells within reach of each other share one. [C,3] -> [C]

    No two cells share a position, so the pairs of a cell are bounded by the cells within reach.
    """
    first, second = cKDTree(centroids.numpy()).query_pairs(reach, output_type="ndarray").T
    return torch.from_numpy(join_pairs(first, second, len(centroids)))


def _join_strays(labels: Tensor, centroids: Tensor, counts: Tensor, least: float) -> Tensor:
    """Return parts numbered by size, the largest 0.

    Cells of parts below `least` join the nearest other cell.
    """
    roots, part = torch.unique(labels, return_inverse=True)
    sizes = torch.zeros(len(roots), dtype=torch.int64).index_add(0, part, counts)
    order = sizes.argsort(descending=True, stable=True)
    count = max(1, int((sizes >= least).sum()))
    number = torch.empty_like(order)
    number[order] = torch.arange(len(order))
    part = number[part]
    stray = (part >= count).nonzero()[:, 0]
    large = (part < count).nonzero()[:, 0]
    if len(stray):
        nearest = PointTree(centroids[large].numpy(), 1).query(centroids[stray].numpy(), 1)[1]
        part[stray] = part[large[torch.from_numpy(nearest[:, 0])]]
    return part


@dataclass(frozen=True)
class GroupSearch:
    """Search for the motion of the parts that fits the training views."""

    __eq__ = equal_fields

    original: Tensor  # raw member rows. [M,C]
    parts: Parts
    crops: Sequence[CropScene]  # the training views
    steps: int = 120  # steps per search, each in one view
    seed: int = 0  # seed of the view order

    def find(self, targets: Sequence[Tensor], start: Motion, on_step: OnStep | None = None) -> Motion:
        """Return the motion of the parts that brings the views closest to their targets.

        A near search starts at full sharpness. If more than a quarter of the distance remains, a wide search
        runs too. The wide search finds positions farther away, but can miss close ones
        (docs/lab/experiments.md, Parts that move).

        Args:
            targets: edited box of each view. [h,w,3] each
            start: initial motion
            on_step: progress: steps done in this search; a wide search counts from 1 again

        Returns:
            the best motion found; `start` if none is better in the mean over all views

        Raises:
            FloatingPointError: the loss is no longer finite.
        """
        best = start
        min_distance = self.distance(targets, start)
        max_distance = _FAILED_SEARCH_SHARE * min_distance
        for wide in (False, True):
            motion = self._search(targets, start, wide, on_step)
            distance = self.distance(targets, motion)
            if distance < min_distance:
                best = motion
                min_distance = distance
            if min_distance < max_distance:
                break
        return best

    def distance(self, targets: Sequence[Tensor], motion: Motion) -> float:
        """Return the mean distance of all views from their targets, at full sharpness and blurred."""
        return mean_distance(self.crops, move_rows(self.original, self.parts, motion), targets)

    def _search(self, targets: Sequence[Tensor], start: Motion, wide: bool, on_step: OnStep | None) -> Motion:
        values = torch.cat(
            [start.shift / self.parts.sizes[:, None], start.log_scale[:, None], start.turn], dim=1
        )
        shift, size, turn = _RATES
        rates = values.new_tensor([shift] * 3 + [size] + [turn] * 3)
        wide_rates = values.new_tensor([3 * shift] * 3 + [size] + [0.0] * 3)
        widening = round(_WIDE_STEP_SHARE * self.steps) if wide else 0

        def loss_in(values: Tensor, view: int, step: int) -> Tensor:
            rows = move_rows(self.original, self.parts, _motion(values, self.parts))
            return view_distance(self.crops[view], rows, targets[view], wide=step < widening)

        def rates_at(step: int) -> Tensor:
            return wide_rates if step < widening else falling(step - widening, self.steps - widening) * rates

        settled = descend(values, loss_in, rates_at, self.steps, len(self.crops), self.seed, on_step=on_step)
        return _motion(settled, self.parts)


def _motion(values: Tensor, parts: Parts) -> Motion:
    return Motion(values[:, :3] * parts.sizes[:, None], values[:, 3], values[:, 4:])


def mean_distance(
    crops: Sequence[CropScene],
    rows: Tensor,
    targets: Sequence[Tensor],
    attributes: Sequence[str] = MOVING_ATTRIBUTES,
) -> float:
    """Return the mean distance of all views from their targets, at full sharpness and blurred.

    Args:
        crops: the views
        rows: raw member rows. [M,C]
        targets: edited box of each view. [h,w,3] each
        attributes: attributes that differ from the original's; the others are ignored
    """
    with torch.no_grad():
        pairs = zip(crops, targets, strict=True)
        total = sum(float(view_distance(crop, rows, target, attributes)) for crop, target in pairs)
    return total / len(targets)


def view_distance(
    scene: CropScene,
    rows: Tensor,
    target: Tensor,
    attributes: Sequence[str] = MOVING_ATTRIBUTES,
    wide: bool = False,
) -> Tensor:
    """Return the L1 distance at full sharpness and blurred, or widely blurred only (`wide`).

    Blurred pictures attract a part to a position that it does not overlap yet. Attributes other than
    `attributes` are the original's.
    """
    image = scene.render(rows, attributes)
    difference = image - target
    loss = difference.new_zeros(()) if wide else difference.abs().mean()
    longer = max(scene.size)
    planes = difference.permute(2, 0, 1)[None]
    for blur in [round(longer * share) for share in _WIDE_BLUR_SHARES] if wide else _BLURS_PX:
        width = max(1, min(blur, *scene.size))
        loss = loss + avg_pool2d(planes, width, max(1, width // 3)).abs().mean()
    return loss


def descend(
    start: Tensor,
    loss_in: Callable[[Tensor, int, int], Tensor],
    rates_at: Callable[[int], Tensor],
    steps: int,
    views: int,
    seed: int,
    damping: float = 0.0,
    on_step: OnStep | None = None,
) -> Tensor:
    """Return the numbers that minimize a loss, averaged over the last quarter of the steps.

    The optimizer is Adam with short memories. It differs from torch's if `damping` is given: ε is then a
    share of the column's root mean square.

    Args:
        start: initial numbers. [P,C]
        loss_in: numbers, index of a view, steps done -> the loss in this view
        rates_at: steps done -> step length of each column. [C]
        steps: total
        views: number of views; drawn in random order without replacement, then again
        seed: seed of the order
        damping: share of a column's typical gradient added to Adam's denominator: hardly visible rows stay
            in place
        on_step: progress

    Raises:
        FloatingPointError: the loss is no longer finite.
    """
    values = start.detach().clone().requires_grad_()
    first = torch.zeros_like(values)
    second = torch.zeros_like(values)
    settled = torch.zeros_like(values)
    averaged = max(1, round(_AVERAGED_STEP_SHARE * steps))
    order = torch.Generator().manual_seed(seed)
    queue: list[int] = []
    for step in range(steps):
        if not queue:
            queue = torch.randperm(views, generator=order).tolist()
        loss = loss_in(values, queue.pop(), step)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise FloatingPointError(f"the loss is {value} at step {step} of the group stage")
        (gradient,) = torch.autograd.grad(loss, values)
        with torch.no_grad():
            first.lerp_(gradient, 0.2)
            second.lerp_(gradient.square(), 0.02)
            mean = first / (1 - 0.8 ** (step + 1))
            spread = (second / (1 - 0.98 ** (step + 1))).sqrt()
            floor = damping * spread.square().mean(dim=0).sqrt()
            values -= rates_at(step) * mean / (spread + floor + 1e-12)
            if steps - step <= averaged:
                settled += values / averaged
        if on_step is not None:
            on_step(step + 1, value)
    return settled


def falling(step: int, steps: int) -> float:
    """Return the factor to a rate, which falls from 1 to 0.05 along half a cosine wave."""
    return 0.05 + 0.95 * (0.5 + 0.5 * math.cos(math.pi * step / steps))
