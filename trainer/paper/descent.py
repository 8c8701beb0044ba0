"""PGS of the paper: Adam with constant rates, and recordings of the raw iterates at fixed intervals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from torch import Tensor

from trainer.optimize.losses import Moment
from trainer.optimize.pgs import (
    ADAM_EPSILON,
    DescentTask,
    OnStep,
    ParameterSnapshot,
    PgsState,
    loss_gradient,
    rated_attributes,
    rates_per_column,
)
from trainer.options import Kind
from trainer.views.boxes import Pictures
from trainer.views.setup import TrainingSetup

from .losses import PaperObjective

RATES_3DGS: Mapping[str, float] = {
    "means": 1.6e-4,
    "log_scales": 5e-3,
    "quats": 1e-3,
    "logit_opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 1.25e-4,
}
"""Learning rates of 3DGS (Kerbl 2023) for a scene of extent 1."""
RATE_FACTORS: Mapping[str, float] = {
    "means": 5.0,
    "log_scales": 2.0,
    "quats": 2.0,
    "logit_opacities": 2.0,
    "sh0": 5.0,
    "shN": 5.0,
}
"""Factors of GaussianEditor's scripts of 1500 steps (Chen 2024) to these rates; the paper states no rates."""
RECORDING_INTERVAL_STEPS = 100
"""Interval between recordings, in steps."""
_MIN_RECORDINGS = 4  # minimum number of recordings of a run; a short one has a shorter interval


def learning_rates(kind: Kind, channels: int, extent: float) -> Tensor:
    """Return the learning rate of every column of a packed row, the same for all kinds of edit. [C]

    Args:
        kind: attributes that the editor changes; all attributes move
        channels: columns of a packed row
        extent: size of the region, world units
    """
    rates = {name: RATE_FACTORS[name] * rate for name, rate in RATES_3DGS.items()}
    return rates_per_column(rates, channels, extent)


def recording_interval(steps: int) -> int:
    """Return the interval between the recordings of a run, in steps."""
    return min(RECORDING_INTERVAL_STEPS, max(1, steps // _MIN_RECORDINGS))


def whole_views(setup: TrainingSetup, edited: Pictures) -> TrainingSetup:
    """Return the setup with training views whose boxes are the whole picture, whatever the edit changes."""
    boxes = [(0, 0, view.camera.width, view.camera.height) for view in setup.train]
    views = [replace(view, box=box) for view, box in zip(setup.train, boxes, strict=True)]
    return replace(setup, train=views)


def descend(task: DescentTask, state: PgsState, on_step: OnStep) -> Iterator[ParameterSnapshot]:
    """Optimize the members as printed, from a state that is changed in place, and yield recordings.

    Args:
        task: inputs of the descent
        state: state to continue from
        on_step: progress callback; the state is consistent, and may be saved, only during this call

    Raises:
        FloatingPointError: the loss or its gradient is not finite; the state is that of the previous step.
    """
    objective = PaperObjective(task.perceptual, task.options.perceptual_weight or 0.0)
    interval = recording_interval(task.options.steps)
    rates = task.rates.to(task.original.device)
    moving = rated_attributes(task.rates)
    finished = task.stages[-1].targets
    for index in range(state.stage, len(task.stages)):
        stage = task.stages[index]
        objective.begin_stage()
        while state.local < stage.steps:
            view = state.view(len(task.crops))
            target = stage.targets[view]
            image = task.crops[view].render(task.original + stage.place(state.moved), moving)
            moment = Moment(image, target, view, state.step, state.local, True, state.moved, state.previous)
            gradient = loss_gradient(objective.terms(moment), image, state, finished[view])
            mean, spread = state.moments(gradient)
            state.move(rates * mean / (spread + ADAM_EPSILON))
            state.average.copy_(state.moved.detach())
            state.advance()
            ends_stage = state.local == stage.steps
            if ends_stage or state.step % interval == 0:
                offsets = stage.place(state.average).clone()
                yield ParameterSnapshot(state.step, ends_stage, offsets, state.means.read())
            on_step(state.step, state.running)
        state.stage = index + 1
        state.local = 0
