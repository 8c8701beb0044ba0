"""Losses of the paper: gradients, readings and their effect."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import pytest
import torch
from torch import Tensor

from tests.helpers.trained import course, small
from trainer.optimize.losses import GradientL1, Moment
from trainer.optimize.pgs import DescentTask, ParameterSnapshot, PgsState
from trainer.options import OptimizeOptions
from trainer.paper.descent import descend
from trainer.paper.losses import Exponent, Over, PaperObjective, progressive_change, sharpness
from trainer.views.setup import TrainingSetup

STEPS = 32


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def recolored() -> list[ParameterSnapshot]:
    """Return the recordings of a short recoloring of a small bear."""
    case = small("body")
    original, crops, _, stages, _, settings = course(case, STEPS)
    task = DescentTask(
        options=OptimizeOptions(steps=STEPS, perceptual_weight=0.1),
        setup=TrainingSetup(case.scene, case.region, case.views),
        rates=settings.rates,
        original=original,
        crops=crops,
        stages=stages[-1:],
        perceptual=GradientL1(),
    )
    return list(descend(task, PgsState(original), lambda step, left: None))


def distance_traveled() -> float:
    """Return the mean absolute offset at the end of a short recoloring."""
    return float(recolored()[-1].offsets.abs().mean())


# ---- the progressive constraint


@pytest.mark.parametrize("exponent", get_args(Exponent))
@pytest.mark.parametrize("over", get_args(Over))
def test_progressive_gradient_matches_finite_differences(exponent: Exponent, over: Over) -> None:
    moved = noise(5, 14).requires_grad_()
    previous = noise(5, 14, seed=1)
    assert torch.autograd.gradcheck(lambda x: progressive_change(x, previous, 70, exponent, over), moved)


def test_progressive_change_is_the_printed_sum_or_the_member_mean() -> None:
    moved = noise(5, 14)
    previous = noise(5, 14, seed=1)
    squares = (moved - previous).square().sum(dim=1)
    lengths: dict[Over, Tensor] = {"sum": squares.sum(), "mean": squares.mean()}
    for over, length in lengths.items():
        for step in (0, 50, 600):
            grown = progressive_change(moved, previous, step, "growth", over)
            decayed = progressive_change(moved, previous, step, "decay", over)
            assert float(grown) == pytest.approx(0.05 * 1.1 ** (step / 50) * float(length))
            assert float(decayed) == pytest.approx(0.05 * 1.1 ** (-step / 50) * float(length))


@pytest.mark.slow
@pytest.mark.parametrize("exponent", get_args(Exponent))
def test_sum_over_members_restrains_an_edit_more_than_the_mean(
    exponent: Exponent, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trainer.paper.losses.EXPONENT", exponent)
    mean = distance_traveled()
    monkeypatch.setattr("trainer.paper.losses.OVER", "sum")
    total = distance_traveled()
    monkeypatch.setattr("trainer.paper.losses.PROGRESSIVE_WEIGHT", 0.0)
    free = distance_traveled()
    assert 5 * total < mean < free


def test_frozen_edit_is_recorded_at_fixed_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trainer.paper.losses.PROGRESSIVE_WEIGHT", 1e4)
    monkeypatch.setattr("trainer.paper.losses.OVER", "sum")
    assert [found.step for found in recolored()] == [8, 16, 24, 32]


# ---- sharpness


def test_sharpness_gradient_matches_finite_differences() -> None:
    image = noise(8, 9, 3).requires_grad_()
    assert torch.autograd.gradcheck(sharpness, image)


def test_sharpness_acts_inside_the_picture_and_rewards_contrast() -> None:
    """Guard against signed Laplacians, whose sum telescopes to the border; that of squares does not."""
    image = noise(20, 20, 3).requires_grad_()
    lost = sharpness(image)
    lost.backward()
    assert image.grad is not None
    assert float(image.grad[2:-2, 2:-2].abs().max()) > 1e-3
    assert float(sharpness(2 * image).detach()) == pytest.approx(4 * float(lost.detach()))


# ---- the objective


def test_every_step_has_all_terms() -> None:
    moved = (noise(5, 14, seed=2) - 0.5).requires_grad_()
    image = noise(8, 9, 3).requires_grad_()
    step = Moment(image, noise(8, 9, 3, seed=1), 0, 100, 0, True, moved, torch.zeros(5, 14))
    for local in range(3):
        terms = PaperObjective(GradientL1(), 1.0).terms(replace(step, local=local))
        assert list(terms) == ["l1", "perceptual", "progressive", "sharpness"]
        assert all(float(term.detach()) for term in terms.values())
