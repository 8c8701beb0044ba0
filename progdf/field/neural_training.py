"""Training a neural field on a finished trajectory, from the first step to the stored network."""

from __future__ import annotations

import math
from collections.abc import Callable

from torch import Tensor

from .neural import NeuralField
from .neural_fit import NeuralFit, NeuralSettings, PictureLoss
from .rendered import Render, rendered_importance
from .separable import check_trajectory, moving_attributes


def fit_neural(
    strengths: Tensor,
    offsets: Tensor,
    rows: Tensor,
    settings: NeuralSettings | None = None,
    visibility: Tensor | None = None,
    render: Render | None = None,
    pictures: PictureLoss | None = None,
    recorded: tuple[float, ...] | None = None,
    on_step: Callable[[int, float], None] | None = None,
) -> NeuralField:
    """Train a neural field on a finished trajectory.

    Args:
        strengths: of the snapshots, ascending from 0 to 1. [T]
        offsets: raw offsets of the members; the first row is 0, the last the recorded end. [T,M,C] float32
        rows: raw values of the members before the edit, packed. [M,≥14]
        settings: see NeuralSettings
        visibility: how much each member shows. [M]; None is evenly
        render: of a few views; tells how much each attribute shows. None weighs all numbers alike
        pictures: the loss is of these instead of offsets
        recorded: strengths for the slider's ticks; `strengths` when None
        on_step: progress: steps done, loss

    Raises:
        ValueError: no trajectory, or one that moves nothing.
    """
    check_trajectory(strengths, offsets)
    attributes = tuple(moving_attributes(offsets))
    if not attributes:
        raise ValueError("nothing moves, so there is nothing for a network to learn")
    fit = NeuralFit(rows, offsets.shape[2], attributes, settings or NeuralSettings(), visibility)
    fit.scale_to(offsets, rendered_importance(offsets, render) if render is not None else None)
    train_network(fit, strengths, offsets, fit.settings.steps, pictures, on_step)
    return fit.field(tuple(strengths.tolist()) if recorded is None else recorded)


def train_network(
    fit: NeuralFit,
    strengths: Tensor,
    offsets: Tensor,
    steps: int,
    pictures: PictureLoss | None = None,
    on_step: Callable[[int, float], None] | None = None,
) -> None:
    """Take `steps` steps with a rate that falls to 0 along half a cosine."""
    for done in range(steps):
        factor = 0.5 * (1.0 + math.cos(math.pi * done / steps))
        loss = fit.step(strengths, offsets, factor, pictures)
        if on_step is not None:
            on_step(done + 1, loss)
