"""Progressive Gaussian splatting (PGS; ProGDF, AAAI 2025): the edit optimization that records its trajectory.

The paper runs one optimization towards the edited views and records its path. The states between look worse
than a straight line (docs/method.md 3). The targets are therefore staged: the editor paints the edit at
several strengths, and the members are optimized towards each in turn. Within a stage the target is blended
from the previous stage's pictures to its own, so that the path between them is short and straight.

Edits that change only colors are solved with all views at once instead (`color_solver`), unless an option
needs descent view by view (`trainer.resolve.resolve_kind`).

Effect of stages: docs/lab/experiments.md, Stages.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import torch
from torch import Tensor

from progdf.gaussians import attribute_slices
from progdf.io.json_values import convert_json, to_json
from progdf.system.equality import equal_fields
from trainer.options import Kind, OptimizeOptions
from trainer.store.state import Saved, generator
from trainer.views.boxes import probe_views
from trainer.views.crops import CropScene, render_all
from trainer.views.setup import TrainingSetup

from .losses import Moment, Objective, Perceptual, TermMeans, l1, total_loss

EPSILON = 0.1
"""Raised ε of Adam, as a share of the root mean square of an attribute's gradient."""

ADAM_EPSILON = 1e-15
"""ε of Adam before it is raised."""
SMOOTHING = 0.9
"""Weight of the previous value in the running mean of the parameters, which is recorded."""

_COUNT_FIELDS = ("step", "stage", "local")
_ROW_FIELDS = ("moved", "previous", "average", "first", "second")


class _StateValues(msgspec.Struct):
    """Values of `PgsState.capture_state` that are not tensors."""

    step: int
    stage: int
    local: int
    running: float | None
    means: dict[str, tuple[float, int]]
    queue: list[int]


