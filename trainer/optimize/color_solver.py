"""Edits of colors alone: all views at once, each member by the step that its own weight asks for.

While nothing moves, every training view is linear in the members' colors (`progdf.rasterize.cpu.engine`), but
for the clamps at black and white. So a stage is a least-squares problem. It is solved by accelerated gradient
descent (Nesterov 1983), each member's step divided by a bound of its curvature, Σ w·m over its pixels (SIRT
in tomography): a member that is a hundredth of a pixel gets its answer as a large one does, and nothing
walks at random, as where an optimizer looks at a view at a time and steps by the gradient's sign.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from progdf.gaussians import attribute_slices, unpack
from progdf.rasterize.cpu.engine import ColorMap, color_map
from progdf.sh import basis
from progdf.threads import one_thread, threads
from trainer.views.crops import CropScene

from .losses import l1
from .pgs import OnStep, ParameterSnapshot, PgsState, TargetStage
from .unseen import UnseenMembers

STEPS_OF_OTHERS = 8
"""Steps of an optimizer that looks at one view at a time which one iteration over all views stands for."""

HURRIED_STEPS, HURRIED = 4, 60
"""The same for a run of few steps, up to so many iterations: with half of them a draft of the toy robot was
mottled half way (held out, s = .5: 30.1 dB; 33.3 with 60, 35.7 with 100)."""

BANDS_HELD = 0.1
"""How strongly the higher bands are held to what the change of DC predicts, beside what the views say of
them: views are few directions, and bands that are free fit these and shine in others."""

_A = TypeVar("_A")
_B = TypeVar("_B")


@dataclass(frozen=True)
class ColorView:
    """One training view's box as a function of the members' colors."""

    map: ColorMap  # what each member weighs in each pixel
    others: Tensor  # what all but the members show, unclamped. [h,w,3]
    basis: Tensor  # weight of each trained band in each member's color from here. [M,B]
    original: Tensor  # the members' unclamped colors as they were. [M,3]

    def colors(self, offsets: Tensor) -> Tensor:
        """Unclamped. [M,B,3] -> [M,3]"""
        return self.original + torch.einsum("mb,mbc->mc", self.basis, offsets)

    def picture(self, colors: Tensor) -> Tensor:
        """Unclamped. [M,3] -> [h,w,3]"""
        return self.others + self.map.picture(colors.clamp_min(0.0))

    def error(self, offsets: Tensor, target: Tensor) -> float:
        """Sum of squared differences, of colors 0..1. [M,B,3], [h,w,3]"""
        image = self.picture(self.colors(offsets)).clamp(0.0, 1.0)
        return float((image - target).square().sum())


def color_view(crop: CropScene, original: Tensor, bands: int) -> ColorView:
    """Prepare a view. `original`: raw member rows [M,14+]; `bands`: how many are trained, DC among them."""
    camera = crop.camera
    members = unpack(original, crop.member_shN)
    directions = torch.nn.functional.normalize(members.means - camera.position, dim=1)
    weights = basis(min(members.sh_degree, 3), directions)
    colors = (weights[..., None] * members.sh[:, : weights.shape[1]]).sum(dim=1) + 0.5
    weighed = color_map(crop.gaussians, camera, crop.box, crop.rows)
    picture = crop.original()
    if crop.cached is not None:
        live, constant = crop.cached
        picture = torch.where(live, picture, constant)
    return ColorView(
        weighed,
        picture - weighed.picture(colors.clamp_min(0.0)),
        weights[:, :bands].contiguous(),
        colors,
    )


@dataclass(frozen=True)
class _Pull:
    """What a view says at some offsets."""

    gradient: Tensor  # of half the squared error, in the members' colors. [M,3]
    squared: float  # sum of squared differences from the target
    left: float  # mean absolute difference from the finished edit


def _pull_into_range(view: ColorView, offsets: Tensor, target: Tensor, finished: Tensor) -> _Pull:
    """A clamp passes what would bring its value back into the range, as `clamp_towards` does."""
    raw = view.colors(offsets)
    rendered = view.picture(raw)
    image = rendered.clamp(0.0, 1.0)
    apart = image - target
    back = view.map.gradient(apart * leads_back(rendered, 0.0, 1.0, apart))
    back = back * leads_back(raw, 0.0, math.inf, back)
    return _Pull(back, float(apart.square().sum()), float(l1(image, finished)))


def leads_back(value: Tensor, low: float, high: float, slope: Tensor) -> Tensor:
    """Where a clamp passes a gradient: inside, and where descent would bring the value back. [...] bool"""
    return ((value >= low) | (slope < 0.0)) & ((value <= high) | (slope > 0.0))


@dataclass(frozen=True)
class Solver:
    """All training views of a run."""

    views: Sequence[ColorView]  # see `ColorView`
    # bound of each member's and band's curvature: Σ w·m over the views' pixels, m the members' weight there,
    # times the basis squared. [M,B,1]
    weights: Tensor
    bands: Tensor  # the members' own higher bands as far as they are trained. [M,B-1,3]
    dc: Tensor  # the members' own DC. [M,3]

    def error(self, offsets: Tensor, targets: Sequence[Tensor]) -> float:
        """Mean squared difference over all pixels and channels of all boxes. [M,B,3]"""
        pairs = list(zip(self.views, targets, strict=True))
        total = sum(_map_threads(lambda pair: pair[0].error(offsets, pair[1]), pairs))
        return total / max(1, sum(target.numel() for target in targets))

    def step(
        self, offsets: Tensor, targets: Sequence[Tensor], finished: Sequence[Tensor]
    ) -> tuple[Tensor, float, float]:
        """One step of plain descent from these offsets. [M,B,3]

        Returns:
            where it leads [M,B,3]; at the offsets: mean squared difference from the targets, mean absolute
            difference from the finished edit
        """
        work = list(zip(self.views, targets, finished, strict=True))
        pulls = _map_threads(lambda item: _pull_into_range(item[0], offsets, item[1], item[2]), work)
        held = self._hold_weights()
        gradient = held * (offsets - self._predicted_bands(offsets))
        for view, pull in zip(self.views, pulls, strict=True):
            gradient += view.basis[..., None] * pull.gradient[:, None]
        squared = sum(pull.squared for pull in pulls) / max(1, sum(target.numel() for target in targets))
        left = sum(pull.left for pull in pulls) / len(pulls)
        return offsets - gradient / (self.weights + held).clamp_min(1e-9), squared, left

    def _hold_weights(self) -> Tensor:
        """How strongly each band of each member is held. [M,B,1]"""
        held = torch.zeros_like(self.weights)
        held[:, 1:] = BANDS_HELD * self.weights[:, :1]
        return held

    @one_thread()  # products of members are added in an order that depends on the number of threads
    def _predicted_bands(self, offsets: Tensor) -> Tensor:
        """DC as it is; the higher bands turned and stretched as DC is: the linear part of the affine map from
        old DC to new, fitted to all members by what they weigh. [M,B,3]"""
        predicted = offsets.clone()
        if offsets.shape[1] > 1:
            weights = self.weights[:, 0]
            x = torch.cat([self.dc, torch.ones(len(self.dc), 1)], dim=1)
            square = x.T @ (weights * x)
            square += 1e-4 * square.diagonal().mean() * torch.eye(4)
            change = torch.linalg.solve(square, x.T @ (weights * offsets[:, 0]))[:3]
            predicted[:, 1:] = self.bands @ change
        return predicted


def iterations(steps: int) -> int:
    """Over all views, for `--steps` of one view each; few steps are not to stop far from the answer."""
    return max(1, round(steps / STEPS_OF_OTHERS), min(HURRIED, round(steps / HURRIED_STEPS)))


def make_solver(crops: Sequence[CropScene], original: Tensor, trained_bands: bool) -> Solver:
    """The views, prepared. `trained_bands`: whether colors may change with the direction otherwise."""
    members = unpack(original, crops[0].member_shN)
    bands = 1 + (min(members.shN.shape[1], 15) if trained_bands else 0)
    views = [color_view(crop, original, bands) for crop in crops]

    def weigh(view: ColorView) -> Tensor:
        ones = torch.ones(view.map.count, 3)
        weight = view.map.gradient(view.map.picture(ones))[:, :1]
        # (Σ a)² ≤ 2 a0² + 2 (Σ others)²: DC is not slowed down by the number of bands
        size = view.basis.abs()
        others = size[:, 1:].sum(dim=1, keepdim=True)
        bound = torch.cat([size[:, :1].square(), size[:, 1:] * others], dim=1) * (2.0 if bands > 1 else 1.0)
        return bound * weight

    weights = torch.stack(_map_threads(weigh, views)).sum(dim=0)[..., None]
    return Solver(views, weights, members.shN[:, : bands - 1], members.sh0)


def solve(
    original: Tensor,
    solver: Solver,
    stages: Sequence[TargetStage],
    state: PgsState,
    on_step: OnStep,
    unseen_members: UnseenMembers | None = None,
) -> Iterator[ParameterSnapshot]:
    """Solve for the stages in turn, each from where the last one ended, and yield each one's end.

    Args:
        original: raw member rows, packed. [M,C]
        solver: the views
        stages: strengths ascending; a stage's steps are its iterations
        state: where to go on from, changed in place; a step is an iteration over all views
        on_step: progress; here, and only here, the state is whole and may be saved
        unseen_members: members that no view shows; tied to those that they follow at every step, they cost
            the views nothing afterwards (the demo's room in another tint, PSNR where no view looks: 17.2 dB
            without them, 42.7 with them)

    Raises:
        FloatingPointError: the loss or where it leads is not finite; the state is that of the step before.
    """
    columns = color_columns(original.shape[1], solver.weights.shape[1])
    finished = stages[-1].targets
    for index in range(state.stage, len(stages)):
        stage = stages[index]
        while state.local < stage.steps:
            moved = state.moved.detach()[:, columns].reshape(len(original), -1, 3)
            before = state.previous[:, columns].reshape(len(original), -1, 3)
            ahead = moved + (moved - before) * (state.local / (state.local + 3.0))
            offsets, squared, state.running = solver.step(ahead, stage.targets, finished)
            if not math.isfinite(squared) or not math.isfinite(float(offsets.sum())):
                raise FloatingPointError(f"the loss is {squared} at step {state.step}")
            state.previous.copy_(state.moved.detach())
            with torch.no_grad():
                state.moved[:, columns] = offsets.flatten(1)
                if unseen_members is not None:
                    state.moved.copy_(unseen_members.propagate(state.moved.detach()))
            state.means.add({"l2": squared, "left": state.running})
            state.step, state.local = state.step + 1, state.local + 1
            state.average.copy_(state.moved.detach())
            if state.local == stage.steps:
                state.recorded += 1
                yield ParameterSnapshot(state.step, index, True, state.average.clone(), state.means.read())
            on_step(state.step, state.running)
        state.stage, state.local = index + 1, 0


def color_columns(channels: int, bands: int) -> Tensor:
    """Where DC and the trained bands are in a packed row. [3·B] int64"""
    slices = attribute_slices(channels)
    dc = torch.arange(channels)[slices["sh0"]]
    higher = torch.arange(channels)[slices["shN"]][: 3 * (bands - 1)] if bands > 1 else dc[:0]
    return torch.cat([dc, higher])


def _map_threads(work: Callable[[_A], _B], items: Sequence[_A]) -> list[_B]:
    """`work` of every item, on as many threads as the rasterizer has; the same bits on any number."""
    if threads() == 1 or len(items) == 1:
        return [work(item) for item in items]
    with ThreadPoolExecutor(threads()) as pool:
        return list(pool.map(work, items))
