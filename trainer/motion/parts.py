"""The parts of a region: which of its Gaussians hang together, and the search for where an edit takes them.

Gaussians that lie within a few spacings of each other are neighbors, and whatever a chain of neighbors joins
is one part. Seven numbers each are fitted to the edited views, coarse to fine: a part that does not overlap
its new place at all is drawn there by what both are blurred to.
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
from trainer.views.crops import CropScene

_NEIGHBOR = 8  # a Gaussian's spacing is the distance to its eighth neighbor: the first can be a twin
_SAMPLES = 512  # Gaussians whose spacing is measured
_REACH = 2.5  # spacings that a gap must have to part what it parts
_CELLS = 2.0  # cells per reach; then any two Gaussians of a cell are neighbors (√3 / 2 < 1)
_BLURS = (9, 21)  # pixels
_WIDE_BLURS = (0.4, 0.2, 0.1)  # of the box's longer side: a part feels a place three times its size away
_WIDE = 0.4  # share of a wide search's steps that see no more than those, shift thrice as fast, never turn
_RATES = (0.06, 0.03, 0.03)  # a step of shift in part sizes, of log-scale, of turn in radians
_MISSED = 0.25  # share of the distance that is left where the near search is taken to have lost its way
_MOVING = ("means", "log_scales", "quats")
_SETTLED = 0.25  # share of the steps, the last, over which the numbers are averaged

OnStep = Callable[[int, float], None]
"""Called after every step: steps done, loss."""


def connected_parts(means: Tensor, least: float = 0.02) -> Tensor:
    """Which part each Gaussian belongs to.

    Time and memory grow with the number of Gaussians: they are gathered in cells first, and cells are
    neighbors where their centroids are within reach, so a gap counts exactly to within half its width.

    Args:
        means: centers of the region's members. [M,3]
        least: a part with a smaller share of the members, or fewer than 8, is not a part of its own: stray
            Gaussians go with the nearest part that is

    Returns:
        Part of each, 0 the one with most members. [M] int64; the same for the same means
    """
    if len(means) == 0:
        return torch.zeros(0, dtype=torch.int64)
    points = means.detach().double()
    reach = _REACH * _spacing(points)
    if reach <= 0:
        return torch.zeros(len(points), dtype=torch.int64)
    cells = ((points - points.amin(dim=0)) / (reach / _CELLS)).floor().long()
    occupied, cell_of = torch.unique(cells, dim=0, return_inverse=True)
    counts = torch.bincount(cell_of, minlength=len(occupied))
    sums = torch.zeros(len(occupied), 3, dtype=torch.float64)
    centroids = sums.index_add(0, cell_of, points) / counts[:, None]
    return _join_strays(_join_cells(centroids, reach), centroids, counts, max(8.0, least * len(points)))[
        cell_of
    ]


def _spacing(points: Tensor) -> float:
    """Median distance to the eighth neighbor (of few points a nearer one), of up to 512 of the points."""
    rows = torch.arange(len(points))[:: max(1, len(points) // _SAMPLES)][:_SAMPLES]
    nearest = min(_NEIGHBOR, max(2, len(points) // 8), len(points) - 1)
    if not nearest:
        return 0.0
    return float(nearest_rows(points, rows, nearest)[1][:, -1].median())


def _join_cells(centroids: Tensor, reach: float) -> Tensor:
    """Return the group of each cell: cells within reach of each other share one. [C,3] -> [C]

    No two cells share a place, so the pairs of a cell are bounded by the cells within reach.
    """
    first, second = cKDTree(centroids.numpy()).query_pairs(reach, output_type="ndarray").T
    return torch.from_numpy(join_pairs(first, second, len(centroids)))


def _join_strays(labels: Tensor, centroids: Tensor, counts: Tensor, least: float) -> Tensor:
    """Parts numbered by size, the largest 0; cells of those below `least` go with the nearest other cell."""
    roots, part = torch.unique(labels, return_inverse=True)
    sizes = torch.zeros(len(roots), dtype=torch.int64).index_add(0, part, counts)
    order = sizes.argsort(descending=True, stable=True)
    count = max(1, int((sizes >= least).sum()))
    number = torch.empty_like(order)
    number[order] = torch.arange(len(order))
    part = number[part]
    stray = (part >= count).nonzero()[:, 0]
    firm = (part < count).nonzero()[:, 0]
    if len(stray):
        nearest = PointTree(centroids[firm].numpy(), 1).query(centroids[stray].numpy(), 1)[1]
        part[stray] = part[firm[torch.from_numpy(nearest[:, 0])]]
    return part


@dataclass(frozen=True)
class GroupSearch:
    """What the parts are fitted to, and how long."""

    original: Tensor  # raw member rows. [M,C]
    parts: Parts
    crops: Sequence[CropScene]  # the training views
    steps: int = 120  # of a search, each in one view
    seed: int = 0  # of the order of the views

    def find(self, targets: Sequence[Tensor], start: Motion, on_step: OnStep | None = None) -> Motion:
        """The motion of the parts that brings the views closest to their targets.

        A near search starts at full sharpness. Where it leaves a quarter of the distance, a wide one is tried
        too. The wide one arrives from farther away, but it can overlook what is close
        (docs/experiments.md, Parts that move).

        Args:
            targets: the edited box of each view. [h,w,3] each
            start: where to look first
            on_step: progress: steps done in this search; a wide one counts from 1 again

        Returns:
            The best motion found; `start` where none is better in the mean of all views.

        Raises:
            FloatingPointError: the loss is no longer finite.
        """
        best = start
        least = self.distance(targets, start)
        missed = _MISSED * least
        for wide in (False, True):
            motion = self._search(targets, start, wide, on_step)
            distance = self.distance(targets, motion)
            if distance < least:
                best = motion
                least = distance
            if least < missed:
                break
        return best

    def distance(self, targets: Sequence[Tensor], motion: Motion) -> float:
        """Mean distance of all views from their targets, at full sharpness and blurred."""
        return mean_distance(self.crops, move_rows(self.original, self.parts, motion), targets)

    def _search(self, targets: Sequence[Tensor], start: Motion, wide: bool, on_step: OnStep | None) -> Motion:
        values = torch.cat(
            [start.shift / self.parts.sizes[:, None], start.log_scale[:, None], start.turn], dim=1
        )
        shift, size, turn = _RATES
        rates = values.new_tensor([shift] * 3 + [size] + [turn] * 3)
        wide_rates = values.new_tensor([3 * shift] * 3 + [size] + [0.0] * 3)
        widening = round(_WIDE * self.steps) if wide else 0

        def loss_in(values: Tensor, view: int, step: int) -> Tensor:
            rows = move_rows(self.original, self.parts, _motion(values, self.parts))
            return view_distance(self.crops[view], rows, targets[view], wide=step < widening)

        def rates_at(step: int) -> Tensor:
            return wide_rates if step < widening else falling(step - widening, self.steps - widening) * rates

        settled = descend(values, loss_in, rates_at, self.steps, len(self.crops), self.seed, on_step=on_step)
        return _motion(settled, self.parts)


def _motion(values: Tensor, parts: Parts) -> Motion:
    return Motion(values[:, :3] * parts.sizes[:, None], values[:, 3], values[:, 4:])


def mean_distance(crops: Sequence[CropScene], rows: Tensor, targets: Sequence[Tensor]) -> float:
    """Mean distance of all views from their targets, at full sharpness and blurred. `rows`: members' [M,C]"""
    with torch.no_grad():
        pairs = zip(crops, targets, strict=True)
        return sum(float(view_distance(crop, rows, target)) for crop, target in pairs) / len(targets)


