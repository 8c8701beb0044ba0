"""Clamp that keeps useful gradients, and perceptual losses."""

from __future__ import annotations

import pytest
import torch

from progdf.errors import ProgdfError
from progdf.metrics.lpips import Lpips
from trainer.optimize import losses
from trainer.optimize.losses import GradientL1, LpipsLoss, perceptual_loss
from trainer.views.crops import clamp_towards


def test_clamp_has_the_values_of_the_plain_clamp() -> None:
    x = torch.linspace(-2.0, 3.0, 101)
    assert torch.equal(clamp_towards(x, 0.0, 1.0), x.clamp(0.0, 1.0))


def test_clamp_passes_only_gradients_back_into_the_range() -> None:
    x = torch.tensor([-1.0, -1.0, 0.5, 0.5, 2.0, 2.0], requires_grad=True)
    gradient = torch.tensor([-1.0, 1.0, -1.0, 1.0, -1.0, 1.0])  # descent moves against the gradient
    (clamp_towards(x, 0.0, 1.0) * gradient).sum().backward()
    assert x.grad is not None
    assert x.grad.tolist() == [-1.0, 0.0, -1.0, 1.0, 0.0, 1.0]


def test_channel_below_zero_can_be_trained_to_a_positive_color() -> None:
    x = torch.tensor([-0.3], requires_grad=True)
    optimizer = torch.optim.Adam([x], lr=0.05)
    for _ in range(60):
        optimizer.zero_grad()
        (clamp_towards(x, 0.0, float("inf")) - 0.4).abs().sum().backward()
        optimizer.step()
    assert float(x.detach()) == pytest.approx(0.4, abs=0.06)


def test_gradient_l1_is_zero_for_equal_images_and_detects_lost_texture() -> None:
    texture = torch.rand(40, 40, 3, generator=torch.Generator().manual_seed(0))
    measure = GradientL1()
    assert float(measure(texture, texture)) == 0.0
    flat = texture.mean(dim=(0, 1), keepdim=True).expand_as(texture)
    assert float(measure(flat, texture)) > 5 * float(measure(texture + 0.05, texture))


def test_missing_lpips_weights_fall_back_with_a_note(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def absent() -> Lpips:
        raise ProgdfError("the LPIPS weights are not installed; pip install something")

    monkeypatch.setattr(losses.Lpips, "load", absent)
    measure, line = perceptual_loss()
    assert measure.name == "gradient-l1"
    assert "gradient L1" in line
    assert "pip install" in line


def test_cached_lpips_targets_keep_their_values_until_forgotten() -> None:
    try:
        measure = LpipsLoss(Lpips.load())
    except ProgdfError:
        pytest.skip("the LPIPS weights are not installed")
    random = torch.Generator().manual_seed(1)
    image, target, other = (torch.rand(64, 64, 3, generator=random) for _ in range(3))
    plain = float(measure(image, target))
    assert float(measure(image, target, "a")) == plain
    assert float(measure(image, other, "a")) == plain, "the cached target counts"
    measure.forget()
    assert float(measure(image, other, "a")) != plain
