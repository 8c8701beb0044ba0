"""The clamp that keeps useful gradients and the perceptual terms."""

from __future__ import annotations

import pytest
import torch

from progdf.errors import ProgdfError
from progdf.metrics.lpips import Lpips
from trainer.optimize import losses
from trainer.optimize.losses import GradientL1, LpipsLoss, perceptual_loss
from trainer.views.crops import clamp_towards


def test_the_clamp_gives_the_plain_clamps_values() -> None:
    x = torch.linspace(-2.0, 3.0, 101)
    assert torch.equal(clamp_towards(x, 0.0, 1.0), x.clamp(0.0, 1.0))


def test_the_clamp_passes_a_gradient_that_leads_back_into_the_range_and_no_other() -> None:
    x = torch.tensor([-1.0, -1.0, 0.5, 0.5, 2.0, 2.0], requires_grad=True)
    pull = torch.tensor([-1.0, 1.0, -1.0, 1.0, -1.0, 1.0])  # descent goes against it
    (clamp_towards(x, 0.0, 1.0) * pull).sum().backward()
    assert x.grad is not None
    assert x.grad.tolist() == [-1.0, 0.0, -1.0, 1.0, 0.0, 1.0]


def test_a_channel_below_zero_can_be_trained_to_a_color_above_it() -> None:
    x = torch.tensor([-0.3], requires_grad=True)
    optimizer = torch.optim.Adam([x], lr=0.05)
    for _ in range(60):
        optimizer.zero_grad()
        (clamp_towards(x, 0.0, float("inf")) - 0.4).abs().sum().backward()
        optimizer.step()
    assert float(x.detach()) == pytest.approx(0.4, abs=0.06)


def test_the_gradient_stand_in_is_zero_for_equal_images_and_sees_lost_texture() -> None:
    texture = torch.rand(40, 40, 3, generator=torch.Generator().manual_seed(0))
    measure = GradientL1()
    assert float(measure(texture, texture)) == 0.0
    flat = texture.mean(dim=(0, 1), keepdim=True).expand_as(texture)
    assert float(measure(flat, texture)) > 5 * float(measure(texture + 0.05, texture))


def test_absent_lpips_weights_mean_the_stand_in_and_a_line_that_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def absent() -> Lpips:
        raise ProgdfError("the LPIPS weights are not installed; pip install something")

    monkeypatch.setattr(losses.Lpips, "load", absent)
    measure, line = perceptual_loss()
    assert measure.name == "gradient-l1"
    assert "gradient L1" in line
    assert "pip install" in line


def test_cached_lpips_targets_change_nothing_and_are_forgotten_when_told() -> None:
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