def view_distance(scene: CropScene, rows: Tensor, target: Tensor, wide: bool = False) -> Tensor:
    """L1 at full sharpness and blurred, or blurred widely only: so a part feels where it does not lie yet."""
    image = scene.render(rows, _MOVING)
    difference = image - target
    loss = difference.new_zeros(()) if wide else difference.abs().mean()
    longer = max(scene.size)
    planes = difference.permute(2, 0, 1)[None]
    for blur in [round(longer * share) for share in _WIDE_BLURS] if wide else _BLURS:
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
    """The numbers that lower a loss, averaged over the last quarter of the steps: Adam with short memories.

    It is not torch's: where `damping` is given, Adam's ε is a share of the column's root mean square.

    Args:
        start: where to begin. [P,C]
        loss_in: numbers, index of a view, steps done -> the loss in this view
        rates_at: steps done -> length of a step, of each column. [C]
        steps: in all
        views: all are taken in random order, again and again
        seed: of the order
        damping: share of a column's typical gradient below Adam's fraction: rows that hardly show stay put
        on_step: progress

    Raises:
        FloatingPointError: the loss is no longer finite.
    """
    values = start.detach().clone().requires_grad_()
    first = torch.zeros_like(values)
    second = torch.zeros_like(values)
    settled = torch.zeros_like(values)
    averaged = max(1, round(_SETTLED * steps))
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
    """Factor to a rate, from 1 to a twentieth along half a wave."""
    return 0.05 + 0.95 * (0.5 + 0.5 * math.cos(math.pi * step / steps))