class PgsState:
    """State of one optimization, changed in place by its steps.

    Args:
        rows: packed raw rows of the members; the state starts exactly at these. [M,C]
        seed: seed of the view order

    Attributes:
        moved: offsets of the members, a leaf that takes gradients. [M,C]
        previous: the offsets one step earlier. [M,C]
        average: their running mean, which is recorded. [M,C]
        first, second: Adam's moments. [M,C]
        pictures: renders of the probes at the last recording. [h,w,3] each; empty before the first step
        step: steps done
        stage, local: index of the stage, and steps done in it
        running: running mean of the L1 distance from the finished edit; NaN before the first step
        means: loss terms since the last recording
    """

    def __init__(self, rows: Tensor, seed: int = 0) -> None:
        self.moved = torch.zeros_like(rows, requires_grad=True)
        self.previous = torch.zeros_like(rows)
        self.average = torch.zeros_like(rows)
        self.first = torch.zeros_like(rows)
        self.second = torch.zeros_like(rows)
        self.pictures: Sequence[Tensor] = ()
        self.step = self.stage = self.local = 0
        self.running = math.nan
        self.means = TermMeans()
        self._order = torch.Generator().manual_seed(seed)
        self._queue: list[int] = []

    def view(self, count: int) -> int:
        """Return the index of the current view.

        Views are drawn in random order without replacement, then again.
        """
        if not self._queue:
            self._queue = torch.randperm(count, generator=self._order).tolist()
        return self._queue[-1]

    def descend(self, gradient: Tensor, rates: Tensor, length: float, growth: float = math.inf) -> None:
        """Take one step of Adam with a rate per column, and advance to the next view.

        Adam ignores the magnitude of gradients, so a hardly visible member would wander as far as a fully
        visible one. A tenth of the attribute's typical gradient, added to ε, keeps it in place
        (docs/lab/experiments.md, Rates and steps). The running mean starts exactly at the original.

        Args:
            gradient: gradient of the loss by `moved`. [M,C]
            rates: learning rate of each column. [C]
            length: factor to all rates
            growth: maximum factor by which a member may grow
        """
        mean, spread = self.moments(gradient)
        floor = torch.full_like(rates, ADAM_EPSILON)
        slices = attribute_slices(len(rates))
        for columns in slices.values():
            floor[columns] += EPSILON * spread[:, columns].square().mean().sqrt()
        self.move(length * (rates * mean / (spread + floor)))
        if growth < math.inf:
            with torch.no_grad():
                self.moved[:, slices["log_scales"]].clamp_(max=math.log(growth))
        smoothing = min(SMOOTHING, (self.step + 1) / (self.step + 10))
        self.average.lerp_(self.moved.detach(), 1.0 - smoothing)
        self.advance()

    def moments(self, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Update Adam's moments (Kingma and Ba 2015).

        Return the unbiased mean and root mean square of the gradient. [M,C] each
        """
        done = self.step + 1
        self.first.lerp_(gradient, 0.1)
        self.second.lerp_(gradient.square(), 0.001)
        mean = self.first / (1 - 0.9**done)
        spread = (self.second / (1 - 0.999**done)).sqrt()
        return mean, spread

    def move(self, change: Tensor) -> None:
        """Subtract a change from the offsets. [M,C]"""
        with torch.no_grad():
            self.previous.copy_(self.moved)
            self.moved -= change

    def advance(self) -> None:
        """Count the step, and advance to the next view."""
        self.step = self.step + 1
        self.local = self.local + 1
        self._queue.pop()

    def capture_state(self) -> Saved:
        """Return the state for saving (see `state.Resumable`)."""
        # For a solved edit the moments are 0 and the mean equals the offsets.
        tensors = {name: getattr(self, name) for name in _ROW_FIELDS}
        tensors = {name: rows for name, rows in tensors.items() if bool(_bit_patterns(rows).any())}
        if torch.equal(_bit_patterns(self.average), _bit_patterns(self.moved)):
            tensors.pop("average", None)
        else:
            tensors["average"] = self.average
        tensors |= {f"picture{i}": picture for i, picture in enumerate(self.pictures)}
        tensors["order"] = self._order.get_state()
        running = self.running if self.step else None
        sums = self.means.sums
        counts = {name: getattr(self, name) for name in _COUNT_FIELDS}
        return Saved(tensors, to_json(_StateValues(**counts, running=running, means=sums, queue=self._queue)))

    def restore(self, saved: Saved) -> None:
        """Restore a saved state (see `state.Resumable`)."""
        tensors = saved.tensors
        values = convert_json(saved.values, _StateValues)
        with torch.no_grad():
            for name in _ROW_FIELDS:
                default = tensors.get("moved" if name == "average" else name, torch.zeros_like(self.first))
                getattr(self, name).copy_(tensors.get(name, default))
        self.pictures = [
            tensors[f"picture{i}"].to(self.first)
            for i in range(sum(k.startswith("picture") for k in tensors))
        ]
        for name in _COUNT_FIELDS:
            setattr(self, name, getattr(values, name))
        self.running = math.nan if values.running is None else values.running
        self.means.sums = dict(values.means)
        self._order = generator(tensors["order"])
        self._queue = list(values.queue)


def _bit_patterns(rows: Tensor) -> Tensor:
    """Return the bit patterns, which distinguish −0 from 0."""
    return rows.detach().view(torch.int32)


LEARNING_RATES: Mapping[Kind, Mapping[str, float]] = {
    # Rates that converge within a few hundred steps (docs/method.md 3). A color edit leaves the geometry
    # unchanged, which is 1.4 dB better and saves 11 floats per Gaussian.
    "color": {"sh0": 7.5e-2, "shN": 3.75e-3},
    "style": {
        "means": 3.2e-4,
        "log_scales": 1e-2,
        "quats": 2e-3,
        "logit_opacities": 2e-2,
        "sh0": 6e-2,
        "shN": 3e-3,
    },
    "geometry": {
        "means": 1.28e-3,
        "log_scales": 2e-2,
        "quats": 8e-3,
        "logit_opacities": 2e-2,
        "sh0": 1e-2,
        "shN": 5e-4,
    },
}

MAX_GROWTH = 2.0
"""Maximum growth factor of a Gaussian beyond that of its part.

Larger Gaussians are fog that hides an error.
"""
REFERENCE_CHANGE = 0.16
"""Change of a channel within a stage for which the rates are tuned (see `PgsSettings.reach`)."""
DECAY_SHARE = 0.35
"""Final share of a stage's steps over which the learning rate falls (see `PgsSettings.fall`)."""
RAMP_SHARE = 0.6
"""Share of a stage's steps over which its target is blended, see `PgsSettings.ramp`."""
SINGLE_RAMP_SHARE = 0.9
"""The same for a single stage, approached slowly: fast steps cause speckles of all colors half way."""
SNAPSHOTS = 32
"""Approximate number of recordings over all stages."""


@dataclass(frozen=True)
class PgsSettings:
    """Settings of the members' descent."""

    __eq__ = equal_fields

    rates: Tensor  # learning rate of each column of a packed row, raw units. [C]
    # share of a stage's steps over which its target is blended from the last stage's
    ramp: float = RAMP_SHARE
    # final share of a stage's steps over which the rate falls to a tenth; 0: constant
    fall: float = DECAY_SHARE
    # Reference for the change of a stage, in 95 % of the changing pixels (`p95_change`). Steps are shorter if
    # the change is smaller, down to a quarter, and longer if it is larger, up to 1.5 times; 0: the same for
    # all. Steps that are too long become random walks where the views do not resolve single Gaussians: close
    # up, these are speckles of all colors.
    reach: float = REFERENCE_CHANGE
    growth: float = math.inf  # maximum factor by which a Gaussian grows beyond its stage's placement
    snapshots: int = SNAPSHOTS  # approximate number of recordings over all stages
    seed: int = 0  # seed of the view order


def pgs_settings(options: OptimizeOptions, rates: Tensor, stages: int) -> PgsSettings:
    """Return the settings of a run's descent.

    Args:
        options: fully resolved, see `trainer.resolve.resolve_kind`
        rates: learning rate of each column. [C]
        stages: number of strengths to optimize towards
    """
    recolors = options.kind != "geometry"
    ramp = SINGLE_RAMP_SHARE if stages == 1 else RAMP_SHARE
    return PgsSettings(
        rates,
        ramp=ramp if recolors else 0.0,
        fall=1.0 if stages == 1 else DECAY_SHARE,
        reach=REFERENCE_CHANGE if recolors else 0.0,
        growth=MAX_GROWTH if options.group_steps else math.inf,
        seed=options.seed,
    )


@dataclass(frozen=True)
class TargetStage:
    """One strength to optimize towards."""

    strength: float  # slider value, 0..1
    targets: Sequence[Tensor]  # edited box of each training view. [h,w,3] each
    steps: int  # number of steps
    # Converts the optimized offsets of the members to the rendered and recorded ones: a part that moves as a
    # whole carries its members. Differentiable. [M,C] -> [M,C]
    place: Callable[[Tensor], Tensor] = lambda offsets: offsets
    # Factor to the learning rates; None: by the change of the pictures, see `PgsSettings.reach`.
    length: float | None = None


@dataclass(frozen=True)
class ParameterSnapshot:
    """One recording: the running mean of the parameters, as offsets from the original."""

    __eq__ = equal_fields

    step: int  # optimizer steps done, over all stages
    ends_stage: bool  # last recording of its stage
    offsets: Tensor  # raw-space offsets of the members after placement. [M,C] float32
    # Means since the last recording: each weighted loss term, over the steps that computed it, and "left",
    # the L1 distance from the finished edit.
    means: Mapping[str, float]
    table: Tensor | None = None  # color map at the end of a stage, if any. [K,3]


OnStep = Callable[[int, float], None]
"""Callback after every step: steps done, running mean of the L1 distance from the finished edit."""


def learning_rates(kind: Kind, channels: int, extent: float) -> Tensor:
    """Return the learning rate of every column of a packed row for a kind of edit. [C]

    Args:
        kind: attributes that move, see `LEARNING_RATES`
        channels: columns of a packed row
        extent: size of the moving object, world units
    """
    return rates_per_column(LEARNING_RATES[kind], channels, extent)


def rates_per_column(rates: Mapping[str, float], channels: int, extent: float) -> Tensor:
    """Return the learning rate of every column of a packed row. [C]

    Args:
        rates: rate of each attribute that moves; the means' is for an object of extent 1
        channels: columns of a packed row
        extent: size of the moving object, world units
    """
    column_rates = torch.zeros(channels)
    for name, columns in attribute_slices(channels).items():
        column_rates[columns] = rates.get(name, 0.0) * (extent if name == "means" else 1.0)
    return column_rates


def rated_attributes(rates: Tensor) -> list[str]:
    """Return the attributes with a learning rate above 0. [C]"""
    slices = attribute_slices(len(rates))
    return [name for name, columns in slices.items() if bool((rates[columns] > 0).any())]


@dataclass(frozen=True)
class DescentTask:
    """Inputs of a run's descent that do not depend on its method."""

    __eq__ = equal_fields

    options: OptimizeOptions  # fully resolved, see `trainer.resolve.resolve_kind`
    setup: TrainingSetup  # scene, members and views, with the rows that the edit adds
    rates: Tensor  # learning rate of each column of a packed row. [C]
    original: Tensor  # raw member rows, packed. [M,C]
    crops: Sequence[CropScene]  # training views, in the order of the stages' targets
    stages: Sequence[TargetStage]  # strengths ascending
    perceptual: Perceptual
    adds_rows: bool = False  # the last members are rows that the edit adds


def descend(task: DescentTask, state: PgsState, on_step: OnStep) -> Iterator[ParameterSnapshot]:
    """Optimize the members of a run, from a state that is changed in place, and yield recordings."""
    options = task.options
    settings = pgs_settings(options, task.rates, len(task.stages))
    # added rows have their stage's opacity from its first step, which a blended target contradicts
    if task.adds_rows:
        settings = replace(settings, ramp=0.0)
    return optimize(
        task.original,
        task.crops,
        probe_views(task.setup, engine=options.engine),
        task.stages,
        Objective(task.perceptual, options),
        settings,
        on_step=on_step,
        state=state,
    )


def optimize(
    original: Tensor,
    crops: Sequence[CropScene],
    probes: Sequence[CropScene],
    stages: Sequence[TargetStage],
    objective: Objective,
    settings: PgsSettings,
    on_step: OnStep | None = None,
    state: PgsState | None = None,
) -> Iterator[ParameterSnapshot]:
    """Optimize the member rows towards each stage in turn, and yield recordings.

    A recording is made when the probes' pictures have changed by a share of the stage's total change, and at
    the end of every stage. Only the members are optimized, so nothing else can drift.

    Args:
        original: raw member rows, packed. [M,14] or [M,14+3K]
        crops: training views, in the order of the stages' targets
        probes: a few small views to measure change in
        stages: strengths ascending
        objective: loss of each step
        settings: see `PgsSettings`
        on_step: progress callback; the state is consistent, and may be saved, only during this call
        state: state to continue from, changed in place; None: start at the original

    Raises:
        FloatingPointError: the loss or its gradient is not finite; the state is that of the previous step.
    """
    rates = settings.rates.to(original.device)
    moving = rated_attributes(settings.rates)
    state = PgsState(original, settings.seed) if state is None else state
    if not state.step:
        state.pictures = render_all(probes, original)
    for index in range(state.stage, len(stages)):
        stage = stages[index]
        before = stages[index - 1].targets if index else render_all(crops, original)
        objective.begin_stage()
        size = _step_size(stage, before, settings.reach)
        spacing = mean_visible_change(stage.targets, before)[0] * len(stages) / settings.snapshots
        while state.local < stage.steps:
            view = state.view(len(crops))
            share = (state.local + 1) / max(1.0, settings.ramp * stage.steps)
            target = stage.targets[view]
            target = target if share >= 1.0 else torch.lerp(before[view], target, share)
            image = crops[view].render(original + stage.place(state.moved), moving)
            moment = Moment(
                image, target, view, state.step, state.local, share >= 1.0, state.moved, state.previous
            )
            gradient = loss_gradient(objective.terms(moment), image, state, stages[-1].targets[view])
            length = size * _decay(settings.fall, state.local, stage.steps)
            state.descend(gradient, rates, length, settings.growth)

            last = state.local == stage.steps
            if last or state.local % 2:
                offsets = stage.place(state.average)
                pictures = render_all(probes, original + offsets, moving)
                if last or _mean_distance(pictures, state.pictures) >= spacing:
                    state.pictures = pictures
                    yield ParameterSnapshot(state.step, last, offsets.clone(), state.means.read())
            if on_step is not None:
                on_step(state.step, state.running)
        state.stage = index + 1
        state.local = 0


def _step_size(stage: TargetStage, before: Sequence[Tensor], reach: float) -> float:
    """Return the rate factor of a stage, see `TargetStage.length` and `PgsSettings.reach`."""
    if stage.length is not None:
        return stage.length
    return min(1.5, max(0.25, p95_change(stage.targets, before) / reach)) if reach > 0 else 1.0


def loss_gradient(terms: Mapping[str, Tensor], image: Tensor, state: PgsState, finished: Tensor) -> Tensor:
    """Return the gradient of the loss by the members' offsets [M,C]. Record its terms in the state.

    Args:
        terms: weighted terms of the loss. [] each
        image: the render. [h,w,3]
        state: state of the descent
        finished: the same view of the finished edit. [h,w,3]

    Raises:
        FloatingPointError: the loss or its gradient is not finite.
    """
    loss = total_loss(terms)
    if not math.isfinite(float(loss.detach())):
        raise FloatingPointError(f"the loss is {float(loss.detach())} at step {state.step}")
    state.moved.grad = None
    loss.backward()  # type: ignore[no-untyped-call]
    gradient = state.moved.grad
    assert gradient is not None
    if not math.isfinite(float(gradient.sum())):
        raise FloatingPointError(f"the loss has no finite gradient at step {state.step}")
    left = float(l1(image.detach(), finished))
    state.means.add({name: float(term.detach()) for name, term in terms.items()} | {"left": left})
    state.running = left if math.isnan(state.running) else 0.95 * state.running + 0.05 * left
    return gradient


def mean_visible_change(targets: Sequence[Tensor], before: Sequence[Tensor]) -> tuple[float, float]:
    """Return the mean change of the pictures, over all pixels and over the changing ones."""
    total = 0.0
    every = 0
    changing = 0
    for target, start in zip(targets, before, strict=True):
        change = (target - start).abs()
        total += float(change.sum())
        every += change.numel()
        changing += 3 * int((change.amax(dim=2) > 1 / 255).sum())
    return total / max(1, every), total / max(1, changing)


def p95_change(targets: Sequence[Tensor], before: Sequence[Tensor]) -> float:
    """Return the 95th percentile of the change of a channel over the changing pixels; 0 if none changes.

    Steps are sized by this instead of the mean: a few saturated pixels need long steps, a wide even change
    does not, and long steps make it noisy (docs/lab/experiments.md, Rates and steps).
    """
    changes = [(target - start).abs().amax(dim=2) for target, start in zip(targets, before, strict=True)]
    changing = torch.cat([change[change > 1 / 255] for change in changes])
    return float(changing.kthvalue(math.ceil(0.95 * len(changing))).values) if len(changing) else 0.0


def _decay(fall: float, local: int, steps: int) -> float:
    """Return the rate factor, which falls towards the end of a stage so that it ends near its target."""
    return min(1.0, 0.1 + 0.9 * (steps - local) / (steps * fall)) if fall > 0 else 1.0


def _mean_distance(a: Sequence[Tensor], b: Sequence[Tensor]) -> float:
    return sum(float((x - y).abs().mean()) for x, y in zip(a, b, strict=True)) / max(1, len(a))
